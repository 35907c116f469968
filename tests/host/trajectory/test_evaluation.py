"""ATE, RPE, KITTI's drift and coverage against evo and NumPy, on hard cases; for real ones see test_evaluation_evo."""

import json

import jax
import numpy as np
import pytest
from evo_figures import Evo
from kitti_drift import kitti_drift
from scipy.spatial.transform import Rotation

from jaxslam.cli.entry_point import main
from jaxslam.errors import TrajectoryError
from jaxslam.trajectory import evaluation
from jaxslam.trajectory.evaluation import evaluate
from jaxslam.trajectory.trajectory import Trajectory, associate, read

STEP_NS = 50_000_000
EPOCH_NS = 1_305_031_102_160_407_001


def make_pair(n=100, seed=0, noise=0.02, scale=1.3) -> tuple[Trajectory, Trajectory]:
    """A smooth trajectory, and a noisy, moved and scaled estimate of it."""
    rng = np.random.default_rng(seed)
    stamps = EPOCH_NS + STEP_NS * np.arange(n)
    positions = np.cumsum(rng.normal(size=(n, 3)) * [1.0, 0.5, 0.1], axis=0) * 0.1
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(size=(n, 3)), axis=0) * 0.05)
    world = Rotation.random(rng=rng)
    moved = scale * world.apply(positions + noise * rng.normal(size=(n, 3))) + [3.0, -2.0, 1.0]
    turned = world * rotations * Rotation.from_rotvec(noise * rng.normal(size=(n, 3)))
    make = lambda r, p: Trajectory(stamps, np.hstack([r.as_quat(scalar_first=True), p]))
    return make(turned, moved), make(rotations, positions)


def on_a_line(n=50, noise=0.0):
    rng = np.random.default_rng(0)
    poses = np.zeros((n, 7))
    poses[:, 0] = 1
    poses[:, 4:] = np.outer(np.linspace(0, 5, n), [1, 2, 2]) / 3 + noise * rng.normal(size=(n, 3))
    return Trajectory(EPOCH_NS + STEP_NS * np.arange(n), poses)


def straight_road(n):
    """A meter a frame."""
    poses = np.zeros((n, 7))
    poses[:, 0], poses[:, 6] = 1, np.arange(n)
    return Trajectory(STEP_NS * np.arange(n), poses)


