"""Simulate a mixed fleet: twelve agents of four types meet, disturbed by gusts, noise and each other."""

from pathlib import Path

from agents import make_law
from khop_env.registry import scenario
from khop_env.results import paper_figure, record

fleet = scenario("mixed_fleet")
simulator = fleet.build(law=make_law(fleet.law))
simulator.reset(seed=0)
recording = record(simulator, duration=20.0, dt=fleet.dt)

out = Path("runs/examples")
out.mkdir(parents=True, exist_ok=True)
print(f"{fleet.fleet}, {fleet.communication.number_of_edges()} links")
for second in (0, 5, 10, 20):
    positions = fleet.fleet.positions(recording.x[recording.time.searchsorted(second)])
    spread = (positions.max(axis=0) - positions.min(axis=0)).round(2)
    print(f"t = {second:2d} s: the team fills a box of {spread[0]} m x {spread[1]} m")
print("figure:", paper_figure(recording, fleet, out / "01_simulate.png"))
