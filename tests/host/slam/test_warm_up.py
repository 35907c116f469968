"""`Slam.warm_up` compiles every program that says so: a robot does not wait for a compiler in the middle of a run."""

from dataclasses import replace

import jax
import pytest
from small_scene import CONFIG, clip

from jaxslam.config.schema import DenseConfig
from jaxslam.datasets.synthetic.ground_truth_detector import SceneDetector
from jaxslam.runtime.compiled import programs
from jaxslam.slam.slam import Slam


@pytest.mark.slow
def test_no_program_is_forgotten() -> None:
    """Everything at once, in threads: occlusion, a dense map, and a detector for every frame or for keyframes."""
    recording, compiled = clip(people=1, frames=2), set()
    jax.clear_caches()
    for frames in ("every", "keyframes"):
        settings = replace(
            CONFIG,
            semantics=replace(CONFIG.semantics, frames=frames),
            dynamics=replace(CONFIG.dynamics, occlusion=replace(CONFIG.dynamics.occlusion, enabled=True)),
            dense=DenseConfig(enabled=True),
            run=replace(CONFIG.run, deterministic=False),
        )
        before = [program.num_compiled for program in programs]
        with Slam(recording.camera, settings, detector=SceneDetector(recording.source)) as slam:
            slam.warm_up()
            after = [program.num_compiled for program in programs]
        compiled |= {program.name for program, a, b in zip(programs, before, after, strict=True) if b > a}
    wanted = {program.name for program in programs if program.when == "warm-up"}
    assert len(wanted) > 20
    assert wanted <= compiled
