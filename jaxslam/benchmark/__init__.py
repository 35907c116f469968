"""Benchmarks: suites of recordings, batches, kernels beside other libraries, and their reports."""
