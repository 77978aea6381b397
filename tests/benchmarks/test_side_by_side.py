"""Two policies in the same episode: the same starts, and the same part of the plane on both sides."""

import numpy as np
import pytest

from benchmarks import side_by_side as module
from benchmarks.side_by_side import INK, Side, side_by_side

POLICIES = {"still": "zero", "random": "random"}


def status(side: Side) -> tuple[str, str]:
    return f"{side.run.episode_return:.2f}", INK


@pytest.mark.parametrize(("environment", "scenario"), [("consensus_v0", "paper"), ("navigation_v0", "crossing")])
def test_both_sides_show_the_same(environment, scenario):
    film = side_by_side(environment, POLICIES, status, scenario_name=scenario, seed=3, every=0.1, duration=0.5)
    pictures = list(film.frames)
    assert len(pictures) == 6
    assert {picture.shape for picture in pictures} == {(480, 1034, 3)}
    left, right = film.sides
    assert not np.array_equal(left.run.simulator.x, right.run.simulator.x)
    for side in film.sides:
        assert side.run.simulator.t[0] == pytest.approx(0.5)
    one, other = (side._renderer._camera for side in film.sides)
    assert one.rect == pytest.approx(other.rect)
    assert one.meters == pytest.approx(other.meters, rel=1e-12)
    np.testing.assert_allclose(one.center, other.center)
    for side in film.sides:  # everybody is in view
        pixels = one.pixels(side.run.env.batched.world.positions()[:, :2, 0])
        x, y, width, height = one.rect
        assert np.all((pixels > (x, y)) & (pixels < (x + width, y + height)))


def test_the_rewards_are_those_of_the_environment():
    """Not of the arguments that a learned policy was trained with."""
    run = module.run_of("navigation_v0", "filter:announce=true:ppo:pretrained/navigation_crossing", "crossing", 0, {})
    assert run.env.batched.task.goal_radius == 0.2
    assert run.env.batched.task.penalty == 0.0
    assert run.env.batched.settings.message_size == 4


def test_sides_that_begin_differently_are_refused(monkeypatch):
    made, seeds = module.run_of, iter((0, 1))
    monkeypatch.setattr(module, "run_of", lambda *given: made(*given[:3], next(seeds), given[4]))
    with pytest.raises(ValueError, match="consensus_v0 on paper, seed 5: the two sides begin in different states"):
        side_by_side("consensus_v0", POLICIES, status, scenario_name="paper", seed=5, every=0.1)
