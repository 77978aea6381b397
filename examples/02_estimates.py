"""Look at estimates: those of one follower about a k-hop target, their errors, and the guaranteed bounds."""

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

print(f"{agent} estimates {layout.slots[slot].id}, which is {layout.slots[slot].hops} hops away")
print("  t (s)   estimate (m)        true state (m)    error    bound")
for cycle in range(1, 41):
    observations, *_ = env.step(policy.act(observations))
    if cycle in (1, 2, 4, 8, 16, 40):
        seen = layout.read(observations[agent])
        own = [seen[name] for name in layout.names[:2]]
        estimate = [seen[f"slot{slot}.position.{axis}"] + p for axis, p in zip("xy", own, strict=True)]
        truth = env.batched.fleet.positions(env.batched.simulator.x)[0, target]  # not part of any observation
        error = max(abs(estimated - true) for estimated, true in zip(estimate, truth, strict=True))
        print(
            f"  {cycle * 0.05:4.2f}   ({estimate[0]:6.3f}, {estimate[1]:6.3f})  ({truth[0]:6.3f}, {truth[1]:6.3f})"
            f"   {error:.4f}   {seen[f'slot{slot}.bound.x1']:.4f}"
        )

out = Path("runs/examples")
out.mkdir(parents=True, exist_ok=True)
imsave(out / "02_estimates.png", env.render())
print("frame:", out / "02_estimates.png")
