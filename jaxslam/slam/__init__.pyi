from .frame_records import FrameRecords as FrameRecords
from .frame_result import FrameRecord as FrameRecord
from .frame_result import FrameResult as FrameResult
from .frame_result import Rejected as Rejected
from .mask_pipeline import MaskSource as MaskSource
from .relative_pose_log import RelativePoseLog as RelativePoseLog
from .slam import Slam as Slam
