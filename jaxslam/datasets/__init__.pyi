from .prefetch import Subset as Subset
from .prefetch import prefetch as prefetch
from .protocol import Associated as Associated
from .protocol import Dataset as Dataset
from .protocol import Loader as Loader
from .protocol import Unmatched as Unmatched
from .registry import dataset_kinds as dataset_kinds
from .registry import open_dataset as open_dataset
