"""Films can be read back: they have the length of the run, the documented size, and changing frames."""

import importlib.util
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from agents import make_law
from agents.running import policy_run
from khop_env.env.rendering.on_map import Extent
from khop_env.registry import scenario as load
from khop_env.results import record, video
from khop_env.results.video import require_video, write_video
from khop_env.scenarios import mixed_fleet, paper


def recorded(scenario, duration=0.4):
    return record(scenario.build(law=make_law(scenario.law)).reset(0), duration, 0.01)


@pytest.fixture(scope="module")
def run():
    scenario = paper()
    return recorded(scenario), scenario


def test_mp4(run, tmp_path):
    path = write_video(*run, tmp_path / "film.MP4", fps=20)
    command = [video._ffmpeg(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    read = subprocess.run(command, capture_output=True, check=True)
    about = next(line for line in read.stderr.decode().splitlines() if "Video:" in line)
    frames = np.frombuffer(read.stdout, np.uint8).reshape(-1, 720, 900, 3).astype(int)
    assert all(word in about for word in ("h264", "yuv420p", "900x720", "20 fps"))  # as browsers and players expect
    assert len(frames) == 8
    assert frames[0].mean() > 200
    assert (np.abs(frames[0] - frames[-1]) > 100).sum() > 1000


def test_what_ffmpeg_says_is_passed_on(run, tmp_path):
    (tmp_path / "film.mp4").mkdir()
    with pytest.raises(OSError, match=r"ffmpeg: .*film\.mp4"):
        write_video(*run, tmp_path / "film.mp4")


def test_gif(run, tmp_path):
    path = write_video(*run, tmp_path / "film.gif")
    with Image.open(path) as film:
        assert film.size == (720, 576)
        assert film.n_frames == 10  # 0.4 s at 25 frames a second
        assert film.info["loop"] == 0
        assert film.info["duration"] == 40
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(9)
        last = np.asarray(film.convert("RGB")).astype(int)
    assert (first == 255).all(axis=2).mean() > 0.7  # the ground is white
    assert (np.abs(first - (0, 114, 178)).max(axis=2) < 8).sum() > 500  # and agents keep their colour
    assert (np.abs(first - last) > 100).sum() > 1000


def test_which_samples_are_shown(run):
    recording, _ = run
    assert video._samples(recording, 25.0) == [0, 4, 8, 12, 16, 20, 24, 28, 32, 40]
    assert video._samples(recording, 50.0)[:3] == [0, 2, 4]
    assert video._samples(recording, 1.0) == [40]  # at least one frame, and always the end
    assert len(video._samples(recording, 1000.0)) == 400  # more than there are: some twice
    alone = replace(recording, states=replace(recording.states, time=recording.time[:1]))
    assert video._samples(alone, 25.0) == [0]


def test_speed(run, tmp_path):
    with Image.open(write_video(*run, tmp_path / "film.gif", speed=2.0)) as film:
        assert film.n_frames == 5


def test_the_gauge_shows_both_kinds_of_observers_at_that_time(run, tmp_path, monkeypatch):
    from khop_env.env import rendering

    recording, scenario = run
    frames = []
    draw = rendering.Renderer.frame
    monkeypatch.setattr(rendering.Renderer, "frame", lambda self, scene: (frames.append(scene), draw(self, scene))[1])
    write_video(recording, scenario, tmp_path / "film.mp4")
    assert len(frames) == 10
    for scene, k in zip(frames, video._samples(recording, 25.0), strict=True):
        kinds = recording.states, recording.inputs
        assert scene.t == recording.time[k]
        assert np.array_equal(scene.bounds, recording.states.bound[k])
        assert scene.ratio == max((np.abs(kind.disagreement[k]) / kind.rho[k]).max() for kind in kinds)


def test_the_observer_is_chosen(tmp_path, monkeypatch):
    from khop_env.env import rendering

    scenario = mixed_fleet()
    chosen = []
    create = rendering.Renderer.__init__
    monkeypatch.setattr(
        rendering.Renderer, "__init__", lambda self, *args, **kw: (create(self, *args, **kw), chosen.append(self))[0]
    )
    recording = recorded(scenario, 0.04)
    for observer in ("vessel_1", 10):
        write_video(recording, scenario, tmp_path / "film.gif", observer=observer)
    assert [renderer.observer for renderer in chosen] == [10, 10]
    with pytest.raises(ValueError, match="did you mean 'vessel_1'"):
        write_video(recording, scenario, tmp_path / "film.gif", observer="vesel_1")


def test_refusals(run, tmp_path, monkeypatch):
    for name in ("film.avi", "film", "mp4"):
        with pytest.raises(ValueError, match=r"must end in \.mp4 or \.gif"):
            require_video(tmp_path / name)
    for options in ({"fps": 0}, {"fps": 100}, {"speed": 0.0}, {"speed": float("nan")}):
        with pytest.raises(ValueError, match="expected fps"):
            write_video(*run, tmp_path / "film.gif", **options)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install -c constraints.txt -e '\.\[render\]'"):
        require_video("film.mp4")


@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
def test_a_film_that_fails_leaves_no_half(run, tmp_path, monkeypatch, name):
    from khop_env.env import rendering

    path = tmp_path / name
    path.write_bytes(b"an older film")
    draw, drawn = rendering.Renderer.frame, []

    def failing(self, scene):
        drawn.append(scene)
        if len(drawn) > 6:
            raise RuntimeError("no ink")
        return draw(self, scene)

    monkeypatch.setattr(rendering.Renderer, "frame", failing)
    with pytest.raises(RuntimeError, match="no ink"):
        write_video(*run, path)
    assert not path.exists()


def test_a_run_that_went_wrong_is_filmed(run, tmp_path):
    recording, scenario = run
    x, estimate = recording.x.copy(), recording.states.estimate.copy()
    x[20:], estimate[20:] = np.nan, np.inf
    broken = replace(recording, x=x, states=replace(recording.states, truth=x, estimate=estimate))
    assert write_video(broken, scenario, tmp_path / "film.mp4").stat().st_size > 1000


def test_progress_is_told(run, tmp_path):
    fractions = []
    write_video(*run, tmp_path / "film.gif", progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_a_film_shows_what_the_task_draws_at_that_time(tmp_path, monkeypatch):
    """Collisions, goals and a filter's arrows of every frame, and not those of the end."""
    from khop_env.env.rendering import Renderer

    class Noted(Extent):
        def circle(self, center, radius, color, *, filled=False):
            self.points.append((*np.round(center, 9), radius, color, filled))

        def line(self, points, color, width=2.0):
            self.points.append((*np.round(points, 9).ravel(), color, width))

    def drawn(draw):
        noted = Noted()
        draw(noted)
        return noted.points

    def played():
        return policy_run("filter:margin=none", scenario, "estimate", None, 23, environment="navigation_v0")

    scenes, frame = [], Renderer.frame
    monkeypatch.setattr(Renderer, "frame", lambda self, scene: (scenes.append(scene), frame(self, scene))[1])
    scenario = load("swap:duration=2.2")
    run = played()
    recording = record(run, run.duration, 0.05, drawing=run.drawing)
    write_video(recording, scenario, tmp_path / "film.mp4", env=run.env.batched, fps=10)
    again, hits = played(), []
    assert len(scenes) == 22
    for scene in scenes:
        while float(again.simulator.t[0]) < scene.t - 1e-9:
            again.step(0.05)
        assert drawn(scene.decorate) == drawn(again.drawing())
        hits.append(sum(filled for *_, filled in drawn(scene.decorate) if filled is True))
    assert hits[0] == 0
    assert max(hits) > 0
