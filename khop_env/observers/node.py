"""The observers of one robot, for its own loop: discrete time, messages in and out, estimates with certified bounds.

    node = ObserverNode(design, "cart_2", period=0.05, center=center, radius=radius)
    while True:
        node.update(t, x, u)                          # own state and input, as measured now
        radio.send(node.message().pack())
        for data in radio.received():
            node.receive(Message.unpack(data, design))
        for target, known in node.estimates(t).items():
            ...                                       # |x_target - known.estimate| <= known.bound, by component

That is a round of messages, in this order. Time t is in seconds since the fleet started, the same for all its agents up
to `skew`. Messages may be lost, late, doubled or out of order: bounds become wider, never wrong. What can't be right is
refused with a ValueError and leaves the node as it was. Nothing here needs a simulator or a compiler.
"""

from __future__ import annotations

import math
from typing import get_args

import numpy as np

from khop_env.network.checks import positive
from khop_env.network.reading import number
from khop_env.observers.base import SolveError
from khop_env.observers.design import ObserverDesign
from khop_env.observers.fingerprint import fingerprint
from khop_env.observers.layout import FloatArray
from khop_env.observers.local import local_observers
from khop_env.observers.remote import Estimate, Received, RemoteAgent
from khop_env.observers.wire import EstimatorName, Known, Message, NumberFormat, check_choice, rounding


