"""Exports of the map, read back by other programs."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from small_map import keyframe, observations, points, pose, small_map

from jaxslam.errors import MapFileError, TrajectoryError
from jaxslam.geometry.se3 import to_local
from jaxslam.map.edit import with_keyframe, with_observations, with_points, without_observations
from jaxslam.map.export import write_colmap, write_keyframe_trajectory, write_ply
from jaxslam.map.keyframe_removal import without_keyframe
from jaxslam.map.point_records import NONE
from jaxslam.map.types import Map, empty_map
from jaxslam.sensors.camera import Camera
from jaxslam.trajectory.trajectory import read_tum

BARREL = Camera("barrel", 64, 48, 50.0, 51.0, 31.0, 24.5, (-0.2, 0.05, 0.003, -0.002, 0.01))


def two_submaps() -> Map:
    """Submap 0 of three keyframes, one of which sees nothing, and submap 1 of one; a keyframe was culled."""
    rng = np.random.default_rng(3)
    slam_map = without_keyframe(small_map(num_keyframes=4, num_points=8), 1)
    slam_map = without_observations(
        slam_map, (slam_map.observations.keyframe == 3) | (slam_map.observations.point == 5)
    )
    slam_map = with_keyframe(slam_map, keyframe(slam_map, rng), pose(rng, 0.01, 0.05), NONE, 1)
    slam_map = with_points(slam_map, points(slam_map, np.array([4, 4]), rng))
    return with_observations(slam_map, observations(slam_map, np.full(2, 4), np.array([8, 9]), np.full(2, NONE), rng))


def decoded(png: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def read_vertices(path: Path) -> np.ndarray:
    """The vertices of a binary PLY of floats and bytes."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    types = {"float": "<f4", "uchar": "u1"}
    fields = [(name, types[kind]) for _, kind, name in (line.split() for line in lines[3:])]
    vertices = np.frombuffer(body, fields)
    assert lines[2] == f"element vertex {len(vertices)}"
    return vertices


class TestPly:
    def test_holds_points_weights_and_observations(self, tmp_path):
        slam_map = two_submaps()
        write_ply(tmp_path / "a.ply", slam_map)
        vertices = read_vertices(tmp_path / "a.ply")
        X = slam_map.points.X_world[:, :8].astype(np.float32)
        np.testing.assert_array_equal([vertices["x"], vertices["y"], vertices["z"]], X)
        np.testing.assert_array_equal(vertices["weight"], slam_map.points.weight[:8])
        assert vertices["observations"].tolist() == [2, 2, 2, 2, 2, 0, 2, 2]

    def test_colors_are_those_of_the_first_image(self, tmp_path):
        slam_map = two_submaps()
        write_ply(tmp_path / "a.ply", slam_map)
        vertices = read_vertices(tmp_path / "a.ply")
        u, v = np.rint(slam_map.observations.uv_raw[:, :7]).astype(int)
        assert slam_map.observations.keyframe[:7].tolist() == [0] * 7
        expected = np.insert(decoded(slam_map.keyframe(0).image_file)[v, u], 5, 128)  # nobody sees point 5
        for channel in ("red", "green", "blue"):
            np.testing.assert_array_equal(vertices[channel], expected)
        assert len(set(expected.tolist())) > 4

    def test_colmap_reads_it(self, tmp_path):
        slam_map = small_map()
        write_ply(tmp_path / "a.ply", slam_map, keyframes=True)
        model = pycolmap.Reconstruction()
        model.import_PLY(str(tmp_path / "a.ply"))
        read = [model.points3D[number] for number in sorted(model.points3D)]
        expected = np.concatenate([slam_map.points.X_world.T, slam_map.T_world_cam[:, 4:]])
        np.testing.assert_allclose([point.xyz for point in read], expected, atol=1e-6)
        assert [point.color.tolist() for point in read[-4:]] == [[255, 128, 0]] * 4

    def test_other_submap_and_one_that_is_not_there(self, tmp_path):
        write_ply(tmp_path / "a.ply", two_submaps(), submap=1)
        assert len(read_vertices(tmp_path / "a.ply")) == 2
        with pytest.raises(MapFileError, match=r"submap: expected one of \[0, 1\], got 7"):
            write_ply(tmp_path / "a.ply", two_submaps(), submap=7)

    def test_empty_map(self, tmp_path):
        write_ply(tmp_path / "a.ply", empty_map(BARREL), keyframes=True)
        assert len(read_vertices(tmp_path / "a.ply")) == 0

    def test_image_that_cannot_be_decoded(self, tmp_path):
        slam_map = small_map(num_keyframes=2)
        slam_map = slam_map._replace(
            keyframes=(slam_map.keyframes[0]._replace(image_file=b"PNG"), slam_map.keyframes[1])
        )
        with pytest.raises(MapFileError, match="keyframe 0: its image cannot be decoded"):
            write_ply(tmp_path / "a.ply", slam_map)
        assert not list(tmp_path.iterdir())


def colmap_model(folder: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(folder / "sparse" / "0"))


