"""Pyramidal Lucas-Kanade flow, patch alignment, and disparity along rows."""
