"""Recordings: what is read, how color and depth are matched, what is refused, and reading ahead."""

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_recording import (
    CAMERA,
    HEIGHT,
    SCALE,
    WIDTH,
    color,
    depth_counts,
    times,
    write_ground_truth,
    write_list,
    write_recording,
)

from jaxslam.datasets import (
    Associated,
    Dataset,
    Subset,
    Unmatched,
    dataset_kinds,
    frames_with_depth,
    imu_sheet,
    open_dataset,
    prefetch,
)
from jaxslam.errors import CameraError, DatasetError
from jaxslam.sensors.camera import Camera
from jaxslam.sensors.frame import Frame
from jaxslam.sensors.imu import ImuSamples, ImuSheet

KITCHEN = Camera("kitchen", 640, 480, 545, 545, 320, 240, depth_scale_per_m=5000)


def open_tiny(folder: Path) -> Dataset:
    return open_dataset(folder, camera=CAMERA)


def unmatched(dataset: Dataset) -> Unmatched:
    assert isinstance(dataset, Associated)
    return dataset.unmatched


class TestReading:
    def test_frames(self, tmp_path: Path) -> None:
        dataset = open_tiny(write_recording(tmp_path / "walk"))
        assert (dataset.name, len(dataset), dataset.camera) == ("walk", 6, CAMERA)
        assert unmatched(dataset) == (0, 0)
        for index, frame in enumerate(dataset[i] for i in range(6)):
            np.testing.assert_array_equal(frame.image, color(index))
            np.testing.assert_array_equal(frame.depth_m, depth_counts(index) / np.float32(SCALE))
            assert frame.depth_m is not None
            assert frame.depth_m.dtype == np.float32
            assert frame.timestamp_ns == dataset.timestamps_ns[index]

    def test_times_are_exact(self, tmp_path: Path) -> None:
        stamps = ["1548339819.87426", "1548339819.907610001", "1548339819.9410500019"]
        dataset = open_tiny(write_recording(tmp_path, color_times=stamps, depth_times=stamps))
        assert dataset.timestamps_ns.dtype == np.int64
        assert dataset.timestamps_ns.tolist() == [
            1548339819_874260000,
            1548339819_907610001,
            1548339819_941050002,
        ]

    def test_index(self, tmp_path: Path) -> None:
        dataset = open_tiny(write_recording(tmp_path))
        assert dataset[-1].timestamp_ns == dataset.timestamps_ns[5]
        for index in (6, -7):
            with pytest.raises(IndexError):
                dataset[index]

    def test_gray_and_jpeg(self, tmp_path: Path) -> None:
        write_recording(tmp_path, count=1)
        gray = cv2.GaussianBlur(color(0)[..., 0], (0, 0), 3)
        (tmp_path / "rgb.txt").write_text("100.0 rgb/gray.jpg\n")
        cv2.imwrite(str(tmp_path / "rgb" / "gray.jpg"), gray)
        image = open_tiny(tmp_path)[0].image
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(image[..., 0] - gray.astype(int)).max() < 16
        np.testing.assert_array_equal(image[..., 0], image[..., 2])

    def test_windows_line_ends_byte_order_mark_commas_and_blank_lines(self, tmp_path: Path) -> None:
        write_recording(tmp_path, count=2)
        text = (tmp_path / "rgb.txt").read_text().replace(" rgb/", ",rgb/").replace("\n", "\r\n\r\n")
        (tmp_path / "rgb.txt").write_bytes(b"\xef\xbb\xbf" + text.encode())
        assert len(open_tiny(tmp_path)) == 2

    def test_ground_truth(self, tmp_path: Path) -> None:
        write_recording(tmp_path / "with")
        write_ground_truth(tmp_path / "with", times(6))
        truth = open_tiny(tmp_path / "with").ground_truth
        assert truth is not None
        np.testing.assert_array_equal(truth.timestamps_ns, open_tiny(tmp_path / "with").timestamps_ns)
        np.testing.assert_allclose(truth.T_world_cam[:, 4], 0.3 * np.arange(6), atol=1e-12)
        np.testing.assert_array_equal(truth.T_world_cam[:, :4], np.tile([1.0, 0, 0, 0], (6, 1)))
        assert open_tiny(write_recording(tmp_path / "without")).ground_truth is None


