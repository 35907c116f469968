"""What every kernel says of arguments that do not fit, while tracing, and of none at all."""

import importlib
import inspect
import pkgutil
import re
from functools import partial
from typing import Annotated, Any, cast

import jax
import jax.numpy as jnp
import jaxslam_kernels
import numpy as np
import pytest
from jaxlie import SE3
from jaxslam_kernels.bundle.bundle_adjust import BundleStatus
from jaxslam_kernels.camera import make_intrinsics, project
from jaxslam_kernels.checks import checked
from jaxslam_kernels.pose.pose_refine import PoseStatus
from jaxslam_kernels.two_view.fundamental import FundamentalStatus
from jaxslam_kernels.types import Mask, Pixels, Points, Scalar, Weights
from jaxtyping import Array, Key
from kernel_cases import cases, filled
from quick_compile import quick_compile

N = 11
CASES = cases(N)
EMPTY = cases(0)
ANY_SHAPE = {"absolute_orientation", "adjugate", "valid_depth", "loss_value", "loss_weight", "compose", "between"}
INSIDE = {  # parts of kernels: called by kernels only, with what those have checked
    *("bundle.edges", "bundle.lens", "bundle.point_chunk", "bundle.schur", "bundle.zero_weight_points", "checks"),
    "derivative_rules",
    *(
        "flow.lk_row_search",
        "flow.lk_search",
        "image.patches",
        "implicit_positions",
        "levenberg_marquardt",
        "pose.pose_cost",
    ),
    *("pose_graph.block_tridiagonal_cg", "pose_graph.cost", "pose_graph.sparse_solve", "two_view.fundamental_refine"),
    *("positive_definite", "program_parts", "two_view.homography"),
}
NOT_CHECKED = {  # parts of kernels beside public ones, and functions of the host
    *("bundle_problem", "free_cameras", "clean_weights", "bundle_views", "bundle_cost", "normal_equations"),
    *("exact_blocks", "solve_bundle", "refine_problem", "solve_pose", "lenient_promotion"),
    *("band_rank", "suitable_group_size", "seed_words", "network_shapes"),
}
NO_SHAPES = {"make_intrinsics", "empty_grid", "empty_table"}  # they take no arrays


