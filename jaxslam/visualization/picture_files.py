"""Several pictures in one file: a contact sheet, an animation."""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from jaxslam.visualization.plots import PNG_LEVEL

_GIF_COLORS, _MAX_GIF_BYTES, _SHEET_COLUMNS = 128, 3_000_000, 4


def spread(pictures: Sequence[np.ndarray], most: int, random: np.random.Generator | None = None) -> list[np.ndarray]:
    """Choose `most` pictures, or all: one by chance from each of as many parts of equal length."""
    if len(pictures) <= most:
        return list(pictures)
    random = random or np.random.default_rng(0)
    ends = np.linspace(0, len(pictures), most + 1).astype(int)
    return [pictures[index] for index in random.integers(ends[:-1], ends[1:])]


def contact_sheet(pictures: Sequence[np.ndarray]) -> bytes:
    """Encode pictures of one size, `(h, w, 3)` uint8 RGB, in rows of four as a PNG."""
    from skimage.util import montage  # noqa: PLC0415 - used once, at the end of a run

    columns = min(len(pictures), _SHEET_COLUMNS)
    shape = -(-len(pictures) // columns), columns
    file = io.BytesIO()
    sheet = montage(np.stack(pictures), fill=(255, 255, 255), grid_shape=shape, channel_axis=-1)
    Image.fromarray(sheet).save(file, "PNG", compress_level=PNG_LEVEL)
    return file.getvalue()


def small_animation(pictures: Sequence[np.ndarray], frame_ms: int) -> bytes:
    """Encode a GIF of all pictures, or of every 2nd, 4th, ... if it would be larger than 3 MB.

    Args:
        pictures: Pictures of one size, `(h, w, 3)` uint8 RGB.
        frame_ms: Time for which each is shown.
    """
    data = _animation(pictures, frame_ms)
    while len(data) > _MAX_GIF_BYTES and len(pictures) > 1:
        pictures = pictures[::2]
        data = _animation(pictures, frame_ms)
    return data


def _animation(pictures: Sequence[np.ndarray], frame_ms: int) -> bytes:
    """Encode a GIF with one palette, so that a mask has the same color in all frames."""
    palette = Image.fromarray(np.concatenate(spread(pictures, 8))).quantize(_GIF_COLORS)
    frames = [Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    file = io.BytesIO()
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=frame_ms, loop=0)
    return file.getvalue()
