"""The same problems solved by Ceres and GTSAM."""
