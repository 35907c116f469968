"""Masks of movable objects: from boxes to masks, their propagation between detections, background depth, instances."""
