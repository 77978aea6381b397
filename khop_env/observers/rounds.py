"""The paper's observers by implicit rounds: each agent solves its own scalar equations with what it got last.

With the last estimates and relayed states that it holds, observer a of target i solves, once a round and with the
period as the step tau,

    y - y* + tau phi'(e) / rho = 0,    e = (d y - sum of what it holds) / rho,

d values in all: the row of M_i that is its own. It is the proximal step of `solve` on one row, so |e| < 1 whatever
has arrived, and with many rounds in the place of one the rows agree on the proximal step of all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled, place
from khop_env.network import Network
from khop_env.observers.base import Extremes, Memory, PlantState
from khop_env.observers.design import ObserverDesign
from khop_env.observers.drifts import Drifts
from khop_env.observers.estimators import Take
from khop_env.observers.indexing import ranges
from khop_env.observers.layout import FloatArray, IntArray, PairLayout
from khop_env.observers.scalar import solve_alone
from khop_env.threads import Range

_OF_STATES = "ppso.held", "ppso.eps", "ppso.estimate", "ppso.normalized"
_OF_INPUTS = "ppso.input_held", "ppso.input_eps", "ppso.input_estimate", "ppso.input_normalized"
_SENT = "ppso.estimate", "ppso.input_estimate", "ppso.neighbor_input"


class _Held(NamedTuple):
    """What the observers of one layout hold of others' messages, each value in the place of (pair, source, component).

    Attributes:
        link: (C,) over which it comes.
        row: (C,) its row in what all agents send.
        start: (pairs + 1,) where each pair's sources begin, counted in sources.
        offset: (pairs,) place of a pair's first value.
        source: (C,) index in the fleet's vector of the component it is about.
    """

    link: IntArray
    row: IntArray
    start: IntArray
    offset: IntArray
    source: IntArray


class Rounds:
    """The paper's observers of states and inputs (PPSO and PPIO), by one implicit solve per agent, target and round.

    What is held is used as it came: neither predicted nor aged. All of its memory begins with "ppso.": "estimate" and
    "input_estimate", "held" and "input_held" of other agents, "neighbor_input", the inputs last heard of neighbours,
    and of the last round "eps", "input_eps" and the disagreements over their funnels, "normalized" and
    "input_normalized". Methods also work on a `part` of the environments and touch no others.

    Attributes:
        divisible: as that of `Drifts`: whether `predict` may be called so in several threads at once; once prepared.
    """

    name = "ppso"
    proposed = "ppso.estimate"

    def prepare(self, design: ObserverDesign, network: Network, num_envs: int, first_row: int) -> None:
        """Find the places of what observers of `design` hold in messages, whose rows begin at `first_row`.

        Rounds last the `network`'s period, in `num_envs` environments.
        """
        self._design, self._num_envs, self._period, self._all = design, num_envs, network.period, (0, num_envs)
        fleet, knowledge, states, inputs = design.fleet, design.knowledge, design.states.layout, design.inputs.layout
        self.proposal = np.array(
            [
                states.slot.get((a, i), -1)
                for i, a in zip(knowledge.pair_target.tolist(), knowledge.observer.tolist(), strict=True)
            ],
            np.int64,
        )
        self._neighbors = np.flatnonzero(knowledge.arrays.relay)  # pairs (agent, neighbour)
        # rows: own g (n), estimates (P), input estimates (Q), the inputs last heard of neighbours
        own_input, estimate = first_row, first_row + fleet.n
        input_estimate = estimate + states.size
        neighbor_input = input_estimate + inputs.size
        place, columns, links = dict[tuple[int, int], int](), list[int](), list[int]()
        for pair in self._neighbors.tolist():
            a, i = int(knowledge.observer[pair]), int(knowledge.pair_target[pair])
            place[a, i] = len(columns)
            columns += range(fleet.state_slice(i).start, fleet.state_slice(i).stop)
            links += [design.links.index[i, a]] * fleet.models[i].n
        self._input_link, self._input_row = np.array(links, np.int64), own_input + np.array(columns, np.int64)
        self.width = fleet.n + states.size + inputs.size + len(columns)
        known = {pair: 1 + fleet.n + start for pair, start in knowledge.slot.items()}
        heard = {pair: neighbor_input + start for pair, start in place.items()}
        self._states = _held(states, estimate, 1, known)
        self._inputs = _held(inputs, input_estimate, own_input, heard)
        self._rho, self._omega = np.ones((states.rows, num_envs)), np.ones((inputs.rows, num_envs))
        self._drifts = Drifts.known_in(design, num_envs)
        self.divisible = self._drifts.divisible
        self._rate = np.zeros((states.size, num_envs))
        self._input = np.full(states.size, -1)  # row of the input estimate that belongs to each estimate
        for who, first in inputs.slot.items():
            n = fleet.models[who[1]].n
            self._input[states.slot[who] : states.slot[who] + n] = np.arange(first, first + n)

    def allocate(self) -> Memory:
        """See the class."""
        batch, states, inputs = self._num_envs, self._design.states.layout, self._design.inputs.layout
        return {
            "ppso.estimate": np.zeros((states.size, batch)),
            "ppso.input_estimate": np.zeros((inputs.size, batch)),
            "ppso.held": np.zeros((len(self._states.link), batch)),
            "ppso.input_held": np.zeros((len(self._inputs.link), batch)),
            "ppso.neighbor_input": np.zeros((len(self._input_link), batch)),
            "ppso.eps": np.zeros((states.size, batch)),
            "ppso.input_eps": np.zeros((inputs.size, batch)),
            "ppso.normalized": np.zeros((states.size, batch)),
            "ppso.input_normalized": np.zeros((inputs.size, batch)),
        }

    def reset(self, memory: Memory, env_ids: IntArray, first_guess: FloatArray) -> None:
        """Start estimates and what is held from `first_guess`, inputs from 0, in the environments `env_ids`."""
        for name in self.allocate():
            memory[name][:, env_ids] = 0.0
        memory["ppso.estimate"][:, env_ids] = first_guess[self._design.states.layout.column_source][:, None]
        memory["ppso.held"][:, env_ids] = first_guess[self._states.source][:, None]

    def predict(self, memory: Memory, t: FloatArray, dt: float, part: Range | None = None) -> None:
        """Y += dt (f(y) + g_hat), explicit Euler as in the proximal step of order 1.

        Args:
            memory: whose estimates move.
            t: (B,) times at the beginning in s.
            dt: in s.
            part: the range of environments; None for all.
        """
        low, high = part or self._all
        estimate = memory["ppso.estimate"]
        self._drifts.evaluate(estimate, t[low:high, None], self._rate, (low, high))
        predict(self._rate, memory["ppso.input_estimate"], self._input, dt, estimate, low, high)

    def message(self, state: PlantState) -> list[FloatArray]:
        """Own inputs' effects, estimates of states and inputs, and the inputs' effects last heard of neighbours."""
        memory = state.memory
        self._design.states.rho.evaluate(state.t, self._rho)  # for `receive`
        self._design.inputs.rho.evaluate(state.t, self._omega)
        return [state.g, *(memory[name] for name in _SENT)]

    def receive(self, state: PlantState, take: Take, due: NDArray[np.bool_], part: Range | None = None) -> None:
        """Hold what has come, and solve in the environments that are `due`.

        Args:
            state: at the time of the round.
            take: fetches values of messages.
            due: (B,) environments in which there is a round.
            part: the range of environments; None for all.
        """
        memory, design, (low, high) = state.memory, self._design, part or self._all
        take(self._input_link, self._input_row, memory["ppso.neighbor_input"])
        for held, funnels, widths, names in (
            (self._states, design.states, self._rho, _OF_STATES),
            (self._inputs, design.inputs, self._omega, _OF_INPUTS),
        ):
            if not funnels.layout.size:
                continue
            values, eps, estimate, normalized = (memory[name] for name in names)
            take(held.link, held.row, values)
            packed, period = funnels.layout.packed, self._period
            solve_alone(
                packed, held.start, held.offset, period, values, widths, due, eps, estimate, normalized, low, high
            )
        memory["input_estimate"][:, low:high] = memory["ppso.input_estimate"][:, low:high]

    def raise_extremes(self, state: PlantState, extremes: Extremes, part: Range | None = None) -> None:
        """Raise the largest |xi| / rho and |mu| / omega, of the disagreements at the last round."""
        memory, (low, high) = state.memory, part or self._all
        largest_size(memory["ppso.normalized"], extremes.normalized, low, high)
        largest_size(memory["ppso.input_normalized"], extremes.input_normalized, low, high)


@compiled
def predict(
    rate: FloatArray, inputs: FloatArray, input_of: IntArray, dt: float, estimate: FloatArray, low: int, high: int
) -> None:
    """Move estimates (P, B) by `dt` s at their rates (P, B) plus rows `input_of` (P,) of `inputs`, -1 for none.

    In environments `low` to `high` - 1.
    """
    for q in range(estimate.shape[0]):
        own = input_of[q]
        if own < 0:
            for e in range(high - low):
                b = place(low + e)
                estimate[q, b] += rate[q, b] * dt
        else:
            for e in range(high - low):
                b = place(low + e)
                estimate[q, b] += (rate[q, b] + inputs[own, b]) * dt


@compiled
def largest_size(values: FloatArray, largest: FloatArray, low: int, high: int) -> None:
    """Raise `largest` (B,) to the largest |value| of any row (rows, B), in environments `low` to `high` - 1."""
    for q in range(values.shape[0]):
        for e in range(high - low):
            b = place(low + e)
            size, most = abs(values[q, b]), largest[b]
            largest[b] = size if not size <= most and most == most else most  # a NaN stays


def _held(layout: PairLayout, estimate: int, own: int, relayed: dict[tuple[int, int], int]) -> _Held:
    """Places of what the observers of a layout hold: others' estimates, then relayed values, pair by pair.

    Args:
        layout: the pairs.
        estimate: row at which their estimates begin in what is sent.
        own: row at which the fleet's own values begin.
        relayed: (relaying agent, target) -> row of the target's value in what that agent sends.
    """
    arrays, count = layout.arrays, layout.pairs
    target, components = layout.pair_target, np.repeat(arrays.components, arrays.observers)
    columns, sources = (np.repeat(each, arrays.observers) for each in (arrays.column, arrays.source))
    of_entry = np.repeat(np.arange(count), np.diff(arrays.entry_start))
    of_relay = np.repeat(np.arange(count), np.diff(layout.relay_start))
    relaying = zip(layout.links.sender[layout.relay_link].tolist(), target[of_relay].tolist(), strict=True)
    own_values = (own + sources[of_relay]).tolist()
    relays = [value if p == i else relayed[p, i] for (p, i), value in zip(relaying, own_values, strict=True)]
    pair = np.concatenate([of_entry, of_relay])
    order = np.argsort(pair, kind="stable")
    pair = pair[order]
    link = np.concatenate([layout.entry_link, layout.relay_link])[order]
    first = np.concatenate([estimate + columns[of_entry] + arrays.entry * components[of_entry], relays])[order]
    size = components[pair]  # of each value that is held
    start = np.concatenate([[0], np.cumsum(np.bincount(pair, minlength=count))])
    way, row = ranges(first.astype(np.int64), size)
    _, source = ranges(sources[pair], size)
    offset = np.concatenate([[0], np.cumsum(size)])[start[:-1]]
    return _Held(link[way], row, start, offset, source)
