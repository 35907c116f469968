"""Camera pose from points: P3P, absolute orientation, RANSAC PnP, robust refinement."""
