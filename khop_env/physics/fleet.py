"""The fleet: many agents of several kinds, evaluated as flat batched vectors.

A fleet's state is (B, n): one row per environment, the agents' states one after the other. Agents may differ in
n_i and m_i; offsets say where each begins, and consecutive agents with equal models are evaluated in one call.
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, SupportsIndex

import numpy as np

from khop_env.physics.agent_model import AgentModel, FloatArray, IndexArray, did_you_mean, require_shape
from khop_env.physics.right_hand_sides import Runs


@dataclass(frozen=True, eq=False)
class Group:
    """A maximal run of consecutive agents with equal models.

    Their states are the view `x[:, group.state_slice].reshape(B, *group.state_shape)`.

    Attributes:
        model: Their common model.
        start: Index of the first agent.
        stop: One past the index of the last.
        state_slice: Their part of the fleet's flat state.
        input_slice: Their part of the fleet's flat input.
        state_shape: (agents, n_i).
        input_shape: (agents, m_i).
    """

    model: AgentModel
    start: int
    stop: int
    state_slice: slice
    input_slice: slice
    state_shape: tuple[int, int]
    input_shape: tuple[int, int]

    @property
    def size(self) -> int:
        """Number of agents."""
        return self.stop - self.start


class Fleet:
    """Agents in a fixed order, and their joint drift and input map.

    Args:
        models: One model per agent. Agents whose models are equal may be one object or several.

    Attributes:
        models: The models, one per agent.
        ids: "<type>_<index>" per agent; the index counts within the type.
        n: Number of states of all agents together.
        m: Number of inputs of all agents together.
        state_offset: Where each agent's states begin, and n at the end, shape (N + 1,).
        input_offset: Where each agent's inputs begin, and m at the end, shape (N + 1,).
        groups: Runs of agents evaluated together.
        position_dim: Dimension d of a position, the same for all agents.
        position_index: Where each agent's position sits in the flat state, shape (N, d).
        input_limit: Symmetric input bounds, shape (m,).
        input_map_bound: Bounds on the components of |g|, shape (n,).
        runs: The groups for compiled loops, the fields of `right_hand_sides.Runs`; None where a model is Python.

    Raises:
        ValueError: There are no models, an entry isn't a model, positions differ in dimension, agents of one type
            differ in their states or inputs, a drift or an input map has a wrong shape or can't be evaluated on a
            batch, or an input map contradicts its model's attributes.
    """

    def __init__(self, models: Sequence[AgentModel]) -> None:
        self.models: tuple[AgentModel, ...] = tuple(models)
        if not self.models:
            raise ValueError("a fleet needs at least one agent model")
        for i, model in enumerate(self.models):
            if not isinstance(model, AgentModel):
                hint = "; write the parentheses to make an instance" if isinstance(model, type) else ""
                raise ValueError(f"agent {i}: expected an AgentModel, got {model!r}{hint}")
            model.validate()
        self.ids = _number_within_type(self.models)
        self._index = {name: i for i, name in enumerate(self.ids)}
        _check_types(self.models, self.ids)

        self.state_offset = _offsets([model.n for model in self.models])
        self.input_offset = _offsets([model.m for model in self.models])
        self.n = int(self.state_offset[-1])
        self.m = int(self.input_offset[-1])
        self.groups = self._runs()

        positions = [group.model.position_index for group in self.groups for _ in range(group.size)]
        self.position_dim = _common_dimension(positions, self.ids)
        self.position_index: IndexArray = np.array(positions) + self.state_offset[:-1, None]
        self.input_limit: FloatArray = np.concatenate([model.input_limit for model in self.models])
        for group in self.groups:
            if group.model.form is None:
                group.model.check_drift()
        self.input_map_bound: FloatArray = np.concatenate(
            [np.tile(group.model.checked_input_map_bound(), group.size) for group in self.groups]
        )

        known = all(group.model.form is not None for group in self.groups)
        parts = [(each.model, each.size, each.state_slice.start, each.input_slice.start) for each in self.groups]
        self.runs: tuple[Any, ...] | None = tuple(Runs.of(parts)) if known else None

    def __len__(self) -> int:
        """Number of agents N."""
        return len(self.models)

    def __str__(self) -> str:
        counts = Counter(model.type for model in self.models)
        return ", ".join(f"{count} {kind}" for kind, count in counts.items())

    def __repr__(self) -> str:
        return f"Fleet({self})"

    def state_slice(self, agent: int) -> slice:
        """Agent's part of the flat state."""
        return slice(int(self.state_offset[agent]), int(self.state_offset[agent + 1]))

    def input_slice(self, agent: int) -> slice:
        """Agent's part of the flat input."""
        return slice(int(self.input_offset[agent]), int(self.input_offset[agent + 1]))

    def agent(self, which: str | SupportsIndex) -> int:
        """Index of an agent from its id or its index.

        Raises:
            ValueError: There is no such agent.
        """
        if isinstance(which, str):
            if which not in self._index:
                raise ValueError(f"no agent {which!r}; {did_you_mean(which, self.ids)}")
            return self._index[which]
        index = operator.index(which)
        if not 0 <= index < len(self):
            raise ValueError(f"no agent {index}: the fleet's agents are 0 to {len(self) - 1}")
        return index

    def component_names(self) -> list[tuple[str, str, str]]:
        """(agent id, state name, unit) of each component of the flat state."""
        return [(i, *state) for i, model in zip(self.ids, self.models, strict=True) for state in model.states.items()]

    def input_names(self) -> list[tuple[str, str, str]]:
        """(agent id, input name, unit) of each component of the flat input."""
        return [(i, *entry) for i, model in zip(self.ids, self.models, strict=True) for entry in model.inputs.items()]

    def drift(self, t: FloatArray, x: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """The drift f of all agents.

        Args:
            t: Time of each environment in seconds, shape (B,).
            x: Fleet states, shape (B, n).
            out: Where to write the result, shape (B, n); a new array if left out.

        Returns:
            Rates of change, shape (B, n); never a view of x.

        Raises:
            ValueError: A model returned a wrong shape.
        """
        out = np.empty(x.shape) if out is None else out
        t = t[:, None]
        for group in self.groups:
            states = x[:, group.state_slice].reshape(len(x), *group.state_shape)
            _fill(out, group, group.model.drift(t, states), states.shape, "drift(t, x)")
        return out

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """The input map g of all agents.

        Args:
            t: Time of each environment in seconds, shape (B,).
            x: Fleet states, shape (B, n).
            u: Fleet inputs, shape (B, m).
            out: Where to write the result, shape (B, n); a new array if left out.

        Returns:
            Rates of change, shape (B, n); never a view of u.

        Raises:
            ValueError: A model returned a wrong shape.
        """
        out = np.empty(x.shape) if out is None else out
        t = t[:, None]
        for group in self.groups:
            states = x[:, group.state_slice].reshape(len(x), *group.state_shape)
            inputs = u[:, group.input_slice].reshape(len(u), *group.input_shape)
            _fill(out, group, group.model.input_map(t, states, inputs), states.shape, "input_map(t, x, u)")
        return out

    def explicit_step(self, reach: FloatArray, disturbance: FloatArray) -> tuple[float, int]:
        """The shortest `AgentModel.explicit_step` of all agents.

        Args:
            reach: Largest |x| of the initial states, shape (n,).
            disturbance: Largest |w|, in state units per second, shape (n,).

        Returns:
            The step in seconds, inf if any will do, and the index of the first agent that asks for it.

        Raises:
            ValueError: A model declares a step that isn't positive.
        """
        steps = [
            model.explicit_step(reach[part], disturbance[part])
            for model, part in ((model, self.state_slice(i)) for i, model in enumerate(self.models))
        ]
        for i, step in enumerate(steps):
            if not step > 0.0:
                raise ValueError(
                    f"{self.models[i].__class__.__name__}.explicit_step must return a positive number of seconds, or "
                    f"math.inf; got {step!r} for {self.ids[i]!r}"
                )
        shortest = min(range(len(self)), key=steps.__getitem__)
        return float(steps[shortest]), shortest

    def positions(self, x: FloatArray) -> FloatArray:
        """Positions of all agents, shape (B, N, d), from fleet states (B, n)."""
        return np.take(x, self.position_index, axis=-1)

    def position_unit(self, axis: int | None = None) -> str:
        """Unit of positions along an axis, or of distances: "m", or "m or rad" where agents or axes differ.

        Args:
            axis: number of the axis; None for all.
        """
        chosen = range(self.position_dim) if axis is None else [axis]
        units = [group.model.states[group.model.position[each]] for each in chosen for group in self.groups]
        return " or ".join(dict.fromkeys(units))

    def _runs(self) -> tuple[Group, ...]:
        firsts = [0, *(i for i in range(1, len(self)) if self.models[i] != self.models[i - 1])]
        groups = []
        for start, stop in zip(firsts, [*firsts[1:], len(self)], strict=True):
            states = slice(int(self.state_offset[start]), int(self.state_offset[stop]))
            inputs = slice(int(self.input_offset[start]), int(self.input_offset[stop]))
            model, size = self.models[start], stop - start
            groups.append(Group(model, start, stop, states, inputs, (size, model.n), (size, model.m)))
        return tuple(groups)


def _fill(out: FloatArray, group: Group, value: FloatArray, shape: tuple[int, ...], what: str) -> None:
    # A copy even for a single group: a model may return its argument (g = u) and callers add into `out`.
    out[:, group.state_slice].reshape(shape)[...] = require_shape(group.model, value, shape, what)


def _offsets(sizes: list[int]) -> IndexArray:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.intp)


