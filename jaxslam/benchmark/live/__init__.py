"""Live timing: frames at the rate of the camera, this tracker and other programs in turn."""
