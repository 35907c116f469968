"""Writes recordings as TUM, Bonn, KITTI and EuRoC publish them: names, headings, digits, gaps and calibrations."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from jaxslam.geometry.so3 import matrices
from jaxslam.io.timestamps import decimal_seconds
from jaxslam.trajectory.trajectory import Trajectory

COUNTS_PER_M = 5000
COLOR_ONLY, ABSENT = 4, 6
"""In recordings of TUM, the index of a color image for which there is no depth image; in those of Bonn, also that of a
depth image that is listed but not in the archive. The first color image comes before the first depth image."""
DEPTH_LATER_NS = 9_000_000

_KITTI = {
    "00": "7.188560000000e+02 6.071928000000e+02 1.852157000000e+02 3.861448000000e+02",
    "03": "7.215377000000e+02 6.095593000000e+02 1.728540000000e+02 3.875744000000e+02",
    "04": "7.070912000000e+02 6.018873000000e+02 1.831104000000e+02 3.798145000000e+02",
}
KITTI_SIZES = {"00": (1241, 376), "03": (1242, 375), "04": (1226, 370)}
"""Width and height of the images of sequences 00 to 02, 03, and 04 to 12, of which each group has one camera."""

EUROC_SIZE = (752, 480)
_EUROC = (
    (
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        "[458.654, 457.296, 367.215, 248.375]",
        "[-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]",
    ),
    (
        [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
        [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
        [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
        "[457.587, 456.134, 379.999, 255.238]",
        "[-0.28368365,  0.07451284, -0.00010473, -3.55590700e-05]",
    ),
)


def write_rgbd(
    folder: Path,
    times_ns: Sequence[int],
    colors: Sequence[np.ndarray],
    depths_m: Sequence[np.ndarray],
    truth: Trajectory,
) -> Path:
    """A recording of TUM or, if the folder is named so, of Bonn: the first color image and one in the middle have no
    depth, one depth image comes after the last color image, and a motion capture system gave poses at 100 Hz."""
    bonn = folder.name.startswith("rgbd_bonn_")
    digits = 5 if bonn else 6
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    listed: dict[str, list[str]] = {"rgb": [], "depth": []}
    for index, (stamp, color, depth_m) in enumerate(zip(times_ns, colors, depths_m, strict=True)):
        name = _named(folder, listed, "rgb", stamp, digits)
        _write(folder / name, cv2.cvtColor(color, cv2.COLOR_RGB2BGR))
        if index in (0, COLOR_ONLY):
            continue
        name = _named(folder, listed, "depth", stamp + DEPTH_LATER_NS, digits)
        if not (bonn and index == ABSENT):
            _write(folder / name, np.round(depth_m * COUNTS_PER_M).astype(np.uint16))
    name = _named(folder, listed, "depth", times_ns[-1] + 30_000_000, digits)
    _write(folder / name, np.round(depths_m[-1] * COUNTS_PER_M).astype(np.uint16))
    source = [] if bonn else [f"# file: '{folder.name}.bag'"]
    for kind, title in (("rgb", "# color images"), ("depth", "# depth maps")):
        lines = [title, *source, "# timestamp filename", *listed[kind]]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    grid = np.arange(truth.timestamps_ns[0], truth.timestamps_ns[-1] + 1, 10_000_000)
    rows = [
        f"{decimal_seconds(stamp, 4)} " + " ".join(f"{value:.{digits}f}" for value in pose[[4, 5, 6, 1, 2, 3, 0]])
        for stamp, pose in zip(grid.tolist(), truth.at(grid).T_world_cam, strict=True)
    ]
    heading = ["# ground truth trajectory", *source, "# timestamp tx ty tz qx qy qz qw"]
    (folder / "groundtruth.txt").write_text("\n".join([*heading, *rows]) + "\n")
    if not bonn:
        (folder / "accelerometer.txt").write_text("# timestamp ax ay az\n1.0 0.1 9.7 -0.4\n")
    return folder


def kitti_focal_center_baseline(group: str) -> tuple[float, float, float, float]:
    """Focal length, center (pixels) and baseline (meters) of a group of sequences, "00", "03" or "04"."""
    f, cx, cy, bf = map(float, _KITTI[group].split())
    return f, cx, cy, bf / f


def write_kitti(
    root: Path, number: str, group: str, pairs: Sequence[tuple[np.ndarray, np.ndarray]], truth: np.ndarray | None
) -> Path:
    """Sequence `number` of KITTI's development kit, gray, at 10 Hz; gives its folder `sequences/NN` under `root`.

    Args:
        root: Folder that the archives are unpacked to, such as `dataset`.
        number: Number of the sequence, two digits.
        group: The group that its camera is of, a key of `KITTI_SIZES`.
        pairs: Left and right images, gray.
        truth: `(n, 7)` wxyz_xyz poses of the left camera; `None` for the sequences 11 to 21, whose poses are secret.
    """
    folder = root / "sequences" / number
    for side in range(2):
        (folder / f"image_{side}").mkdir(parents=True)
        for index, pair in enumerate(pairs):
            _write(folder / f"image_{side}" / f"{index:06d}.png", pair[side])
    f, cx, cy, bf = _KITTI[group].split()
    zero, one = "0.000000000000e+00", "1.000000000000e+00"
    rows = [
        f"P{camera}: {f} {zero} {cx} {zero if camera % 2 == 0 else '-' + bf}"
        f" {zero} {f} {cy} {zero} {zero} {zero} {one} {zero}"
        for camera in range(4)
    ]
    laser = "Tr: 4.276802385584e-04 -9.999672484946e-01 -8.084491683471e-03 -1.198459927713e-02 " + " ".join([one] * 8)
    (folder / "calib.txt").write_text("\n".join([*rows, laser]) + "\n")
    (folder / "times.txt").write_text("".join(f"{0.1037 * index:e}\n" for index in range(len(pairs))))
    if truth is not None:
        (root / "poses").mkdir(exist_ok=True)
        top = np.concatenate([matrices(truth[:, :4]), truth[:, 4:, None]], axis=2).reshape(-1, 12)
        (root / "poses" / f"{number}.txt").write_text(
            "".join(" ".join(f"{value:e}" for value in row) + "\n" for row in top)
        )
    return folder


def write_euroc(folder: Path, times_ns: Sequence[int], left_without_right: int) -> Path:
    """A flight such as `V2_03_difficult` as its archive is unpacked: a folder that holds `mav0`, and what macOS left.

    Args:
        folder: Folder of the flight.
        times_ns: Times of the left images.
        left_without_right: Index of the left image whose right one is missing, as several are in the real flight.
    """
    mav = folder / "mav0"
    width, height = EUROC_SIZE
    for camera, (*rows, intrinsics, distortion) in enumerate(_EUROC):
        own = mav / f"cam{camera}"
        (own / "data").mkdir(parents=True)
        numbers = ",\n         ".join(", ".join(map(str, row)) for row in (*rows, [0.0, 0.0, 0.0, 1.0]))
        (own / "sensor.yaml").write_text(
            f"# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam{camera} (MT9M034)\n\n"
            f"# Sensor extrinsics wrt. the body-frame.\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{numbers}]\n\n"
            f"# Camera specific definitions.\nrate_hz: 20\nresolution: [{width}, {height}]\ncamera_model: pinhole\n"
            f"intrinsics: {intrinsics} #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
            f"distortion_coefficients: {distortion}\n\n"
        )
        stamps = [stamp for index, stamp in enumerate(times_ns) if camera == 0 or index != left_without_right]
        (own / "data.csv").write_text(
            "#timestamp [ns],filename\r\n" + "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
        )
        for index, stamp in enumerate(stamps):
            _write(own / "data" / f"{stamp}.png", gray_picture(index, EUROC_SIZE))
    identity = f"T_BS:\n  cols: 4\n  rows: 4\n  data: {np.eye(4).ravel().tolist()}\n"
    (mav / "imu0").mkdir()
    (mav / "imu0" / "sensor.yaml").write_text(
        f"#Default imu sensor yaml file\nsensor_type: imu\ncomment: VI-Sensor IMU (ADIS16448)\n\n"
        f"{identity}rate_hz: 200\n"
        'gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]   ( gyro "white noise" )\n'
        "gyroscope_random_walk: 1.9393e-05       # [ rad / s^2 / sqrt(Hz) ] ( gyro bias diffusion )\n"
        'accelerometer_noise_density: 2.0000e-3  # [ m / s^2 / sqrt(Hz) ]   ( accel "white noise" )\n'
        "accelerometer_random_walk: 3.0000e-3    # [ m / s^3 / sqrt(Hz) ].  ( accel bias diffusion )\n"
    )
    every_5_ms = range(times_ns[0] - 50_000_000, times_ns[-1] + 1, 5_000_000)
    (mav / "imu0" / "data.csv").write_text(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\r\n"
        + "".join(f"{stamp},0.01,-0.02,0.03,9.2,0.1,-3.3\r\n" for stamp in every_5_ms)
    )
    (mav / "vicon0").mkdir()  # poses of the markers: not read
    (mav / "vicon0" / "data.csv").write_text("#timestamp [ns], p_RS_R_x [m], ...\n1,2,3\n")
    (mav / "body.yaml").write_text("%YAML:1.0\ncomment: vicon_room2\n")
    truth = mav / "state_groundtruth_estimate0"
    truth.mkdir()
    state = "0.878612,2.142470,0.947262,0.060514,-0.828459,-0.058956,-0.553641" + ",0.01" * 9
    (truth / "sensor.yaml").write_text(f"sensor_type: visual-inertial\n{identity}")
    (truth / "data.csv").write_text(
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [],"
        " v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1],"
        " b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\r\n"
        + "".join(f"{stamp},{state}\r\n" for stamp in every_5_ms if stamp > times_ns[0])
    )
    (folder / "__MACOSX").mkdir()
    (folder / "__MACOSX" / "._mav0").write_bytes(b"\0\5\26\7")
    return folder


def gray_picture(index: int, size: tuple[int, int]) -> np.ndarray:
    """A gray picture with edges, another one for every index; quick to compress."""
    width, height = size
    row = np.arange(width + 7 * index, dtype=np.uint16)[7 * index :]
    return np.tile((row // 16 * 37 % 200 + 20).astype(np.uint8), (height, 1))


def _named(folder: Path, listed: dict[str, list[str]], kind: str, stamp: int, digits: int) -> str:
    seconds = decimal_seconds(stamp, digits)
    name = f"{kind}/{seconds}.png"
    listed[kind].append(f"{seconds} {name}")
    return name


def _write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image), path
