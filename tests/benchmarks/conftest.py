"""What timings share: XLA computes in one thread, as it does by itself in a process that starts on one core."""

from jaxslam.xla import prefer_one_thread

prefer_one_thread()  # before the first array, which tests make when they are imported
