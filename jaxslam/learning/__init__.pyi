from .fit import Fit as Fit
from .fit import fit as fit
from .losses import ate_loss as ate_loss
from .losses import pose_loss as pose_loss
from .losses import relative_pose_loss as relative_pose_loss
