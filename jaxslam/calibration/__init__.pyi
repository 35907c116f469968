from .camera_calibration import calibrate as calibrate
from .gyro_calibration import calibrate_gyro as calibrate_gyro
from .report import Calibration as Calibration
from .report import Estimate as Estimate
from .report import ResidualField as ResidualField
from .report import Verdict as Verdict
from .start_camera import StartCamera as StartCamera
from .start_camera import open_with_start as open_with_start