def _leaves(arguments):
    """Name and shape of every array, such as `observations.xy`."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(arguments)[0]:
        name = jax.tree_util.keystr(path)
        yield re.sub(r"^\['(\w+)'\]", r"\1", name).replace("[<flat index 0>]", ".wxyz_xyz"), leaf


def _with(arguments, name, change):
    """The arguments with one array changed."""
    names = iter([name for name, _ in _leaves(arguments)])
    return jax.tree.map(lambda leaf: change(leaf) if next(names) == name else leaf, arguments)


def _trace(case, arguments):
    with jax.enable_x64(True):
        return jax.eval_shape(lambda arguments: case.function(**arguments), arguments)


def _of_type(dtype):
    return lambda leaf: jax.ShapeDtypeStruct(leaf.shape, dtype)


def _floats(arguments):
    return [name for name, leaf in _leaves(arguments) if leaf.dtype == jnp.float32]


def test_all_kernels_are_here():
    found = set()
    for module in pkgutil.walk_packages(jaxslam_kernels.__path__, "jaxslam_kernels."):
        if module.ispkg or module.name.removeprefix("jaxslam_kernels.") in INSIDE:
            continue
        loaded = importlib.import_module(module.name)
        functions = inspect.getmembers(loaded, inspect.isfunction)
        found |= {name for name, f in functions if f.__module__ == loaded.__name__ and not name.startswith("_")}
    assert found - NOT_CHECKED == set(CASES) | NO_SHAPES


@pytest.mark.parametrize("kernel", CASES)
def test_what_fits_goes_through(kernel):
    case = CASES[kernel]
    _trace(case, case.arguments)


@pytest.mark.parametrize("kernel", CASES)
def test_wrong_shape(kernel):
    """Of each array in turn, one dimension more; and another number of points."""
    case = CASES[kernel]
    for name, leaf in _leaves(case.arguments):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) or kernel in ANY_SHAPE:
            continue
        longer = lambda leaf: jax.ShapeDtypeStruct((9, 9, *leaf.shape), leaf.dtype)
        with pytest.raises(ValueError, match=rf"^{kernel}: {re.escape(name)}: expected .*\), got \w+ \(9, 9"):
            _trace(case, _with(case.arguments, name, longer))


@pytest.mark.parametrize("kernel", CASES)
def test_wrong_type(kernel):
    """Whole numbers where there should be others, and the other way round."""
    case = CASES[kernel]
    for name, leaf in _leaves(case.arguments):
        if name in ("image", "pictures"):
            continue  # of any number
        wrong = jnp.int32 if jnp.issubdtype(leaf.dtype, jnp.floating) else jnp.float32
        with pytest.raises(TypeError, match=rf"^{kernel}: {re.escape(name)}: expected .*, got {jnp.dtype(wrong)} "):
            _trace(case, _with(case.arguments, name, _of_type(wrong)))


@pytest.mark.parametrize("kernel", CASES)
def test_mixed_precision(kernel):
    case = CASES[kernel]
    names = [name for name in _floats(case.arguments) if name not in ("image", "pictures")]
    for name in names if len(names) > 1 else []:
        with pytest.raises(TypeError, match=rf"^{kernel}: [\w.\[\]]+: expected float(32|64) .* like .*, got float"):
            _trace(case, _with(case.arguments, name, _of_type(jnp.float64)))


WHOLE = {"depth_change", "half_size", "build_pyramid", "cross_matrix", "displacement", "draw_samples"}


@pytest.mark.parametrize("kernel", sorted(set(EMPTY) - WHOLE))
def test_nothing(kernel):
    """No points, no pairs, no edges: finite numbers and an honest status."""
    case = EMPTY[kernel]
    result = quick_compile(lambda arguments: case.function(**arguments))(filled(case.arguments))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
    expected = {
        "refine_pose": PoseStatus.TOO_FEW_POINTS,
        "ransac_pnp": PoseStatus.TOO_FEW_POINTS,
        "ransac_fundamental": FundamentalStatus.TOO_FEW_POINTS,
        "bundle_adjust": BundleStatus.NOTHING_TO_ADJUST,
    }
    if kernel in expected:
        assert result.status == expected[kernel]


@checked
def _checked_example(
    T_world_cam: SE3,
    X_world: Points,
    uv: Pixels,
    *,
    weights: Weights | None = None,
    sigma: Weights | Scalar | float = 1.0,
    mask: Mask | None = None,
    poses: Annotated[SE3, "k"] | None = None,
    num_steps: int = 3,
):
    return num_steps


_example: Any = _checked_example  # what does not fit is not for the static checker to find
POSE = SE3(jnp.array([1, 0, 0, 0, 0, 0, 0], jnp.float32))


class TestWords:
    """The whole of an error."""

    @pytest.mark.parametrize(
        ("changed", "error", "message"),
        [
            (
                {"uv": np.zeros((60, 2))},
                ValueError,
                "uv: expected float (2, 60), got float32 (60, 2) (n = 60 from X_world)",
            ),
            ({"X_world": np.zeros((60, 3))}, ValueError, "X_world: expected float (3, n), got float32 (60, 3)"),
            ({"uv": None}, TypeError, "uv: expected float (2, 60), got None"),
            ({"uv": [[0.0]]}, TypeError, "uv: expected float (2, 60), got list"),
            ({"sigma": np.zeros(3)}, ValueError, "sigma: expected float (60,), got float32 (3,) (n = 60 from X_world)"),
            ({"sigma": np.zeros((3, 60))}, ValueError, "sigma: expected float (60,) or float (), got float32 (3, 60)"),
            ({"sigma": "1"}, TypeError, "sigma: expected float (60,) or float (), got '1'"),
            ({"mask": np.ones(60)}, TypeError, "mask: expected bool (60,), got float32 (60,)"),
            ({"T_world_cam": np.ones(7)}, TypeError, "T_world_cam: expected SE3, got float32 (7,)"),
            ({"poses": POSE}, ValueError, "poses.wxyz_xyz: expected float (k, 7), got float32 (7,)"),
            ({"num_steps": 2.0}, TypeError, "num_steps: expected a Python int, got 2.0"),
        ],
    )
    def test_words(self, changed, error, message):
        single = lambda x: x.astype(np.float32) if isinstance(x, np.ndarray) else x
        fitting = {"T_world_cam": POSE, "X_world": np.zeros((3, 60)), "uv": np.zeros((2, 60))}
        with pytest.raises(error, match=f"^{re.escape(f'_checked_example: {message}')}$"):
            _example(**{name: single(value) for name, value in (fitting | changed).items()})

    def test_precision(self):
        X_world, uv = np.zeros((3, 60), np.float32), np.zeros((2, 60))
        _example(POSE, X_world, uv)  # JAX itself makes them one
        with jax.enable_x64(True), pytest.raises(TypeError) as caught:
            _example(POSE, X_world, uv)
        expected = "_checked_example: uv: expected float32 (2, 60) like T_world_cam.wxyz_xyz, got float64 (2, 60)"
        assert str(caught.value) == expected

    def test_options(self):
        case = CASES["refine_pose"]
        told = "one of 'squared', 'huber', 'cauchy', 'geman_mcclure', got 'Cauchy'; did you mean 'cauchy'?"
        with pytest.raises(ValueError, match=f"^{re.escape(f'refine_pose: loss: expected {told}')}"):
            jax.eval_shape(partial(CASES["refine_pose"].function, loss="Cauchy"), **case.arguments)
        with pytest.raises(ValueError, match=r"bundle_adjust: loss: .* got 'tukey'"):
            jax.eval_shape(partial(CASES["bundle_adjust"].function, loss="tukey"), **CASES["bundle_adjust"].arguments)
        with pytest.raises(ValueError, match=r"ate: alignment: .* got 'SE3'; did you mean 'se3'"):
            jax.eval_shape(partial(CASES["ate"].function, alignment="SE3"), **CASES["ate"].arguments)

    def test_unknown_argument(self):
        with pytest.raises(TypeError, match=r"^_checked_example: got an unexpected keyword argument 'weight'"):
            _example(POSE, np.zeros((3, 60)), np.zeros((2, 60)), weight=1)


class TestWhatIsTaken:
    """Numbers, NumPy's arrays, weak types, and every transformation."""

    def test_numbers(self):
        X_world, uv = np.zeros((3, 60), np.float32), np.zeros((2, 60), np.float32)
        for sigma in (1.0, 1, np.float64(1), np.float32(1), jnp.asarray(1.0), np.ones(60, np.float32)):
            assert _example(POSE, X_world, uv, sigma=sigma) == 3

    def test_weak_types_have_no_precision(self):
        with jax.enable_x64(True):
            run = jax.jit(
                lambda sigma: _example(POSE, jnp.zeros((3, 2), "float32"), jnp.zeros((2, 2), "float32"), sigma=sigma)
            )
            assert run(1.0) == 3

    def test_random_keys_of_both_kinds(self):
        @checked
        def draw(key: Key[Array, ""]):
            return jax.random.uniform(key)

        assert draw(jax.random.key(0)) == draw(jax.random.PRNGKey(0))
        with pytest.raises(TypeError, match=r"^draw: key: expected random key \(\), got 0$"):
            draw(cast(Any, 0))

    def test_transformations(self):
        camera = make_intrinsics(100.0, 100.0, 50.0, 50.0)
        X = jnp.ones((4, 3, 2))
        batched = jax.jit(jax.vmap(partial(project, camera)))(X)
        assert batched.shape == (4, 2, 2)
        with pytest.raises(ValueError, match=r"project: X_cam: expected float \(3, n\), got float32 \(2, 3\)"):
            jax.vmap(partial(project, camera))(X.swapaxes(1, 2))
        gradient = jax.grad(lambda camera: project(camera, X[0]).sum())(camera)
        assert gradient.cx == 2
