from .dataset import SyntheticConfig as SyntheticConfig
from .dataset import SyntheticDataset as SyntheticDataset
from .dataset import SyntheticFrame as SyntheticFrame
from .ground_truth_detector import SceneDetector as SceneDetector
from .ground_truth_masks import with_true_masks as with_true_masks
from .sensor_noise import PERFECT_SENSOR as PERFECT_SENSOR
from .sensor_noise import SensorConfig as SensorConfig
from .write_tum import write_tum as write_tum
