"""`khop train --sweep --ray` gives the numbers of one process; in an environment of its own (make integrations)."""

import tempfile
from pathlib import Path

from agents.learning import Sweep, run_sweep

settings = {"environment": "consensus_v0", "timesteps": 2048, "num_envs": 8, "evaluations": 1}
sweep = Sweep(settings, {"learning_rate": [1e-3, 2e-3]}, seeds=[0])
with tempfile.TemporaryDirectory() as folder:
    here, there = (run_sweep(sweep, Path(folder, str(ray)), ray=ray) for ray in (False, True))
assert all(run.status == "finished" for run in there.runs.values())
assert [run.curve for run in here.runs.values()] == [run.curve for run in there.runs.values()]
print("a sweep on Ray as in one process:")
for name, run in there.runs.items():
    print(f"  {name} {run.curve[-1].mean_return:.3f}")
