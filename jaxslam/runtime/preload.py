"""Imports that `import jaxslam` leaves out, made before the first frame instead of in the middle of a run."""


def import_scipy() -> None:
    """Import the parts of SciPy that the map uses.

    They take a third of the time of `import jax`, which a step or a trajectory alone does not need; the functions that
    use them import them again, which costs nothing then.
    """
    import scipy.sparse.csgraph  # noqa: PLC0415
    import scipy.sparse.linalg  # noqa: PLC0415
    import scipy.spatial  # noqa: F401, PLC0415
