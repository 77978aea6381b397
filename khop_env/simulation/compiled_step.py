"""A whole step of plant and observers in one compiled call, where everything in it is the library's own.

It is `Proximal.advance`, `FleetPlant` and `FunnelObservers.raise_extremes` with the same operations in the same order,
so that the results are theirs to the bit (tests/simulation/test_compiled_step.py). Everything happens in a range of
environments, so that threads share a batch, and block by block, so that the arrays of a block stay in the cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from khop_env.compiled import available, compiled, numba
from khop_env.elementary import combine, copy_block
from khop_env.observers import FloatArray, IntArray, Observers, Proximal
from khop_env.observers.base import Extremes
from khop_env.observers.disagreement import largest_ratios
from khop_env.observers.performance import exponentials
from khop_env.observers.prediction import predict
from khop_env.observers.solve import solve
from khop_env.physics.right_hand_sides import input_maps
from khop_env.simulation.edge_law import HELD, command_inputs
from khop_env.simulation.packing import (
    System,
    Values,
    Work,
    all_drifts_in,
    edges_in,
    estimates_in,
    input_runs_in,
    inputs_in,
    omega_in,
    packed,
    rho_in,
    runs_in,
    states_in,
    sums_in,
    terms_in,
)
from khop_env.simulation.plant import FleetPlant, advance_plant, require_finite
from khop_env.simulation.state import SimulatorState

PATIENCE = 2000
"""Steps of a simulator in Python before the compiled step is compiled, where it hasn't been yet."""
BLOCK = 256  # environments: enough to fill vector registers, few enough for the cache
_STATE, _STATES, _INPUTS = 1, 2, 3  # what failed: a state, the state observers' solve, or the input observers'


class CompiledStep:
    """Advances a simulator's state by one step of the proximal scheme; made by `compiled_step`.

    Args:
        plant: without Python in it.
        observers: prepared.
        state: advanced in place.
        before: gets the state at the beginning of each step.
        extremes_before: gets the running maxima there.
    """

    def __init__(
        self,
        plant: FleetPlant,
        observers: Proximal,
        state: SimulatorState,
        before: SimulatorState,
        extremes_before: Extremes,
    ) -> None:
        design, fleet, batch = observers.design, plant.fleet, plant.num_envs
        self._plant, self._observers, self._state = plant, observers, state
        self._waited = -1  # steps since its code was looked for on disk
        states, inputs, edges = design.states, design.inputs, plant.edges
        runs, input_runs, all_drifts = observers.prediction.compiled_runs()
        self._system = packed(
            System(
                plant.runs,
                runs,
                plant.terms,
                tuple(edges),
                tuple(states.layout.packed),
                tuple(inputs.layout.packed),
                states.rho.coefficients,
                inputs.rho.coefficients,
                states.layout.inverse_row_sums,
                inputs.layout.inverse_row_sums,
                input_runs,
                np.array([fleet.position_dim, all_drifts], np.int64),
            )
        )
        self._work = Work(
            plant.rates_of(observers.stages.predicted.shape[0]),
            *observers.stages,
            np.zeros((fleet.n, batch)),
            np.zeros((len(states.rho), batch)),
            np.zeros((len(inputs.rho), batch)),
            np.zeros((*edges.own.shape, batch)),
            np.zeros((fleet.position_index.size, batch)),
            np.zeros((fleet.n, batch)),
        )
        values = tuple(Values.of(state)), tuple(Values.of(before))
        self._arrays = *values, state.drawn, tuple(self._work), tuple(extremes_before)

    def ready(self, extremes: Extremes, now: bool = False) -> bool:
        """Whether to use it for the next step, of which this is asked once.

        Its code takes longer to compile than short runs take in Python. So it is used from the first step where it has
        been compiled before, and otherwise compiled after `PATIENCE` steps, or `now`.
        """
        if self._waited < 0 and available(step, *self._arguments(1.0, extremes, False), 0, 0):
            self._waited = PATIENCE
        self._waited = PATIENCE if now else self._waited + 1
        return self._waited >= PATIENCE

    def _arguments(self, dt: float, extremes: Extremes, held: bool) -> tuple[Any, ...]:
        law, scheme = self._plant.edge_law(), self._observers.scheme(dt)
        return (*self._system, law, *scheme, *self._arrays, tuple(extremes), held)

    def __call__(self, dt: float, extremes: Extremes, held: bool) -> None:
        """Advance by `dt` seconds, and raise the running maxima `extremes`.

        Args:
            dt: in s.
            extremes: raised.
            held: whether inputs are new, so that their effect has to be computed first.

        Raises:
            SolveError: if a number isn't finite; the state is undefined then.
        """
        run: Any = step
        common = self._arguments(dt, extremes, held)
        ranges = self._plant.ranges
        if len(ranges) == 1:
            self._settle(*run(*common, *ranges[0]))
            return
        for result in self._plant.threads.run(lambda range_: run(*common, *range_), ranges):
            self._settle(*result)

    def _settle(self, failure: int, evaluations: int, env: int, target: int) -> None:
        """Count the work of a range; raise the error of what failed."""
        observers, state, work = self._observers, self._state, self._work
        if not failure:
            observers.evaluations += evaluations
            return
        if failure == _STATE:
            require_finite(state.x, self._plant.fleet)
        of_inputs = failure == _INPUTS
        funnels = observers.design.inputs if of_inputs else observers.design.states
        source, rho = (state.g, work.omega) if of_inputs else (state.x, work.rho)
        observers.account([(evaluations, env, target)], funnels, source, rho)


