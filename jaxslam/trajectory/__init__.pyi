from .consistency import Consistency as Consistency
from .consistency import RelativePoses as RelativePoses
from .consistency import evaluate_consistency as evaluate_consistency
from .coverage import Coverage as Coverage
from .evaluation import Evaluation as Evaluation
from .evaluation import evaluate as evaluate
from .trajectory import Trajectory as Trajectory
