from .detections import Detections as Detections
from .detections import Detector as Detector
from .detections import no_detections as no_detections
from .detector import OnnxDetector as OnnxDetector
from .detector import load_detector as load_detector
