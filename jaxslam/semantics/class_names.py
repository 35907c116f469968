"""Names of the classes of public data sets, and of the classes of a network."""

import ast
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

from jaxslam.errors import ConfigError, ModelError, nearest

# The 91 categories of COCO by id, as its annotations number them. The second version of the data set leaves eleven
# of them without an object; the id 0 is no category.
_COCO_IDS = """
person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant - stop_sign parking_meter
bench bird cat dog horse sheep cow elephant bear zebra giraffe - backpack umbrella - - handbag tie suitcase frisbee
skis snowboard sports_ball kite baseball_bat baseball_glove skateboard surfboard tennis_racket bottle - wine_glass cup
fork knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch potted_plant
bed - dining_table - - toilet - tv laptop mouse remote keyboard cell_phone microwave oven toaster sink refrigerator
- book clock vase scissors teddy_bear hair_drier toothbrush
"""

COCO_IDS: tuple[str, ...] = ("", *(name.strip("-").replace("_", " ") for name in _COCO_IDS.split()))
"""Name of each COCO category id, 0 to 90; empty for unused ids."""

COCO: tuple[str, ...] = tuple(name for name in COCO_IDS if name)
"""The 80 classes of COCO, in the order of the outputs of networks."""

VOC: tuple[str, ...] = (
    *("background", "airplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow"),
    *("dining table", "dog", "horse", "motorcycle", "person", "potted plant", "sheep", "couch", "train", "tv"),
)
"""The 21 classes of PASCAL VOC's segmentation, under COCO's names."""

_SYNONYMS = {
    "aeroplane": "airplane",
    "motorbike": "motorcycle",
    "diningtable": "dining table",
    "pottedplant": "potted plant",
    "sofa": "couch",
    "tvmonitor": "tv",
}

GROUPS: Mapping[str, tuple[str, ...]] = {
    "people": ("person",),
    "vehicles": ("bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat"),
    "animals": ("bird", "cat", "dog", "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe"),
    "furniture": ("chair", "couch", "potted plant", "bed", "dining table"),
    "bags": ("backpack", "handbag", "suitcase"),
    "handheld": (
        *("umbrella", "frisbee", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard"),
        *(
            "tennis racket",
            "bottle",
            "wine glass",
            "cup",
            "fork",
            "knife",
            "spoon",
            "bowl",
            "laptop",
            "mouse",
            "remote",
        ),
        *("keyboard", "cell phone", "book", "vase", "scissors", "teddy bear", "hair drier", "toothbrush"),
    ),
}
"""Classes of COCO by group. The first three groups move by themselves; the others are moved by someone."""

_MOVE_BY_THEMSELVES = frozenset(name for group in ("people", "vehicles", "animals") for name in GROUPS[group])


class FoundClasses(NamedTuple):
    """Classes that someone wants a network to find.

    Attributes:
        known: Those that the network knows, by COCO's names.
        missing: Those that it does not know, by COCO's names.
    """

    known: tuple[str, ...]
    missing: tuple[str, ...]


def one_name(name: str) -> str:
    """Return COCO's name of a class, so that a label means the same for every network."""
    return _SYNONYMS.get(name.strip(), name.strip())


def box_names(num_classes: int, stored: tuple[str, ...] | None) -> tuple[str, ...] | None:
    """Return the names of the classes of a network for boxes; `None` if they are unknown.

    Args:
        num_classes: Number of classes in the network's outputs.
        stored: Names in the network's metadata, if any.
    """
    return stored if stored and len(stored) == num_classes else (COCO if num_classes == len(COCO) else None)


def pixel_names(num_classes: int, stored: tuple[str, ...] | None) -> tuple[str, ...] | None:
    """Return the names of the classes of a network for pixels; `None` if they are unknown.

    Without stored names, only 21 classes are unambiguous: 19 may be those of Cityscapes or parts of a face, and 20 may
    be clothes.

    Args:
        num_classes: Number of classes in the network's outputs.
        stored: Names in the network's metadata, if any.
    """
    return stored if stored and len(stored) == num_classes else (VOC if num_classes == len(VOC) else None)


def stored_names(metadata: Mapping[str, str]) -> tuple[str, ...] | None:
    """Parse the entry `names` of a model's metadata: `{0: 'person', ...}` or `['person', ...]`.

    Raises:
        ModelError: If the entry has neither form.
    """
    text = metadata.get("names")
    if text is None:
        return None
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = None
    if isinstance(value, dict) and sorted(map(str, value)) == sorted(str(index) for index in range(len(value))):
        value = [value[key] for key in sorted(value, key=int)]
    if not isinstance(value, list | tuple) or not value or not all(isinstance(name, str) for name in value):
        expected = "a list of names, or a name for each number from 0 on"
        raise ModelError(f"metadata names: expected {expected}, got {text[:80]!r}")
    return tuple(map(one_name, value))


def valid_labels(names: Iterable[str]) -> list[str]:
    """Return the names that a caller may ask for, sorted."""
    return sorted({name for name in names if name})


def find_classes(labels: Collection[str], names: Iterable[str]) -> FoundClasses:
    """Look up the classes that a list of labels names.

    Args:
        labels: Names of classes, as the network, COCO or PASCAL VOC names them, or of groups in `GROUPS`. The network's
            own names go first: if it has a class `animals`, that class alone is meant.
        names: Classes of the network.

    Raises:
        ConfigError: If there is no label, or one names neither a class nor a group.
    """
    own = valid_labels(names)
    if isinstance(labels, str) or not labels:
        raise ConfigError(f"labels: expected one or more names in a list, got {labels!r}")
    wanted: list[str] = []
    for label in labels:
        name = one_name(label) if isinstance(label, str) else ""
        valid = {*own, *COCO, *GROUPS}
        if name not in valid:
            expected = "classes of the network, of COCO or of PASCAL VOC, or groups of classes"
            raise ConfigError(f"labels: expected {expected}, got {label!r}{nearest(str(label), valid)}")
        wanted += [name] if name in own else GROUPS.get(name, (name,))
    known, missing = ([n for n in dict.fromkeys(wanted) if (n in own) == there] for there in (True, False))
    return FoundClasses(tuple(known), tuple(missing))


def moves_by_itself(label: str) -> bool:
    """Return whether an object of a class can move by itself; a class that COCO does not have may."""
    name = one_name(label)
    return name in _MOVE_BY_THEMSELVES or name not in COCO
