"""Pictures of the masks of a run: an animation and a contact sheet."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jaxslam.io.atomic_files import write_atomically
from jaxslam.sensors.frame import Frame
from jaxslam.slam.frame_result import FrameResult, Rejected
from jaxslam.slam.mask_pipeline import MaskSource
from jaxslam.visualization.overlay import GREEN, ORANGE, PURPLE, SKY_BLUE, VERMILION, Rgb, tint
from jaxslam.visualization.picture_files import contact_sheet, small_animation, spread

MASK_RGB: dict[MaskSource, Rgb] = {
    MaskSource.NONE: (120, 120, 120),
    MaskSource.DETECTOR: ORANGE,
    MaskSource.PROPAGATED: SKY_BLUE,
    MaskSource.CALLER: PURPLE,
    MaskSource.DEPTH: GREEN,
    MaskSource.CUES: VERMILION,
}
"""The color of a mask, by where it comes from."""

_MAX_PICTURES = 60
_WIDTH_PX, _BAR_PX, _FONT_PX = 320, 20, 14
_FRAME_MS, _SHEET_PICTURES = 150, 12


class MaskPictures:
    """Collects pictures of frames with a mask, evenly over a run: an `on_frame` of `Slam.run`.

    How many frames will have one is not known before, so that one of n is kept, and n doubles whenever there are too
    many. Which one of n is left to chance: a detector comes back every few frames, and every nth might be its own.

    Attributes:
        kept: `(h, 320, 3)` uint8 RGB each, in the order of the run: the frame, its mask in the color of its source,
            and a line that says what it is.
    """

    def __init__(self, most: int = _MAX_PICTURES) -> None:
        """Keep `most` pictures at most, half as many at least, or those there are."""
        self.kept: list[np.ndarray] = []
        self._most, self._one_of, self._wanted, self._masked, self._seen = most, 1, 0, 0, 0
        self._random = np.random.default_rng(0)

    def __call__(self, frame: Frame | None, result: FrameResult | Rejected) -> None:
        """Add one frame."""
        if frame is not None and isinstance(result, FrameResult) and result.dynamic_mask.any():
            if self._masked % self._one_of == 0:
                self._wanted = self._masked + int(self._random.integers(self._one_of))
            if self._masked == self._wanted:
                self._keep(draw_mask(frame.image, result, f"frame {self._seen}"))
            self._masked += 1
        self._seen += 1

    def _keep(self, picture: np.ndarray) -> None:
        if len(self.kept) == self._most:
            self.kept = spread(self.kept, self._most // 2, self._random)
            self._one_of *= 2
        self.kept.append(picture)


def draw_mask(image: np.ndarray, tracked: FrameResult, title: str) -> np.ndarray:
    """Draw a small picture of a frame with its mask, and the source, age and share of the mask in words.

    Args:
        image: `(h, w, 3)` RGB or `(h, w)` gray, uint8.
        tracked: Result of the frame, with a mask of the image's size.
        title: Beginning of the text.

    Returns:
        `(round(320 h / w) + 20, 320, 3)` uint8 RGB.
    """
    size = _WIDTH_PX, max(1, round(_WIDTH_PX * image.shape[0] / image.shape[1]))
    picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    picture = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
    color = MASK_RGB[tracked.mask_source]
    mask = cv2.resize(tracked.dynamic_mask.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    tint(picture, mask.view(bool), color)
    age = f", age {tracked.mask_age}" if tracked.mask_age >= 0 else ""
    text = f"{title}: {tracked.mask_source.name.lower()}{age}, {100 * tracked.dynamic_ratio:.0f} %"
    return np.concatenate([_bar(text, color), picture])


def write_mask_pictures(folder: Path, pictures: Sequence[np.ndarray]) -> None:
    """Write `masks.gif`, 3 MB at most, and `masks.png`, twelve of the pictures side by side.

    Args:
        folder: Existing folder for the files. Existing files are replaced atomically.
        pictures: At least one `(h, w, 3)` uint8 RGB picture; all have the same size.

    Raises:
        JaxSlamError: If a file cannot be written.
    """
    write_atomically(folder / "masks.png", contact_sheet(spread(pictures, _SHEET_PICTURES)))
    write_atomically(folder / "masks.gif", small_animation(pictures, _FRAME_MS))


def _bar(text: str, color: tuple[int, int, int]) -> np.ndarray:
    """Black words on a ground of a color."""
    bar = Image.new("RGB", (_WIDTH_PX, _BAR_PX), color)
    font = ImageFont.load_default(_FONT_PX)
    ImageDraw.Draw(bar).text((4, _BAR_PX // 2), text, fill=(0, 0, 0), font=font, anchor="lm")
    return np.asarray(bar)
