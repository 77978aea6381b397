"""Watch the beliefs: what one follower thinks of agents that it can't hear, and how far it can be wrong."""

from pathlib import Path

from matplotlib.image import imsave

from agents import describe, make_policy
from khop_env import leader_following_v0

env = leader_following_v0.parallel_env(bounds=True, render_mode="rgb_array")
policy = make_policy("leader_following")
policy.reset(describe(env), seeds=[0])
observations, infos = env.reset(seed=0)
agent = env.agents[0]
layout = env.layout(agent)
slot = next(number for number, slot in enumerate(layout.slots) if not slot.heard)
target = env.batched.fleet.agent(layout.slots[slot].id)

print(f"{agent} can't hear {layout.slots[slot].id}, {layout.slots[slot].hops} hops away")
print("  t (s)   it believes (m)     the truth (m)     error   guaranteed")
for cycle in range(1, 41):
    observations, *_ = env.step(policy.act(observations))
    if cycle in (1, 2, 4, 8, 16, 40):
        seen = layout.read(observations[agent])
        own = [seen[name] for name in layout.names[:2]]
        belief = [seen[f"slot{slot}.position.{axis}"] + mine for axis, mine in zip("xy", own, strict=True)]
        truth = env.batched.fleet.positions(env.batched.simulator.x)[0, target]  # no policy gets to see this
        error = max(abs(believed - true) for believed, true in zip(belief, truth, strict=True))
        print(
            f"  {cycle * 0.05:4.2f}   ({belief[0]:6.3f}, {belief[1]:6.3f})  ({truth[0]:6.3f}, {truth[1]:6.3f})"
            f"   {error:.4f}   {seen[f'slot{slot}.bound.x1']:.4f}"
        )

out = Path("runs/examples")
out.mkdir(parents=True, exist_ok=True)
imsave(out / "02_beliefs.png", env.render())
print("frame:", out / "02_beliefs.png")
