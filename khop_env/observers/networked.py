"""Observers that know of others by messages only: sampled, lost, late, and over links that come and go.

Every period each agent broadcasts one message: the time, its own state, and for every agent up to k hops away that it
has heard of the freshest state that has reached it, with its age. So states are stored and forwarded, predicted by the
models in the meantime, and each lies in a box that the age alone certifies (docs/theory_certificates.md). An estimator
adds what it wants to send, and estimates inside the boxes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.network import Channel, Network
from khop_env.observers.base import Assumptions, Certified, Extremes, Information, Memory, Plant, PlantState
from khop_env.observers.certificate import Certificate
from khop_env.observers.certified import CertifiedBoxes
from khop_env.observers.design import ObserverDesign
from khop_env.observers.estimators import Estimator, as_estimator
from khop_env.observers.layout import FloatArray, IntArray
from khop_env.observers.merging import Sources, largest_share, merge
from khop_env.observers.reckoning import Reckoning
from khop_env.physics import AgentModel, hops_from_targets

_CHANNEL = "channel."


class Networked:
    """Observers over a network of messages; an `Observers`.

    The plant moves by Runge-Kutta steps of order 4, and its inputs are kept within the models' limits, on which the
    certificates rest. Rounds take place at the first grid point at or after each multiple of the network's period.

    Args:
        network: how often agents send, and what becomes of messages; anything that `Network.of` reads.
        estimator: a name of `ESTIMATORS`, or an `Estimator`.

    Attributes:
        network: a `Network`.
        estimator: this object's own copy.
        channel: the links; once prepared.
        boxes: the certified boxes of all pairs; once prepared.

    Raises:
        ValueError: for an unknown network or estimator.
    """

    name = "networked"
    order = 1
    by_messages = True

    def __init__(self, network: Network | Mapping[str, object] | str, estimator: str | Estimator = "ppso") -> None:
        found = Network.of(network)
        if found is None:
            raise ValueError("Networked needs a network, e.g. 'wifi'; without one states are exchanged continuously")
        self.network, self.estimator = found, as_estimator(estimator)

    def __repr__(self) -> str:
        return f"Networked({self.network.described()}; {self.estimator.name})"

    @property
    def longest_step(self) -> float:
        """Simulators divide steps so that no round is left out, in s."""
        return self.network.period

    def prepare(self, design: ObserverDesign, num_envs: int, assumed: Assumptions) -> None:
        """Allocate buffers, and tabulate the certificates."""
        fleet, layout = design.fleet, design.knowledge
        self.design, self.num_envs, self.layout, self._assumed = design, num_envs, layout, assumed
        received, initial = _certificates(design, assumed, self.network.noise)
        self.boxes = CertifiedBoxes(layout, received, initial)
        self._reckoning = Reckoning(layout, fleet.models, [each.growth for each in received], num_envs)
        self._sources: Any = tuple(Sources.of(layout, fleet.n))
        shared = 1 + fleet.n + layout.size + 2 * layout.pairs
        self.estimator.prepare(design, self.network, num_envs, shared)
        self.channel = Channel(self.network, design.links, num_envs, shared + self.estimator.width)
        self._proposal = self.estimator.proposal
        self._lag = np.zeros((layout.pairs, num_envs))
        self._fastest = self._fastest_ages()

    def allocate(self) -> Memory:
        """Predictions from what was received, its stamps and ways, the estimates, their bounds; channel; estimator."""
        (size, pairs), batch = (self.layout.size, self.layout.pairs), self.num_envs
        channel = {_CHANNEL + name: values for name, values in self.channel.allocate().items()}
        return {
            "estimate": np.zeros((size, batch)),
            "input_estimate": np.zeros((self.design.inputs.layout.size, batch)),
            "bound": np.zeros((size, batch)),
            "center": np.zeros((size, batch)),
            "stamp": np.zeros((pairs, batch)),
            "hops": np.zeros((pairs, batch)),
            "arrived": np.zeros((pairs, batch)),
            **self.estimator.allocate(),
            **channel,
        }

    def reset(
        self, state: PlantState, env_ids: IntArray, rngs: Sequence[np.random.Generator], first_guess: FloatArray
    ) -> None:
        """Start from `first_guess` in the environments `env_ids`, and run their first round."""
        memory = state.memory
        memory["center"][:, env_ids] = first_guess[self.layout.column_source][:, None]
        for name in ("stamp", "arrived"):
            memory[name][:, env_ids] = -1.0
        memory["hops"][:, env_ids] = memory["input_estimate"][:, env_ids] = 0.0
        self.channel.reset(self._of_channel(memory), env_ids, rngs)
        self.estimator.reset(memory, env_ids, first_guess)
        due = np.zeros(self.num_envs, np.bool_)
        due[env_ids] = True
        self._round(state, due, self.network.period)
        self._report(state)

    def advance(self, plant: Plant, before: PlantState, state: PlantState, dt: float) -> None:
        """Advance `state`, a copy of `before`, by `dt` seconds, and run the round that is due then, if any.

        Raises:
            SolveError: if a state isn't finite.
        """
        memory = state.memory
        self.estimator.predict(memory, state.t, dt)
        self._reckoning.advance(memory["center"], state.t, dt)
        for number, (weights, elapsed) in enumerate(_RUNGE_KUTTA):
            plant.stage(number, dt * weights, dt * elapsed, before, state)
            plant.effect(state)
        due = self.channel.due(self._of_channel(memory), state.t)
        if due.any():
            self._round(state, due, dt)
        self._report(state)
        plant.actuate(state)

    def bound(self, state: PlantState, out: FloatArray) -> Certified:
        """The certified bound: the distance from each estimate to the farther face of its box; inf without one."""
        np.copyto(out, state.memory["bound"])
        return Certified(out, "certificate")

    def information(self, state: PlantState) -> Information:
        """Age, way and time of arrival of the newest state that each pair has received."""
        stamp, arrived = state.memory["stamp"], state.memory["arrived"]
        nothing = stamp < 0.0
        age, since = (np.where(nothing, math.inf, state.t - values) for values in (stamp, arrived))
        return Information(age, state.memory["hops"], since)

    def limits(self, state: PlantState, out: FloatArray) -> FloatArray:
        """The information limit: certified radii at the age that a state has at least, were no message lost.

        It is what no estimator can do better than, with this network's period and smallest latency.

        Returns:
            `out` (P, B), written.
        """
        round_, waiting = self._of_channel(state.memory)["round"], self._fastest[:, None]
        period = self.network.period
        since_round = state.t - np.maximum(round_, 0) * period
        stamp = state.t - np.maximum(since_round, 0.0) - waiting * period
        return self.boxes.radii(state.t, np.where(round_ < waiting, -1.0, np.maximum(stamp, 0.0)), out)

    def raise_extremes(self, state: PlantState, extremes: Extremes) -> None:
        """Raise running maxima: errors over certified bounds, and the estimator's own |xi| / rho."""
        largest_share(
            self.layout.column_source, state.memory["estimate"], state.x, state.memory["bound"], extremes.relative
        )
        self.estimator.raise_extremes(state, extremes)

    # -- parts ---------------------------------------------------------------------------------------------------

    def _of_channel(self, memory: Memory) -> Memory:
        return {name[len(_CHANNEL) :]: values for name, values in memory.items() if name.startswith(_CHANNEL)}

    def _round(self, state: PlantState, due: NDArray[np.bool_], dt: float) -> None:
        """A round: late messages arrive, everybody sends, and messages without delay arrive."""
        memory, channel = state.memory, self._of_channel(state.memory)
        self.channel.begin_round(channel, None, due)
        if self.network.most_rounds_late:
            self._merge(True, state, channel, dt)
        shared = [state.t[None], self.channel.measured(channel, state.x)]
        shared += [memory[name] for name in ("center", "stamp", "hops")]
        self.channel.send(channel, [*shared, *self.estimator.message(state)], due)
        if not self.network.fewest_rounds_late:
            self._merge(False, state, channel, dt)

        def take(link: IntArray, row: IntArray, held: FloatArray) -> None:
            self.channel.receive(channel, link, row, held)

        self.estimator.receive(state, take, due)

    def _merge(self, late: bool, state: PlantState, channel: Memory, dt: float) -> None:
        memory = state.memory
        behind = merge(
            self._sources,
            late,
            channel["sent"],
            channel["round"],
            channel["newest"],
            channel["heard"],
            state.t,
            memory["center"],
            memory["stamp"],
            memory["hops"],
            memory["arrived"],
            self._lag,
        )
        if behind and self._reckoning.moves:
            self._reckoning.catch_up(memory["center"], state.t, self._lag, dt)

    def _report(self, state: PlantState) -> None:
        memory = state.memory
        own = memory[self.estimator.proposed] if self.estimator.proposed else memory["center"]
        held = memory["stamp"], memory["center"]
        self.boxes.report(state.t, *held, self._proposal, own, memory["estimate"], memory["bound"])

    def _fastest_ages(self) -> FloatArray:
        """(pairs,) rounds that a state is old at least when it arrives, by distance and smallest latency."""
        hops = hops_from_targets(self.design.communication, self.design.k)
        distance = np.array(
            [hops[a][i] for i, a in zip(self.layout.pair_target.tolist(), self.layout.observer.tolist(), strict=True)],
            float,
        )
        late = self.network.fewest_rounds_late
        return distance * late if late else distance - 1.0


