"""One process per robot, datagrams between them; one robot is killed, and comes back while the others go on.

`khop deploy` on the command line, and here what its tables say about that robot. docs/guides/robots.md tells what to
replace for robots of your own.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import polars as pl

ROBOT, KILLED, RESTARTED = "integrator_2", 1.0, 2.0  # times in s

with tempfile.TemporaryDirectory() as folder:
    out = str(Path(folder) / "run")
    command = [sys.executable, "-m", "khop_env", "deploy", "random_geometric:agents=4,k=2", "--duration", "5"]
    command += ["--network", "lossy:loss=0.2", "--estimator", "relay", "--kill", f"{ROBOT}@{KILLED}:{RESTARTED}"]
    printed = subprocess.run([*command, "--out", out, "--json"], check=True, capture_output=True, text=True).stdout
    summary = json.loads(printed)
    table = pl.read_parquet(Path(out) / "estimates.parquet")

print(f"{summary['agents']} processes, {summary['network']}")
print("t (s)   what others know of it: age (s)   certified (m)   error (m)   what it certifies of others")
for t in (0.5, 0.95, 1.5, 2.0, 3.5, 4.5, 5.0):
    now = table.filter(pl.col("time") == t)
    others = now.filter((pl.col("target") == ROBOT) & (pl.col("component") == "x"))
    own = now.filter(pl.col("observer") == ROBOT)["bound"].max()
    certified = "nothing: away" if own == float("inf") else f"up to {own:.2f} m"
    age, bound, error = others["age"].max(), others["bound"].max(), others["error"].abs().max()
    print(f"{t:5.2f}   {age:32.2f}   {bound:13.3f}   {error:9.3f}   {certified}")
deployed = summary["deploy"]
print(f"errors above their certified bounds: {summary['violations']} of {summary['pair_samples']}")
print(f"messages: {deployed['messages']}, {deployed['message_bytes']} bytes; away: ", end="")
print({agent: each["away_rounds"] for agent, each in deployed["agents"].items() if each["away_rounds"]})
