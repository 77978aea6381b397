"""Small GIFs for pages: few colours, the same in all pictures."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

COLORS = 64
HOLD = 1500  # ms for which the last picture stays


def shrunk(pictures: Iterable[Any]) -> list[Any]:
    """PIL's pictures with few colours, the same for all: those of four of them."""
    import numpy as np
    from PIL import Image

    kept = list(pictures)
    typical = np.vstack([np.asarray(kept[number * (len(kept) - 1) // 3]) for number in range(4)])
    palette = Image.fromarray(typical).quantize(COLORS, Image.Quantize.MEDIANCUT, kmeans=3)
    entries = np.array(palette.getpalette()).reshape(-1, 3)
    entries[entries.min(axis=1) > 247] = 255  # the background stays white
    palette.putpalette(entries.ravel().tolist())
    return [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in kept]


def write_film(path: Path, pictures: Sequence[Any], shown: int, comment: str = "") -> None:
    """Write pictures as a GIF in a loop.

    Args:
        path: of the file.
        pictures: that `shrunk` returns.
        shown: time for which each is shown, in ms; the last one stays for a while.
        comment: text in the file.
    """
    first, *others = pictures
    duration = [shown] * len(others) + [HOLD]
    extra = {"comment": comment.encode()} if comment else {}
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0, optimize=True, **extra)
    print(f"{path.name}: {len(pictures)} pictures, {path.stat().st_size // 1000} kB")
