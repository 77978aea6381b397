"""Observers that know of others by messages only: sampled, lost, late, and over links that come and go.

Every period each agent broadcasts one message: the time, its own state, and for every agent up to k hops away that it
has heard of the freshest state that has reached it, with its age. So states are stored and forwarded, predicted by the
models in the meantime, and each lies in a box that the age alone certifies (docs/theory/certificates.md). An estimator
adds what it wants to send, and estimates inside the boxes.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from khop_env.network import Channel, Network
from khop_env.observers.base import Assumptions, Certified, Extremes, Information, Memory, Observers, Plant, PlantState
from khop_env.observers.certified import ages, report
from khop_env.observers.design import ObserverDesign
from khop_env.observers.estimators import Estimator
from khop_env.observers.exchange import CHANNEL, Exchange
from khop_env.observers.known_estimators import as_estimator, require_memory, require_own_names
from khop_env.observers.layout import FloatArray, IntArray
from khop_env.observers.merging import Sources, largest_share
from khop_env.observers.proximal import MOST_THREADS
from khop_env.observers.reckoning import Reckoning, certificates_of
from khop_env.observers.scalar import LANES
from khop_env.observers.steps import Plan, Step, note_length
from khop_env.physics import hops_from_targets
from khop_env.threads import Range, Threads

T = TypeVar("T")


class Networked:
    """Observers over a network of messages; an `Observers`.

    The plant moves by explicit Euler steps, as with `Proximal(order=1)`, and a law's inputs are kept within the models'
    limits, on which the certificates rest. Rounds take place at the first grid point at or after each multiple of the
    network's period. Equal steps are usual: a message counts as lost if steps of another length have begun while it was
    on its way, for longer than one step.

    Args:
        network: how often agents send, and what becomes of messages; anything that `Network.of` reads.
        estimator: a name of `ESTIMATORS`, or an `Estimator`.
        message_size: numbers that each agent's policy adds to its message. They are stored and forwarded with its
            state: the memory `said` (N * message_size, B) is sent, `data` (pairs * message_size, B) has arrived.
        threads: number of threads that share the environments; results don't depend on it. An estimator of your own
            is called with all of them at once, on one thread.

    Attributes:
        network: a `Network`.
        estimator: this object's own copy.
        channel: the links; once prepared.
        pool: the threads; once prepared.
        uncertified: agents whose state has no bound in some component, by index, and why; once prepared.

    Raises:
        ValueError: for an unknown network or estimator, or if threads is out of range.
    """

    name = "networked"
    order = 1
    by_messages = True
    copied = False

    def __init__(
        self,
        network: Network | Mapping[str, object] | str,
        estimator: str | Estimator = "ppso",
        message_size: int = 0,
        threads: int = 1,
    ) -> None:
        found = Network.of(network)
        if found is None:
            raise ValueError("Networked needs a network, e.g. 'wifi'; without one states are exchanged continuously")
        self.network, self.estimator, self.message_size = found, as_estimator(estimator), message_size
        if isinstance(threads, bool) or not isinstance(threads, int | np.integer) or not 1 <= threads <= MOST_THREADS:
            raise ValueError(f"threads must be an integer from 1 to {MOST_THREADS}; got {threads!r}")
        self.threads = int(threads)

    def __repr__(self) -> str:
        return f"Networked({self.network.described()}; {self.estimator.name})"

    def prepare(self, design: ObserverDesign, num_envs: int, assumed: Assumptions) -> None:
        """Allocate buffers, and tabulate the certificates."""
        fleet, layout = design.fleet, design.knowledge
        self.design, self.num_envs, self.layout, self._assumed = design, num_envs, layout, assumed
        received = certificates_of(design, assumed, self.network.noise)
        self.uncertified = {i: each.reason for i, each in enumerate(received) if each.reason}
        self._reckoning = Reckoning(layout, received, num_envs)
        self.longest_step = min(self.network.period, self._reckoning.longest_step)
        sources = Sources.of(layout, fleet.n, len(fleet), self.message_size)
        self._pairs = sources.column, sources.components
        regions = np.concatenate([each.region for each in received])
        self._region = regions[layout.column_source]
        self.estimator = copy.copy(self.estimator)  # its buffers are this object's own
        shared = 1 + fleet.n + 2 * (layout.size + layout.pairs) + self.message_size * (len(fleet) + layout.pairs)
        self.estimator.prepare(design, self.network, num_envs, shared)
        require_memory(self.estimator, sources.components)
        self.pool = Threads(self.threads)
        self._ranges = self.pool.ranges(num_envs, LANES)
        self._light = self.pool.worthwhile(num_envs, layout.pairs)
        self.channel = Channel(self.network, design.links, num_envs, shared + self.estimator.width)
        self._exchange = Exchange(self.channel, self.estimator, sources, fleet.n, self.pool)
        self._activity = None if design.schedule is None else design.activity()
        self._up = np.ones((len(design.links), num_envs), np.bool_)
        hops = hops_from_targets(design.communication, design.k)
        pairs = zip(layout.pair_target.tolist(), layout.observer.tolist(), strict=True)
        self._distance = np.array([hops[a][i] for i, a in pairs], float)
        self._plan_steps()

    def allocate(self) -> Memory:
        """Predictions from what was received, its stamps and ways, the estimates, their bounds; channel; estimator."""
        (size, pairs), batch = (self.layout.size, self.layout.pairs), self.num_envs
        memory = {
            "estimate": np.zeros((size, batch)),
            "input_estimate": np.zeros((self.design.inputs.layout.size, batch)),
            "bound": np.zeros((size, batch)),
            "center": np.zeros((size, batch)),
            "error": np.zeros((size, batch)),
            "stamp": np.zeros((pairs, batch)),
            "hops": np.zeros((pairs, batch)),
            "arrived": np.zeros((pairs, batch)),
            "said": np.zeros((len(self.design.fleet) * self.message_size, batch)),
            "data": np.zeros((pairs * self.message_size, batch)),
            "step": np.zeros(batch),
            "even_since": np.zeros(batch),
            **self._exchange.allocate(),
        }
        own = self.estimator.allocate()
        require_own_names(self.estimator, own, memory)
        return memory | own

    def reset(
        self, state: PlantState, env_ids: IntArray, rngs: Sequence[np.random.Generator], first_guess: FloatArray
    ) -> None:
        """Start from `first_guess` in the environments `env_ids`, and run their first round."""
        memory = state.memory
        memory["center"][:, env_ids] = first_guess[self.layout.column_source][:, None]
        memory["error"][:, env_ids] = self._assumed.radius[self.layout.column_source][:, None]
        for name in ("stamp", "arrived"):
            memory[name][:, env_ids] = -1.0
        for name in ("hops", "input_estimate", "said", "data", "step", "even_since"):
            memory[name][..., env_ids] = 0.0
        channel = self._exchange.of_channel(memory)
        self.channel.reset(channel, env_ids, rngs)
        heard = channel["heard"].copy()
        self.estimator.reset(memory, env_ids, first_guess)
        due = np.zeros(self.num_envs, np.bool_)
        due[env_ids] = True
        self._carry_out(self._first_round, Step(state, channel, due, self.links_up(state)))
        np.copyto(channel["heard"], heard, where=~due)  # the others' last round is as it was

    def advance(self, plant: Plant, before: PlantState, state: PlantState, dt: float) -> None:
        """Advance `state`, a copy of `before`, by `dt` seconds, and run the round that is due then, if any.

        Raises:
            SolveError: if a state isn't finite.
        """
        memory = state.memory
        plant.stage(0, np.array([dt]), dt, before, state)  # first: nothing has changed yet if it raises
        plant.effect(state)
        channel = self._exchange.of_channel(memory)
        due = self.channel.due(channel, state.t)
        note_length(dt, before.t, memory["step"], memory["even_since"])
        self._carry_out(self._whole_step, Step(state, channel, due, self.links_up(state), before.t, dt))
        plant.actuate(state)

    def bound(self, state: PlantState, out: FloatArray) -> Certified:
        """The certified bound: the distance from each estimate to the farther face of its box; inf without one."""
        bound = state.memory["bound"]
        self._run(lambda part: np.copyto(out[:, slice(*part)], bound[:, slice(*part)]))
        return Certified(out, "certificate")

    def links_up(self, state: PlantState) -> NDArray[np.bool_] | None:
        """(L, B) whether each link of the design is up, overwritten by the next call; None where all are, always."""
        if self._activity is None:
            return None
        return self._activity.up(state.memory[CHANNEL + "key"], state.t, state.x, self._up)

    def drawn(self, state: PlantState) -> list[Network]:
        """The network of each environment's episode: `network` with what was drawn in place of ranges."""
        return [self.network.drawn(key) for key in state.memory[CHANNEL + "key"].tolist()]

    def information(self, state: PlantState) -> Information:
        """Age, way and time of arrival of the newest state that each pair has received."""
        stamp, arrived = state.memory["stamp"], state.memory["arrived"]
        age, since = np.empty(stamp.shape), np.empty(stamp.shape)
        self._run(lambda part: ages(state.t, stamp, arrived, age, since, *part))
        return Information(age, state.memory["hops"], since)

    def limits(self, state: PlantState, out: FloatArray) -> FloatArray:
        """The information limit: certified radii at the age that a state has at least, were no message lost.

        It is what no estimator can do better than, with this network's period and each episode's smallest latency.

        Returns:
            `out` (P, B), written.
        """
        h, period = float(state.memory["step"].max()) or self.longest_step, self.network.period
        round_ = state.memory[CHANNEL + "round"]
        late = np.array([network.fewest_rounds_late for network in self.drawn(state)], float)
        rounds = np.where(late > 0.0, self._distance[:, None] * late, self._distance[:, None] - 1.0)
        since = np.maximum(state.t - round_ * period, 0.0)
        grid = np.floor((since + rounds * period) / h + 1e-6).astype(np.int64)
        source = self.layout.column_source
        from_start = self._reckoning.radii(
            np.broadcast_to(np.rint(state.t / h).astype(np.int64), grid.shape), self._assumed.radius[source], h
        )
        received = self._reckoning.radii(grid, np.full(len(source), self.network.noise), h)
        out[...] = np.where((round_ < rounds)[self.layout.column_pair], from_start, received)
        return np.minimum(out, self._region[:, None], out=out)

    def raise_extremes(self, state: PlantState, extremes: Extremes) -> None:
        """Raise running maxima: errors over certified bounds, and the estimator's own |xi| / rho."""
        source, memory, own = self.layout.column_source, state.memory, self._exchange.own

        def raised(part: Range) -> None:
            largest_share(source, memory["estimate"], state.x, memory["bound"], extremes.relative, *part)
            if own is not None:
                own.raise_extremes(state, extremes, part)

        self._run(raised)
        if own is None:
            self.estimator.raise_extremes(state, extremes)

    # -- parts ---------------------------------------------------------------------------------------------------

    def _run(self, work: Callable[[Range], T]) -> list[T]:
        """Results of `work`, of about a number for each pair, on all environments, in threads where that pays."""
        return self.pool.run(work, self._light)

    def _plan_steps(self) -> None:
        """Decide which work may be divided."""
        own, reckoning = self._exchange.own, self._reckoning.divisible
        begin = [(Networked._begin, True)]
        move = [
            (Networked._catch_up, reckoning),
            (Networked._predict, own is not None and own.divisible),
            (Networked._move, reckoning),
        ]
        end = [
            (Networked._compose, own is not None),
            (Networked._send, True),
            (Networked._receive, own is not None),
            (Networked._report, True),
        ]
        self._whole_step, self._first_round = Plan([*begin, *move, *end]), Plan([*begin, *end])

    def _carry_out(self, plan: Plan[Networked], step: Step) -> None:
        if self._exchange.own is not None and step.rounds:
            step.parts = self._exchange.parts(step.state)  # of the library's estimators: here, on one thread
        plan.carry_out(self, step, self.pool, self._ranges)

    def _begin(self, step: Step, part: Range) -> None:
        """Decide what arrives; take over what has been on its way."""
        self._exchange.begin(step.channel, step.state, step.up, step.due, part)
        # as if late messages had arrived at the last grid point, and what they say had been moved from there
        if step.dt and step.rounds and self._exchange.merge_late(step.channel, step.state, step.t, part):
            step.behind.add(part)

    def _catch_up(self, step: Step, part: Range) -> None:
        if any(part[0] <= first < part[1] for first, _ in step.behind):
            memory = step.state.memory
            lag = self._exchange.lag
            self._reckoning.catch_up(memory["center"], memory["error"], step.t, lag, step.dt, part)

    def _predict(self, step: Step, part: Range) -> None:
        own, memory = self._exchange.own, step.state.memory
        if own is None:
            self.estimator.predict(memory, step.t, step.dt)
        else:
            own.predict(memory, step.t, step.dt, part)

    def _move(self, step: Step, part: Range) -> None:
        memory = step.state.memory
        self._reckoning.advance(memory["center"], memory["error"], step.t, step.dt, part)

    def _compose(self, step: Step, part: Range) -> None:
        if self._exchange.own is None and step.rounds:
            step.parts = self._exchange.parts(step.state)

    def _send(self, step: Step, part: Range) -> None:
        if step.rounds:
            self._exchange.send(step.channel, step.state, step.due, step.parts, part)

    def _receive(self, step: Step, part: Range) -> None:
        if step.rounds:
            self._exchange.receive(step.channel, step.state, step.due, part)

    def _report(self, step: Step, part: Range) -> None:
        self._clip(step.state.memory, part)

    def _clip(self, memory: Memory, part: Range) -> None:
        """Estimates and bounds, from predictions and what the estimator proposes."""
        report(
            *self._pairs,
            self.estimator.proposal,
            self._region,
            memory["center"],
            memory["error"],
            memory[self.estimator.proposed] if self.estimator.proposed else memory["center"],
            memory["estimate"],
            memory["bound"],
            *part,
        )


def missed_rounds(observers: Observers, state: PlantState) -> FloatArray:
    """(L, B) rounds by which the newest message over each link is older than one that comes on time.

    It is inf where nothing has arrived, and 0 for observers without rounds.
    """
    if not isinstance(observers, Networked):
        return np.zeros((len(observers.layout.links), len(state.t)))
    newest = state.memory[CHANNEL + "newest"]
    on_time = [network.most_rounds_late for network in observers.drawn(state)]
    missed = state.memory[CHANNEL + "round"] - newest - on_time
    return np.where(newest < 0, math.inf, np.maximum(missed, 0))
