"""Agent models: the right-hand sides f_i and g_i of the paper's equation (1).

    x_i' = f_i(x_i) + g_i(x_i, u_i) + w_i(x, t)

f_i is the `drift`, g_i the `input_map`, w_i a disturbance (khop_env.physics.disturbances). A model is written once,
vectorised over leading axes, and the same function serves the plant and the observers that copy it.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from khop_env.physics.growth import Growth
from khop_env.physics.right_hand_sides import Form

FloatArray: TypeAlias = NDArray[np.float64]
"""An array of float64."""
Array = TypeVar("Array", bound=np.ndarray)
IndexArray: TypeAlias = NDArray[np.intp]
"""An array of indices."""
InputLimit: TypeAlias = Any  # set to a number or one per input; read as a float array of shape (m,)


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """End of an error message about an unknown name: the closest known name, or all of them."""
    known = list(known)
    nearest = difflib.get_close_matches(str(name), known, n=1)
    if nearest:
        return f"did you mean {nearest[0]!r}?"
    return f"known: {', '.join(known[:12])}{', ...' if len(known) > 12 else ''}"


def or_did_you_mean(name: object, known: Iterable[str]) -> str:
    """End of an error message that lists all known names already: the closest one, or nothing."""
    nearest = difflib.get_close_matches(str(name), list(known), n=1)
    return f"; did you mean {nearest[0]!r}?" if nearest else ""


def read_only(view: Array) -> Array:
    """The view itself, which can't be written through any more."""
    view.flags.writeable = False
    return view


_PROBES = 8  # random inputs at which g is checked to be affine in each input


def require_shape(model: AgentModel, value: FloatArray, shape: tuple[int, ...], what: str) -> FloatArray:
    """The result of a model's right-hand side as an array, with its shape checked.

    Args:
        model: The model.
        value: The result.
        shape: The expected shape.
        what: The function and its arguments, for the error message.

    Raises:
        ValueError: The shape is different.
    """
    if np.shape(value) != shape:
        raise ValueError(
            f"{model.__class__.__name__}.{what} returned shape {np.shape(value)}, expected {shape}: the leading "
            f"axes of x, then the {model.n} states {tuple(model.states)}"
        )
    return np.asarray(value)


def _same(first: FloatArray, second: FloatArray) -> bool:
    """True if rates (K, n) agree, to rounding of the largest of each component."""
    scale = np.maximum(np.abs(first), np.abs(second)).max(axis=0)
    return not bool(np.any(np.abs(first - second) > 1e-9 * scale))


def _hashable(value: object) -> object:
    """A parameter as something that can be compared and hashed."""
    if isinstance(value, np.ndarray):
        return value.tobytes()
    if isinstance(value, Mapping):
        return tuple((key, _hashable(entry)) for key, entry in value.items())
    return tuple(map(_hashable, value)) if isinstance(value, list) else value


