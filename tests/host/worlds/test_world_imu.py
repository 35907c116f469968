"""The IMU of a world: its samples against the way of the camera, its noise, and those of real flights."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxslam.datasets.synthetic.virtual_camera import START_NS
from jaxslam.errors import ConfigError, DatasetError
from jaxslam.geometry.se3 import angle, between, compose
from jaxslam.sensors import ImuState, predict, preintegrate, read_imu_samples, read_imu_sheet, write_imu_samples
from jaxslam.worlds import World, WorldRecording, load_world
from jaxslam.worlds.camera_way import camera_way
from jaxslam.worlds.description import Way, WorldCamera, WorldImu
from jaxslam.worlds.imu import ADIS16448, ImuRecord, record_imu

WALK = Way(((0.0, 0.0, 1.4), (2.0, 0.0, 1.4), (2.0, 2.0, 1.8)), speed_m_per_s=0.7, ends="loop")
EXACT = WorldImu(noise_free=True)
WORLD = World("A walk.", 10.0, WALK, imu=EXACT)
FRAMES_NS = START_NS + np.arange(0, 10_000_000_000, 50_000_000)


def recorded(world: World, frames_ns: np.ndarray = FRAMES_NS) -> ImuRecord:
    return record_imu(world, camera_way(world), frames_ns)


def without_noise(world: World) -> World:
    assert world.imu is not None
    return dataclasses.replace(world, imu=dataclasses.replace(world.imu, noise_free=True))


def end_of(record: ImuRecord, last: int = -1) -> tuple[ImuState, np.ndarray, np.ndarray]:
    """The state at a frame by integration from the true one at the first, and the true pose and velocity there."""
    samples, states = record.samples, record.states
    assert samples is not None
    assert states is not None
    start = ImuState(states.T_world_imu[0], states.velocity_m_per_s[0])
    delta = preintegrate(samples, int(states.timestamps_ns[0]), int(states.timestamps_ns[last]))
    return predict(start, delta), states.T_world_imu[last], states.velocity_m_per_s[last]


WAYS = {
    "walk with tremor": WALK,
    "look at a point": Way(WALK.points_m, look=(1.0, 5.0, 0.5)),
    "stop, looking around": Way(WALK.points_m, ends="stop", swing_deg=30.0),
    "drone": load_world("drone").way,
}


class TestExactSamples:
    @pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())
    def test_integrate_to_the_way(self, way: Way) -> None:
        """Measured: at most 1.4 mm and 0.0004 degrees after 10 s at 200 Hz, a quarter of it at 400 Hz."""
        end, T, velocity = end_of(recorded(dataclasses.replace(WORLD, way=way)))
        assert np.linalg.norm(end.T_world_imu[4:] - T[4:]) < 0.002
        assert np.rad2deg(angle(between(T, end.T_world_imu))) < 0.001
        assert np.linalg.norm(end.velocity_m_per_s - velocity) < 0.002

    @pytest.mark.parametrize(("flight", "tremor"), [("euroc_V103", 0.0), ("euroc_V202", 1.0)])
    def test_integrate_to_a_flight(self, data_dir: Path, flight: str, tremor: float) -> None:
        """Measured: 2.4 and 4.0 mm, at most 0.0011 degrees."""
        file = str(data_dir / "imu" / flight / "groundtruth.txt")
        end, T, _ = end_of(recorded(dataclasses.replace(WORLD, way=Way(file=file, from_s=20.0, tremor=tremor))))
        assert np.linalg.norm(end.T_world_imu[4:] - T[4:]) < 0.01
        assert np.rad2deg(angle(between(T, end.T_world_imu))) < 0.1

    def test_the_imu_is_where_the_sheet_says(self) -> None:
        record = recorded(WORLD)
        assert record.states is not None
        cameras = camera_way(WORLD).poses(1e-9 * (FRAMES_NS - START_NS))
        got = compose(record.states.T_world_imu, np.array(ADIS16448.T_imu_cam)[None])
        np.testing.assert_allclose(np.abs(np.sum(got[:, :4] * cameras[:, :4], axis=1)), 1, atol=1e-12)
        np.testing.assert_allclose(got[:, 4:], cameras[:, 4:], atol=1e-12)

    @pytest.mark.parametrize("scale", [0.5, 4.0])
    def test_a_scaled_world_keeps_its_gravity(self, scale: float) -> None:
        end, T, _ = end_of(recorded(dataclasses.replace(WORLD, scale=scale)))
        assert np.linalg.norm(end.T_world_imu[4:] - T[4:]) < 0.003 * scale
        record = recorded(dataclasses.replace(WORLD, scale=scale))
        assert record.sheet is not None
        np.testing.assert_allclose(record.sheet.T_imu_cam[4:], scale * np.array(ADIS16448.T_imu_cam[4:]))

    def test_rest_measures_gravity_alone(self) -> None:
        """Before a way that stops begins, and with the camera level: its y axis points down."""
        still = Way(((0.0, 0.0, 1.0), (1.0, 0.0, 1.0)), ends="stop", pause_s=8.0, down_deg=0.0, tremor=0.0)
        imu = dataclasses.replace(EXACT, T_imu_cam=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        samples = recorded(dataclasses.replace(WORLD, way=still, imu=imu)).samples
        assert samples is not None
        np.testing.assert_allclose(samples.accel_m_per_s2[200:1000], np.tile([0, -9.81, 0], (800, 1)), atol=1e-6)
        np.testing.assert_allclose(samples.gyro_rad_per_s[200:1000], 0, atol=1e-9)


class TestNoise:
    def test_is_that_of_the_sheet(self) -> None:
        imu = WorldImu(gyroscope_random_walk=0.0, accelerometer_random_walk=0.0, rate_hz=400.0)
        world = dataclasses.replace(WORLD, imu=imu)
        noisy, exact = recorded(world), recorded(without_noise(world))
        assert noisy.samples is not None
        assert exact.samples is not None
        for name, density in (("gyro_rad_per_s", 1.6968e-4), ("accel_m_per_s2", 2.0e-3)):
            noise = getattr(noisy.samples, name) - getattr(exact.samples, name)
            assert noise.std() == pytest.approx(density * np.sqrt(400.0), rel=0.03)
            assert abs(noise.mean()) < 4 * density * np.sqrt(400.0 / noise.size)

    def test_biases_walk_as_the_sheet_says_and_are_known(self) -> None:
        """The standard deviation of a bias after 10 s is its density times the root of 10 s."""
        imu = WorldImu(gyroscope_noise_density=0.0, accelerometer_noise_density=0.0, rate_hz=50.0)
        ends = []
        for seed in range(40):
            world = dataclasses.replace(WORLD, imu=imu, seed=seed)
            record, exact = recorded(world), recorded(without_noise(world))
            assert record.samples is not None
            assert exact.samples is not None
            assert record.states is not None
            bias = record.samples.accel_m_per_s2 - exact.samples.accel_m_per_s2
            np.testing.assert_allclose(bias[0], 0, atol=1e-12)
            assert record.states.accel_bias_m_per_s2 is not None
            since_s = 1e-9 * (record.samples.timestamps_ns - START_NS)
            at_last = [np.interp(1e-9 * (FRAMES_NS[-1] - START_NS), since_s, column) for column in bias.T]
            np.testing.assert_allclose(record.states.accel_bias_m_per_s2[-1], at_last, atol=1e-9)
            ends.append(bias[-1])
        assert np.std(ends) == pytest.approx(3.0e-3 * np.sqrt(10.0), rel=0.2)

    def test_is_the_same_again_and_other_for_another_seed(self) -> None:
        world = dataclasses.replace(WORLD, imu=WorldImu())
        first, again, other = recorded(world), recorded(world), recorded(dataclasses.replace(world, seed=1))
        for record, same in ((again, True), (other, False)):
            assert first.samples is not None
            assert record.samples is not None
            assert np.array_equal(record.samples.gyro_rad_per_s, first.samples.gyro_rad_per_s) == same

    @pytest.mark.parametrize("frames", [17, 100, 181])
    def test_does_not_depend_on_the_length(self, frames: int) -> None:
        world = dataclasses.replace(WORLD, imu=WorldImu())
        whole, part = recorded(world).samples, recorded(world, FRAMES_NS[:frames]).samples
        assert whole is not None
        assert part is not None
        for name in ("timestamps_ns", "gyro_rad_per_s", "accel_m_per_s2"):
            np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[: len(part)])
        assert part.timestamps_ns[-1] >= FRAMES_NS[frames - 1]


SMALL = WorldCamera(64, 48, fps=20.0)


class TestRecording:
    def test_frames_hold_what_came_since_the_last(self) -> None:
        world = dataclasses.replace(WORLD, seconds=0.2, camera=SMALL)
        recording = WorldRecording(world)
        samples = recording.imu_samples
        assert recording.imu == ADIS16448
        assert samples is not None
        parts = [recording[index].imu for index in range(len(recording))]
        lengths = [len(part) for part in parts if part is not None]
        assert lengths == [1, 10, 10, 10]  # the first one begins with the recording
        last = recording[-1].imu
        assert last is not None
        np.testing.assert_array_equal(last.gyro_rad_per_s, samples.gyro_rad_per_s[21:31])

    def test_none_without_one(self) -> None:
        recording = WorldRecording(dataclasses.replace(WORLD, seconds=0.2, camera=SMALL, imu=None))
        assert recording.imu is recording.imu_samples is recording.imu_states is recording[1].imu is None

    def test_figures_given_come_before_those_of_the_sheet(self, data_dir: Path) -> None:
        folder = data_dir / "imu"
        imu = WorldImu(sheet=str(folder / "sensor.yaml"), rate_hz=100.0)
        sheet = recorded(dataclasses.replace(WORLD, imu=imu)).sheet
        assert sheet is not None
        assert dataclasses.replace(sheet, rate_hz=200.0) == read_imu_sheet(folder / "sensor.yaml")
        assert sheet.rate_hz == 100.0

    def test_the_default_sheet_is_that_of_euroc(self, data_dir: Path) -> None:
        sheet = read_imu_sheet(data_dir / "imu" / "sensor.yaml")
        assert dataclasses.replace(sheet, T_imu_cam=ADIS16448.T_imu_cam) == ADIS16448
        # Processors round the quaternion of the file's matrix otherwise.
        np.testing.assert_allclose(sheet.T_imu_cam, ADIS16448.T_imu_cam, rtol=0, atol=1e-15)


REAL = """
about: A flight.
seconds: 2
camera: {width: 64, height: 48, fps: 20}
way: {file: $JAXSLAM_DATA/imu/euroc_V103/groundtruth.txt, from_s: 30, tremor: 0, turn_deg: 40}
imu: {sheet: $JAXSLAM_DATA/imu/sensor.yaml, file: $JAXSLAM_DATA/imu/euroc_V103/imu0.csv.gz}
"""


class TestRealSamples:
    def test_are_on_the_clock_of_the_way(self, data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Rates without the mean bias of the flight turn as its poses do, to 1.5 degrees in 2 s."""
        monkeypatch.setenv("JAXSLAM_DATA", str(data_dir))
        (tmp_path / "flight.yaml").write_text(REAL)
        recording = WorldRecording(tmp_path / "flight.yaml")
        samples, states = recording.imu_samples, recording.imu_states
        assert samples is not None
        assert states is not None
        assert states.gyro_bias_rad_per_s is None
        assert samples.timestamps_ns[0] <= START_NS
        assert samples.timestamps_ns[-1] >= recording.timestamps_ns[-1]
        given = read_imu_samples(data_dir / "imu" / "euroc_V103" / "imu0.csv.gz")
        first = np.flatnonzero((given.gyro_rad_per_s == samples.gyro_rad_per_s[0]).all(axis=1))[0]
        # The first pose of the trajectory is at 1403715888.384058112 s, and 30 s later the recording begins.
        assert given.timestamps_ns[first] - samples.timestamps_ns[0] == 1403715918384058112 - START_NS
        bias = np.array([-0.003, 0.022, 0.076])
        turned = preintegrate(samples, START_NS, int(states.timestamps_ns[-1]), bias).rotation
        true = between(states.T_world_imu[0], states.T_world_imu[-1])
        off = between(true, np.concatenate([turned, np.zeros(3)]))
        assert np.rad2deg(angle(true)) > 10
        assert np.rad2deg(angle(off)) < 1.5
        frame = recording[1]
        assert frame.imu is not None
        assert len(frame.imu) == 10

    def test_must_cover_the_recording(self, data_dir: Path, tmp_path: Path) -> None:
        folder = data_dir / "imu" / "euroc_V103"
        samples = read_imu_samples(folder / "imu0.csv.gz")
        write_imu_samples(tmp_path / "late.csv", samples.between(int(samples.timestamps_ns[400]), 2**62))
        way = Way(file=str(folder / "groundtruth.txt"), tremor=0.0)
        world = dataclasses.replace(WORLD, way=way, imu=WorldImu(file=str(tmp_path / "late.csv")))
        with pytest.raises(ConfigError, match=r"late\.csv: expected samples of the whole recording, 0\.000 to 9"):
            recorded(world)
        with pytest.raises(DatasetError, match=r"nowhere\.csv: cannot be read"):
            recorded(dataclasses.replace(world, imu=WorldImu(file=str(tmp_path / "nowhere.csv"))))

    @pytest.mark.parametrize(
        "change",
        [{"way": WALK}, {"way": Way(file="way.txt", tremor=1.0)}, {"way": Way(file="way.txt", tremor=0), "scale": 2.0}],
    )
    def test_must_have_been_on_the_way(self, change: dict[str, object]) -> None:
        with pytest.raises(ConfigError, match=r"WorldImu\.file: expected a way\.file with way\.tremor 0"):
            World(**({"about": "A flight.", "seconds": 1.0, "imu": WorldImu(file="imu.csv")} | change))  # type: ignore[arg-type]


