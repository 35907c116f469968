"""A small file, or a folder, of examples: what to segment, shown by masks, boxes or points.

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
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8

from jaxslam.config.validation import checked_value
from jaxslam.errors import ConfigError
from jaxslam.io.yaml_files import check_keys, read_mapping
from jaxslam.semantics.prompted.prompt import Prompt, prompt
from jaxslam.semantics.prompted.segmenter import PromptSegmenter
from jaxslam.sensors.image_files import read_color, read_gray

_KEYS = ("label", "image", "mask", "boxes", "points", "not_points")
_MASK = "_mask"
_IMAGES = (".png", ".jpg", ".jpeg")


class Example(NamedTuple):
    """One of them.

    Attributes:
        origin: Where it stands, for messages.
        label: What the thing is called.
        image: `(h, w, 3)` RGB; `None` if it is about every frame.
        mask: `(h, w)` true on the thing, where it has one.
        prompts: Boxes and points, where it has no mask.
    """

    origin: str
    label: str
    image: UInt8[np.ndarray, "h w 3"] | None
    mask: Bool[np.ndarray, "h w"] | None
    prompts: tuple[Prompt, ...]


def read_examples(path: Path) -> list[Example]:
    """The examples of a YAML file, or of a folder.

    Raises:
        ConfigError: If there are none, or one is not as it should be.
        DatasetError: If an image cannot be read.
    """
    if path.is_dir():
        return _of_folder(path)
    content = read_mapping(path, ConfigError)
    check_keys(content, ("examples",), ("examples",), str(path), ConfigError)
    rows = content["examples"]
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f"{path}: examples: expected a list of one or more, got {rows!r}")
    return [_of_row(row, path.parent, f"{path}: examples[{number}]") for number, row in enumerate(rows)]


def with_masks(examples: Sequence[Example], segmenter: PromptSegmenter | None) -> list[Example]:
    """Examples whose masks a promptable segmenter has made of their boxes and points, as USD-SLAM makes them with SAM.

    Args:
        examples: With images.
        segmenter: `None` if there is none.

    Raises:
        ConfigError: If an example has no mask and there is no segmenter, or it finds nothing there.
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


def _of_row(row: object, folder: Path, origin: str) -> Example:
    if not isinstance(row, dict):
        raise ConfigError(f"{origin}: expected keys such as label and image, got {row!r}")
    check_keys(row, _KEYS, ("label",), origin, ConfigError)
    label, image, mask = (checked_value(str | None, row.get(key), f"{origin}: {key}") for key in _KEYS[:3])
    if not label or not label.strip():
        raise ConfigError(f"{origin}: label: expected the name of a class, got {label!r}")
    asked = [key for key in ("boxes", "points", "not_points") if row.get(key)]
    if mask is not None:
        if image is None or asked:
            got = "no image" if image is None else asked[0]
            raise ConfigError(f"{origin}: mask: expected an image, and neither boxes nor points, beside it, got {got}")
        return _with_mask(folder / mask, folder / image, label, origin)
    prompts = _prompts(row, label, origin)
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


def _prompts(row: dict[str, Any], label: str, origin: str) -> tuple[Prompt, ...]:
    """Boxes, each a thing of its own; or points, with one box at most."""
    boxes = _rows(row, "boxes", tuple[float, float, float, float], origin)
    on, beside = (_rows(row, key, tuple[float, float], origin) for key in ("points", "not_points"))
    for left, top, right, bottom in boxes:
        if not (right > left and bottom > top):
            got = [left, top, right, bottom]
            raise ConfigError(f"{origin}: boxes: expected left, top, right, bottom, in this order, got {got}")
    if not boxes and not on:
        raise ConfigError(f"{origin}: expected a mask, boxes or points of the thing, got none")
    if not on and not beside:
        return tuple(prompt(label, box=box) for box in boxes)
    if len(boxes) > 1:
        raise ConfigError(f"{origin}: boxes: expected one at most with points, got {len(boxes)}")
    return (prompt(label, box=boxes[0] if boxes else None, on=on, beside=beside),)


def _rows(row: dict[str, Any], key: str, each: Any, origin: str) -> tuple[tuple[float, ...], ...]:
    return checked_value(tuple[each, ...] | None, row.get(key), f"{origin}: {key}") or ()
