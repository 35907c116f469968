"""Import heavy libraries before the first frame: `import jaxslam` skips them, and they must not delay a later frame."""

from jaxslam.runtime.threads import bound_blas


def import_scipy(threads: int) -> None:
    """Import the parts of SciPy that the map uses, and bound the threads of the BLAS library that comes with it.

    They take a third of the time of `import jax`, and code that only tracks or only reads trajectories does not need
    them. The functions that use SciPy import it again, which costs nothing by then.

    Args:
        threads: Number of threads of BLAS.
    """
    import scipy.sparse.csgraph  # noqa: PLC0415
    import scipy.sparse.linalg  # noqa: PLC0415
    import scipy.spatial  # noqa: F401, PLC0415

    bound_blas(threads)
