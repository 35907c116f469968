"""Read examples of objects to segment from a file or a folder: masks, boxes or points.

```yaml
examples:
  - label: person            # an image with a mask, white on the thing, of the same size: for in-context segmenters
    image: office.png        # beside this file
    mask: office_mask.png
  - label: person            # or with boxes and points, of which a promptable segmenter makes the mask
    image: hall.png
    boxes: [[10, 20, 200, 400]]  # left, top, right, bottom in pixels
  - label: arm               # without an image: of every frame, for a camera that stands still or moves with the thing
    points: [[320, 450]]     # pixels (u, v) of the thing, (0, 0) the center of the top left one
    not_points: [[320, 20]]  # pixels that are not of it
```

A folder holds one for each class, named as it is, with pairs of images `NAME.png` (or .jpg) and `NAME_mask.png`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from jaxslam.config.validation import ValidatedConfig, from_mapping
from jaxslam.errors import ConfigError
from jaxslam.io.yaml_files import check_keys, read_mapping
from jaxslam.semantics.prompted.prompt import Prompt, prompt
from jaxslam.semantics.prompted.segmenter import PromptSegmenter
from jaxslam.sensors.image_files import read_color, read_gray

_MASK = "_mask"
_IMAGES = (".png", ".jpg", ".jpeg")


class Example(NamedTuple):
    """An example of an object.

    Attributes:
        origin: File and entry of the example, for messages.
        label: Name of the object's class.
        image: `(h, w, 3)` RGB image; `None` for prompts of every frame.
        mask: `(h, w)` mask of the object; `None` if the example has prompts.
        prompts: Boxes and points; empty if the example has a mask.
    """

    origin: str
    label: str
    image: UInt8[np.ndarray, "h w 3"] | None
    mask: Bool[np.ndarray, "h w"] | None
    prompts: tuple[Prompt, ...]


@dataclass(frozen=True)
class _Row(ValidatedConfig):
    """One example as a file holds it, with the keys that the module describes."""

    label: str
    image: str | None = None
    mask: str | None = None
    boxes: tuple[tuple[float, float, float, float], ...] | None = None
    points: tuple[tuple[float, float], ...] | None = None
    not_points: tuple[tuple[float, float], ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [key for key in ("boxes", "points", "not_points") if getattr(self, key)]
        if not self.label.strip():
            raise ConfigError(f"label: expected the name of a class, got {self.label!r}")
        if self.mask is not None and (self.image is None or given):
            got = "no image" if self.image is None else given[0]
            raise ConfigError(f"mask: expected an image, and neither boxes nor points, beside it, got {got}")
        for left, top, right, bottom in self.boxes or ():
            if not (right > left and bottom > top):
                got = [left, top, right, bottom]
                raise ConfigError(f"boxes: expected left, top, right, bottom, in this order, got {got}")
        if self.mask is None and not (self.boxes or self.points):
            raise ConfigError("expected a mask, boxes or points of the object, got none")
        if (self.points or self.not_points) and len(self.boxes or ()) > 1:
            raise ConfigError(f"boxes: expected one at most with points, got {len(self.boxes or ())}")

    def prompts(self) -> tuple[Prompt, ...]:
        """Return one prompt for each box, or one prompt of all points with at most one box."""
        boxes, on, beside = self.boxes or (), self.points or (), self.not_points or ()
        if not on and not beside:
            return tuple(prompt(self.label, box=box) for box in boxes)
        return (prompt(self.label, box=boxes[0] if boxes else None, on=on, beside=beside),)


def read_examples(path: Path) -> list[Example]:
    """Read the examples of a YAML file or a folder.

    Raises:
        ConfigError: If there are no examples, or one is wrong.
        DatasetError: If an image cannot be read.
    """
    if path.is_dir():
        return _of_folder(path)
    content = read_mapping(path, ConfigError)
    check_keys(content, ("examples",), ("examples",), str(path), ConfigError)
    rows = content["examples"]
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f"{path}: examples: expected a list of one or more, got {rows!r}")
    origins = [f"{path}: examples[{number}]" for number in range(len(rows))]
    return [
        _of_row(from_mapping(_Row, row, origin), path.parent, origin) for row, origin in zip(rows, origins, strict=True)
    ]


def with_masks(examples: Sequence[Example], segmenter: PromptSegmenter | None) -> list[Example]:
    """Add the masks that a promptable segmenter makes from boxes and points, as USD-SLAM does with SAM.

    Args:
        examples: Examples with images.
        segmenter: Segmenter for the examples without a mask; `None` if there is none.

    Raises:
        ConfigError: If an example has no mask and there is no segmenter, or the segmenter finds nothing.
        ModelError: If the segmenter fails.
    """
    return [each if each.mask is not None else _segmented(each, segmenter) for each in examples]


def _segmented(example: Example, segmenter: PromptSegmenter | None) -> Example:
    assert example.image is not None  # as said
    if segmenter is None:
        raise ConfigError(f"{example.origin}: expected a mask, or a promptable segmenter to make it, got neither")
    mask = segmenter(example.image, example.prompts).masks.any(axis=0)
    if not mask.any():
        raise ConfigError(f"{example.origin}: expected boxes or points of a thing, got some where nothing is found")
    return example._replace(mask=mask)


def _of_folder(folder: Path) -> list[Example]:
    found = [
        _with_mask(mask, image, mask.parent.name, str(image))
        for mask in sorted(folder.glob(f"*/*{_MASK}.png"))
        for image in [_image_of(mask)]
    ]
    if not found:
        raise ConfigError(f"{folder}: expected images LABEL/NAME.png with masks LABEL/NAME{_MASK}.png, got none")
    return found


def _image_of(mask: Path) -> Path:
    stem = mask.stem.removesuffix(_MASK)
    images = [path for suffix in _IMAGES if (path := mask.with_name(stem + suffix)).is_file()]
    if len(images) != 1:
        raise ConfigError(f"{mask}: expected one image {stem}.png or .jpg beside it, got {len(images)}")
    return images[0]


def _of_row(row: _Row, folder: Path, origin: str) -> Example:
    label, image = row.label, row.image
    if row.mask is not None and image is not None:
        return _with_mask(folder / row.mask, folder / image, label, origin)
    prompts = row.prompts()
    if image is None:
        return Example(origin, label, None, None, prompts)
    pixels = read_color(folder / image)
    for each in prompts:
        if not ((each.points >= 0) & (each.points <= pixels.shape[1::-1])).all():
            size = f"{pixels.shape[1]}x{pixels.shape[0]} pixels of {image}"
            raise ConfigError(f"{origin}: expected boxes and points in the {size}, got {each.points.tolist()}")
    return Example(origin, label, pixels, None, prompts)


def _with_mask(mask: Path, image: Path, label: str, origin: str) -> Example:
    pixels, gray = read_color(image), read_gray(mask)
    if gray.shape != pixels.shape[:2]:
        (height, width), (rows, columns) = pixels.shape[:2], gray.shape
        raise ConfigError(f"{origin}: mask: expected the image's {width}x{height} pixels, got {columns}x{rows}")
    if not gray.any():
        raise ConfigError(f"{origin}: mask: expected white on the thing, got a black picture")
    return Example(origin, label, pixels, gray > gray.max() // 2, ())
