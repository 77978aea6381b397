"""`khop evaluate --ray` gives numbers and files of one machine; in an environment of its own (make integrations)."""

import tempfile
from pathlib import Path

from agents import compare

arguments = {
    "policies": ["linear", "random"],
    "observe": ("estimate", "local"),
    "scenario": "mixed_fleet",
    "seeds": range(60),
}
with tempfile.TemporaryDirectory() as folder:
    roots = Path(folder, "here"), Path(folder, "there")
    here = compare("consensus_v0", **arguments, record=roots[0])
    there = compare("consensus_v0", **arguments, record=roots[1], ray=True)
    files = [{str(file.relative_to(root)): file.read_bytes() for file in root.rglob("*.parquet")} for root in roots]
assert files[0] == files[1]
assert here.summary() == there.summary()
assert here.frame().equals(there.frame())
print("on Ray as on one machine:")
for row in there.rows:
    print(f"  {row.label} {row.episodes.returns.mean():.3f}")
