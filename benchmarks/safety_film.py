"""Film an episode twice, side by side: the same filter on point estimates, and on estimates with certified bounds.

python -m benchmarks.safety_film docs/images/safety.gif         # or .mp4
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.side_by_side import BAD, GOOD, Side, side_by_side
from khop_env.results.video import require_video, write_frames
from khop_env.terminal import say

POLICIES = {"filter on point estimates": "filter:margin=none", "filter on certified bounds": "filter"}
FPS = 10
HOLD = 1.5  # s: the last picture stays


def collisions(side: Side) -> tuple[str, str]:
    """The number of collisions until now, and its colour."""
    return (f"agents that collided: {side.collisions}", BAD) if side.collisions else ("no collision", GOOD)


def main() -> None:
    """Write the film."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("path", type=Path, help="of the film, .gif or .mp4")
    parser.add_argument("--scenario", default="swap", help="of navigation_v0; swap by default")
    parser.add_argument("--seed", type=int, default=23, help="of the episode; 23 by default, in which agents collide")
    parser.add_argument("--observer", type=int, default=0, help="number of the agent whose estimates are drawn")
    chosen = parser.parse_args()
    require_video(chosen.path)
    film = side_by_side(
        "navigation_v0",
        POLICIES,
        collisions,
        scenario_name=chosen.scenario,
        seed=chosen.seed,
        every=1.0 / FPS,
        observer=chosen.observer,
    )
    pictures = list(film.frames)
    pictures += pictures[-1:] * round(HOLD * FPS)
    typical = [pictures[number * (len(pictures) - 1) // 3] for number in range(4)]
    write_frames(iter(pictures), chosen.path, FPS, lambda: typical)
    say(f"{chosen.path}: {len(pictures)} pictures, {chosen.path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
