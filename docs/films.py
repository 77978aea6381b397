"""The films and thumbnails of the site; needs the extra `render`.

python docs/films.py [ENV ...]             # environments' pages: docs/images/ENV.gif and docs/images/ENV_small.png
python docs/films.py --gallery [NAME ...]  # docs/images/gallery_NAME.gif and docs/gallery.md

`khop run` makes the films of environments; here they get fewer pictures and colours, and are small enough for a page.
"""

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for benchmarks, which aren't installed
from gallery_films import GALLERY, PAGE, page
from gallery_films import make as make_gallery
from gif import shrunk, write_film

IMAGES = Path(__file__).parent / "images"
MAP = (47, 33, 550, 536)  # the map in a picture, without axes and legend
THUMBNAIL = 360  # pixels


@dataclass(frozen=True)
class Film:
    """How a film is made, and what is in it.

    Attributes:
        options: of `khop run ENV`.
        caption: what can be seen.
        step: simulated time between pictures, in s.
        shown: time for which a picture is shown, in ms.
        thumbnail: time of the thumbnail's picture, in s.
    """

    options: str
    caption: str
    step: float
    shown: int
    thumbnail: float

    def command(self, name: str, path: str) -> str:
        """The command for the film of environment `name` in the file `path`."""
        return " ".join(filter(None, ["khop run", name, self.options, "--video", path]))


FILMS = {
    "consensus_v0": Film(
        "--duration 2",
        "Agents meet, and the view follows them. Boxes around the hollow markers hold the true positions of agents "
        "that the ringed agent only estimates.",
        step=0.1,
        shown=120,
        thumbnail=0.1,
    ),
    "formation_v0": Film(
        "--duration 2.4",
        "Agents form an octagon. Most edges of the task (dashed) join agents that don't communicate (solid).",
        step=0.1,
        shown=100,
        thumbnail=2.4,
    ),
    "leader_following_v0": Film(
        "--controller leader_following --duration 3",
        "Five followers around three leaders (stars), which they don't communicate with: dashed edges join them.",
        step=0.1,
        shown=100,
        thumbnail=3.0,
    ),
    "navigation_v0": Film(
        "--shield certified",
        "Agents on their way to their goals (green), in the filter that keeps them apart; arrows are what it changes. "
        "Boxes grow with the age of what the ringed agent has received. Twice as fast as real time.",
        step=0.3,
        shown=150,
        thumbnail=3.2,
    ),
}


def make(name: str) -> None:
    """Write the film and the thumbnail of an environment."""
    import numpy as np
    from PIL import Image

    film = FILMS[name]
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "film.gif"
        arguments = film.command(name, str(whole)).split()[1:]
        subprocess.run([sys.executable, "-m", "khop_env", *arguments, "--out", f"{folder}/run"], check=True)
        times, pictures = [0.0], []
        with Image.open(whole) as source:
            for number in range(source.n_frames):
                source.seek(number)
                pictures.append(source.convert("RGB"))
                times.append(times[-1] + source.info["duration"] / 1000)

    def at(time: float) -> Any:
        return pictures[min(np.searchsorted(times, time + 1e-6, "right") - 1, len(pictures) - 1)]

    small = at(film.thumbnail).crop(MAP).resize((THUMBNAIL, THUMBNAIL), Image.Resampling.LANCZOS)
    small.save(IMAGES / f"{name}_small.png", optimize=True)
    kept = [*map(at, np.arange(0.0, times[-1] - film.step, film.step)), pictures[-1]]
    write_film(IMAGES / f"{name}.gif", shrunk(kept), film.shown)


def main() -> None:
    """Write the films that are asked for, or all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", metavar="NAME", nargs="*", help="by default all environments, or the whole gallery")
    parser.add_argument("--gallery", action="store_true", help="films of the gallery, and its page")
    chosen = parser.parse_args()
    known = GALLERY if chosen.gallery else FILMS
    for name in chosen.names:
        if name not in known:
            parser.error(f"no film of {name!r}; there are {', '.join(known)}")
    for name in chosen.names or known:
        (make_gallery if chosen.gallery else make)(name)
    if chosen.gallery:
        PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