class AgentModel:
    """Base class of agent models: name the states and inputs, then write `drift` and `input_map`.

    A subclass sets the attributes below, on the class or on the instance. If it defines its own `__init__`, it ends
    with `super().__init__()`, which checks them. Models of equal class and equal parameters are equal, and a fleet
    evaluates consecutive agents with equal models in one call.

    Right-hand sides take time without an axis for the states: t has shape (B, 1) where x has (B, N, n). Next to
    x[..., 0] write t, next to x itself t[..., None].

    Attributes:
        type: Prefix of its agents' ids, e.g. "unicycle" for "unicycle_0"; lower-case letters, digits and underscores.
        states: Name of each of the n states and its unit, in order.
        inputs: Name of each of the m inputs and its unit, in order.
        position: Names of the states that are the agent's position.
        input_limit: Symmetric bound |u| <= input_limit, a number or one per input, np.inf for unbounded; reads as
            an array of shape (m,) once the model is built.
        input_map_uses_state: Whether g depends on x. If so there is no input observer for it (the paper's Remark 1).
        form: Its compiled form, for the library's own; None for models whose right-hand sides are Python.
    """

    type: str
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    position: tuple[str, ...]
    input_limit: InputLimit
    input_map_uses_state: bool = False
    form: Form | None = None

    def __init_subclass__(cls) -> None:
        if "form" not in vars(cls):
            cls.form = None  # a subclass may have another drift than the class whose compiled form it would inherit

    def __init__(self) -> None:
        self.validate()

    def __post_init__(self) -> None:
        self.validate()

    def drift(self, t: FloatArray, x: FloatArray) -> FloatArray:
        """f_i: the state's rate of change without input or disturbance.

        Args:
            t: Time in seconds, of a shape that broadcasts against x[..., 0]: (B, 1) beside an x of shape (B, N, n).
            x: States, shape (..., n).

        Returns:
            Rates of change, shape (..., n), in state units per second.
        """
        raise NotImplementedError(f"{self.__class__.__name__} has no drift(t, x)")

    def input_map(self, t: FloatArray, x: FloatArray, u: FloatArray) -> FloatArray:
        """g_i: the contribution of the input to the state's rate of change.

        Args:
            t: Time in seconds, of a shape that broadcasts against x[..., 0]: (B, 1) beside an x of shape (B, N, n).
            x: States, shape (..., n).
            u: Inputs, shape (..., m).

        Returns:
            Rates of change, shape (..., n), in state units per second.
        """
        raise NotImplementedError(f"{self.__class__.__name__} has no input_map(t, x, u)")

    def drift_lipschitz(self) -> float:
        """Lipschitz constant of the drift in the 2-norm: inf if it is only locally Lipschitz, nan if not declared."""
        return math.nan

    def drift_growth(self, region: FloatArray | None = None) -> Growth | None:
        """A bound on how fast two solutions of the drift may part; None, the default, if the model doesn't say.

        With it, what was known of an agent some time ago is a bound on its state now (`observers.Certificate`), however
        messages were lost in between. Without it, or outside its region, nothing is certified.

        Args:
            region: (n,) largest |x| of the agent's states at all times, inf where none is known; None for all inf.
                Drifts that are only locally Lipschitz need one.
        """
        return None

    def operating_region(self, reach: FloatArray, disturbance: FloatArray) -> FloatArray:
        """Bounds that |x| never leaves as long as inputs are within their limits, shape (n,).

        This default knows none: inf.

        Args:
            reach: Largest |x| that agents start with, shape (n,).
            disturbance: Largest |w|, in state units per second, shape (n,).
        """
        return np.full(self.n, math.inf)

    def explicit_step(self, reach: FloatArray, disturbance: FloatArray) -> float:
        """Longest step of an explicit method, in s, for which the drift is stable; inf if every step is.

        The default is inf, right for a drift that is bounded or slow. A model whose drift is stiff, such as a strong
        drag, overrides it: an explicit method multiplies a mode with decay rate r by about 1 - r dt, so that it grows
        for steps beyond 2 / r. Simulators divide longer steps.

        Args:
            reach: Largest |x| of the initial states, shape (n,).
            disturbance: Largest |w|, in state units per second, shape (n,).
        """
        return math.inf

    def input_map_bound(self) -> FloatArray:
        """Bound on each component of |g_i| over all states and all inputs within their limits, shape (n,).

        The default is the largest |g| over the corners of the input box, with inf for components that depend on an
        unlimited input. It is exact if g is affine in each input and depends on nothing else. A model with any other g
        overrides it, with np.inf for a component that has no bound.

        Raises:
            ValueError: g depends on the state, on time, or isn't affine in each input, so that its values at the
                corners don't bound it.
        """
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=self.m)))
        unlimited = np.isinf(self.input_limit)
        box = np.where(unlimited, 1.0, self.input_limit)
        at_corners = self._probe(0.0, np.zeros(self.n), corners * box)
        bound = np.abs(at_corners).max(axis=0)
        why = "depends on the state" if self.input_map_uses_state else None
        rng = np.random.default_rng(0)
        inside = rng.uniform(-1.0, 1.0, (_PROBES, self.m))
        at_inside = self._probe(0.0, np.zeros(self.n), inside * box)
        if not _same(self._probe(rng.uniform(1.0, 100.0), np.zeros(self.n), inside * box), at_inside):
            why = "depends on time"
        weights = (1.0 + corners * inside[:, None]).prod(axis=-1) / 2.0**self.m
        if not _same(at_inside, weights @ at_corners):
            why = why or "isn't affine in each input"
        if why is not None:
            raise ValueError(
                f"{self.__class__.__name__}.input_map {why}, so that its values at the limits of the inputs don't "
                "bound it: write "
                f"input_map_bound(self), returning the largest |g| of each of the {self.n} states' rates over all "
                "states, times and inputs within their limits as an array, with np.inf where there is none"
            )
        for j in np.flatnonzero(unlimited):
            low, high = at_corners[corners[:, j] < 0], at_corners[corners[:, j] > 0]  # in one order: they differ in u_j
            bound[(low != high).any(axis=0)] = np.inf
        return bound

    def check_drift(self) -> None:
        """Check the drift's shape on a batch in which no number of environments, agents or states is the same.

        Raises:
            ValueError: The drift can't be evaluated on a batch, or returns a wrong shape.
        """
        environments, agents = self.n + 2, self.n + 1
        columns = np.random.default_rng(0).normal(size=(agents, self.n, environments))
        x = read_only(columns.transpose(2, 0, 1))  # as in a simulator, so that nothing is compiled for this check alone
        t = np.zeros((environments, 1))
        f = self._evaluated(lambda: self.drift(t, x), x, "drift(t, x)")
        require_shape(self, f, x.shape, f"drift(t, x) on x of shape {x.shape}")

    def checked_input_map_bound(self) -> FloatArray:
        """`input_map_bound`, after sampled checks of the input map and checks of the bound.

        Raises:
            ValueError: The input map returns a wrong shape, or depends on the state although `input_map_uses_state` is
                False; or the bound has a wrong shape, is negative or not a number.
        """
        who, rng = self.__class__.__name__, np.random.default_rng(0)
        u = np.tile(rng.uniform(-1.0, 1.0, self.m) * np.minimum(self.input_limit, 1.0), (2, 1))
        g = self._probe(0.0, rng.normal(size=(2, self.n)), u)
        if not self.input_map_uses_state and not _same(g[:1], g[1:]):
            raise ValueError(
                f"{who}.input_map depends on the state: set input_map_uses_state = True, and write input_map_bound. "
                "Such an agent has no input observer (Theorem 3 is about g(u)), and its g has to be bounded"
            )
        bound = np.asarray(self.input_map_bound(), dtype=np.float64)
        if bound.shape != (self.n,) or not (bound >= 0.0).all():
            raise ValueError(
                f"{who}.input_map_bound() must return {self.n} numbers that aren't negative, one for each state "
                f"{tuple(self.states)}; got {bound}"
            )
        return bound

    def _probe(self, t: float, x: FloatArray, u: FloatArray) -> FloatArray:
        """Values of g at inputs (K, m), evaluated as in a simulator: one environment of K agents."""
        states = np.broadcast_to(x, (1, len(u), self.n)).copy()
        time, inputs = np.full((1, 1), t), u[None].copy()
        g = self._evaluated(lambda: self.input_map(time, states, inputs), states, "input_map(t, x, u)")
        return require_shape(self, g, states.shape, "input_map(t, x, u)")[0]

    def _evaluated(self, side: Callable[[], FloatArray], x: FloatArray, what: str) -> FloatArray:
        """The value of a right-hand side; an error in it says which one it is and how x is indexed."""
        try:
            with np.errstate(all="ignore"):
                return side()
        except NotImplementedError as error:
            raise ValueError(str(error)) from error
        except Exception as error:
            first = next(iter(self.states))
            raise ValueError(
                f"{self.__class__.__name__}.{what} raised {type(error).__name__} ({error}) on x of shape {x.shape}: "
                f"the states are the last axis, so that {first!r} is x[..., 0], and np.stack takes axis=-1"
            ) from error

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
        """True if g is bounded: the paper's Assumption 2-i, under which the input observer can be left out."""
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
        return self.__class__, *((name, _hashable(value)) for name, value in vars(self).items())

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, AgentModel) and self._key() == other._key())

    def __hash__(self) -> int:
        return hash(self._key())
