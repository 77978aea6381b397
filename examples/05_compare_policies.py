"""Compare policies: a table with confidence intervals over the same episodes, and a policy of your own in it."""

import numpy as np

from agents import evaluate, make_policy
from khop_env import leader_following_v0


class FollowTheSlot:
    """Full speed towards where the first slot should be: about the simplest policy possible."""

    def reset(self, env, seeds):
        self.layouts = env.layouts

    def act(self, observations):
        actions = {}
        for agent, seen in observations.items():  # (..., columns): one observation, or one per environment
            layout = self.layouts[agent]
            position = seen[..., layout.columns("slot0.position")]
            actions[agent] = np.sign(position - seen[..., layout.columns("slot0.displacement")])
        return actions


env = leader_following_v0.batched_env(num_envs=50)
policies = {name: make_policy(name) for name in ("leader_following", "tanh", "zero")}
frame = evaluate(env, {"own": FollowTheSlot(), **policies}, seeds=range(50))
print(f"leader_following_v0 on {env.scenario}, 50 episodes, on estimates")
for (name,), rows in frame.group_by("policy", maintain_order=True):
    returns = rows["return"]
    print(f"  {name:17s} return {returns.mean():8.2f}   error at the end {rows['final_task_error'].mean():6.3f} m")
best = frame.filter(frame["policy"] == "leader_following")["return"]
more = (frame.filter(frame["policy"] == "own")["return"] - best).to_numpy()
print(
    f"own policy against the tuned law, paired: {more.mean():+.2f} +- {1.96 * more.std(ddof=1) / len(more) ** 0.5:.2f}"
)