TWO_POINTS = "about: A.\nseconds: 1\nway: {points_m: [[0, 0, 1], [1, 0, 1]]}\n"


class TestPaths:
    def test_need_the_folder_of_recordings(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "flight.yaml").write_text(REAL)
        monkeypatch.delenv("JAXSLAM_DATA", raising=False)
        world = load_world(tmp_path / "flight.yaml")
        assert world.way.file == "$JAXSLAM_DATA/imu/euroc_V103/groundtruth.txt"
        assert world.imu is not None
        assert world.imu.sheet == "$JAXSLAM_DATA/imu/sensor.yaml"
        with pytest.raises(ConfigError, match="JAXSLAM_DATA: expected the folder in which"):
            WorldRecording(world)

    def test_lie_beside_the_description(self, tmp_path: Path) -> None:
        (tmp_path / "flight.yaml").write_text(REAL.replace("$JAXSLAM_DATA/", ""))
        world = load_world(tmp_path / "flight.yaml")
        assert world.imu is not None
        assert world.imu.file == str(tmp_path / "imu" / "euroc_V103" / "imu0.csv.gz")

    @pytest.mark.parametrize(
        ("line", "message"),
        [
            ("imu: {rate_hz: 0}", "rate_hz: expected a finite number > 0"),
            ("imu: {rate: 200}", "unknown key 'rate'"),
            ("imu: {gyroscope_random_walk: -1}", "gyroscope_random_walk: expected a finite number >= 0"),
            ("imu: {T_imu_cam: [1, 0, 0]}", "T_imu_cam: expected a list of 7"),
            ("imu: {noise_free: true, file: imu.csv}", "WorldImu: expected noise_free or a file, got both"),
        ],
    )
    def test_what_is_wrong_is_named(self, tmp_path: Path, line: str, message: str) -> None:
        (tmp_path / "mine.yaml").write_text(f"{TWO_POINTS}{line}\n")
        with pytest.raises(ConfigError, match=message):
            load_world(tmp_path / "mine.yaml")

    def test_a_quaternion_of_another_length_is_refused(self) -> None:
        with pytest.raises(ConfigError, match=r"ImuSheet\.T_imu_cam: expected a unit quaternion first"):
            recorded(dataclasses.replace(WORLD, imu=WorldImu(T_imu_cam=(2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))))
