"""The paper's observers of one agent, by rounds of messages: each solves its own scalar equations, in plain Python."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from khop_env.observers.design import Funnels, ObserverDesign
from khop_env.observers.impulse import impulse
from khop_env.observers.layout import FloatArray
from khop_env.observers.performance import PerformanceFunction
from khop_env.observers.remote import intervals_of
from khop_env.physics import AgentModel


@dataclass
class LocalObserver:
    """An observer of one target, and what it holds of others, by sender.

    Attributes:
        model: of the target.
        drift: whether the observer uses f.
        rho: funnels, one per component.
        estimate: (n_i,).
        peers: last estimate that came from each agent that estimates the target, too.
        sources: last true value that came from each agent that relays the target's, or from itself.
    """

    model: AgentModel
    drift: bool
    rho: tuple[PerformanceFunction, ...]
    estimate: FloatArray
    peers: dict[int, FloatArray]
    sources: dict[int, FloatArray]

    def solved(self, t: float, tau: float) -> FloatArray:
        """The estimate after a proximal step of `tau` s that ends at `t`, against what is held.

        Each component y solves y - y* + tau phi'(e) / rho = 0, where e = (d y - sum of what is held) / rho and d is the
        number of what is held.
        """
        degree = len(self.peers) + len(self.sources)
        total = sum([*self.peers.values(), *self.sources.values()], np.zeros_like(self.estimate))
        found = self.estimate.copy()
        for c, function in enumerate(self.rho):
            rho = float(function(np.array([t]))[0])
            z = impulse(float(degree * found[c] - total[c]) / rho, tau * degree / rho**2)
            found[c] -= tau * z / rho
        return found

    def moved(self, t: float, dt: float, step: float, effect: FloatArray | None) -> FloatArray:
        """The estimate of a state `dt` s after time `t`, by Euler steps of about `step` s: y' = f(y) + g_hat.

        Args:
            t: in s.
            dt: in s.
            step: in s.
            effect: (n_i,) the estimate g_hat of the input's effect, None without one.
        """
        estimate = self.estimate
        if dt == 0.0:
            return estimate
        intervals = intervals_of(dt, step)
        for k in range(intervals):
            rate = np.zeros_like(estimate)
            if self.drift:
                with np.errstate(over="ignore", invalid="ignore"):
                    rate = self.model.drift(np.array([t + k * dt / intervals]), estimate[None])[0]
            if effect is not None:
                rate = rate + effect
            estimate = estimate + dt / intervals * rate
        return estimate


def local_observers(
    design: ObserverDesign, funnels: Funnels, agent: int, guess: FloatArray
) -> dict[int, LocalObserver]:
    """The observers of an agent by target.

    Args:
        design: the observers of the whole fleet.
        funnels: `design.states` or `design.inputs`.
        agent: its index.
        guess: (n,) what all start from.
    """
    layout, found = funnels.layout, {}
    entries, sender = layout.arrays.entry_start, layout.links.sender
    for block in layout.blocks:
        start = guess[block.sources]
        for pair in range(block.pairs.start, block.pairs.stop):
            if layout.observer[pair] != agent:
                continue
            peers = sender[layout.entry_link[entries[pair] : entries[pair + 1]]].tolist()
            sources = sender[layout.relay_link[layout.relay_start[pair] : layout.relay_start[pair + 1]]].tolist()
            found[block.agent] = LocalObserver(
                design.fleet.models[block.agent],
                design.options[block.agent].drift,
                funnels.rho.functions[block.rows],
                start.copy(),
                dict.fromkeys(peers, start),
                dict.fromkeys(sources, start),
            )
    return found
