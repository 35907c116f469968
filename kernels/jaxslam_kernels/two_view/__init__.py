"""Two views: fundamental matrix, homography, epipolar distances."""
