"""A furnished room with walking people, rendered: RGB-D recordings with exact ground truth, without any download."""

from jaxslam.datasets.synthetic.dataset import SyntheticConfig as SyntheticConfig
from jaxslam.datasets.synthetic.dataset import SyntheticDataset as SyntheticDataset
from jaxslam.datasets.synthetic.dataset import SyntheticFrame as SyntheticFrame
from jaxslam.datasets.synthetic.detector import SceneDetector as SceneDetector
from jaxslam.datasets.synthetic.sensor import PERFECT_SENSOR as PERFECT_SENSOR
from jaxslam.datasets.synthetic.sensor import SensorConfig as SensorConfig
from jaxslam.datasets.synthetic.truth import with_true_masks as with_true_masks
from jaxslam.datasets.synthetic.write import write_tum as write_tum
