"""Keeping apart from agents that nobody hears: the same filter on point estimates, and on estimates with bounds.

Messages are lost in bursts, so that what agents know of each other may be old. docs/benchmarks/safety.md says what is
certain.
"""

from agents import compare

EPISODES = 10

comparison = compare(
    "navigation_v0",
    ["keep_right", "filter:margin=none", "filter"],
    ["estimate"],
    scenario="swap:agents=6,duration=20",
    seeds=range(EPISODES),
)
print(f"6 robots swap places, 30 % of the messages are lost in bursts; {EPISODES} episodes each")
print("policy                        collided   arrived safely   smallest distance (m)   changed by the filter (m/s)")
for row in comparison.rows:
    seen = row.summary()
    changed = "" if seen["intervention"] is None else f"{seen['intervention']:.3f}"
    print(
        f"{row.policy:28}  {100 * seen['collision_rate']:6.0f} %   {100 * seen['success_rate']:12.0f} %   "
        f"{seen['min_distance']:21.3f}   {changed:>27}"
    )
