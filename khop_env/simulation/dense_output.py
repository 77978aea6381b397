"""Values between the ends of a step, which keep the guarantee: dense output for samples at given times.

docs/theory/step.md, "Between the ends of a step".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, IntArray
from khop_env.simulation.step_control import StepControl

if TYPE_CHECKING:
    from khop_env.simulation.simulator import Simulator

_MOST_SAMPLES = 32  # that are completed together, as one batch of environments
_MOST_NUMBERS = 1_000_000  # estimates of such a batch


class DenseOutput:
    """Samples of a run of one environment at given times, within the steps that `StepControl` takes.

    States follow a polynomial of degree 3 (`StepControl.states_at`). Estimates' errors over the funnel's width follow
    the straight line between the ends of the step, so that |xi| / rho is at most that at one of the ends. The law is
    evaluated at each sample.

    Args:
        control: of a simulator of one environment; its next step is the first.
        write: called with a simulator whose first environments are samples, in order, and with their number.
    """

    def __init__(self, control: StepControl, write: Callable[[Simulator, int], None]) -> None:
        self._control, self._write, simulator = control, write, control.simulator
        self._layouts = simulator.design.states.layout, simulator.design.inputs.layout
        widest = max(1, *(each.size for each in self._layouts))
        self._samples = simulator.resized(max(1, min(_MOST_SAMPLES, _MOST_NUMBERS // widest)))
        present = simulator.state.arrays()
        for name, values in self._samples.state.arrays().items():
            values[...] = present[name]  # of the one environment
        # errors over widths, (columns, 2) at both ends of the step and (columns, samples) in between
        self._ends = [np.zeros((each.size, 2)) for each in self._layouts]
        self._inside = [np.zeros((each.size, self._samples.num_envs)) for each in self._layouts]
        self._filled = 0
        self._note_end()
        none = np.zeros(0)  # compiles the rest
        for ends, inside in zip(self._ends, self._inside, strict=True):
            _between(none, 0, ends, inside)
        self._complete()

    def take(self, times: FloatArray) -> None:
        """Sample the step that was just taken; called after every step.

        Args:
            times: (count,) ascending, after its beginning, none after its end.
        """
        control, state = self._control, self._samples.state
        self._note_end()
        end = control.simulator.state.t[0]
        while len(times):
            start, some = self._filled, times[: self._samples.num_envs - self._filled]
            state.t[start : start + len(some)] = some
            share = np.minimum(1.0 - (end - some) / control.last, 1.0)
            control.states_at(share, control.last, start, state.x)
            for ends, inside in zip(self._ends, self._inside, strict=True):
                _between(share, start, ends, inside)
            self._filled += len(some)
            if self._filled == self._samples.num_envs:
                self.flush()
            times = times[len(some) :]

    def flush(self) -> None:
        """Write the samples that haven't been written yet."""
        if self._filled:
            self._complete()
            self._write(self._samples, self._filled)
            self._filled = 0

    def _complete(self) -> None:
        """From states and errors over widths to estimates and inputs."""
        samples, state = self._samples, self._samples.state
        widths = samples.observers.rho.at(state.t), samples.observers.omega.at(state.t)  # type: ignore[attr-defined]
        layouts, memory = self._layouts, state.memory
        for kind, name in enumerate(("estimate", "input_estimate")):
            if kind:
                samples.plant.actuate(state)
            source = (state.x, state.g)[kind]
            columns = layouts[kind].column_source, layouts[kind].column_row
            _estimates(*columns, source, widths[kind], self._inside[kind], memory[name])

    def _note_end(self) -> None:
        """Keep the errors over widths at the end of the step."""
        simulator = self._control.simulator
        state, observers = simulator.state, simulator.observers
        for kind, widths in enumerate((observers.rho, observers.omega)):  # type: ignore[attr-defined]
            layout, ends = self._layouts[kind], self._ends[kind]
            estimate = state.memory[("estimate", "input_estimate")[kind]]
            columns = layout.column_source, layout.column_row
            _errors(*columns, (state.x, state.g)[kind], widths.at(state.t), estimate, ends)


@compiled
def _between(share: FloatArray, start: int, ends: FloatArray, out: FloatArray) -> None:
    """Write values on the line between both ends, from the column `start` on."""
    for c in range(ends.shape[0]):
        for k in range(share.size):
            out[c, start + k] = (1.0 - share[k]) * ends[c, 0] + share[k] * ends[c, 1]


@compiled
def _errors(
    source: IntArray, row: IntArray, true: FloatArray, width: FloatArray, estimate: FloatArray, ends: FloatArray
) -> None:
    """Write errors over widths into the second column of `ends`, whose first becomes what this was."""
    for c in range(ends.shape[0]):
        ends[c, 0] = ends[c, 1]
        ends[c, 1] = (estimate[c, 0] - true[source[c], 0]) / width[row[c], 0]


@compiled
def _estimates(
    source: IntArray, row: IntArray, true: FloatArray, width: FloatArray, inside: FloatArray, out: FloatArray
) -> None:
    """Write the estimates whose errors over widths are `inside`, all (columns, samples)."""
    for c in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[c, k] = true[source[c], k] + width[row[c], k] * inside[c, k]
