"""`khop evaluate --ray` gives the numbers of one machine; in an environment of its own (make integrations)."""

from agents import compare

arguments = {
    "policies": ["linear", "random"],
    "observe": ("estimate", "local"),
    "scenario": "mixed_fleet",
    "seeds": range(60),
}
here = compare("consensus_v0", **arguments)
there = compare("consensus_v0", **arguments, ray=True)
assert here.summary() == there.summary()
assert here.frame().equals(there.frame())
print("on Ray as on one machine:")
for row in there.rows:
    print(f"  {row.label} {row.episodes.returns.mean():.3f}")
