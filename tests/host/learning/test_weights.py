"""Weights of the learned cue: labels, losses, recipes, and a small training that helps and repeats itself."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxslam_kernels.point_network import PointScores

from jaxslam.config.loading import configs_dir
from jaxslam.errors import ConfigError
from jaxslam.learning import (
    LearnedWeights,
    RoomScene,
    WeightsRecipe,
    WrongPoints,
    learn_weights,
    load_recipe,
    new_network,
    render_room,
    track_scene,
    tracker_with,
    wrong_points,
)
from jaxslam.learning.label_training import label_loss, noisier
from jaxslam.learning.point_samples import PointSamples, edges, true_labels
from jaxslam.runtime.compiled import committed, programs

SMALL = WeightsRecipe(
    frames=20,
    rooms=(RoomScene(seed=2001, path="xyz", people=2, boxes=1, width=160, start=60, every=2),),
    held_out=(RoomScene(seed=2002, path="xyz", people=1, boxes=1, width=160, start=60, every=2),),
    num_hidden=6,
    rounds=1,
    label_steps=300,
    window=5,
    num_windows=2,
    pose_steps=2,
)


class TestLabels:
    def test_near_an_edge_there_is_none(self) -> None:
        moving = np.zeros((1, 20, 30), bool)
        moving[0, 5:15, 10:25] = True
        uv = np.array([[[12.0, 11.4, 8.4, 7.0, 40.0, np.nan], [10.0, 10.0, 10.0, 10.0, 10.0, 10.0]]])
        moves, near = true_labels(moving, uv)
        assert moves.tolist() == [[True, True, False, False, False, False]]
        assert near.tolist() == [[False, True, True, False, False, False]]
        assert edges(moving).sum() == 14 * 19 - 6 * 11

    def test_loss_is_cross_entropy(self) -> None:
        """Loss of four points and the two regions that three of them are in, by its definition."""
        probability = np.array([0.9, 0.2, 0.6, 0.3])
        moving, sure = np.array([True, False, True, True]), np.array([True, True, True, False])
        of_regions = np.array([0.8, 0.4])
        logit = lambda p: jnp.asarray(np.log(p / (1 - p)), jnp.float32)
        scores = PointScores(logit(probability), logit(of_regions), jnp.array([2.0, 1.0]))
        samples = PointSamples(
            None, None, jnp.array([0, 0, 1, 1]), jnp.asarray(sure), jnp.asarray(moving), jnp.asarray(sure)
        )
        points = (3 * -np.log(0.9) - np.log(0.8) + 3 * -np.log(0.6)) / 3
        entropy = lambda p, share: -share * np.log(p) - (1 - share) * np.log(1 - p)
        regions = (np.sqrt(2 / 24) * 2 * entropy(0.8, 0.5) + np.sqrt(1 / 24) * 3 * entropy(0.4, 1.0)) / 2
        assert float(label_loss(scores, samples, 3.0)) == pytest.approx(points + regions, rel=1e-5)

    def test_shares(self) -> None:
        assert WrongPoints(1, 2, 10, 20).share == pytest.approx(0.1)
        assert WrongPoints(0, 0, 0, 0).share == 0
        assert WrongPoints(1, 2, 10, 20) + WrongPoints(1, 1, 1, 1) == WrongPoints(2, 3, 11, 21)


class TestNoise:
    frame = PointSamples(
        points=jnp.stack([*jnp.full((7, 64), 1.0), *jnp.ones((4, 64))]).at[1].set(jnp.linspace(0.1, 3, 64)),
        regions=jnp.ones((2, 2)),
        region_of=jnp.arange(64) % 2,
        mask=jnp.arange(64) < 60,
        moving=jnp.zeros(64, bool),
        sure=jnp.ones(64, bool),
    )

    def test_longer_distances_agree_no_more(self) -> None:
        """Distances of a region are multiplied by one factor; who is farther than all that agreed before does not."""
        noisy = noisier(jax.random.key(2), self.frame, jnp.float32(1.5))
        factors = np.asarray(noisy.points[1] / self.frame.points[1])
        assert len(np.unique(factors.round(3))) == 2
        assert factors.min() > np.exp(-0.75)
        assert factors.max() < np.exp(2.25)
        assert factors.max() > 2, "this key gives a longer one"
        farthest = self.frame.points[1][self.frame.mask].max()
        agrees = np.asarray(noisy.points[9]) > 0
        np.testing.assert_array_equal(agrees, np.asarray((noisy.points[1] <= farthest) & self.frame.mask))
        assert 0 < agrees.sum() < 60
        np.testing.assert_array_equal(noisy.points[6:9], self.frame.points[6:9])

    def test_without_noise_nothing_changes(self) -> None:
        same = noisier(jax.random.key(3), self.frame, jnp.float32(0))
        np.testing.assert_allclose(same.points[:9], self.frame.points[:9])
        np.testing.assert_array_equal(same.points[9] > 0, self.frame.mask)


class TestRecipe:
    def test_packaged(self) -> None:
        recipe = load_recipe()
        assert not {room.seed for room in recipe.rooms} & {room.seed for room in recipe.held_out}
        assert min(room.seed for room in (*recipe.rooms, *recipe.held_out)) >= 1000, "suites have smaller seeds"

    def test_nothing_of_it_is_judged(self) -> None:
        """The suite that compares the cue holds none of the worlds of the recipe."""
        suite = (configs_dir() / "benchmarks" / "learned_cue.yaml").read_text()
        assert not [world.world for world in load_recipe().worlds if world.world in suite]

    def test_errors(self, tmp_path: Path) -> None:
        file = tmp_path / "recipe.yaml"
        for text, problem in (
            ("frames: 60\n", "rooms, held_out: expected at least one scene each, got none"),
            ("rooms: [{seed: 1, path: xyz, peple: 2}]\n", "peple"),
            ("rooms: [{seed: 1, path: xzy}]\n", "path"),
            ("window: 1\n", "window"),
        ):
            file.write_text(text)
            with pytest.raises(ConfigError, match=problem):
                load_recipe(str(file))
        with pytest.raises(ConfigError, match=r"none\.yaml"):
            load_recipe(str(tmp_path / "none.yaml"))


def test_untrained_network_has_no_opinion() -> None:
    """The same seed gives the same numbers, another one others; of about unit size for any number of hidden units."""
    first, same, other = new_network(0, 12), new_network(0, 12), new_network(1, 12)
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a == b).all()), first, same)))
    assert not (first.embed == other.embed).all()
    assert float(jnp.std(first.refine) * jnp.sqrt(36.0)) == pytest.approx(1, rel=0.2)


@pytest.mark.slow
def test_all_networks_are_tracked_by_one_program() -> None:
    """Those that were trained, which are results of a program, and new ones; each would be compiled for a minute."""
    scene, network = render_room(SMALL.held_out[0], SMALL.window), new_network(0, 6)
    program = next(each for each in programs if each.name.endswith("point_samples._track_part"))
    before = program.num_compiled
    for each in (network, committed(network)):
        track_scene(scene, *tracker_with(scene.camera, each), window=SMALL.window)
    assert program.num_compiled == before + 1


@pytest.fixture(scope="module")
def learned() -> LearnedWeights:
    return learn_weights(SMALL)


@pytest.mark.slow
class TestLearned:
    def test_helps(self, learned: LearnedWeights) -> None:
        """On a room of another seed, against a network that takes all for static."""
        scene = render_room(SMALL.held_out[0], SMALL.frames)
        nothing = new_network(0, 6)._replace(group_bias=jnp.float32(-9.0))
        shares = [
            wrong_points(track_scene(scene, *tracker_with(scene.camera, network), window=SMALL.window)).share
            for network in (nothing, learned.network)
        ]
        print(shares, learned.stages)
        assert shares[1] < 0.7 * shares[0]
        assert [stage.stage for stage in learned.stages] == ["clusters", "labels, round 1", "poses"]
        assert learned.label_losses[-20:].mean() < 0.7 * learned.label_losses[:20].mean()
        assert np.isfinite(learned.pose_losses).all()
        assert len(learned.pose_losses) == 3

    def test_repeats_itself(self, learned: LearnedWeights) -> None:
        again = learn_weights(replace(SMALL))
        assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a == b).all()), learned.network, again.network)))
        assert learned.stages == again.stages
