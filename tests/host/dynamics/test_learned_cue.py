"""The learned cue: what it needs, how soft it is, and that the network that comes with jaxslam tells what moves."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cue_scenes import MOTIONS, N, check_finite, moves, scene
from jax.test_util import check_grads
from jaxslam_kernels.point_network import PointNetwork, network_shapes
from jaxslam_kernels.se3 import to_camera
from quick_compile import quick_compile

from jaxslam.config.cue_sections import LearnedCueConfig
from jaxslam.dynamics.cue import CueInput
from jaxslam.dynamics.learned_cue import CUE, LearnedParams, learned_cue, learned_features, network_inputs
from jaxslam.dynamics.network_file import GROUP_FEATURES, PACKAGED, POINT_FEATURES, load_network, save_network
from jaxslam.dynamics.regions import Regions
from jaxslam.errors import ModelError

pytestmark = pytest.mark.usefixtures("float64")
K = 4


def full_scene(motion: Any, moved_m: Any = (0, 0, 0), **named: Any) -> CueInput:
    """A scene in which every third point moves, all those in a region of their own."""
    given = scene(motion, moved_m, **named)
    of_point = np.where(moves(), 0, 1 + np.arange(N) // 3 % (K - 1)).astype(np.int32)
    X_cam = np.asarray(to_camera(given.T_world_cam, given.X_world))
    centers = np.stack([X_cam[:, of_point == region].mean(axis=1) for region in range(K)], axis=1)
    regions = Regions(
        jnp.zeros((4, 4), jnp.int32), jnp.asarray(of_point), jnp.asarray(centers), jnp.full(K, 1200, jnp.int32)
    )
    return given._replace(
        regions=regions,
        depth_sigma=0.003 * jnp.square(given.depth),
        region_weight=jnp.ones(K),
    )


_judged = quick_compile(learned_cue)


def packaged(temperature: float = 0.0) -> LearnedParams:
    made = CUE.read_params
    assert made is not None
    return made(LearnedCueConfig(), temperature, jnp.dtype(float))


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_tells_what_moves(motion: Any) -> None:
    """A third of the points has moved by 15 cm since half a second ago, the last 3 cm of it since the last frame.

    How many of them are rejected is measured in scenes: here they are scattered over the picture, on no surface.
    """
    given = full_scene(motion, (0.03, 0, 0), noise_px=0.1)
    given = given._replace(X_anchor=given.X_world.at[0].add(jnp.where(moves(), -0.12, 0.0)))
    found = _judged(given, packaged())
    evidence = np.asarray(found.evidence)
    assert np.median(evidence[moves()]) > 10 * np.median(evidence[~moves()])
    assert found.known.all()


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_nothing_moves(motion: Any) -> None:
    assert (np.asarray(_judged(full_scene(motion, noise_px=0.1), packaged()).weight) == 1).all()


def test_scale_of_the_world_does_not_matter() -> None:
    """All lengths ten times as long, with the noise of depth: the same features, to a digit."""
    given = full_scene(MOTIONS["all"], (0.03, 0, 0))
    longer = lambda T: type(T)(T.wxyz_xyz.at[..., 4:].multiply(10))
    lengths = ("depth", "depth_before", "X_world", "X_anchor", "depth_sigma")
    large = given._replace(
        **{name: 10 * getattr(given, name) for name in lengths},
        T_world_cam=longer(given.T_world_cam),
        T_world_before=longer(given.T_world_before),
        regions=given.regions._replace(centers=10 * given.regions.centers),  # pyright: ignore[reportOptionalMemberAccess]
    )
    for one, other in zip(learned_features(given), learned_features(large), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)


def test_a_worse_camera_does_not_matter() -> None:
    """Three times the distance of every point from where a static one would be, beyond what is usual at least."""
    random = np.random.default_rng(0)
    points = np.zeros((len(POINT_FEATURES), N))
    points[:7] = random.uniform(1, 5, (7, N)) * random.choice([-1, 1], (7, N))
    points[[0, 1, 2, 6]] = np.abs(points[[0, 1, 2, 6]])
    points[7:] = 1
    worse = points.copy()
    worse[:7] *= 3
    mask = jnp.ones(N, bool)
    one, other = (network_inputs(jnp.asarray(each), mask) for each in (points, worse))
    np.testing.assert_allclose(one, other, rtol=1e-9)
    assert np.asarray(one[:7]).std(axis=1).min() > 0.1
    assert not np.asarray(network_inputs(jnp.asarray(points), ~mask)).any()


def test_features_have_names() -> None:
    features = learned_features(full_scene(MOTIONS["all"]))
    assert features.points.shape == (len(POINT_FEATURES), N)
    assert features.regions.shape == (len(GROUP_FEATURES), K)


@pytest.mark.slow
def test_gradient() -> None:
    """By the weights of the network, positions of points and their pixels; and in a soft scene only."""
    given = full_scene(MOTIONS["all"], (0.02, 0, 0), noise_px=0.3)
    given = given._replace(X_anchor=given.X_world + 0.01)  # not where the drift is zero, and bends within 1e-4 pixels

    def weight(network: PointNetwork, X_anchor: Any, uv: Any, temperature: float = 0.3) -> Any:
        params = LearnedParams(jax.tree.map(jnp.asarray, network), jnp.asarray(temperature))
        return learned_cue(given._replace(X_anchor=jnp.asarray(X_anchor), uv=jnp.asarray(uv)), params).weight

    network = packaged().network
    check_grads(weight, (network, given.X_anchor, given.uv), order=1, modes=("fwd", "rev"), eps=1e-6)
    hard = jax.grad(lambda network: weight(network, given.X_anchor, given.uv, 0.0).sum())(network)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(hard))


class TestDegenerate:
    @pytest.mark.parametrize("name", ["regions", "depth_sigma", "region_weight"])
    def test_something_missing(self, name: str) -> None:
        given = full_scene(MOTIONS["all"])._replace(**{name: None})
        with pytest.raises(ValueError, match=f"scene.{name}: expected a value for the learned cue, got None"):
            learned_cue(given, packaged())

    @pytest.mark.parametrize("case", ["no depth", "nothing followed", "not finite", "behind", "at rest", "no regions"])
    def test_finite(self, case: str) -> None:
        given = full_scene(MOTIONS["none"])
        assert given.regions is not None
        none = jnp.zeros(N)
        changed = {
            "no depth": {"depth": none, "depth_before": none, "depth_sigma": none},
            "nothing followed": {"followed": jnp.zeros(N, bool), "agrees": jnp.zeros(N, bool)},
            "not finite": {"uv": given.uv.at[:, 3].set(jnp.nan), "X_anchor": given.X_anchor.at[:, 5].set(jnp.inf)},
            "behind": {"X_world": -given.X_world, "X_anchor": -given.X_anchor},
            "at rest": {"X_anchor": given.X_world, "uv": given.uv_before},
            "no regions": {
                "regions": given.regions._replace(
                    of_point=jnp.full(N, -1, jnp.int32),
                    centers=jnp.full((3, K), jnp.inf),
                    num_pixels=jnp.zeros(K, jnp.int32),
                )
            },
        }[case]
        given = given._replace(**changed)
        check_finite(_judged, given, packaged())
        check_finite(_judged, given, packaged(0.3))
        slope = jax.grad(
            lambda network, X_world: learned_cue(
                given._replace(X_world=X_world), LearnedParams(network, jnp.asarray(0.3))
            ).weight.sum(),
            argnums=(0, 1),
        )
        if case != "not finite":
            check_finite(quick_compile(slope), packaged().network, given.X_world)
        if case in ("nothing followed", "behind"):
            found = _judged(given, packaged())
            assert (found.weight == 1).all()
            assert not found.known.any()


class TestFile:
    def test_packaged(self) -> None:
        found = load_network()
        assert PACKAGED.stat().st_size < 16_000
        assert {"seed", "command", "scenes", "held_out"} <= set(found.provenance)
        assert len(found.provenance["scenes"]) > 10

    def test_round_trip(self, tmp_path: Path) -> None:
        found = load_network()
        save_network(tmp_path / "again.json", found.weights, found.provenance)
        assert (tmp_path / "again.json").read_bytes() == PACKAGED.read_bytes()

    @pytest.mark.parametrize("kept", [0, 1, 100, 3000, -2])
    def test_cut(self, tmp_path: Path, kept: int) -> None:
        (tmp_path / "cut.json").write_bytes(PACKAGED.read_bytes()[:kept])
        with pytest.raises(ModelError, match=r"cut.json: expected JSON, got a damaged or another file: "):
            load_network(tmp_path / "cut.json")

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(ModelError, match=r"none.json: cannot be read: No such file"):
            load_network(tmp_path / "none.json")
        with pytest.raises(ModelError, match=r"cannot be read"):
            load_network(tmp_path)

    @pytest.mark.parametrize(
        ("key", "value", "problem"),
        [
            ("format", "map", "format: expected 'jaxslam point network', got 'map'"),
            ("version", 1, "version: expected 2, got 1"),
            ("point_features", ["age"], "point_features: expected "),
            ("weights", [1, 2], r"weights: expected a mapping, got \[1, 2\]"),
            ("provenance", None, "provenance: expected a mapping, got None"),
        ],
    )
    def test_another_layout(self, tmp_path: Path, key: str, value: Any, problem: str) -> None:
        self.changed(tmp_path, lambda content: content.update({key: value}), problem)

    def test_wrong_weights(self, tmp_path: Path) -> None:
        def change(name: str, value: Any) -> Any:
            return lambda content: content["weights"].update({name: value})

        self.changed(tmp_path, change("embed", [[1.0]]), r"weights.embed: expected numbers \(\d+, 11\), got \(1, 1\)")
        self.changed(tmp_path, change("embed", [[1.0], [1.0, 2.0]]), "weights.embed: expected numbers, got ")
        self.changed(tmp_path, change("group_bias", "a"), "weights.group_bias: expected numbers, got 'a'")
        self.changed(tmp_path, change("group_bias", 1e99), "weights.group_bias: expected finite numbers")
        self.changed(tmp_path, change("embed_bias", []), r"weights.embed_bias: expected 1 to 256 numbers, got \(0,\)")
        self.changed(tmp_path, change("more", 1.0), "weights: expected embed, .*, got ")
        self.changed(tmp_path, lambda content: content["weights"].pop("join"), "weights: expected embed, .*, got ")

    @staticmethod
    def changed(tmp_path: Path, change: Any, problem: str) -> None:
        content = json.loads(PACKAGED.read_bytes())
        change(content)
        (tmp_path / "changed.json").write_text(json.dumps(content))
        with pytest.raises(ModelError, match=problem):
            load_network(tmp_path / "changed.json")

    def test_not_to_be_saved(self, tmp_path: Path) -> None:
        shapes = network_shapes(len(POINT_FEATURES), len(GROUP_FEATURES), 2)
        weights = {name: np.full(shape, np.nan) for name, shape in shapes.items()}
        with pytest.raises(ModelError, match=r"weights\.embed: expected finite numbers"):
            save_network(tmp_path / "nan.json", weights, {})
        assert not list(tmp_path.iterdir())
