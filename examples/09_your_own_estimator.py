"""Write your own estimator over a network: the freshest state as it came, without prediction.

From the command line: khop network paper --estimators relay,examples/09_your_own_estimator.py:LastHeard
"""

import numpy as np

from khop_env.observers import Relay
from khop_env.registry import scenario
from khop_env.results.networks import measure_networks


class LastHeard(Relay):
    """Stamped states are stored, passed on and certified anyway; this only proposes another estimate."""

    name = "last_heard"
    proposed = "last_heard.state"  # its memory; what leaves the certified box is clipped to it

    def prepare(self, design, network, num_envs, first_row):
        pairs = design.knowledge
        self._shape, self._pair = (pairs.size, num_envs), np.asarray(pairs.column_pair)
        self.proposal = np.array(sorted(pairs.slot.values()))  # where each pair's estimate begins

    def allocate(self):
        return {self.proposed: np.zeros(self._shape)}

    def reset(self, memory, env_ids, first_guess):
        memory[self.proposed][:, env_ids] = memory["center"][:, env_ids]

    def receive(self, state, take, due):
        fresh = (state.memory["arrived"] == state.t)[self._pair]  # by number of each pair, and environment
        state.memory[self.proposed][fresh] = state.memory["center"][fresh]


if __name__ == "__main__":
    from agents import make_law

    paper = scenario("paper")
    for row in measure_networks(paper, make_law(paper.law), ["wifi"], ["relay", LastHeard()], episodes=4, duration=5.0):
        print(f"{row.estimator:10}  mean error {row.mean_error:.4f} m, mean certified bound {row.mean_bound:.4f} m")