class TestMatching:
    def test_nearest_one_to_one(self, tmp_path: Path) -> None:
        dataset = open_tiny(
            write_recording(
                tmp_path,
                color_times=["1.000", "1.010", "2.000", "3.0000", "4.000"],
                depth_times=["1.008", "1.9800", "3.0201", "4.0005", "5.0"],
            )
        )
        assert dataset.timestamps_ns.tolist() == [1_010_000_000, 2_000_000_000, 3_000_000_000, 4_000_000_000]
        assert frames_with_depth(dataset).tolist() == [True, True, False, True]
        assert frames_with_depth(Subset(dataset, 1, 4, 2)).tolist() == [True, True]
        assert unmatched(dataset) == (1, 2)
        np.testing.assert_array_equal(dataset[0].depth_m, depth_counts(0) / np.float32(SCALE))
        assert dataset[2].depth_m is None
        np.testing.assert_array_equal(dataset[3].depth_m, depth_counts(3) / np.float32(SCALE))

    def test_nothing_matches(self, tmp_path: Path) -> None:
        write_recording(tmp_path, depth_times=times(6, first=900))
        with pytest.raises(DatasetError, match=r"rgb\.txt: .*100.000 to 100.167 s against 900.000 to 900.167 s"):
            open_tiny(tmp_path)


class TestRecognition:
    @pytest.mark.parametrize(
        ("name", "camera"),
        [
            ("rgbd_dataset_freiburg1_xyz", "tum_fr1"),
            ("rgbd_dataset_freiburg2_desk_excerpt", "tum_fr2"),
            ("rgbd_dataset_freiburg3_walking_xyz", "tum_fr3"),
            ("rgbd_bonn_crowd2", "bonn"),
        ],
    )
    def test_camera_from_the_name(self, tmp_path: Path, name: str, camera: str) -> None:
        assert open_dataset(write_recording(tmp_path / name)).camera == Camera.load(camera)

    def test_camera_by_name_or_file(self, tmp_path: Path) -> None:
        write_recording(tmp_path / "walk")
        assert open_dataset(tmp_path / "walk", camera="tum_fr3").camera == Camera.load("tum_fr3")
        CAMERA.save(tmp_path / "tiny.yaml")
        assert open_dataset(tmp_path / "walk", camera=tmp_path / "tiny.yaml").camera == CAMERA

    def test_camera_beside_the_images_beats_the_name(self, tmp_path: Path) -> None:
        folder = write_recording(tmp_path / "rgbd_bonn_mine")
        CAMERA.save(folder / "camera.yaml")
        assert open_dataset(folder).camera == CAMERA
        assert open_dataset(folder, camera="bonn").camera == Camera.load("bonn")

    def test_unknown_camera(self, tmp_path: Path) -> None:
        with pytest.raises(CameraError, match=r"walk: .*--camera .* one of bonn, tum_fr1, tum_fr2, tum_fr3"):
            open_dataset(write_recording(tmp_path / "walk"))

    def test_camera_without_depth_scale(self, tmp_path: Path) -> None:
        camera = Camera("stereo", WIDTH, HEIGHT, 30.0, 30.0, 15.5, 11.5, baseline_m=0.1)
        with pytest.raises(CameraError, match="camera 'stereo': depth_scale_per_m"):
            open_dataset(write_recording(tmp_path), camera=camera)

    def test_kinds(self, tmp_path: Path) -> None:
        known = {"bonn", "euroc", "folder", "kitti", "tartanair", "tartanair_stereo", "tum"}
        assert known <= set(dataset_kinds())
        assert dataset_kinds() == sorted(dataset_kinds())
        assert open_dataset(write_recording(tmp_path / "walk"), kind="bonn").camera == Camera.load("bonn")
        with pytest.raises(DatasetError, match=r"kind: expected 'auto' or a known one, got 'tumm' \(did you mean"):
            open_dataset(tmp_path / "walk", kind="tumm")

    def test_no_recording(self, tmp_path: Path) -> None:
        kinds, files = " or ".join(dataset_kinds()), "calib.txt, times.txt, image_0 and image_1; "
        with pytest.raises(DatasetError, match=rf"expected a recording of kind {kinds} \(.*{files}"):
            open_dataset(tmp_path)
        with pytest.raises(DatasetError, match="expected the folder of a recording, got nothing there"):
            open_dataset(tmp_path / "none")
        (tmp_path / "walk.tgz").write_bytes(b"")
        with pytest.raises(DatasetError, match="an archive must be unpacked first"):
            open_dataset(tmp_path / "walk.tgz")


