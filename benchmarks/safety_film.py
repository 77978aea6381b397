"""Film an episode twice, side by side: the same filter on point estimates, and on estimates with certified bounds.

python -m benchmarks.safety_film docs/images/safety.gif         # or .mp4
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.running import PolicyRun, policy_run
from khop_env.env.rendering import Renderer, Scene
from khop_env.registry import scenario
from khop_env.results.video import require_video, write_frames
from khop_env.terminal import say

POLICIES = {"filter on point estimates": "filter:margin=none", "filter on certified bounds": "filter"}
FPS = 10
HOLD = 1.5  # s: the last picture stays
SIZE = (444, 480)  # pixels of a map; the strip is beside the second
STRIP = 148
INK, HIT, GOOD = "#222222", "#cc3311", "#228833"


class Half:
    """One of the two episodes.

    Args:
        title: above the map.
        run: at the beginning of the episode.
        observer: index of the agent whose estimates are drawn.
        panel: whether time and legend are beside the map.
    """

    def __init__(self, title: str, run: PolicyRun, observer: int, panel: bool) -> None:
        self.title, self.run = title, run
        self._batched = batched = run.env.batched
        self._renderer = Renderer.of(
            batched.task,
            batched.world,
            batched.simulator.observers,
            observer=observer,
            panel=panel,
            size=(SIZE[0] + STRIP * panel, SIZE[1]),
        )
        self._touching: set[int] = set()
        self.collisions = 0

    def step(self) -> None:
        """A control period, unless the episode is over."""
        if self.run.ended():
            return
        self.run.step(self._batched.settings.control_period)
        cost = self._batched.task.evaluate(self._batched.world).infos["cost"][0]
        touching = set(np.flatnonzero(cost).tolist())
        self.collisions += len(touching - self._touching)
        self._touching = touching
        simulator = self._batched.simulator
        self._renderer.remember(float(simulator.t[0]), simulator.x[0])

    def frame(self) -> NDArray[np.uint8]:
        """The picture, with the title and the number of collisions until now."""
        from PIL import Image, ImageDraw

        batched = self._batched
        draw = functools.partial(batched.task.draw, world=batched.world)
        scene = Scene.of(batched.simulator, float(batched.task_errors().mean()), draw)
        picture = Image.fromarray(self._renderer.frame(scene))
        pen = ImageDraw.Draw(picture)
        pen.text((44, 15), self.title, INK, _font(13), anchor="lm")
        hits = f"agents that collided: {self.collisions}" if self.collisions else "no collision"
        pen.text((SIZE[0] - 22, 44), hits, HIT if self.collisions else GOOD, _font(12), anchor="rm")
        return np.asarray(picture)


@functools.cache
def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans-Bold.ttf", size)


def frames(name: str, seed: int, observer: int) -> Iterator[NDArray[np.uint8]]:
    """Both episodes until both are over, side by side."""
    halves = [
        Half(
            title, policy_run(spec, scenario(name), "estimate", None, seed, environment="navigation_v0"), observer, last
        )
        for (title, spec), last in zip(POLICIES.items(), (False, True), strict=True)
    ]
    every = round(1.0 / FPS / halves[0].run.env.batched.settings.control_period)
    yield _joined(halves)
    while not all(half.run.ended() for half in halves):
        for half in halves * every:
            half.step()
        yield _joined(halves)
    for _ in range(round(HOLD * FPS)):
        yield _joined(halves)


def _joined(halves: Sequence[Half]) -> NDArray[np.uint8]:
    return np.hstack([half.frame() for half in halves])


def main() -> None:
    """Write the film."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("path", type=Path, help="of the film, .gif or .mp4")
    parser.add_argument("--scenario", default="swap", help="of navigation_v0; swap by default")
    parser.add_argument("--seed", type=int, default=23, help="of the episode; 23 by default, in which agents collide")
    parser.add_argument("--observer", type=int, default=0, help="number of the agent whose estimates are drawn")
    chosen = parser.parse_args()
    require_video(chosen.path)
    pictures = list(frames(chosen.scenario, chosen.seed, chosen.observer))
    typical = [pictures[number * (len(pictures) - 1) // 3] for number in range(4)]
    write_frames(iter(pictures), chosen.path, FPS, lambda: typical)
    say(f"{chosen.path}: {len(pictures)} pictures, {chosen.path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
