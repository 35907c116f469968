"""Import heavy libraries before the first frame: `import jaxslam` skips them, and they must not delay a later frame."""


def import_scipy() -> None:
    """Import the parts of SciPy that the map uses.

    They take a third of the time of `import jax`, and code that only tracks or only reads trajectories does not need
    them. The functions that use SciPy import it again, which costs nothing by then.
    """
    import scipy.sparse.csgraph  # noqa: PLC0415
    import scipy.sparse.linalg  # noqa: PLC0415
    import scipy.spatial  # noqa: F401, PLC0415
