"""Text of `jaxslam --version`."""

import sys
from importlib.metadata import version

import cv2
import jax

from jaxslam import __version__
from jaxslam.datasets.catalog import recordings_dir
from jaxslam.runtime.compile_cache import compile_cache_dir
from jaxslam.runtime.machine import machine
from jaxslam.semantics.model_zoo import models_dir
from jaxslam.worlds.stored_world import worlds_dir


def version_text() -> str:
    """Versions of what computes, the processor, and the folders in which files are kept between runs."""
    here = machine()
    commit = "" if here["commit"] is None else f" ({here['commit']})"
    return "\n".join(
        [
            f"jaxslam {__version__}{commit}",
            f"Python {sys.version.split()[0]}, JAX {jax.__version__}, jaxlib {version('jaxlib')},"
            f" OpenCV {cv2.__version__}, NumPy {version('numpy')}, onnxruntime {version('onnxruntime')}",
            f"CPU: {here['cpu']} ({here['vectors']}), {here['cores']} cores",
            f"compiled code: {compile_cache_dir()}",
            f"networks: {models_dir()}",
            f"recordings: {recordings_dir()}",
            f"rendered frames: {worlds_dir()}",
        ]
    )
