"""Plots, overlays, galleries and the viewer."""