class TestMalformedLists:
    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("", "rgb.txt: expected at least one line `timestamp file`, got none"),
            ("# only\n\n", "rgb.txt: expected at least one line"),
            ("1.0 rgb/a.png\n2.0\n", "rgb.txt:2: expected `timestamp file`, got '2.0'"),
            ("1.0 rgb/a.png 1.0 depth/a.png\n", "rgb.txt:1: expected `timestamp file`"),
            ("# a\nrgb/a.png 1.0\n", "rgb.txt:2: expected a timestamp in seconds, got 'rgb/a.png'"),
            ("nan rgb/a.png\n", "rgb.txt:1: expected a timestamp in seconds, got 'nan'"),
            ("-1 rgb/a.png\n", "rgb.txt:1: expected a timestamp in seconds, got '-1'"),
            (
                "2.0 rgb/a.png\n# b\n1.0 rgb/b.png\n",
                "rgb.txt:3: expected a time after the 2.000000 s before it",
            ),
            ("2.0 rgb/a.png\n2.0 rgb/b.png\n", "rgb.txt:2: expected a time after the 2.000000 s before it"),
            (
                "1.5 rgb/a.png\n1548339819907610000 rgb/b.png\n",
                "rgb.txt:2: expected a timestamp in seconds, got '1548",
            ),
            (
                "0.0 rgb/a.png\n0.033 rgb/b.png\n0.066 rgb/c.png\n99000000 rgb/d.png\n",
                "rgb.txt:4: expected a timestamp in seconds, got a jump of 9.9e+07 s",
            ),
        ],
        ids=[
            "empty",
            "comments",
            "short",
            "long",
            "swapped",
            "nan",
            "negative",
            "back",
            "again",
            "ns",
            "mixed",
        ],
    )
    def test_refuses(self, tmp_path: Path, text: str, words: str) -> None:
        (write_recording(tmp_path) / "rgb.txt").write_text(text)
        with pytest.raises(DatasetError) as error:
            open_tiny(tmp_path)
        assert words in str(error.value)

    def test_depth_in_nanoseconds(self, tmp_path: Path) -> None:
        write_recording(tmp_path)
        stamps = [f"{int(float(stamp) * 1e9)}" for stamp in times(6)]
        write_list(tmp_path / "depth.txt", stamps, "depth")
        with pytest.raises(DatasetError, match=r"depth\.txt:3: expected a timestamp in seconds, got '1000"):
            open_tiny(tmp_path)

    def test_no_text(self, tmp_path: Path) -> None:
        (write_recording(tmp_path) / "depth.txt").write_bytes(b"\x89PNG\xff\xfe")
        with pytest.raises(DatasetError, match=r"depth\.txt: expected text in UTF-8"):
            open_tiny(tmp_path)

    def test_missing_list(self, tmp_path: Path) -> None:
        (write_recording(tmp_path) / "depth.txt").unlink()
        with pytest.raises(DatasetError, match=r"depth\.txt: cannot be read: No such file"):
            open_dataset(tmp_path, kind="tum", camera=CAMERA)


