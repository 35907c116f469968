"""Compiled code kept between processes, so that only the first start on a machine waits for the compiler."""

from pathlib import Path

import jax
import platformdirs


def cache_dir() -> Path:
    """Where jaxslam keeps compiled code: `xla` in the user's cache folder for jaxslam."""
    return Path(platformdirs.user_cache_dir("jaxslam", appauthor=False)) / "xla"


def enable_compile_cache() -> Path:
    """Turn JAX's persistent compilation cache on, unless the user chose a folder of their own; says which is used."""
    chosen: str | None = jax.config.values["jax_compilation_cache_dir"]
    if chosen:
        return Path(chosen)
    folder = cache_dir()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return folder