def _matrices(trajectory):
    T = np.tile(np.eye(4), (len(trajectory), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(trajectory.T_world_cam[:, :4], scalar_first=True).as_matrix()
    T[:, :3, 3] = trajectory.positions
    return T


def reference_rpe(estimate, reference, delta_s):
    """The RPE of the TUM benchmark, pose by pose, by the time of each pair: RMSE of both, and the number of pairs."""
    P, Q, lengths, angles = _matrices(estimate), _matrices(reference), [], []
    for i, stamp in enumerate(estimate.timestamps_ns):
        later = [j for j, other in enumerate(estimate.timestamps_ns) if other >= stamp + delta_s * 1e9]
        if later:
            E = np.linalg.inv(np.linalg.inv(Q[i]) @ Q[later[0]]) @ np.linalg.inv(P[i]) @ P[later[0]]
            seconds = (estimate.timestamps_ns[later[0]] - stamp) / 1e9
            lengths.append(np.linalg.norm(E[:3, 3]) / seconds)
            angles.append(np.degrees(Rotation.from_matrix(E[:3, :3]).magnitude()) / seconds)
    return np.sqrt(np.mean(np.square(lengths))), np.sqrt(np.mean(np.square(angles))), len(lengths)


def assert_equals_evo(result, estimate, reference, align):
    evo = Evo(estimate, reference, align)
    theirs = evo.ate()
    for figure in ("rmse", "mean", "median", "max", "std"):
        assert getattr(result, f"ate_{figure}_m") == pytest.approx(theirs[figure], abs=1e-6, rel=1e-6)
    assert result.scale == pytest.approx(evo.scale, rel=1e-9)
    np.testing.assert_allclose(result.positions_m, evo.estimate.positions_xyz, atol=1e-6)
    assert result.rpe_trans_m_per_frame == pytest.approx(evo.rpe("translation_part"), abs=1e-6)
    assert result.rpe_rot_deg_per_frame == pytest.approx(evo.rpe("rotation_angle_deg"), abs=1e-6)
    similar = Evo(estimate, reference, "sim3")
    assert result.ate_sim3_rmse_m == pytest.approx(similar.ate()["rmse"], abs=1e-6)
    assert result.sim3_scale == pytest.approx(similar.scale, rel=1e-9)


class TestAgainstEvo:
    @pytest.mark.parametrize("align", ["none", "se3", "sim3"])
    def test_made_up_trajectory(self, align):
        estimate, reference = make_pair()
        assert_equals_evo(evaluate(estimate, reference, align), estimate, reference, align)

    def test_from_file_to_figure(self, data_dir):
        """evo's own reading and matching too, at its own default gap."""
        from evo.core import metrics, sync  # noqa: PLC0415
        from evo.tools import file_interface  # noqa: PLC0415

        paths = [data_dir / "trajectories" / f"freiburg1_xyz-{name}.txt" for name in ("rgbdslam", "groundtruth")]
        theirs, truth = sync.associate_trajectories(
            *(file_interface.read_tum_trajectory_file(path) for path in paths), max_diff=0.01
        )
        theirs.align(truth)
        metric = metrics.APE(metrics.PoseRelation.translation_part)
        metric.process_data((truth, theirs))
        ours = evaluate(read(paths[0]), read(paths[1]), max_gap_s=0.01)
        assert ours.num_matched == theirs.num_poses
        assert ours.ate_rmse_m == pytest.approx(metric.get_all_statistics()["rmse"], abs=1e-6)

    def test_one_second_is_evos_delta_of_that_many_frames(self):
        """At an even 20 Hz, one second is 20 frames and evo's `all_pairs`."""
        estimate, reference = make_pair()
        result = evaluate(estimate, reference)
        evo = Evo(estimate, reference, "se3")
        assert result.rpe_trans_m_per_s == pytest.approx(evo.rpe("translation_part", 20, all_pairs=True), abs=1e-9)
        assert result.rpe_rot_deg_per_s == pytest.approx(evo.rpe("rotation_angle_deg", 20, all_pairs=True), abs=1e-9)
        figures = result.summary()
        for name in ("mean", "median", "std"):
            trans, rot = (
                evo.rpe(relation, 20, all_pairs=True, statistic=name)
                for relation in ("translation_part", "rotation_angle_deg")
            )
            assert figures[f"rpe_trans_{name}_m_per_s"] == pytest.approx(trans, abs=1e-9)
            assert figures[f"rpe_rot_{name}_deg_per_s"] == pytest.approx(rot, abs=1e-9)


class TestRpe:
    @pytest.mark.parametrize("delta_s", [0.4, 1.0])
    def test_pairs_by_time(self, delta_s):
        """Stamps jitter and poses are missing: the partner is the first pose late enough."""
        estimate, reference = make_pair()
        rng = np.random.default_rng(1)
        kept = np.sort(rng.choice(100, 60, replace=False))
        jitter = np.sort(estimate.timestamps_ns[kept] + rng.integers(-9_000_000, 9_000_000, 60))
        estimate = Trajectory(jitter, estimate.T_world_cam[kept])
        result = evaluate(estimate, reference, rpe_delta_s=delta_s)
        length, angle, pairs = reference_rpe(estimate, reference.select(kept), delta_s)
        assert result.rpe_pairs == pairs
        assert result.rpe_trans_m_per_s == pytest.approx(length, rel=1e-9)
        assert result.rpe_rot_deg_per_s == pytest.approx(angle, rel=1e-9)

    def test_real_trajectory(self, data_dir):
        estimate = read(data_dir / "trajectories" / "freiburg1_xyz-rgbdslam.txt").select(np.arange(150))
        reference = read(data_dir / "trajectories" / "freiburg1_xyz-groundtruth.txt")
        index = associate(estimate.timestamps_ns, reference.timestamps_ns)
        length, angle, pairs = reference_rpe(estimate.select(index[0]), reference.select(index[1]), 1.0)
        result = evaluate(estimate, reference)
        assert (result.rpe_trans_m_per_s, result.rpe_rot_deg_per_s) == pytest.approx((length, angle), abs=1e-6)
        assert result.rpe_pairs == pairs

    def test_is_that_of_the_scaled_estimate_with_sim3(self):
        estimate, reference = make_pair(noise=0.0)
        assert evaluate(estimate, reference, "sim3").rpe_trans_m_per_s == pytest.approx(0, abs=1e-9)
        assert evaluate(estimate, reference, "se3").summary()["rpe_trans_m_per_s"] > 0.01

    def test_absent_without_pairs(self):
        estimate, reference = make_pair(5)
        result = evaluate(estimate, reference)
        assert result.rpe_trans_m_per_s is result.rpe_rot_deg_per_s is None
        assert result.rpe_trans_std_m_per_s is result.rpe_rot_median_deg_per_s is None
        assert result.rpe_pairs == 0
        assert result.rpe_trans_m_per_frame is not None
        assert "m/s" not in str(result)


class TestKitti:
    def test_of_a_real_drive(self, data_dir, capsys):
        """As the command prints it; and what ORB-SLAM2's paper has for this sequence: 0.70 % and 0.25 deg/100 m."""
        paths = [data_dir / "trajectories" / f"KITTI_00_{name}.txt" for name in ("ORB", "gt")]
        estimate, reference = (read(path) for path in paths)
        lengths = np.arange(1, 9) * 100.0
        translations, rotations, count = kitti_drift(estimate.T_world_cam, reference.T_world_cam, lengths, 10)
        percent, degrees = 100 * translations.sum() / count, 100 * np.degrees(rotations.sum() / count)
        result = evaluate(estimate, reference)
        assert result.kitti_segments == count
        assert result.kitti_trans_percent == pytest.approx(percent, abs=1e-9)
        assert result.kitti_rot_deg_per_100m == pytest.approx(degrees, abs=1e-6)
        assert (round(percent, 2), round(degrees, 2)) == (0.70, 0.25)
        main(["eval", *(str(path) for path in paths)])
        line = f"KITTI  {percent:.6f} %  {degrees:.6f} deg/100 m  (mean of {count} segments of 100 to 800 m)"
        assert line in capsys.readouterr().out

    def test_two_percent_too_long(self):
        """A straight road, 1 m a frame; and a segment of 100 m ends at 101 m, so that 2 % become 2.02 %."""
        reference = straight_road(120)
        estimate = Trajectory(reference.timestamps_ns, reference.T_world_cam * [1, 1, 1, 1, 1, 1, 1.02])
        result = evaluate(estimate, reference)
        assert result.kitti_trans_percent == pytest.approx(2.02, rel=1e-9)
        assert result.kitti_rot_deg_per_100m == pytest.approx(0, abs=1e-9)
        assert result.kitti_segments == 2  # from 0 and from 10 m
        assert evaluate(estimate, reference, "sim3").kitti_trans_percent == pytest.approx(0, abs=1e-9)

    def test_counts_matched_poses(self):
        """Of a drive of which half the poses are missing, every tenth of the others begins a segment."""
        reference = straight_road(220)
        result = evaluate(reference.select(np.arange(0, 220, 2)), reference)
        assert result.kitti_segments == 6 + 1  # of 100 m from 0, 20, ... 100 m, of 200 m from 0
        assert result.kitti_trans_percent == pytest.approx(0, abs=1e-9)

    def test_absent_on_short_paths(self):
        result = evaluate(straight_road(101), straight_road(101))
        assert result.kitti_trans_percent is result.kitti_rot_deg_per_100m is None
        assert result.kitti_segments == 0
        assert "KITTI" not in str(result)
        assert evaluate(straight_road(102), straight_road(102)).kitti_segments == 1


class TestHardCases:
    @pytest.mark.parametrize(("poses", "rest"), [(1, "the ATE"), (2, "the ATE and the RPE")])
    def test_too_few_to_align(self, poses, rest):
        estimate, reference = make_pair()
        few = estimate.select(np.arange(poses) * 30)
        message = f"alignment needs 3 matches, got {poses} within 20 ms .*'none' still gives {rest}$"
        with pytest.raises(TrajectoryError, match=message):
            evaluate(few, reference)
        result = evaluate(few, reference, "none")
        distances = np.linalg.norm(few.positions - reference.positions[: 30 * poses : 30], axis=1)
        assert result.ate_rmse_m == pytest.approx(np.sqrt((distances**2).mean()))
        assert result.ate_sim3_rmse_m is result.sim3_scale is None
        assert (result.rpe_trans_m_per_s is None) == (poses == 1)
        assert result.notes == ("fewer than 3 matches: no alignment",)

    def test_three_are_enough(self):
        estimate, reference = make_pair()
        few, truth = estimate.select(np.array([0, 40, 80])), reference.select(np.array([0, 40, 80]))
        assert_equals_evo(evaluate(few, reference), few, truth, "se3")

    @pytest.mark.parametrize("align", ["se3", "sim3"])
    def test_straight_line(self, align):
        """evo refuses a line; its error is well defined all the same, and is that of a line about to bend."""
        rng = np.random.default_rng(3)
        estimate, reference = on_a_line(), on_a_line(noise=0.01)
        bent = Trajectory(estimate.timestamps_ns, estimate.T_world_cam + 1e-7 * rng.normal(size=(50, 7)))
        result = evaluate(estimate, reference, align)
        assert "straight line" in result.notes[0]
        assert result.ate_rmse_m == pytest.approx(Evo(bent, reference, align).ate()["rmse"], rel=1e-4)

    def test_standing_still(self):
        pose = np.tile([1.0, 0, 0, 0, 0.1, 0.2, 0.3], (10, 1))
        estimate = Trajectory(EPOCH_NS + STEP_NS * np.arange(10), pose)
        result = evaluate(estimate, estimate, "sim3")
        assert (result.ate_rmse_m, result.scale, result.rpe_trans_m_per_frame) == (0, 1, 0)
        assert result.notes

    def test_perfect(self):
        _, reference = make_pair()
        result = evaluate(reference, reference, frames_ns=reference.timestamps_ns)
        assert result.ate_max_m == pytest.approx(0, abs=1e-12)
        assert result.rpe_rot_deg_per_s == pytest.approx(0, abs=1e-6)
        assert result.coverage_percent == 100
        assert result.notes == ()

    def test_gaps_count_as_lost(self):
        estimate, reference = make_pair()
        kept = np.r_[10:40, 60:90]
        result = evaluate(estimate.select(kept), reference, frames_ns=reference.timestamps_ns)
        lost = (result.lost_spans_ns - EPOCH_NS) // STEP_NS
        assert lost.tolist() == [[0, 10], [39, 60], [89, 99]]
        assert result.coverage_percent == 60
        np.testing.assert_array_equal(evaluate(estimate.select(kept), reference).lost_spans_ns, result.lost_spans_ns)
        assert result.num_matched == 60
        assert_equals_evo(result, estimate.select(kept), reference.select(kept), "se3")

    def test_duplicates_count_once(self):
        """Every pose of the estimate twice, the second time wrong."""
        estimate, reference = make_pair()
        wrong = estimate.T_world_cam + np.array([0, 0, 0, 0, 9, 9, 9])
        twice = np.stack([estimate.T_world_cam, wrong], axis=1).reshape(-1, 7)
        result = evaluate(Trajectory(np.repeat(estimate.timestamps_ns, 2), twice), reference)
        assert (result.num_estimate, result.num_matched) == (200, 100)
        assert result.ate_rmse_m == evaluate(estimate, reference).ate_rmse_m

    def test_matches_may_cross(self):
        """Two true poses just before two estimated ones: the nearest pair up first, then the rest."""
        estimate, reference = make_pair(2)
        late = Trajectory(np.array([7, 8]) * 1_000_000, estimate.T_world_cam)
        early = Trajectory(np.array([5, 6]) * 1_000_000, reference.T_world_cam)
        result = evaluate(late, early, "none")
        np.testing.assert_array_equal(result.reference_m, reference.positions[::-1])

    def test_figures_do_not_depend_on_the_padding(self):
        """Poses before and after, unmatched, and poses that only fill the next capacity up."""
        estimate, reference = make_pair()
        stamps = np.append(estimate.timestamps_ns, EPOCH_NS + STEP_NS * (1000 + np.arange(1000)))
        long = Trajectory(stamps, np.vstack([estimate.T_world_cam, np.repeat(estimate.T_world_cam[:1], 1000, axis=0)]))
        short = evaluate(estimate, reference)
        assert evaluate(long, reference).ate_rmse_m == short.ate_rmse_m

    @pytest.mark.parametrize(
        ("shift_ns", "factor", "message"),
        [
            (10**12, 1, "no stamps within 20 ms .*100 poses, 1305031102.160 to .*: they do not overlap in time"),
            (25_000_000, 1, "the nearest are 25.000 ms apart"),
            (0, 1000, "the second are a thousand times larger; are the units the same"),
            (0, 10**9, "the second are a billion times larger"),
        ],
    )
    def test_nothing_matches(self, shift_ns, factor, message):
        estimate, reference = make_pair()
        shifted = Trajectory((estimate.timestamps_ns + shift_ns) // factor, estimate.T_world_cam)
        with pytest.raises(TrajectoryError, match=message):
            evaluate(shifted, reference)

    def test_one_pose_each_too_far_apart(self):
        estimate, reference = (t.select(np.array([k])) for k, t in enumerate(make_pair()))
        with pytest.raises(TrajectoryError, match="do not overlap in time"):
            evaluate(estimate, reference)

    def test_empty(self):
        estimate, reference = make_pair()
        nothing = estimate.select(np.zeros(100, bool))
        with pytest.raises(TrajectoryError, match="the estimate holds no poses"):
            evaluate(nothing, reference)
        with pytest.raises(TrajectoryError, match="the reference holds no poses"):
            evaluate(estimate, nothing)

    def test_diverged(self):
        estimate, reference = make_pair()
        poses = estimate.T_world_cam.copy()
        poses[7, 5] = 1e12
        with pytest.raises(TrajectoryError, match=r"1 matched poses are more than 1e\+09 m"):
            evaluate(Trajectory(estimate.timestamps_ns, poses), reference)

    @pytest.mark.parametrize(
        ("setting", "message"),
        [
            ({"align": "sim"}, "align: unknown alignment 'sim'.*sim3"),
            ({"max_gap_s": 0}, "max_gap_s: expected a positive number of seconds, got 0"),
            ({"rpe_delta_s": float("nan")}, "rpe_delta_s: expected a positive number"),
        ],
    )
    def test_settings(self, setting, message):
        estimate, reference = make_pair()
        with pytest.raises(TrajectoryError, match=message):
            evaluate(estimate, reference, **setting)


class TestOtherBody:
    """Ground truth of a marker on the camera, as Bonn RGB-D Dynamic has it."""

    def test_is_noted(self):
        estimate, _ = make_pair(noise=0.001, scale=1.0)
        mounted = Rotation.from_rotvec([2.0, -1.0, 0.5])
        turned = Rotation.from_quat(estimate.T_world_cam[:, :4], scalar_first=True) * mounted
        poses = np.hstack([turned.as_quat(scalar_first=True), estimate.positions])
        result = evaluate(estimate, Trajectory(estimate.timestamps_ns, poses))
        assert result.rpe_rot_deg_per_s is not None
        assert result.rpe_rot_deg_per_s > 3
        assert any("another body" in note for note in result.notes)
        assert "another body" in str(result)

    @pytest.mark.parametrize("noise", [0.001, 0.3])
    def test_is_not_suspected_without_reason(self, noise):
        estimate, reference = make_pair(noise=noise, scale=1.0)
        assert evaluate(estimate, reference).notes == ()

    def test_bonn(self, data_dir):
        reference = read(data_dir / "bonn" / "rgbd_bonn_crowd" / "groundtruth.txt")
        turned = Rotation.from_quat(reference.T_world_cam[:, :4], scalar_first=True)
        back = turned * Rotation.from_rotvec([-0.46, 2.889, -1.453]).inv()  # to the camera, from a run of the tracker
        poses = np.hstack([back.as_quat(scalar_first=True), reference.positions])
        result = evaluate(Trajectory(reference.timestamps_ns, poses), reference)
        assert any("another body" in note for note in result.notes)


class TestReport:
    def test_names_what_was_done(self):
        estimate, reference = make_pair()
        result = evaluate(estimate, reference, "sim3", max_gap_s=0.01, frames_ns=reference.timestamps_ns)
        assert result.title == "ATE w.r.t. translation (with Sim(3) alignment, gap 10 ms)"
        assert str(result).startswith(result.title)
        assert "matched 100 of 100 estimated and 100 true poses; 100.0 % of 100 frames covered" in str(result)

    def test_summary_is_json(self):
        result = evaluate(*make_pair(5))
        summary = json.loads(json.dumps(result.summary()))
        assert summary["ate_rmse_m"] == result.ate_rmse_m
        assert summary["align"] == "se3"
        assert summary["rpe_trans_m_per_s"] is None
        assert summary["kitti_trans_percent"] is None
        assert evaluate(straight_road(200), straight_road(200)).summary()["kitti_segments"] == 10
        assert "errors_m" not in summary

    def test_arrays_belong_together(self):
        estimate, reference = make_pair()
        result = evaluate(estimate, reference)
        distances = np.linalg.norm(result.positions_m - result.reference_m, axis=1)
        np.testing.assert_allclose(result.errors_m, distances, atol=1e-12)
        np.testing.assert_array_equal(result.timestamps_ns, estimate.timestamps_ns)
        assert result.ate_rmse_m == pytest.approx(np.sqrt((distances**2).mean()))


class TestJax:
    def test_ignores_and_keeps_the_users_precision(self):
        pair = make_pair()
        figures = evaluate(*pair).summary()
        assert not jax.config.read("jax_enable_x64")
        with jax.enable_x64(True):
            assert evaluate(*pair).summary() == figures

    def test_one_trace_serves_many_lengths_and_alignments(self, monkeypatch):
        estimate, reference = make_pair()
        evaluate(estimate, reference)
        traced = []
        monkeypatch.setattr(evaluation, "ate", lambda *args, **_: traced.append(args))
        for n in (3, 10, 99):
            for align in ("none", "se3", "sim3"):
                evaluate(estimate.select(np.arange(n)), reference, align)
        assert not traced