def compiled_step(
    plant: FleetPlant,
    observers: Observers,
    state: SimulatorState,
    before: SimulatorState,
    extremes_before: Extremes,
) -> CompiledStep | None:
    """The compiled step, or None where Python is needed: for models, disturbances, laws or funnels of a user, or links
    that come and go.
    """
    if type(observers) is not Proximal or observers.links is not None or not plant.compiled or numba is None:
        return None
    design = observers.design
    known = observers.prediction.compiled_runs()[0] is not None
    return (
        CompiledStep(plant, observers, state, before, extremes_before)
        if known and design.states.rho.exponential and design.inputs.rho.exponential
        else None
    )


@compiled
def step(
    integers: IntArray,
    floats: FloatArray,
    law: Any,
    nodes: FloatArray,
    explicit: FloatArray,
    implicit: FloatArray,
    now: Any,
    before: Any,
    drawn: FloatArray,
    work: Any,
    extremes_before: Any,
    extremes: Any,
    held: bool,
    low: int,
    high: int,
) -> tuple[int, int, int, int]:
    """One step in the environments low to high - 1.

    Args:
        integers: of the `packed` `System`.
        floats: likewise.
        law: the fields of `EdgeLaw`; HELD for inputs that are held.
        nodes: (stages,) times of the stages after the beginning, in s.
        explicit: (stages, stages) weights of the rates, in s.
        implicit: (stages, stages) of the corrections, in s.
        now: the fields of `Values`, advanced.
        before: likewise, overwritten with the state at the beginning.
        drawn: (B, K) the disturbance's random numbers.
        work: the fields of `Work`.
        extremes_before: those of `Extremes`, overwritten with the running maxima at the beginning.
        extremes: those of `Extremes`, raised.
        held: whether the effect of the inputs has to be computed first.
        low: first environment.
        high: one past the last.

    Returns:
        What failed, if anything (_STATE, _STATES or _INPUTS), and then as `solve`.
    """
    n, f = integers, floats
    runs, estimates, input_runs, all_drifts = runs_in(n, f), estimates_in(n, f), input_runs_in(n), all_drifts_in(n)
    terms, edges, states, inputs = terms_in(n, f), edges_in(n, f), states_in(n, f), inputs_in(n, f)
    rho, omega, (state_sums, input_sums) = rho_in(n, f), omega_in(n, f), sums_in(n, f)
    now, before, work = Values(*now), Values(*before), Work(*work)
    extremes, earlier = Extremes(*extremes), Extremes(*extremes_before)
    observed, evaluations = inputs[0].size, 0
    for begin in range(low, high, BLOCK):
        end = min(begin + BLOCK, high)
        if held:
            input_maps(runs, now.x, now.u, now.g, begin, end)
        for e in range(begin, end):
            before.t[e] = now.t[e]
            earlier.normalized[e], earlier.relative[e] = extremes.normalized[e], extremes.relative[e]
            earlier.input_normalized[e] = extremes.input_normalized[e]
            earlier.input_relative[e] = extremes.input_relative[e]
        copy_block(now.x, before.x, begin, end)
        copy_block(now.u, before.u, begin, end)
        copy_block(now.g, before.g, begin, end)
        copy_block(now.estimate, before.estimate, begin, end)
        copy_block(now.input_estimate, before.input_estimate, begin, end)
        copy_block(now.eps, before.eps, begin, end)
        copy_block(now.nu, before.nu, begin, end)
        for s in range(nodes.size):
            tau = implicit[s, s]
            predict(estimates, all_drifts, input_runs, now.estimate, now.input_estimate, work.predicted[s], begin, end)
            if not advance_plant(
                runs,
                terms,
                drawn,
                s,
                nodes[s],
                explicit[s],
                before.t,
                before.x,
                now.t,
                now.x,
                now.g,
                work.rates,
                work.w,
                begin,
                end,
            ):
                return _STATE, evaluations, -1, -1
            combine(before.estimate, explicit[s], s + 1, work.predicted, now.estimate, begin, end)
            combine(now.estimate, implicit[s], s, work.slopes, now.estimate, begin, end)
            exponentials(now.t, rho[0], rho[1], rho[2], work.rho, begin, end)
            count, env, target = solve(
                states,
                tau,
                now.estimate,
                now.x,
                work.rho,
                now.eps,
                now.estimate,
                work.slopes[s],
                (begin, end),
                (0, states[0].size),
            )
            evaluations += count
            if env >= 0:
                return _STATES, evaluations, env, target
            if law[0] != HELD:
                command_inputs(
                    law,
                    edges,
                    runs,
                    now.x,
                    now.estimate,
                    now.u,
                    work.terms,
                    work.velocity,
                    work.drift,
                    begin,
                    end,
                )
            input_maps(runs, now.x, now.u, now.g, begin, end)
            if observed:
                if s:
                    combine(before.input_estimate, implicit[s], s, work.input_slopes, now.input_estimate, begin, end)
                exponentials(now.t, omega[0], omega[1], omega[2], work.omega, begin, end)
                count, env, target = solve(
                    inputs,
                    tau,
                    now.input_estimate,
                    now.g,
                    work.omega,
                    now.nu,
                    now.input_estimate,
                    work.input_slopes[s],
                    (begin, end),
                    (0, observed),
                )
                evaluations += count
                if env >= 0:
                    return _INPUTS, evaluations, env, target
        largest_ratios(
            states,
            now.estimate,
            now.x,
            work.rho,
            state_sums,
            extremes.normalized,
            extremes.relative,
            begin,
            end,
        )
        if observed:
            largest_ratios(
                inputs,
                now.input_estimate,
                now.g,
                work.omega,
                input_sums,
                extremes.input_normalized,
                extremes.input_relative,
                begin,
                end,
            )
    return 0, evaluations, -1, -1
