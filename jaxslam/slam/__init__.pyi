from .frame_result import FrameRecord as FrameRecord
from .frame_result import Rejected as Rejected
from .frame_result import Tracked as Tracked
from .mask_pipeline import MaskSource as MaskSource
from .slam import Slam as Slam
