"""Kernels beside other libraries, over sizes: what is compared, and how the times are taken and shown."""
