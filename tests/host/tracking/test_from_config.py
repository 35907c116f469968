"""Settings as the compiled step takes them: none is forgotten, and defaults are those of the settings."""

from dataclasses import fields, replace

import numpy as np
import pytest

from jaxslam.config.schema import Config, MappingConfig, TrackConfig
from jaxslam.features.orb import FeaturePlan
from jaxslam.mapping.local_bundle_adjustment import AdjustPlan
from jaxslam.mapping.local_mapping import MappingPlan, mapping_plan
from jaxslam.sensors.camera import Camera
from jaxslam.tracking.from_config import track_params, track_plan
from jaxslam.tracking.state import TrackParams, TrackPlan

CAMERA = Camera("test", width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
OTHER = {"new_points": "keyframes", "keyframe_policy": "sparing", "max_speed_m_per_s": 3.0}
"""Values other than the default of settings whose default is no number."""


def changed(name: str) -> TrackConfig:
    default = getattr(TrackConfig(), name)
    return replace(TrackConfig(), **{name: OTHER.get(name) or default + (2 if isinstance(default, int) else 0.03)})


def names(kind: type) -> list[str]:
    return [field.name for field in fields(TrackConfig) if field.name in kind._fields]  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", names(TrackPlan))
def test_plan_takes_every_setting_of_its_name(name: str) -> None:
    config = changed(name)
    assert getattr(track_plan(config), name) == getattr(config, name) != getattr(TrackPlan(), name)


@pytest.mark.parametrize("name", names(TrackParams))
def test_params_take_every_setting_of_their_name(name: str) -> None:
    config = changed(name)
    assert getattr(track_params(CAMERA, config), name) == np.float32(getattr(config, name))


def test_defaults_are_those_of_the_settings() -> None:
    assert track_plan(TrackConfig()) == TrackPlan()
    assert mapping_plan(CAMERA, Config()) == MappingPlan(FeaturePlan(), AdjustPlan())


def test_mapping_takes_every_setting_of_its_name() -> None:
    mapping = MappingConfig(num_features=500, num_levels=6, scale_factor=1.3, fast_threshold=30, min_fast_threshold=9)
    assert mapping_plan(CAMERA, Config(mapping=mapping)).features == FeaturePlan(500, 6, 1.3, 30, 9)
