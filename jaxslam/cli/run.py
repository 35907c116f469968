"""`jaxslam demo` and `jaxslam run`: their options, and what they open to be tracked."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from jaxslam.cli.console import console, print_json
from jaxslam.cli.shared_options import ALLOW_MISSING_MODEL, Settings, WithJson, flat
from jaxslam.datasets.synthetic.camera_path_kind import CameraPathKind
from jaxslam.errors import ConfigError, nearest

if TYPE_CHECKING:
    from jaxslam.config.schema import Config
    from jaxslam.datasets import Dataset

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Demo(WithJson):
    """Options of `jaxslam demo`."""

    out: Path = Path("results/demo")
    """Folder for the results."""
    frames: int = 150
    """Frames to render."""
    path: CameraPathKind = "xyz"
    """How the camera moves."""
    people: int = 2
    """People walking through the room."""
    boxes: int = 0
    """Boxes carried about in it, which no network knows."""
    seated: int = 0
    """People sitting at the desk, who hardly move."""
    parked: int = 0
    """Boxes that stand, and are pushed about now and then."""
    seed: int = 0
    """Seed of room, people, path and noise."""
    viz: bool = False
    """Watch it in the viewer of rerun."""
    rrd: Path | None = None
    """File to write a recording for that viewer to."""
    dense: bool = False
    """Make a dense map of what stands still too: points, an octree, and a picture."""
    set: Settings = ()
    """Settings, as in `--set semantics.model=scene`, which tracks with the true masks of who moves."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.cli.tracking_run import make_viewer, track  # noqa: PLC0415
        from jaxslam.config.loading import load_config  # noqa: PLC0415
        from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset, with_true_masks  # noqa: PLC0415
        from jaxslam.slam.slam import Slam  # noqa: PLC0415

        config = load_config(overrides=(*_dense(self.dense), *flat(self.set)))
        scene = SyntheticConfig(
            frames=self.frames,
            path=self.path,
            people=self.people,
            boxes=self.boxes,
            seated=self.seated,
            parked=self.parked,
            seed=self.seed,
        )
        console.print(f"Rendering a room with {self._who()}, the camera moving as in '{self.path}'.")
        dataset, truth = with_true_masks(SyntheticDataset(scene), config.semantics)
        slam = Slam(dataset.camera, config, detector=truth)
        viewer = make_viewer(slam, dataset, live=self.viz, path=self.rrd)
        summary = track(dataset, slam, "default", self.out, viewer, quiet=self.json)
        if self.json:
            print_json(summary)

    def _who(self) -> str:
        boxes = f", {self.boxes} boxes carried about" if self.boxes else ""
        parked = f", {self.parked} boxes pushed now and then" if self.parked else ""
        return f"{self.people} people{boxes}{parked}" + (f", {self.seated} people at the desk" if self.seated else "")


@dataclass(frozen=True)
class OfRecording(WithJson):
    """Base of the commands that track recordings."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of the recording."""
    dataset: str = "auto"
    """Kind of the recording, such as tum or kitti; auto recognizes it."""
    camera: str | None = None
    """Known camera or camera file (jaxslam, ORB-SLAM2, ORB-SLAM3, Kalibr), of both cameras if a pair is unrectified."""
    config: Path | None = None
    """YAML file of settings that differ from the preset."""
    out: Path | None = None
    """Folder for the results; results/NAME if not given."""
    max_frames: int | None = None
    """Track at most this many frames."""
    start: int = 0
    """First frame to track."""
    deterministic: bool = True
    """Run everything in turn: two runs give the same bytes."""
    realtime: bool = False
    """Feed frames at the rate they were taken at, and drop those that come late; each module in its thread."""
    allow_missing_model: bool = False
    """Go on without the network of a preset that needs one, where it is not on this machine; all results say so."""
    set: Settings = ()
    """Settings, as in `--set track.num_points=400 run.seed=3`; may be given again."""

    def settings(self, preset: str, *overrides: str) -> "Config":
        """The settings of a run, with more overrides if there are any."""
        from jaxslam.config.loading import load_config  # noqa: PLC0415

        chosen = ["run.deterministic=false"] if not self.deterministic else []
        chosen += ["run.realtime=true"] if self.realtime else []
        chosen += [ALLOW_MISSING_MODEL] if self.allow_missing_model else []
        return load_config(preset, self.config, (*chosen, *flat(self.set), *overrides))

    def opened(self) -> "Dataset":
        """The recording, or the part of it that is wanted."""
        from jaxslam.datasets import Subset, dataset_kinds, open_dataset  # noqa: PLC0415

        if self.dataset not in ("auto", *dataset_kinds()):
            raise ConfigError(
                f"--dataset: unknown kind '{self.dataset}'{nearest(self.dataset, ['auto', *dataset_kinds()])}"
            )
        if self.max_frames is not None and self.max_frames < 1:
            raise ConfigError(f"--max-frames: expected at least 1, got {self.max_frames}")
        dataset = open_dataset(self.recording, self.dataset, self.camera)
        if not self.start and self.max_frames is None:
            return dataset
        return Subset(dataset, self.start, None if self.max_frames is None else self.start + self.max_frames)

    def folder(self) -> Path:
        """Return the folder of the results."""
        return self.out or Path("results") / self.recording.resolve().name


@dataclass(frozen=True)
class Run(OfRecording):
    """Options of `jaxslam run`."""

    preset: str = "default"
    """Preset to start from."""
    map: Path | None = None
    """Map file to start with; the world is that of the map."""
    dense: bool = False
    """Make a dense map of what stands still too: points, an octree, and a picture."""
    localize_only: bool = False
    """Only find the camera in the map, which stays as it is."""
    save_map: Path | None = None
    """File to write the map to."""
    viz: bool = False
    """Watch it in the viewer of rerun."""
    rrd: Path | None = None
    """File to write a recording for that viewer to."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.cli.tracking_run import make_viewer, track  # noqa: PLC0415
        from jaxslam.datasets import imu_sheet  # noqa: PLC0415
        from jaxslam.map.npz_file import load_map  # noqa: PLC0415
        from jaxslam.slam.slam import Slam  # noqa: PLC0415

        if self.localize_only and self.map is None:
            raise ConfigError("--localize-only: needs the map to localize in: --map FILE")
        if self.localize_only and self.dense:
            raise ConfigError("--dense: a map that stays as it is, by --localize-only, gets no dense one")
        config, dataset = self.settings(self.preset, *_dense(self.dense)), self.opened()
        start = None if self.map is None else load_map(self.map)
        slam = Slam(dataset.camera, config, slam_map=start, localize_only=self.localize_only, imu=imu_sheet(dataset))
        viewer = make_viewer(slam, dataset, live=self.viz, path=self.rrd)
        summary = track(dataset, slam, self.preset, self.folder(), viewer, save_map=self.save_map, quiet=self.json)
        if self.json:
            print_json(summary)


def _dense(wanted: bool) -> tuple[str, ...]:
    """The override that has a dense map made."""
    return ("dense.enabled=true",) if wanted else ()