class ObserverNode:
    """The observers of one agent: its knowledge of all agents within k hops, from its own messages only.

    With the estimator "relay" it keeps and passes on the freshest state of each and predicts it with f; "ppso" runs the
    paper's state and input observers by implicit steps, one a round, on what was heard last. Both report estimates
    within the certified box (docs/theory/certificates.md), agents at one hop included.

    A round begins with every `update`, or with `step`, as soon as the next multiple of the period has come. It ends
    with `estimates`, or with the next update.

    Args:
        design: the observers of the whole fleet; all robots have the same.
        agent: whose node it is, by id or index.
        estimator: "ppso" or "relay", the same for all robots.
        period: time between two rounds, in s.
        step: time between two updates, in s, where it is shorter than the period.
        disturbance: bound on |w| in state units per second, a number or (n,) of the whole fleet.
        center: first guess of all states, a number or (n,).
        radius: largest distance of states from it at time 0, a number or (n,); unknown by default.
        noise: bound on the error of what agents measure of their own states, a number or (n,).
        skew: bound on the difference of any two clocks, in s.
        dtype: number format of messages. Rounding to float32 or float16 is an error of what was sent and becomes part
            of the bounds; messages that were rounded more than that are refused.
        largest: largest |x| of what is sent, a number or (n,); needed unless dtype is float64.
        sampled: whether agents follow the difference equation x+ = x + step (f + g + w) of simulators over a network,
            in place of the differential equation.

    Attributes:
        id: of the agent.
        hears: ids of the agents that it receives messages from.
        targets: ids of the agents that it estimates.
        due: whether the last update began a round, in which a message is to be sent.
        time: of the last update, in s.
        reasons: by target, why nothing is certified of it, or not of every component; empty if all is well.

    Raises:
        ValueError: for an unknown agent or estimator, or a value that is misshapen or out of range.
    """

    def __init__(
        self,
        design: ObserverDesign,
        agent: str | int,
        *,
        estimator: EstimatorName = "ppso",
        period: float,
        step: float | None = None,
        disturbance: FloatArray | float = 0.0,
        center: FloatArray | float = 0.0,
        radius: FloatArray | float = math.inf,
        noise: FloatArray | float = 0.0,
        skew: float = 0.0,
        dtype: NumberFormat = "float64",
        largest: FloatArray | float | None = None,
        sampled: bool = False,
    ) -> None:
        fleet = design.fleet
        check_choice("estimator", estimator, get_args(EstimatorName))
        check_choice("dtype", dtype, get_args(NumberFormat))
        positive(period, "period", "s")
        if step is not None and not 0.0 < number(step, "step") <= period * (1.0 + 1e-9):
            raise ValueError(
                f"step, between two updates, must be positive and at most the period {period:g} s; got {step}"
            )
        if not 0.0 <= number(skew, "skew") < math.inf:
            raise ValueError(f"skew must be finite and not negative, in s; got {skew!r}")
        if sampled and skew > 0.0:
            raise ValueError(f"a sampled system has one clock: skew must be 0 with sampled=True; got {skew!r}")
        if dtype != "float64" and largest is None:
            raise ValueError(
                f"dtype={dtype!r} rounds what is sent: give `largest`, the largest |x|, to bound that error"
            )
        self._design, self._agent, self._estimator = design, fleet.agent(agent), estimator
        self._period, self._step, self._skew, self._dtype = period, step, skew, dtype
        self._largest = _of_fleet(design, "largest", math.inf if largest is None else largest)
        self._unlimited = bool(np.isinf(self._largest).all())
        values = {
            "disturbance": _of_fleet(design, "disturbance", disturbance),
            "noise": _of_fleet(design, "noise", noise),
            "center": _of_fleet(design, "center", center, signed=True),
            "radius": _of_fleet(design, "radius", radius),
            "rounding": rounding(dtype, self._largest),
        }
        guess, model = values["center"], fleet.models[self._agent]
        self._targets: dict[int, RemoteAgent] = {}
        for i in sorted(i for observer, i in design.knowledge.slot if observer == self._agent):
            own = fleet.state_slice(i)
            of_target = {name: value[own] for name, value in values.items()}
            self._targets[i] = RemoteAgent(
                fleet.models[i], step=step or period, skew=skew, sampled=sampled, **of_target
            )
        ppso = estimator == "ppso"
        self._states = local_observers(design, design.states, self._agent, guess) if ppso else {}
        self._inputs = local_observers(design, design.inputs, self._agent, np.zeros(fleet.n)) if ppso else {}

        self.id = fleet.ids[self._agent]
        self._senders = design.links.senders[self._agent]
        self.hears = tuple(fleet.ids[i] for i in sorted(self._senders))
        self.targets = tuple(fleet.ids[i] for i in self._targets)
        self.reasons = {fleet.ids[i]: each.reason for i, each in self._targets.items() if each.reason}
        self.time, self.due = 0.0, False
        self._open = False  # whether the round's solve is still to come
        self._round = self._updates = 0
        self._x, self._g = np.full(model.n, math.nan), np.full(model.n, math.nan)
        self._most = model.input_limit * (1.0 + 1e-6)  # inputs may have been rounded to float32
        self._newest: dict[int, float] = {}
        self._early: dict[int, Message] = {}
        self._heard: dict[int, FloatArray] = {}
        self._passed_on: dict[int, FloatArray] = {}  # the same at the end of the last round, as the simulator sends it

    def __repr__(self) -> str:
        return f"ObserverNode({self.id!r}, {self._estimator}; hears {len(self.hears)}, {len(self.targets)} targets)"

    def update(self, t: float, own_state: FloatArray, own_input: FloatArray) -> None:
        """Move on to time `t`: end the last round, predict, and perhaps begin a round.

        Args:
            t: in s, never less than before.
            own_state: (n_a,) as measured now.
            own_input: (m_a,) u that was in force until now, as it was applied: within the model's `input_limit`.

        Raises:
            ValueError: for a value that is misshapen or not finite, an input beyond its limit, or a time that runs
                backwards or far ahead.
            SolveError: if an estimate isn't finite any more.
        """
        model = self._design.fleet.models[self._agent]
        dt = self._since(t, "update")
        x = self._own("state", own_state, tuple(model.states))
        u = self._own("input", own_input, tuple(model.inputs))
        if (np.abs(u) > self._most).any():
            raise ValueError(
                f"node of {self.id!r}: its input {_short(u)} is beyond input_limit {_short(model.input_limit)}; "
                "certified bounds assume it isn't: clip what goes to the motors, and pass what was applied"
            )
        g = np.array(model.input_map(np.array([t]), x[None], u[None])[0], np.float64)
        self._end_round()
        moved = [target.moved(target.freshest.state, self.time, dt) for target in self._targets.values()]
        estimates = {i: self._moved_estimate(i, dt) for i in self._states}
        for target, state in zip(self._targets.values(), moved, strict=True):
            target.freshest = target.freshest._replace(state=state)
        for i, estimate in estimates.items():
            self._states[i].estimate = estimate
        self.time, self._x, self._g = float(t), x, g
        self._updates += 1
        self.due = self._step is None or t >= (self._round - 1e-9 * self._round) * self._period
        if self.due:
            self._round = math.floor(t / self._period + 1e-9) + 1
            self._open = True
        for message in [message for message in self._early.values() if message.time <= t]:
            self._merge(message)
            del self._early[message.sender]

    def message(self) -> Message:
        """The message of a round: made before anything of this round is received, so that rounds are the same for all.

        What came late, of earlier rounds, may be received before, to be passed on at once.

        Raises:
            ValueError: before the first update, or for an own state beyond `largest`.
        """
        if self._updates == 0:
            raise ValueError(f"node of {self.id!r}: no message before the first update(t, own_state, own_input)")
        if not self._within(self._agent, self._x):
            raise ValueError(
                f"node of {self.id!r}: its state {self._x.tolist()} is beyond largest = "
                f"{self._limit(self._agent).tolist()}, up to which the rounding to {self._dtype} is certified"
            )
        known = {
            i: Known(held.stamp, held.hops, held.state.copy())
            for i, held in ((i, target.freshest) for i, target in self._targets.items())
            if 1 <= held.hops <= 255 and self._within(i, held.state)
        }
        ppso = self._estimator == "ppso"
        return Message(
            self._design,
            self._agent,
            self.time,
            self._x.copy(),
            known,
            self._estimator,
            self._g.copy() if ppso and self._agent in self._design.inputs.layout.target else None,
            {i: observer.estimate.copy() for i, observer in self._states.items()},
            {i: observer.estimate.copy() for i, observer in self._inputs.items()},
            {i: g.copy() for i, g in self._passed_on.items()} if self._design.relay else {},
            self._dtype,
        )

    def receive(self, message: Message) -> bool:
        """Take in a message, now or later: one that is up to a period ahead of this clock waits for its time.

        Returns:
            Whether it is of use: False for one that is no newer than what came from its sender before.

        Raises:
            ValueError: for what isn't a `Message`, or one of another fleet, of an agent that isn't heard, of another
                estimator, rounded more than the bounds allow for, or too far ahead of this clock or behind it.
        """
        who = f"node of {self.id!r}"
        if not isinstance(message, Message):
            raise ValueError(f"{who}: expected a Message, got {type(message).__name__}: Message.unpack(data, design)")
        ids, sender = self._design.fleet.ids, message.sender
        if message.design is not self._design and fingerprint(message.design) != fingerprint(self._design):
            raise ValueError(f"{who}: a message of another fleet, {message.design}; this one is {self._design}")
        if sender not in self._senders:
            raise ValueError(f"{who}: a message of {ids[sender]!r}, which it doesn't hear; it hears {self.hears}")
        if message.estimator != self._estimator:
            raise ValueError(
                f"{who}: {ids[sender]!r} runs the estimator {message.estimator!r}, this node {self._estimator!r}; "
                "give all nodes the same"
            )
        formats = get_args(NumberFormat)
        if formats.index(message.dtype) > formats.index(self._dtype):
            raise ValueError(
                f"{who}: {ids[sender]!r} sent {message.dtype}, but this node's bounds allow for {self._dtype}; "
                f"give all nodes dtype={message.dtype!r} and `largest`"
            )
        states = [] if self._unlimited else [(i, known.state) for i, known in message.known.items()]
        for i, state in [(sender, message.state), *states]:
            if not self._within(i, state, 1.0 + 1e-3):
                raise ValueError(f"{who}: {ids[sender]!r} sent a state of {ids[i]!r} beyond largest, {state.tolist()}")
        ahead = message.time - self.time
        if ahead > self._period + self._skew:
            raise ValueError(
                f"{who}: the message of {ids[sender]!r} is of t = {message.time:.6g} s, {ahead:.3g} s ahead of the "
                f"last update; clocks differ by more than skew = {self._skew:g} s, or updates stopped"
            )
        if message.time <= self._newest.get(sender, -math.inf):
            return False
        if ahead <= 0.0:
            self._merge(message)
        elif sender not in self._early or message.time > self._early[sender].time:
            self._early[sender] = message
        else:
            return False
        return True

    def estimates(self, t: float) -> dict[str, Estimate]:
        """The estimates of all targets, by id, at time `t`, that of the last update or later; ends the round.

        Raises:
            ValueError: for a time before the last update.
            SolveError: if an estimate isn't finite any more.
        """
        dt = self._since(t, "estimates")
        self._end_round()
        return {
            self._design.fleet.ids[i]: target.estimate(
                t, dt, self._moved_estimate(i, dt) if i in self._states else None
            )
            for i, target in self._targets.items()
        }

    def _merge(self, message: Message) -> None:
        """Take what is fresher from a message that isn't of the future."""
        sender, dt = message.sender, self.time - message.time
        sent = {i: (known.state, known.stamp, known.hops + 1) for i, known in message.known.items()}
        sent[sender] = (message.state, message.time, 1)
        fresh = {}
        for i, (state, stamp, hops) in sent.items():
            received = Received(state, stamp, hops, (self._updates, dt > 0.0), sender, self.time)
            if i in self._targets and received.replaces(self._targets[i].freshest):
                fresh[i] = received._replace(state=self._targets[i].moved(state, message.time, dt))
        for i, received in fresh.items():
            self._targets[i].freshest = received
        self._newest[sender] = message.time
        if message.input_effect is not None:
            self._heard[sender] = message.input_effect
        states = {i: state for i, (state, _, _) in sent.items()}
        effects = dict(message.heard)
        if message.input_effect is not None:
            effects[sender] = message.input_effect
        for observers, estimates, values in (
            (self._states, message.estimates, states),
            (self._inputs, message.input_estimates, effects),
        ):
            for i, observer in observers.items():
                if sender in observer.peers:
                    observer.peers[sender] = estimates[i]
                if sender in observer.sources and i in values:
                    observer.sources[sender] = values[i]

    def _end_round(self) -> None:
        """The solve of a round, on what has arrived until now."""
        if not self._open:
            return
        for observers in (self._states, self._inputs):
            for observer in observers.values():
                observer.estimate = observer.solved(self.time, self._period)
        self._passed_on = dict(self._heard)
        self._open = False

    def _moved_estimate(self, i: int, dt: float) -> FloatArray:
        """The estimate of a state after `dt` s of prediction, by Euler steps: y' = f(y) + g_hat."""
        effect = self._inputs[i].estimate if i in self._inputs else None
        moved = self._states[i].moved(self.time, dt, self._step or self._period, effect)
        if not np.isfinite(moved).all():
            raise SolveError(
                f"node of {self.id!r}: its estimate of {self._design.fleet.ids[i]!r} isn't finite any more; give a "
                "shorter step, or the estimator 'relay'"
            )
        return moved

    def _limit(self, i: int) -> FloatArray:
        return self._largest[self._design.fleet.state_slice(i)]

    def _within(self, i: int, state: FloatArray, margin: float = 1.0) -> bool:
        return self._unlimited or bool((np.abs(state) <= self._limit(i) * margin).all())

    def _since(self, t: float, what: str) -> float:
        if not (math.isfinite(number(t, f"node of {self.id!r}: the time of {what}")) and t >= self.time):
            raise ValueError(
                f"node of {self.id!r}: {what} at t = {t!r}; expected {self.time!r} s, the last time, or later"
            )
        return t - self.time

    def _own(self, what: str, value: FloatArray, names: tuple[str, ...]) -> FloatArray:
        found = _numbers(value)
        if found.shape != (len(names),) or not np.isfinite(found).all():
            raise ValueError(
                f"node of {self.id!r}: its {what} must be {len(names)} finite numbers {names}; got {value!r}"
            )
        return found


def _short(values: FloatArray) -> str:
    return f"[{', '.join(f'{value:g}' for value in values)}]"


def _numbers(value: object) -> FloatArray:
    """A copy of an array of numbers; nan where it is none, which every check refuses."""
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError):
        return np.array(math.nan)


def _of_fleet(design: ObserverDesign, name: str, value: FloatArray | float, signed: bool = False) -> FloatArray:
    """A value (n,) of the whole fleet."""
    found, n = _numbers(value), design.fleet.n
    if found.shape not in ((), (n,)) or not (np.isfinite(found) if signed else found >= 0.0).all():
        sign = "finite" if signed else "not negative"
        raise ValueError(f"{name} must be a number or {n} numbers, of the whole fleet's states, {sign}; got {value!r}")
    return np.broadcast_to(found, n).copy()
