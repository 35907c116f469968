"""Suites of recordings run with presets, and reports of their figures beside published ones."""
