"""Networks that find people and other movable things in an image, whatever family they are of.

A detector is any callable that takes an image and returns `Detections`; `load_detector` makes one of an ONNX file.
"""

from jaxslam.semantics.detections import Detections as Detections
from jaxslam.semantics.detections import Detector as Detector
from jaxslam.semantics.detections import no_detections as no_detections
from jaxslam.semantics.detector import OnnxDetector as OnnxDetector
from jaxslam.semantics.detector import load_detector as load_detector
