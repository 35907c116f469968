"""Suites of recordings run with presets: plans, runs, stored results, gates, published figures."""
