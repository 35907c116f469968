"""Pure, compiled, differentiable kernels of jaxslam: arrays in, arrays out, nothing else.

Chapters: `image`, `flow`, `depth`, `clustering`, `two_view`, `pose`, `bundle`, `pose_graph`, `trajectory`. Single
modules: `camera` and `rolling_shutter` (models of a camera), `se3` and `types`, `scene_flow`, and what solvers share
(`levenberg_marquardt`, `robust`, `ransac_sampling`, `counter_random`, `positive_definite`, `implicit_positions`,
`derivative_rules`, `program_parts`, `checks`).

The tracker does not call `camera.undistort_pixels`, `camera.depth_from_disparity` and `camera.disparity_from_depth`:
they are for losses of your own on pixels and on stereo pairs.
"""
