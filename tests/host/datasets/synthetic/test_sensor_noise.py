"""The faults of the synthetic camera: each one as large as configured, each one on its own switch."""

import dataclasses
from typing import Any

import cv2
import jax
import numpy as np
import pytest

from jaxslam.datasets.synthetic import PERFECT_SENSOR, SensorConfig, SyntheticConfig, SyntheticDataset
from jaxslam.datasets.synthetic.sensor_noise import LensParams, depth_params, measure_color, measure_depth

SHAPE = (120, 160)
GRAY = np.uint32(400 | 400 << 10 | 400 << 20)


def measured(
    depth: np.ndarray, config: SensorConfig, *, incidence: float = 1.0, gain: float = 1.0, key: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Channels and depth of a gray picture."""
    cosines, random = np.full(SHAPE, incidence, np.float32), jax.random.key(key)
    channels = measured_color(np.full((1, 1, *SHAPE), GRAY), 0, gain, config.image_noise, random)[:, 0, 0]
    result = measure_depth(depth.astype(np.float32), cosines, 525.0, depth_params(config), random)
    return np.asarray(channels), np.asarray(result)


def measured_color(tiles: np.ndarray, first: int, *args: Any, **kwargs: Any) -> np.ndarray:
    """Color of rows of tiles of one moment."""
    return np.asarray(measure_color((tiles,), first, *args, **kwargs, height=SHAPE[0], width=SHAPE[1]))


def wall(depth_m: float) -> np.ndarray:
    return np.full(SHAPE, depth_m)


def with_fault(**fault: float) -> SensorConfig:
    return dataclasses.replace(PERFECT_SENSOR, **fault)


class TestDepth:
    def test_perfect_is_exact(self):
        depth = np.random.default_rng(0).uniform(0.1, 20.0, SHAPE)
        np.testing.assert_allclose(measured(depth, PERFECT_SENSOR)[1], depth, rtol=1e-6)

    def test_noise_grows_with_the_square_of_depth(self):
        config = with_fault(depth_noise_per_m=1.425e-3)
        for depth_m in (0.5, 1.0, 2.0, 4.0):
            error = measured(wall(depth_m), config)[1] - depth_m
            assert error.std() == pytest.approx(1.425e-3 * depth_m**2, rel=0.05)
            assert abs(error.mean()) < 0.1 * error.std()

    def test_disparity_steps(self):
        config = with_fault(depth_step_per_m=2.85e-3)
        ramp = np.broadcast_to(np.linspace(1.0, 4.0, SHAPE[1]), SHAPE)
        depth = measured(ramp, config)[1]
        steps = 1.0 / depth / 2.85e-3
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
        assert np.abs(depth - ramp).max() < 0.51 * 2.85e-3 * 16.0
        assert len(np.unique(measured(3.9 + 0.01 * ramp, config)[1])) < 4

    def test_units_of_image_files(self):
        depth = measured(np.random.default_rng(0).uniform(0.5, 5.0, SHAPE), with_fault(depth_unit_m=1 / 5000))[1]
        np.testing.assert_allclose(depth * 5000, np.round(depth * 5000), atol=5e-3)

    def test_limits(self):
        ramp = np.broadcast_to(np.linspace(0.1, 8.0, SHAPE[1]), SHAPE)
        depth = measured(ramp, with_fault(min_depth_m=0.4, max_depth_m=5.0))[1]
        np.testing.assert_array_equal(depth > 0, (ramp.astype(np.float32) >= 0.4) & (ramp <= 5.0))

    def test_grazing_surfaces_are_lost(self):
        config = with_fault(max_incidence_deg=80.0)
        assert measured(wall(2.0), config, incidence=np.cos(np.deg2rad(79.0)))[1].all()
        assert not measured(wall(2.0), config, incidence=np.cos(np.deg2rad(81.0)))[1].any()

    def test_shadow_lies_left_of_what_casts_it(self):
        """A column 1 m away before a wall at 2 m hides `fx b (1 / 1 - 1 / 2)` pixels of it from the projector."""
        depth = wall(2.0)
        depth[:, 80:100] = 1.0
        lost = measured(depth, with_fault(shadow_baseline_m=0.04))[1] == 0
        width = 525.0 * 0.04 * 0.5
        columns = np.flatnonzero(lost[60])
        np.testing.assert_array_equal(columns, np.arange(80 - len(columns), 80))
        assert abs(len(columns) - width) <= 1.0
        np.testing.assert_array_equal(lost, np.broadcast_to(lost[60], SHAPE))

    def test_slanted_wall_casts_no_shadow(self):
        slanted = 1.0 / np.broadcast_to(np.linspace(0.3, 1.2, SHAPE[1]), SHAPE)
        for depth in (slanted, slanted[:, ::-1]):
            assert measured(depth, with_fault(shadow_baseline_m=0.075))[1].all()

    def test_edges_are_lost(self):
        depth = wall(2.0)
        depth[:, 80:] = 2.2
        lost = measured(depth, with_fault(edge_jump=0.05))[1] == 0
        np.testing.assert_array_equal(np.flatnonzero(lost[60]), [79, 80])
        assert not (measured(depth, with_fault(edge_jump=0.2))[1] == 0).any()

    def test_key_chooses_the_noise(self):
        config = SensorConfig()
        one, again, other = (measured(wall(2.0), config, key=key) for key in (1, 1, 2))
        for first, second, third in zip(one, again, other, strict=True):
            np.testing.assert_array_equal(first, second)
            assert not np.array_equal(first, third)


class TestColor:
    def test_noise(self):
        channels = measured(wall(2.0), with_fault(image_noise=3.0))[0].astype(float)
        assert channels.std() == pytest.approx(3.0, rel=0.05)
        assert channels.mean() == pytest.approx(127.5, abs=0.2)
        red, green = channels[0].ravel(), channels[1].ravel()
        assert abs(np.corrcoef(red, green)[0, 1]) < 0.05

    def test_gain(self):
        bright, dark = (measured(wall(2.0), PERFECT_SENSOR, gain=gain)[0] for gain in (1.2, 0.8))
        assert (bright == 153).all()
        assert (dark == 102).all()
        assert (measured(wall(2.0), PERFECT_SENSOR, gain=5.0)[0] == 255).all()

    @pytest.mark.parametrize("lens", [None, LensParams(vignetting=0.4, gamma=2.2)])
    def test_tiles_in_parts_are_the_whole_picture(self, lens: LensParams | None):
        """The last tiles, of 50 x 64 pixels, reach beyond the picture."""
        key, rows = jax.random.key(3), np.linspace(0.8, 1.2, 150)
        one = np.full((1, 1, *SHAPE), GRAY)
        whole = measured_color(one, 0, rows[: SHAPE[0]].reshape(1, 1, 1, -1, 1), 2.0, key, lens)[:, 0, 0]
        parts = [
            measured_color(np.full((count, 3, 50, 64), GRAY), first, gain, 2.0, key, lens)
            for first, count in ((0, 2), (2, 1))
            for gain in [rows[50 * first : 50 * (first + count)].reshape(1, count, 1, 50, 1)]
        ]
        tiles = np.concatenate(parts, axis=1)
        put_together = tiles.transpose(0, 1, 3, 2, 4).reshape(3, 150, 192)[:, : SHAPE[0], : SHAPE[1]]
        difference = np.abs(put_together.astype(int) - whole)
        assert difference.max() <= 1  # of a product and a sum, rounded once or twice
        assert np.mean(difference > 0) < 1e-4


class TestInARecording:
    CONFIG = SyntheticConfig(width=160, height=120, people=2, path="rpy", sensor=PERFECT_SENSOR)

    def dataset(self, **fault: float) -> SyntheticDataset:
        return SyntheticDataset(dataclasses.replace(self.CONFIG, sensor=with_fault(**fault)))

    def test_perfect_depth_is_the_exact_one(self):
        frame = self.dataset().render(4)
        np.testing.assert_allclose(frame.depth_m, frame.exact_depth_m, rtol=1e-6)

    def test_default_sensor_loses_the_edges_of_people(self):
        frame = SyntheticDataset(dataclasses.replace(self.CONFIG, sensor=SensorConfig())).render(0)
        missing = frame.depth_m == 0
        person = (frame.instance_mask > 0).astype(np.uint8)
        rim = cv2.morphologyEx(person, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
        assert missing[rim].mean() > 0.6
        assert missing.mean() < 0.35
        error = (frame.depth_m - frame.exact_depth_m) / frame.exact_depth_m**2
        assert np.abs(error[~missing]).max() < 0.02
        assert 0.5 * 1.425e-3 < error[~missing].std() < 3.0 * 1.425e-3

    def test_blur_is_of_the_color_alone_and_comes_from_motion(self):
        detail = {}
        for path in ("rpy", "static"):
            config = dataclasses.replace(self.CONFIG, path=path, people=0)
            sharp = SyntheticDataset(config).render(10)
            slow = with_fault(exposure_s=0.06)
            blurred = SyntheticDataset(dataclasses.replace(config, sensor=slow)).render(10)
            np.testing.assert_array_equal(sharp.depth_m, blurred.depth_m)
            assert abs(sharp.rgb.mean() - blurred.rgb.mean()) < 2.0
            one, other = (np.abs(np.diff(frame.rgb.astype(float), axis=1)).mean() for frame in (sharp, blurred))
            detail[path] = other / one
        assert detail["rpy"] < 0.9
        assert 0.95 < detail["static"] < 1.02

    def test_exposure_wanders_smoothly(self):
        dataset = self.dataset(gain_swing=0.2)
        steady = self.dataset()
        ratio = np.array([dataset.render(i).rgb.mean() / steady.render(i).rgb.mean() for i in range(0, 300, 6)])
        assert ratio.max() - ratio.min() > 0.15
        assert np.abs(np.diff(ratio)).max() < 0.04

    def test_more_samples_smooth_edges(self):
        aliased = dataclasses.replace(PERFECT_SENSOR, exposure_samples=1)
        rough = SyntheticDataset(dataclasses.replace(self.CONFIG, sensor=aliased)).render(0).rgb
        smooth = self.dataset().render(0).rgb
        fine = SyntheticDataset(dataclasses.replace(self.CONFIG, width=320, height=240)).render(0).rgb
        truth = cv2.resize(fine, (160, 120), interpolation=cv2.INTER_AREA).astype(float)
        assert np.square(smooth - truth).mean() < 0.7 * np.square(rough - truth).mean()
