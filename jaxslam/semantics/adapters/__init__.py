"""Families of networks, one file each: how to recognize one, what it takes, what it gives."""

from jaxslam.semantics.adapters.base import Adapter as Adapter
from jaxslam.semantics.adapters.class_map import ClassMap
from jaxslam.semantics.adapters.fastestdet import FastestDet
from jaxslam.semantics.adapters.nanodet import NanoDet, NanoDetPlus
from jaxslam.semantics.adapters.ssd import Ssd
from jaxslam.semantics.adapters.yolov8 import YoloV8, YoloV8Seg
from jaxslam.semantics.adapters.yolox import YoloX

ADAPTERS: dict[str, type[Adapter]] = {
    adapter.name: adapter for adapter in (YoloX, NanoDet, NanoDetPlus, FastestDet, YoloV8, YoloV8Seg, Ssd, ClassMap)
}
"""All of them by name; no graph fits two."""
