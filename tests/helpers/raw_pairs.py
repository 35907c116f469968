"""A rendered room as two cameras see it that are neither undistorted nor aligned, with the calibration known."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from jaxslam.datasets.synthetic import SyntheticConfig, SyntheticDataset
from jaxslam.geometry.se3 import between, compose, inverse
from jaxslam.geometry.so3 import axis_rotation, matrices, multiply
from jaxslam.sensors.stereo_rig import Lens, Rig

BASELINE_M = 0.1
WIDTH, HEIGHT = 640, 480
RADTAN = (
    Lens(WIDTH, HEIGHT, 420.0, 424.0, 310.0, 246.0, (-0.28, 0.07, 0.0004, -0.0003)),
    Lens(WIDTH, HEIGHT, 417.0, 416.0, 327.0, 235.0, (-0.27, 0.065, -0.0005, 0.0002)),
)
EUROC = (
    Lens(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)),
    Lens(752, 480, 457.587, 456.134, 379.999, 255.238, (-0.28368365, 0.07451284, -0.00010473, -3.5559070e-05)),
)
"""The two lenses of EuRoC's flights, as published."""
FISHEYE = (
    Lens(WIDTH, HEIGHT, 400.0, 401.0, 310.0, 246.0, (0.01, -0.02, 0.01, -0.003), "equidistant"),
    Lens(WIDTH, HEIGHT, 398.0, 396.0, 325.0, 236.0, (0.008, -0.015, 0.008, -0.002), "equidistant"),
)
_TURNED_LEFT = multiply(axis_rotation(0, np.array(0.012)), axis_rotation(1, np.array(-0.016)))
_TURNED_RIGHT = multiply(axis_rotation(2, np.array(0.014)), axis_rotation(1, np.array(0.02)))
T_BODY_LEFT = np.array([0.7071068, 0.0, 0.0, 0.7071068, -0.02, -0.06, 0.01])  # z of the body forward is not needed


@dataclass
class RawRoom:
    """What two turned and distorting cameras see of a room."""

    frames: int = 30
    lenses: tuple[Lens, Lens] = RADTAN
    room: SyntheticDataset = field(init=False)
    rig: Rig = field(init=False)

    def __post_init__(self) -> None:
        wide = SyntheticConfig(
            frames=self.frames, people=0, width=960, height=720, fx=400.0, fps=20.0, baseline_m=BASELINE_M
        )
        self.room = SyntheticDataset(wide)
        self.T_room_left = np.concatenate([_TURNED_LEFT, np.zeros(3)])
        self.T_room_right = np.concatenate([_TURNED_RIGHT, [BASELINE_M, 0, 0]])
        T_left_right = between(self.T_room_left, self.T_room_right)
        self.rig = Rig("rig", *self.lenses, tuple(T_left_right.tolist()), fps=20.0)
        turns = self.T_room_left, self.T_room_right
        self._maps = [_map(lens, T, self.room) for lens, T in zip(self.lenses, turns, strict=True)]

    def images(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The two RGB images, as the cameras deliver them."""
        frame = self.room.render(index)
        assert frame.right is not None
        return tuple(  # pyright: ignore[reportReturnType]
            cv2.remap(image, *maps, cv2.INTER_CUBIC)
            for image, maps in zip((frame.rgb, frame.right), self._maps, strict=True)
        )

    @property
    def bodies(self) -> np.ndarray:
        """`(n, 7)` poses of a body on which the left camera sits at `T_BODY_LEFT`."""
        T_room_body = compose(self.T_room_left, inverse(T_BODY_LEFT))
        return compose(self.room.T_world_cam, T_room_body[None])


def _map(lens: Lens, T_room_camera: np.ndarray, room: SyntheticDataset) -> tuple[np.ndarray, np.ndarray]:
    """Where in the picture of the room each pixel of a camera looks."""
    v, u = np.mgrid[: lens.height, : lens.width].astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    undistort = cv2.fisheye.undistortPoints if lens.model == "equidistant" else _undistort
    rays = undistort(pixels, lens.matrix, lens.terms)[:, 0]
    x, y, z = matrices(T_room_camera[:4]) @ np.column_stack([rays, np.ones(len(rays))]).T
    found = np.stack([room.fx * x / z + room.cx, room.fy * y / z + room.cy]).astype(np.float32)
    return found[0].reshape(u.shape), found[1].reshape(u.shape)


def _undistort(pixels: np.ndarray, K: np.ndarray, terms: np.ndarray) -> np.ndarray:
    exact = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-9)
    return cv2.undistortPoints(pixels, K, terms, criteria=exact)


def sensor_text(lens: Lens, T_body_camera: np.ndarray) -> str:
    """A `sensor.yaml` of EuRoC."""
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = matrices(T_body_camera[:4]), T_body_camera[4:]
    model = {"radtan": "radial-tangential", "equidistant": "equidistant"}[lens.model]
    return f"""sensor_type: camera
comment: VI-Sensor cam
T_BS:
  cols: 4
  rows: 4
  data: {M.ravel().tolist()}
rate_hz: 20
resolution: [{lens.width}, {lens.height}]
camera_model: pinhole
intrinsics: [{lens.fx}, {lens.fy}, {lens.cx}, {lens.cy}] #fu, fv, cu, cv
distortion_model: {model}
distortion_coefficients: {list(lens.distortion)}
"""


def write_euroc(folder: Path, raw: RawRoom) -> Path:
    """A recording in the layout of EuRoC, gray, with ground truth of the body; gives the folder that holds `mav0`."""
    mav = folder / "mav0"
    stamps = [int(stamp) for stamp in raw.room.timestamps_ns]
    T_left_right = np.array(raw.rig.T_left_right)
    for which, T in (("cam0", T_BODY_LEFT), ("cam1", compose(T_BODY_LEFT, T_left_right))):
        (mav / which / "data").mkdir(parents=True)
        lens = raw.lenses[int(which[-1])]
        (mav / which / "sensor.yaml").write_text("%YAML:1.0\n" + sensor_text(lens, T))
        rows = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
        (mav / which / "data.csv").write_text(f"#timestamp [ns],filename\r\n{rows}")
    for index, stamp in enumerate(stamps):
        for which, image in zip(("cam0", "cam1"), raw.images(index), strict=True):
            cv2.imwrite(str(mav / which / "data" / f"{stamp}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    (mav / "state_groundtruth_estimate0").mkdir()
    rows = []
    for stamp, T in zip(stamps, raw.bodies, strict=True):
        numbers = [*T[4:], *T[:4], *[0.0] * 9]
        rows.append(",".join([str(stamp), *(f"{number:.9f}" for number in numbers)]))
    heading = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], ..."
    (mav / "state_groundtruth_estimate0" / "data.csv").write_text("\n".join([heading, *rows]) + "\n")
    return folder
