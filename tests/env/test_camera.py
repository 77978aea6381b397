"""The view holds what it follows, and labels find room beside their markers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.env.rendering.camera import Camera, Labels


class TestCamera:
    RECT = (50.0, 40.0, 600.0, 500.0)

    @given(
        st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=1, max_size=5),
        st.lists(st.floats(0.0, 2.0), min_size=1, max_size=4),
    )
    def test_what_is_followed_is_in_view(self, points, times):
        camera = Camera(self.RECT, margin=30.0)
        for number, elapsed in enumerate(times):
            followed = np.array(points) * (1.0 + number)
            camera.follow(followed, elapsed)
            pixels = camera.pixels(followed)
            assert np.all(pixels >= (80 - 1e-6, 70 - 1e-6))
            assert np.all(pixels <= (620 + 1e-6, 510 + 1e-6))

    def test_closes_in_slowly_and_then_stays(self):
        camera = Camera(self.RECT, margin=30.0)
        wide, narrow = np.array([[-5.0, 0.0], [5.0, 0.0]]), np.array([[-1.0, 0.0], [1.0, 0.0]])
        camera.follow(wide, np.inf)
        start = camera.meters
        camera.follow(narrow, 0.04)
        assert 0.9 * start < camera.meters < start
        for _ in range(1000):
            camera.follow(narrow, 0.04)
        assert camera.meters == pytest.approx(start / 5)

    @given(st.floats(1e-3, 1e6), st.floats(-1e4, 1e4))
    def test_ticks_are_round_and_apart(self, scale, middle):
        camera = Camera(self.RECT, margin=30.0)
        camera.follow(middle + scale * np.array([[-1.0, -1.0], [1.0, 1.0]]), np.inf)
        for axis in (0, 1):
            places, texts = zip(*camera.ticks(axis), strict=True)
            assert np.all(np.abs(np.diff(places)) >= 70 - 1e-3)
            assert len(set(texts)) == len(texts)


def test_labels_cover_nothing():
    """Agents that have almost met: each label that is placed is free of markers and of other labels."""
    rng = np.random.default_rng(0)
    anchors, sizes, radii = rng.normal(300.0, 25.0, (25, 2)), np.tile([18.0, 12.0], (25, 1)), np.full(25, 7.0)
    taken = np.hstack([anchors - 7.0, anchors + 7.0])
    labels = Labels()
    places = labels.place(anchors, sizes, radii, taken, (0.0, 0.0, 600.0, 600.0))
    assert len(places) > 15
    middles = np.array([middle for middle, _ in places.values()])
    apart = np.abs(middles[:, None] - middles[None])
    assert np.all((apart[..., 0] >= 18 - 1e-9) | (apart[..., 1] >= 12 - 1e-9) | np.eye(len(middles), dtype=bool))
    from_markers = np.abs(middles[:, None] - anchors[None])
    assert np.all((from_markers[..., 0] >= 9 + 7 - 1e-9) | (from_markers[..., 1] >= 6 + 7 - 1e-9))
    own = np.abs(middles - anchors[list(places)])
    assert np.all((own[:, 0] >= 9 + 7 + 4 - 1e-9) | (own[:, 1] >= 6 + 7 + 4 - 1e-9))  # clear of rings around markers
    again = labels.place(anchors + 0.01, sizes, radii, taken + 0.01, (0.0, 0.0, 600.0, 600.0))
    assert {n: far for n, (_, far) in again.items()} == {n: far for n, (_, far) in places.items()}
    for number, (middle, _) in again.items():
        assert middle == pytest.approx(places[number][0] + 0.01)  # labels don't jump
