from .coverage import Coverage as Coverage
from .evaluation import Evaluation as Evaluation
from .evaluation import evaluate as evaluate
from .trajectory import Trajectory as Trajectory
