"""Samples and data sheets of an IMU: what is accepted, cut, read and written, and what is refused."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from jaxslam.errors import ConfigError, DatasetError, FrameError
from jaxslam.sensors import (
    ImuSamples,
    ImuSheet,
    read_imu_samples,
    read_imu_sheet,
    write_imu_samples,
    write_imu_sheet,
)
from jaxslam.sensors.frame import Frame

TIMES = np.arange(0, 50, 5) * 1_000_000
RNG = np.random.default_rng(0)
SAMPLES = ImuSamples(TIMES, RNG.normal(size=(10, 3)), RNG.normal(size=(10, 3)))
HEADING = "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_x,a_y,a_z\n"
SHEET = """
rate_hz: 200
gyroscope_noise_density: 1.7e-04
gyroscope_random_walk: 2.0e-05
accelerometer_noise_density: 2.0e-3
accelerometer_random_walk: 3.0e-3
"""


def test_samples_are_cut_after_a_time_and_up_to_one():
    part = SAMPLES.between(5_000_000, 20_000_000)
    assert part.timestamps_ns.tolist() == [10_000_000, 15_000_000, 20_000_000]
    np.testing.assert_array_equal(part.gyro_rad_per_s, SAMPLES.gyro_rad_per_s[2:5])
    np.testing.assert_array_equal(part.accel_m_per_s2, SAMPLES.accel_m_per_s2[2:5])
    assert len(SAMPLES.between(45_000_000, 90_000_000)) == 0


def test_frames_share_the_samples_without_gap_or_overlap():
    frames_ns = np.array([11, 20, 44]) * 1_000_000
    parts = [SAMPLES.since_last_frame(frames_ns, index, fps=100.0).timestamps_ns // 1_000_000 for index in range(3)]
    assert [part.tolist() for part in parts] == [[5, 10], [15, 20], [25, 30, 35, 40]]


def test_arrays_are_copies_that_cannot_be_written():
    gyro = np.zeros((10, 3))
    samples = ImuSamples(TIMES, gyro, gyro)
    gyro[0] = 1.0
    assert not samples.gyro_rad_per_s.any()
    with pytest.raises(ValueError, match="read-only"):
        samples.accel_m_per_s2[0] = 1.0


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("timestamps_ns", TIMES * 1e-9, "(n,) integers in nanoseconds, got float64 (10,)"),
        ("timestamps_ns", TIMES[::-1], "times that increase, got 40000000 after 45000000, index 1"),
        ("timestamps_ns", TIMES // 2 // 5_000_000, "times that increase, got 0 after 0, index 1"),
        ("gyro_rad_per_s", np.zeros((9, 3)), "shape (10, 3), one row a time, got (9, 3)"),
        ("gyro_rad_per_s", np.zeros((10, 3)).tolist(), "(10, 3) floats, got [["),
        ("accel_m_per_s2", np.zeros((10, 3), bool), "(10, 3) floats, got bool"),
        ("accel_m_per_s2", np.full((10, 3), np.nan), "finite numbers, got [nan, nan, nan] at index 0"),
    ],
)
def test_samples_that_cannot_be_are_refused(field, value, words):
    fields = {"timestamps_ns": TIMES, "gyro_rad_per_s": np.zeros((10, 3)), "accel_m_per_s2": np.zeros((10, 3))}
    with pytest.raises(FrameError) as error:
        ImuSamples(**(fields | {field: value}))
    assert str(error.value).startswith(f"{field}: expected ")
    assert words in str(error.value)


def test_a_frame_takes_samples_up_to_its_time():
    image, depth_m = np.zeros((12, 16), np.uint8), np.zeros((12, 16), np.float32)
    assert Frame(45_000_000, image, depth_m, imu=SAMPLES).imu is SAMPLES
    with pytest.raises(FrameError, match="imu: expected samples up to the frame's time, got one 5000000 ns later"):
        Frame(40_000_000, image, depth_m, imu=SAMPLES)
    with pytest.raises(FrameError, match=r"imu: expected a jaxslam\.sensors\.ImuSamples, got list"):
        Frame(0, image, depth_m, imu=[])  # type: ignore[arg-type]


def test_written_samples_are_read_back(tmp_path: Path):
    write_imu_samples(tmp_path / "data.csv", SAMPLES)
    (tmp_path / "data.csv.gz").write_bytes(gzip.compress((tmp_path / "data.csv").read_bytes()))
    for name in ("data.csv", "data.csv.gz"):
        read = read_imu_samples(tmp_path / name)
        np.testing.assert_array_equal(read.timestamps_ns, TIMES)
        np.testing.assert_allclose(read.gyro_rad_per_s, SAMPLES.gyro_rad_per_s, atol=5.1e-13)
        np.testing.assert_allclose(read.accel_m_per_s2, SAMPLES.accel_m_per_s2, atol=5.1e-13)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEADING, "data.csv: expected at least one line"),
        (f"{HEADING}1,0,0,0,0,0\n", "data.csv:2: expected nanoseconds, three angular rates.*, got 6 columns"),
        (f"{HEADING}1,0,0,0,0,0,9\n2,0,0,x,0,0,9\n", "data.csv:3: expected nanoseconds.*got '2,0,0,x,0,0,9'"),
        (f"{HEADING}1.5,0,0,0,0,0,9\n", "data.csv:2: expected nanoseconds"),
        (f"{HEADING}{2**63},0,0,0,0,0,9\n", "data.csv:2: expected nanoseconds"),
        (f"{HEADING}1,0,0,nan,0,0,9\n", "data.csv:2: expected finite numbers"),
        (f"{HEADING}2,0,0,0,0,0,9\n\n2,0,0,0,0,0,9\n", "data.csv:4: expected a time after 2, got 2"),
    ],
)
def test_a_malformed_file_is_refused_with_the_line(tmp_path: Path, text: str, words: str):
    (tmp_path / "data.csv").write_text(text)
    with pytest.raises(DatasetError, match=words):
        read_imu_samples(tmp_path / "data.csv")


def test_a_missing_or_damaged_file_is_named(tmp_path: Path):
    with pytest.raises(DatasetError, match=r"data\.csv: cannot be read"):
        read_imu_samples(tmp_path / "data.csv")
    whole = gzip.compress(b"1,0,0,0,0,0,9\n" * 100)
    for damaged in (whole[:-12], b"plain text", whole[:20] + b"\xff" * 10 + whole[30:]):
        (tmp_path / "data.csv.gz").write_bytes(damaged)
        with pytest.raises(DatasetError, match=r"data\.csv\.gz: cannot be read"):
            read_imu_samples(tmp_path / "data.csv.gz")


def test_a_sheet_of_euroc_gets_the_place_of_the_camera(tmp_path: Path):
    T_body_cam = np.array([0.5, -0.5, 0.5, -0.5, 0.1, 0.2, 0.3])
    sheet = ImuSheet(200, 1.7e-4, 2e-5, 2e-3, 3e-3, tuple(T_body_cam.tolist()))
    write_imu_sheet(tmp_path / "sensor.yaml", sheet)
    assert read_imu_sheet(tmp_path / "sensor.yaml", T_body_cam) == sheet
    with pytest.raises(ConfigError, match=r"sensor\.yaml: missing 'T_imu_cam0'"):
        read_imu_sheet(tmp_path / "sensor.yaml")


def test_the_camera_is_placed_on_an_imu_that_is_not_the_body(tmp_path: Path):
    (tmp_path / "sensor.yaml").write_text(SHEET + "T_BS: [[1,0,0,0.5],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n")
    sheet = read_imu_sheet(tmp_path / "sensor.yaml", np.array([1.0, 0, 0, 0, 0.75, 0, 0]))
    np.testing.assert_allclose(sheet.T_imu_cam, [1, 0, 0, 0, 0.25, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("rate_hz: 200", "rate_hz: 0"), "rate_hz: expected a finite number > 0, got 0"),
        (("rate_hz: 200", ""), "sensor.yaml: missing 'rate_hz'"),
        (("walk: 2.0e-05", "walk: -2"), "gyroscope_random_walk: expected a finite number >= 0, got -2"),
        (("2.0e-3", "few"), "accelerometer_noise_density: expected a finite number >= 0, got 'few'"),
        (("T_imu_cam0: [1,", "T_imu_cam0: [2,"), "T_imu_cam: expected a unit quaternion first, got one of length 2"),
        (("T_imu_cam0: [1,", "T_imu_cam0: ["), "T_imu_cam0: expected a 4 x 4 matrix or qw qx qy qz x y z"),
    ],
)
def test_a_sheet_that_cannot_be_is_refused(tmp_path: Path, change: tuple[str, str], words: str):
    text = SHEET + "T_imu_cam0: [1, 0, 0, 0, 0, 0, 0]\n"
    assert change[0] in text
    (tmp_path / "sensor.yaml").write_text(text.replace(*change))
    with pytest.raises(ConfigError, match=words):
        read_imu_sheet(tmp_path / "sensor.yaml")


def test_the_real_sheet_and_flights_are_read(data_dir: Path):
    sheet = read_imu_sheet(data_dir / "imu" / "sensor.yaml")
    assert (sheet.rate_hz, sheet.gyroscope_noise_density, sheet.accelerometer_random_walk) == (200, 1.6968e-4, 3e-3)
    np.testing.assert_allclose(sheet.T_imu_cam[4:], [-0.0216401454975, -0.064676986768, 0.00981073058949])
    samples = read_imu_samples(data_dir / "imu" / "euroc_V103" / "imu0.csv.gz")
    assert len(samples) == 21_500
    assert np.median(np.diff(samples.timestamps_ns)) == pytest.approx(5e6, rel=1e-3)
    assert np.linalg.norm(samples.accel_m_per_s2.mean(axis=0)) == pytest.approx(9.8, abs=0.3)