# The classical method of order 4: weights of the rates so far, and the time of the stage, per unit of the step. No
# weight is negative, so that a disturbance within its bound moves the plant by no more than its bound.
_RUNGE_KUTTA = tuple(
    (np.array(weights), elapsed)
    for weights, elapsed in (
        ([0.5], 0.5),
        ([0.0, 0.5], 0.5),
        ([0.0, 0.0, 1.0], 1.0),
        ([1 / 6, 1 / 3, 1 / 3, 1 / 6], 1.0),
    )
)


def _certificates(
    design: ObserverDesign, assumed: Assumptions, noise: float
) -> tuple[list[Certificate], list[Certificate]]:
    """Per agent the certificates of a received state and of the initial set; equal ones are one object."""
    made: dict[tuple[AgentModel, bytes, bytes, bytes], Certificate] = {}
    reach = np.abs(assumed.center) + assumed.radius

    def certificate(i: int, start: FloatArray) -> Certificate:
        model, part = design.fleet.models[i], design.fleet.state_slice(i)
        disturbance = assumed.disturbance[part]
        region = model.operating_region(reach[part], disturbance)
        key = model, disturbance.tobytes(), start.tobytes(), region.tobytes()
        if key not in made:
            made[key] = Certificate(model, disturbance=disturbance, start=start, region=region)
        return made[key]

    fleet = design.fleet
    received = [certificate(i, np.full(model.n, noise)) for i, model in enumerate(fleet.models)]
    initial = [certificate(i, assumed.radius[fleet.state_slice(i)]) for i in range(len(fleet))]
    return received, initial