class TestBadImages:
    def test_missing(self, tmp_path: Path) -> None:
        write_recording(tmp_path)
        for stamp in times(6)[2:4]:
            (tmp_path / "rgb" / f"{stamp}.png").unlink()
        with pytest.raises(DatasetError, match=r"rgb/100.066667\.png: listed but missing, one of 2 such images"):
            open_tiny(tmp_path)

    @pytest.mark.parametrize("folder", ["rgb", "depth"])
    @pytest.mark.parametrize("keep", [0, 20, 200])
    @pytest.mark.filterwarnings("ignore")
    def test_cut_short(self, tmp_path: Path, folder: str, keep: int) -> None:
        file = min((write_recording(tmp_path) / folder).iterdir())
        file.write_bytes(file.read_bytes()[:keep])
        with pytest.raises(DatasetError, match=rf"{file.name}: expected an image, got {keep} bytes"):
            open_tiny(tmp_path)[0]

    def test_jpeg_cut_short(self, tmp_path: Path) -> None:
        file = min((write_recording(tmp_path) / "rgb").iterdir())
        jpeg = cv2.imencode(".jpg", color(0))[1].tobytes()
        file.write_bytes(jpeg)
        open_tiny(tmp_path)[0]
        file.write_bytes(jpeg[: len(jpeg) // 2])
        with pytest.raises(DatasetError, match=f"{file.name}: expected an image"):
            open_tiny(tmp_path)[0]

    @pytest.mark.parametrize(
        ("pixels", "words"),
        [
            (np.ones((HEIGHT, WIDTH), np.uint8), "expected depth as one uint16 a pixel, got 1 x uint8"),
            (np.ones((HEIGHT, WIDTH, 3), np.uint16), "expected depth as one uint16 a pixel, got 3 x uint16"),
            (np.ones((12, 16), np.uint16), "expected 32x24 pixels, the size of camera 'tiny', got 16x12"),
        ],
        ids=["8 bit", "color", "size"],
    )
    def test_depth(self, tmp_path: Path, pixels: np.ndarray, words: str) -> None:
        file = min((write_recording(tmp_path) / "depth").iterdir())
        cv2.imwrite(str(file), pixels)
        with pytest.raises(DatasetError, match=f"{file.name}: {words}"):
            open_tiny(tmp_path)[0]

    def test_camera_of_another_size(self, tmp_path: Path) -> None:
        dataset = open_dataset(write_recording(tmp_path), camera="bonn")
        with pytest.raises(DatasetError, match="expected 640x480 pixels, the size of camera 'bonn', got 32x24"):
            dataset[0]


class TestSubset:
    def test_is_a_recording_of_its_own(self, tmp_path: Path) -> None:
        whole = open_tiny(write_recording(tmp_path / "walk"))
        part = Subset(whole, 2, 5)
        assert (part.name, len(part), part.camera) == ("walk[2:5]", 3, CAMERA)
        np.testing.assert_array_equal(part.timestamps_ns, whole.timestamps_ns[2:5])
        assert [part[i].timestamp_ns for i in range(3)] == part.timestamps_ns.tolist()
        assert part[-1].timestamp_ns == whole.timestamps_ns[4]
        assert part.ground_truth is whole.ground_truth
        with pytest.raises(IndexError):
            part[3]

    def test_ends(self, tmp_path: Path) -> None:
        whole = open_tiny(write_recording(tmp_path / "walk"))
        assert len(Subset(whole)) == 6
        slower = Subset(whole, 1, 6, 2)
        assert (slower.name, len(slower)) == ("walk[1:6:2]", 3)
        assert [slower[index].timestamp_ns for index in range(3)] == whole.timestamps_ns[1:6:2].tolist()
        np.testing.assert_array_equal(slower.timestamps_ns, whole.timestamps_ns[1:6:2])
        assert Subset(whole, -2, 99).name == "walk[4:6]"
        assert Subset(Subset(whole, 1, 5), 1, 3)[0].timestamp_ns == whole.timestamps_ns[2]
        with pytest.raises(DatasetError, match="walk: expected a part of 6 frames, got 6:9"):
            Subset(whole, 6, 9)


class Inertial(Subset):
    """A recording with an IMU of 100 Hz."""

    @property
    def imu(self) -> ImuSheet:
        return ImuSheet(100.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def imu_samples(self) -> ImuSamples:
        times_ns = np.arange(self.timestamps_ns[0] - 10**9, self.timestamps_ns[-1], 10**7)
        return ImuSamples(times_ns, np.zeros((len(times_ns), 3)), np.zeros((len(times_ns), 3)))


def test_frames_of_every_second_have_the_samples_of_those_between(tmp_path: Path) -> None:
    whole = Inertial(open_tiny(write_recording(tmp_path)))
    part = Subset(Subset(whole, 0, 6, 2), 0, 3)
    assert imu_sheet(part) == whole.imu
    assert imu_sheet(open_tiny(tmp_path)) is None
    for index in (1, 2, -1):
        samples = Subset(whole, 0, 6, 2)[index].imu
        assert samples is not None
        end = range(3)[index]
        expected = whole.imu_samples.between(*part.timestamps_ns[[end - 1, end]].tolist())
        np.testing.assert_array_equal(samples.timestamps_ns, expected.timestamps_ns)


class Recorder(Subset):
    """A recording that remembers which frames were asked for, and in which thread."""

    def __init__(self, dataset: Dataset) -> None:
        super().__init__(dataset)
        self.asked: list[int] = []
        self.threads: set[int] = set()

    def __getitem__(self, index: int) -> Frame:
        self.asked.append(index)
        self.threads.add(threading.get_ident())
        return super().__getitem__(index)


def prefetch_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("jaxslam-prefetch")]


class TestPrefetch:
    @pytest.mark.parametrize("ahead", [1, 4, 100])
    def test_keeps_the_order_in_one_other_thread(self, tmp_path: Path, ahead: int) -> None:
        dataset = Recorder(open_tiny(write_recording(tmp_path)))
        stamps = [frame.timestamp_ns for frame in prefetch(dataset, ahead)]
        assert stamps == dataset.timestamps_ns.tolist()
        assert dataset.asked == list(range(6))
        assert len(dataset.threads) == 1
        assert threading.get_ident() not in dataset.threads
        assert prefetch_threads() == []

    def test_reads_no_further_than_asked(self, tmp_path: Path) -> None:
        dataset = Recorder(open_tiny(write_recording(tmp_path)))
        frames = prefetch(dataset, ahead=2)
        next(frames)
        frames.close()
        assert len(dataset.asked) <= 3
        assert prefetch_threads() == []

    def test_an_abandoned_loop_ends_the_thread(self, tmp_path: Path) -> None:
        dataset = open_tiny(write_recording(tmp_path))
        for _ in prefetch(dataset):
            break
        assert prefetch_threads() == []

    def test_errors_come_in_their_turn(self, tmp_path: Path) -> None:
        dataset = open_tiny(write_recording(tmp_path))
        (tmp_path / "rgb" / f"{times(6)[2]}.png").write_bytes(b"no image")
        frames = prefetch(dataset)
        assert [next(frames).timestamp_ns for _ in range(2)] == dataset.timestamps_ns[:2].tolist()
        with pytest.raises(DatasetError, match="expected an image, got 8 bytes"):
            next(frames)
        assert prefetch_threads() == []


class TestRealRecordings:
    @pytest.mark.parametrize(
        ("path", "camera", "frames", "left_out", "poses"),
        [
            ("bonn/rgbd_bonn_crowd", None, 927, (1, 0), 933),
            ("tum/rgbd_dataset_freiburg1_rpy_excerpt", None, 160, (0, 1), 630),
            ("composite/kitchen_people", KITCHEN, 200, (0, 0), 202),
        ],
    )
    def test_opens(
        self,
        data_dir: Path,
        path: str,
        *,
        camera: Camera | None,
        frames: int,
        left_out: tuple[int, int],
        poses: int,
    ) -> None:
        dataset = open_dataset(data_dir / path, camera=camera)
        assert (len(dataset), unmatched(dataset)) == (frames, left_out)
        assert dataset.ground_truth is not None
        assert len(dataset.ground_truth.timestamps_ns) == poses
        frame = dataset[len(dataset) // 2]
        assert frame.size == (640, 480)
        assert frame.depth_m is not None
        assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0]) < 4
