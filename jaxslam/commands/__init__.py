"""The commands of `jaxslam`, one file each; `cli.py` chooses."""
