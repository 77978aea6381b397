"""A recording as a film: frames of the environment's renderer in an .mp4 or .gif file."""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from khop_env.env import BatchedEnv
from khop_env.extras import how_to_install
from khop_env.results.metrics import consensus_error
from khop_env.results.recording import Progress, Recording
from khop_env.results.records import MessageRecord, ObserverRecord
from khop_env.scenarios import Scenario
from khop_env.tasks import directed

if TYPE_CHECKING:
    from khop_env.env.rendering import Renderer

SIZES = {".mp4": (900, 720), ".gif": (720, 576)}
"""Width and height in pixels by suffix; even, as H.264 requires."""

_PACKAGES = {".mp4": ("pygame", "imageio_ffmpeg"), ".gif": ("pygame", "PIL")}


def require_video(path: str | Path) -> None:
    """Check before a run that a film can be written.

    Args:
        path: path of the file; its suffix sets the format.

    Raises:
        ValueError: if the suffix isn't .mp4 or .gif.
        ModuleNotFoundError: if a package is missing; the message says what to install.
    """
    ending = Path(path).suffix.lower()
    if ending not in SIZES:
        raise ValueError(f"{path}: a video's name must end in {' or '.join(SIZES)}; got {ending or 'no suffix'!r}")
    missing = [name for name in _PACKAGES[ending] if importlib.util.find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(f"{path}: videos need {' and '.join(missing)}: {how_to_install('render')}")
    if ending == ".mp4":
        _ffmpeg()


def write_video(
    recording: Recording,
    scenario: Scenario,
    path: str | Path,
    *,
    observer: str | int | None = None,
    env: BatchedEnv | None = None,
    fps: int = 25,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Write a film of a run: agents, edges, and one agent's estimates of its k-hop targets.

    Each frame shows the sample nearest in time, the last frame the final sample. With fewer samples per second than
    frames, samples repeat.

    Args:
        recording: recording of the run.
        scenario: scenario of the run.
        path: path of the file; .mp4 (H.264) or .gif (in a loop; its times are rounded to 10 ms).
        observer: id or index of the agent whose estimates are drawn; by default the agent with most task edges to
            agents that aren't its neighbours.
        env: the environment of the run, for its task's edges and the mean of its task error; None for agreement along
            the scenario's task graph, with the consensus error |Pi p|. What else the task draws is in the recording.
        fps: frames per second, up to 50.
        speed: simulated seconds per second of the film.
        progress: called with the completed fraction.

    Returns:
        The path.

    Raises:
        ValueError: if suffix, observer, fps or speed is invalid.
        ModuleNotFoundError: if a package is missing; the message says what to install.
        OSError: if the file can't be written; no partial file is left.
    """
    require_video(path)
    from khop_env.env.rendering import Renderer

    path = Path(path)
    if not (1 <= fps <= 50 and 0.0 < speed < np.inf):
        raise ValueError(f"expected fps from 1 to 50 and a positive, finite speed; got fps={fps!r}, speed={speed!r}")
    index = None if observer is None else recording.fleet.agent(observer)
    size = SIZES[path.suffix.lower()]
    if env is None:
        edges = directed(scenario.task)
        over = recording.states if isinstance(recording.states, MessageRecord) else None
        renderer = Renderer(
            recording.design,
            edges,
            layout=recording.states.layout,
            network=None if over is None else over.network,
            estimator="" if over is None else over.estimator,
            observer=index,
            title=scenario.name,
            error_label="consensus error",
            size=size,
        )
    else:
        title = f"{env.task.name} on {scenario.name}"
        renderer = Renderer.of(env.task, env.world, env.simulator.observers, observer=index, title=title, size=size)
    samples = _samples(recording, fps / speed)
    frames = _frames(renderer, recording, samples, progress)
    ends = samples[0], samples[len(samples) // 2], samples[-1]
    return write_frames(frames, path, fps, lambda: [*_frames(renderer, recording, ends)])


def write_frames(
    frames: Iterator[NDArray[np.uint8]], path: Path, fps: int, typical: Callable[[], Sequence[NDArray[np.uint8]]]
) -> Path:
    """Write pictures as a film.

    Args:
        frames: (H, W, 3) each.
        path: of the file, .mp4 or .gif.
        fps: frames per second.
        typical: returns some of them, which have all colours; for .gif.

    Raises:
        OSError: if the file can't be written; no partial file is left.
    """
    try:
        if path.suffix.lower() == ".gif":
            _write_gif(path, frames, fps, np.vstack([*typical()]))
        else:
            _write_mp4(path, frames, fps)
    except BaseException:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        raise
    return path


def _samples(recording: Recording, per_second: float) -> list[int]:
    """Indices of the samples nearest to the frames' times; the last frame has the last sample."""
    time = recording.time
    wanted = time[0] + np.arange(max(1, round((time[-1] - time[0]) * per_second))) / per_second
    wanted[-1] = time[-1]
    later = np.searchsorted(time, wanted).clip(1, len(time) - 1) if len(time) > 1 else np.zeros(len(wanted), int)
    return np.where(wanted - time[later - 1] < time[later] - wanted, later - 1, later).tolist()


def _frames(
    renderer: Renderer,
    recording: Recording,
    samples: Sequence[int],
    progress: Progress | None = None,
) -> Iterator[NDArray[np.uint8]]:
    from khop_env.env.rendering import Messages, Scene

    states = recording.states
    bounds = states.bound
    for number, k in enumerate(samples):
        time, x, errors = float(recording.time[k]), recording.x[k], recording.task_error
        error = float(consensus_error(recording.fleet, x)) if errors is None else float(errors[k])
        decorate = None if recording.drawings is None else recording.drawings[k]
        if isinstance(states, MessageRecord):
            messages, largest = Messages(states.age[k], states.missed[k]), _largest_share(states, k)
        else:
            kinds = (kind for kind in (states, recording.inputs) if isinstance(kind, ObserverRecord))
            messages, largest = None, max(_largest_ratio(kind, k) for kind in kinds)
        up = None if states.up is None else states.up[k]
        scene = Scene(time, x, states.estimate[k], bounds[k], largest, error, decorate, messages, up)
        yield renderer.frame(scene)
        if progress is not None:
            progress((number + 1) / len(samples))


def _largest_ratio(kind: ObserverRecord, sample: int) -> float:
    """Largest |disagreement| / funnel of one kind of observer in one sample; 0 without observers."""
    layout = kind.funnels.layout
    funnels = kind.funnels.rho.evaluate(kind.time[[sample]], np.empty((layout.rows, 1)))
    return float(np.max(np.abs(kind.disagreement[sample]) / funnels[layout.column_row, 0], initial=0.0))


def _largest_share(record: MessageRecord, sample: int) -> float:
    """Largest error over its certified bound in one sample; 0 where nothing is certified."""
    truth, bound = record.truth[sample, record.layout.column_source], record.bound[sample]
    error = np.abs(record.estimate[sample] - truth)
    return float(np.max(np.divide(error, bound, out=np.where(error > 0.0, np.inf, 0.0), where=bound > 0.0)))


def _write_mp4(path: Path, frames: Iterator[NDArray[np.uint8]], fps: int) -> None:
    first = next(frames)
    height, width, _ = first.shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
    target = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart", str(path.resolve())]
    command = [_ffmpeg(), "-loglevel", "error", "-y", *source, *target]
    with tempfile.TemporaryFile() as log:
        with (
            contextlib.suppress(BrokenPipeError),  # ffmpeg has ended; its message is in the log
            subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log) as process,
        ):
            assert process.stdin is not None
            try:
                for frame in itertools.chain([first], frames):
                    process.stdin.write(frame.data)
            except BaseException:
                process.kill()
                raise
        if process.returncode:
            log.seek(0)
            raise OSError(f"ffmpeg: {log.read().decode(errors='replace').strip() or process.returncode}")


def _ffmpeg() -> str:
    """Path of the ffmpeg program.

    Raises:
        ModuleNotFoundError: if it isn't available on this machine.
    """
    from imageio_ffmpeg import get_ffmpeg_exe

    try:
        return str(get_ffmpeg_exe())
    except RuntimeError as error:
        raise ModuleNotFoundError(f"videos in .mp4 need ffmpeg; .gif doesn't: {error}") from None


def _write_gif(path: Path, frames: Iterator[NDArray[np.uint8]], fps: int, colors: NDArray[np.uint8]) -> None:
    """Write frames with the palette of the image `colors`; a common palette keeps unchanged pixels out of the file."""
    from PIL import Image

    palette = Image.fromarray(colors).quantize(256, Image.Quantize.MAXCOVERAGE)
    entries = np.array(palette.getpalette()).reshape(-1, 3)
    entries[entries.min(axis=1) > 247] = 255  # the background stays white
    palette.putpalette(entries.ravel().tolist())
    pictures = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    next(pictures).save(path, save_all=True, append_images=pictures, duration=round(100 / fps) * 10, loop=0)