class TestColmap:
    @pytest.mark.parametrize(
        "slam_map", [small_map(), two_submaps(), small_map(camera=BARREL)], ids=["one", "two", "barrel"]
    )
    def test_model_reprojects_as_the_map_does(self, slam_map, tmp_path):
        write_colmap(tmp_path, slam_map)
        model = colmap_model(tmp_path)
        assert (model.is_valid(), model.num_cameras(), model.num_reg_images()) == (
            True,
            1,
            (slam_map.submap == 0).sum(),
        )
        seen, compared = slam_map.observations, 0
        for image in model.images.values():
            inside = np.flatnonzero(seen.keyframe == image.image_id - 1)
            own = inside[np.argsort(seen.point[inside])]
            assert [entry.point3D_id - 1 for entry in image.points2D] == seen.point[own].tolist()
            for row, entry in zip(own, image.points2D, strict=True):
                projected = image.project_point(model.points3D[entry.point3D_id].xyz)
                assert projected is not None
                np.testing.assert_allclose(projected - entry.xy, residual(slam_map, row), atol=1e-9)
                np.testing.assert_allclose(entry.xy - 0.5, seen.uv[:, row], atol=1e-9)
                compared += 1
        first = np.isin(seen.keyframe, slam_map.ids[slam_map.submap == 0])
        assert compared == model.compute_num_observations() == first.sum()

    def test_errors_of_points_are_those_that_colmap_finds(self, tmp_path):
        write_colmap(tmp_path, small_map())
        model = colmap_model(tmp_path)
        written = {number: point.error for number, point in model.points3D.items()}
        model.update_point_3d_errors()
        assert written == pytest.approx({number: point.error for number, point in model.points3D.items()}, rel=1e-9)
        assert model.compute_mean_reprojection_error() > 0.3

    def test_images_are_what_a_camera_without_distortion_sees(self, tmp_path):
        """A bright spot drawn where the distorted camera sees a point is found where the model projects it."""
        slam_map = small_map(num_keyframes=1, num_points=1, camera=BARREL)
        K = np.array([[BARREL.fx, 0, BARREL.cx], [0, BARREL.fy, BARREL.cy], [0, 0, 1]])
        X = np.array([[0.9, -0.7, 2.0]])
        seen = cv2.projectPoints(X, np.zeros(3), np.zeros(3), K, np.array(BARREL.distortion))[0].reshape(2)
        rows, columns = np.mgrid[: BARREL.height, : BARREL.width]
        spot = 255 * np.exp(-((columns - seen[0]) ** 2 + (rows - seen[1]) ** 2) / (2 * 2.0**2))
        image = cv2.imencode(".png", np.rint(spot).astype(np.uint8))[1].tobytes()
        write_colmap(tmp_path, slam_map._replace(keyframes=(slam_map.keyframes[0]._replace(image_file=image),)))
        written = decoded((tmp_path / "images" / "000000.png").read_bytes()).astype(float)
        center = np.array([(columns * written).sum(), (rows * written).sum()]) / written.sum()
        projected = colmap_model(tmp_path).cameras[1].img_from_cam(X)
        assert projected is not None
        ideal = projected[0] - 0.5
        assert np.hypot(*(ideal - seen)) > 1.5
        np.testing.assert_allclose(center, ideal, atol=0.2)

    def test_images_of_a_camera_without_distortion_stay_as_they_are(self, tmp_path):
        slam_map = two_submaps()
        write_colmap(tmp_path, slam_map)
        assert sorted(path.name for path in (tmp_path / "images").iterdir()) == [
            "000000.png",
            "000002.png",
            "000003.png",
        ]
        for image in colmap_model(tmp_path).images.values():
            written = decoded((tmp_path / "images" / image.name).read_bytes())
            np.testing.assert_array_equal(written, decoded(slam_map.keyframe(image.image_id - 1).image_file))

    def test_empty_map(self, tmp_path):
        write_colmap(tmp_path, empty_map(BARREL))
        assert colmap_model(tmp_path).num_images() == 0

    def test_folder_that_cannot_be_made(self, tmp_path):
        (tmp_path / "file").write_text("x")
        with pytest.raises(MapFileError, match="cannot be made"):
            write_colmap(tmp_path / "file", small_map())


def residual(slam_map: Map, row: int) -> np.ndarray:
    """Where a point should have been seen, less where it was, pixels."""
    seen = slam_map.observations
    at = np.searchsorted(slam_map.points.ids, seen.point[row])
    x, y, z = to_local(slam_map.pose(int(seen.keyframe[row])), slam_map.points.X_world[:, [at]])[:, 0]
    camera = slam_map.camera
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy]) - seen.uv[:, row]


class TestTrajectory:
    def test_holds_the_keyframes_of_one_submap(self, tmp_path):
        slam_map = two_submaps()
        write_keyframe_trajectory(tmp_path / "a.txt", slam_map)
        read = read_tum(tmp_path / "a.txt")
        assert read.timestamps_ns.tolist() == [slam_map.keyframe(number).timestamp_ns for number in (0, 2, 3)]
        np.testing.assert_allclose(read.T_world_cam, slam_map.T_world_cam[:3], atol=1e-8)
        write_keyframe_trajectory(tmp_path / "b.txt", slam_map, submap=1)
        np.testing.assert_allclose(read_tum(tmp_path / "b.txt").T_world_cam, slam_map.T_world_cam[3:], atol=1e-8)

    def test_no_folder(self, tmp_path):
        with pytest.raises(TrajectoryError, match="cannot be written"):
            write_keyframe_trajectory(tmp_path / "no" / "a.txt", small_map())