def _number_within_type(models: tuple[AgentModel, ...]) -> tuple[str, ...]:
    seen: Counter[str] = Counter()
    ids = []
    for model in models:
        ids.append(f"{model.type}_{seen[model.type]}")
        seen[model.type] += 1
    return tuple(ids)


def _check_types(models: tuple[AgentModel, ...], ids: tuple[str, ...]) -> None:
    first: dict[str, int] = {}
    for i, model in enumerate(models):
        other = first.setdefault(model.type, i)
        for name in ("states", "inputs"):
            own, known = dict(getattr(model, name)), dict(getattr(models[other], name))
            if own != known:
                raise ValueError(
                    f"{ids[i]} and {ids[other]} share the type {model.type!r} but differ in their {name}: "
                    f"{own} and {known}; give one of the models another type"
                )


def _common_dimension(positions: list[IndexArray], ids: tuple[str, ...]) -> int:
    common = Counter(map(len, positions)).most_common(1)[0][0]
    odd = [f"{i} ({len(index)})" for i, index in zip(ids, positions, strict=True) if len(index) != common]
    if odd:
        raise ValueError(
            f"all agents must share one position dimension; most have {common}, but not {', '.join(odd[:8])}"
            f"{' and others' if len(odd) > 8 else ''}"
        )
    return common
