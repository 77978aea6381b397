"""What an agent model is: the right-hand sides f_i and g_i of the paper's equation (1).

    x_i' = f_i(x_i) + g_i(x_i, u_i) + w_i(x, t)

f_i is the `drift`, g_i the `input_map`, w_i a disturbance (khop_env.physics.disturbances). A model is written once,
vectorised over leading axes, and the same function serves the plant and the observers that copy it.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IndexArray: TypeAlias = NDArray[np.intp]
InputLimit: TypeAlias = Any  # given as a number or one per input; read as a float array of shape (m,)


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of an error message about an unknown name: the nearest known one, or all of them."""
    known = list(known)
    nearest = difflib.get_close_matches(str(name), known, n=1)
    if nearest:
        return f"did you mean {nearest[0]!r}?"
    return f"known: {', '.join(known[:12])}{', ...' if len(known) > 12 else ''}"


class AgentModel:
    """Base class of agent models: name the states and inputs, then write `drift` and `input_map`.

    A subclass sets the attributes below, on the class or on the instance. One that writes its own `__init__` ends
    it with `super().__init__()`, which checks them. Models of equal class and equal parameters are equal, and a fleet
    evaluates neighbours that are equal in one call.

    Attributes:
        type: What its agents are called, e.g. "unicycle" for "unicycle_0"; lower-case letters, digits and underscores.
        states: Name of each of the n states and its unit, in order.
        inputs: Name of each of the m inputs and its unit, in order.
        position: Names of the states that are the agent's position.
        input_limit: Symmetric bound |u| <= input_limit, a number or one per input, np.inf for unbounded; reads as
            an array of shape (m,) once the model is built.
        input_map_uses_state: Whether g depends on x. If so there is no input observer for it (the paper's Remark 1).
    """

    type: str
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    position: tuple[str, ...]
    input_limit: InputLimit
    input_map_uses_state: bool = False

    def __init__(self) -> None:
        self.validate()

    def __post_init__(self) -> None:
        self.validate()

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """f_i: the state's rate of change without input or disturbance.

        Args:
            t: Time in seconds, of a shape that broadcasts against x[..., 0].
            x: States, shape (..., n).

        Returns:
            Rates of change, shape (..., n), in state units per second.
        """
        raise NotImplementedError(f"{self.__class__.__name__} has no drift(t, x)")

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """g_i: what the input adds to the state's rate of change.

        Args:
            t: Time in seconds, of a shape that broadcasts against x[..., 0].
            x: States, shape (..., n).
            u: Inputs, shape (..., m).

        Returns:
            Rates of change, shape (..., n), in state units per second.
        """
        raise NotImplementedError(f"{self.__class__.__name__} has no input_map(t, x, u)")

    def drift_lipschitz(self) -> float:
        """Lipschitz constant of the drift in the 2-norm: inf if it is only locally Lipschitz, nan if not declared."""
        return math.nan

    def input_map_bound(self) -> FloatArray:
        """Bound on each component of |g_i| over all states and all inputs within their limits, shape (n,).

        This default is the largest |g| over the corners of the input box at t = 0 and x = 0. It is exact where g is
        affine in each input and depends on nothing else; a model with any other g overrides it. A component that
        depends on an unlimited input has the bound inf.
        """
        box = np.where(np.isfinite(self.input_limit), self.input_limit, 1.0)
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=self.m)))
        corners = np.asarray(self.input_map(np.zeros(len(signs)), np.zeros((len(signs), self.n)), signs * box))
        bound = np.abs(corners).max(axis=0)
        for j in np.flatnonzero(np.isinf(self.input_limit)):
            low, high = corners[signs[:, j] < 0], corners[signs[:, j] > 0]  # in one order: they differ in u_j only
            bound[(low != high).any(axis=0)] = np.inf
        return bound

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def position_index(self) -> IndexArray:
        """Indices of the position among the states, shape (d,)."""
        names = list(self.states)
        return np.array([names.index(name) for name in self.position], dtype=np.intp)

    @property
    def input_map_bounded(self) -> bool:
        """Whether g is bounded: the paper's Assumption 2-i, under which the input observer can be left out."""
        return bool(np.isfinite(self.input_map_bound()).all())

    def validate(self) -> None:
        """Check the declared attributes and turn `input_limit` into an array of shape (m,); repeatable.

        Raises:
            ValueError: An attribute is missing, or inconsistent with the others.
        """
        who = self.__class__.__name__
        for name in ("type", "states", "inputs", "position", "input_limit"):
            if not hasattr(self, name):
                raise ValueError(f"{who} doesn't set `{name}`, which every agent model needs")
        if not isinstance(self.type, str) or not re.fullmatch(r"[a-z](?:[a-z0-9_]*[a-z])?", self.type):
            raise ValueError(
                f"{who}.type must be lower-case letters, digits and underscores that start and end with a letter, "
                f"because agents are called '<type>_<index>'; got {self.type!r}"
            )
        for name in ("states", "inputs"):
            if not isinstance(getattr(self, name), Mapping) or not getattr(self, name):
                raise ValueError(f"{who}.{name} must map each name to its unit; got {getattr(self, name)!r}")
        if isinstance(self.position, str) or not len(self.position) or len(set(self.position)) != len(self.position):
            raise ValueError(f"{who}.position must be a tuple of different state names; got {self.position!r}")
        for name in self.position:
            if name not in self.states:
                raise ValueError(f"{who}.position: {name!r} is not a state; {did_you_mean(name, self.states)}")
        limit = np.array(self.input_limit, dtype=np.float64)
        if limit.shape not in ((), (self.m,)):
            raise ValueError(
                f"{who}.input_limit must be a number or one per input {tuple(self.inputs)}; got {self.input_limit!r}"
            )
        if not (limit > 0).all():
            raise ValueError(f"{who}.input_limit must be positive (np.inf for unbounded); got {self.input_limit!r}")
        limit = np.broadcast_to(limit, self.m).copy()
        limit.setflags(write=False)
        object.__setattr__(self, "input_limit", limit)  # the library's models are frozen

    def _key(self) -> tuple[object, ...]:
        return self.__class__, *(
            (name, value.tobytes() if isinstance(value, np.ndarray) else value) for name, value in vars(self).items()
        )

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, AgentModel) and self._key() == other._key())

    def __hash__(self) -> int:
        return hash(self._key())
