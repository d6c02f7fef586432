"""Measures of a trajectory: each against a case whose answer is known."""

import numpy as np
import pytest
from support.run_folders import disturbed, START_NS, true_pose

from thermal_fiducial.core.geometry.se3 import inverse, so3_exp, transform
from thermal_fiducial.report import metrics
from thermal_fiducial.report.trajectory import Trajectory

SECONDS = 30.0


def trajectory(rate_hz=200.0, seconds=SECONDS, start=0.0):
    stamps = START_NS + np.arange(round(start * 1e9), round(seconds * 1e9), round(1e9 / rate_hz))
    return Trajectory(stamps, true_pose((stamps - START_NS) * 1e-9))


TRUTH = trajectory(100.0, SECONDS + 0.02)


def shifted(t, d):
    """``t`` with the constant error ``d`` (6,)."""
    T = t.T_map_body
    return Trajectory(t.stamps_ns, transform(so3_exp(-d[3:]) @ T[:, :3, :3], T[:, :3, 3] - d[:3]))


def test_truth_is_interpolated_between_its_stamps():
    """Linear and SLERP at 100 Hz miss this motion by less than 1e-5 m: half a millisecond would be 3e-4."""
    estimate = trajectory(173.0)
    e = metrics.errors(estimate, TRUTH)
    assert len(e) == len(estimate)
    assert np.abs(e.d).max() < 1e-5


def test_interpolation_is_exact_for_uniform_motion():
    stamps = START_NS + np.array([0, 100_000_000])
    T = transform(so3_exp([[0.0, 0.0, 0.0], [0.3, -0.2, 0.5]]), [[0.0, 0, 0], [1.0, 2.0, 3.0]])
    between, exists = metrics.interpolate(Trajectory(stamps, T), START_NS + np.array([25_000_000]))
    assert exists.all()
    assert np.allclose(between[0], transform(so3_exp([0.075, -0.05, 0.125]), [0.25, 0.5, 0.75]), atol=1e-12)


def test_no_truth_before_after_and_in_holes():
    keep = (TRUTH.stamps_ns < START_NS + 10**10) | (TRUTH.stamps_ns > START_NS + 11 * 10**9)
    asked = START_NS + np.array([-1, 0, 5 * 10**9, 10_500_000_000, 12 * 10**9, 31 * 10**9])
    _, exists = metrics.interpolate(TRUTH.take(keep), asked)
    assert exists.tolist() == [False, True, True, False, True, False]
    assert not metrics.interpolate(TRUTH.take(np.array([0])), asked)[1].any()


def test_errors_have_the_sign_and_the_frame_of_the_covariance_convention():
    d = np.array([0.01, -0.02, 0.03, 0.004, -0.005, 0.006])
    e = metrics.errors(shifted(TRUTH, d), TRUTH)
    assert np.allclose(e.d, d, atol=1e-12)
    T = e.estimate[7]
    corrected = transform(so3_exp(e.d[7, 3:]) @ T[:3, :3], T[:3, 3] + e.d[7, :3])
    assert np.allclose(corrected, e.truth[7], atol=1e-12)


def test_accuracy_is_not_aligned_away():
    d = np.array([0.03, 0.04, 0.0, 0.0, 0.0, np.deg2rad(2.0)])
    result = metrics.accuracy(metrics.errors(shifted(TRUTH, d), TRUTH))
    assert result['position_rms_mm'] == pytest.approx(50.0)
    assert result['position_max_mm'] == pytest.approx(50.0)
    assert result['attitude_median_deg'] == pytest.approx(2.0)
    assert result['position_aligned_rms_mm'] == pytest.approx(0.0, abs=1e-6)


def test_alignment_removes_a_rigid_motion_and_nothing_else():
    T = transform(so3_exp([0.1, -0.4, 2.0]), [3.0, -1.0, 0.5])
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 0.01, (len(TRUTH), 3))
    moved = T @ TRUTH.T_map_body
    moved[:, :3, 3] += noise
    residuals = metrics.aligned_residuals(metrics.errors(Trajectory(TRUTH.stamps_ns, moved), TRUTH))
    # Six parameters out of three times 3002 numbers: the alignment takes next to nothing of the noise.
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(np.sqrt(np.mean(noise**2)), rel=2e-3)


@pytest.mark.parametrize('rate', [30.0, 200.0])
def test_jitter_of_white_noise_is_root_two_of_it(rate):
    rng = np.random.default_rng(1)
    sigma = np.array([1e-3] * 3 + [1e-4] * 3)
    clean = trajectory(rate, 60.0)
    noisy = Trajectory(clean.stamps_ns, disturbed(clean.T_map_body, sigma, rng))
    result = metrics.jitter(metrics.errors(noisy, clean))
    # 1800 independent pairs or more of three axes: within 5 sigma of the estimate of a variance.
    assert result['position_mm'] == pytest.approx(np.sqrt(6.0), rel=0.05)
    assert result['attitude_deg'] == pytest.approx(np.rad2deg(1e-4 * np.sqrt(6.0)), rel=0.05)


def test_a_constant_error_has_no_jitter_and_gaps_are_not_crossed():
    d = np.array([0.05, 0, 0, 0.0, 0.01, 0])
    fiducial = trajectory(30.0)
    keep = np.arange(len(fiducial)) % 7 < 3
    e = metrics.errors(shifted(fiducial, d).take(keep), fiducial)
    assert metrics.jitter(e)['position_mm'] == pytest.approx(0.0, abs=1e-9)
    i, j = metrics.pairs_apart(e.stamps_ns, metrics.FRAME_NS)
    assert np.all(j - i == 1)
    assert len(i) == np.sum(np.diff(e.stamps_ns) < 2 * metrics.FRAME_NS - 1_000_000)


def test_relative_error_of_a_drift():
    t = trajectory()
    seconds = (t.stamps_ns - START_NS) * 1e-9
    drifting = t.T_map_body.copy()
    drifting[:, 0, 3] += 0.002 * seconds
    result = metrics.relative_pose_error(metrics.errors(Trajectory(t.stamps_ns, drifting), t))
    assert result['position_mm'] == pytest.approx(2.0, rel=1e-3)
    assert result['attitude_deg'] == pytest.approx(0.0, abs=1e-6)


def test_relative_error_does_not_depend_on_the_frame_of_the_map():
    rng = np.random.default_rng(2)
    t = trajectory(50.0)
    noisy = disturbed(t.T_map_body, np.array([1e-3] * 6), rng)
    T = transform(so3_exp([0.3, 0.2, -1.0]), [5.0, 1.0, 2.0])
    plain = metrics.relative_pose_error(metrics.errors(Trajectory(t.stamps_ns, noisy), t))
    moved = metrics.relative_pose_error(metrics.errors(Trajectory(t.stamps_ns, T @ noisy), t))
    assert moved == pytest.approx(plain, rel=1e-9)


def test_nees_of_matched_noise_is_one_a_degree_of_freedom():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(6, 6)) * np.array([[1e-2]] * 3 + [[1e-3]] * 3)
    P = A @ A.T
    t = trajectory(100.0, 40.0)
    d = rng.multivariate_normal(np.zeros(6), P, len(t))
    T = t.T_map_body
    noisy = Trajectory(t.stamps_ns, transform(so3_exp(-d[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] - d[:, :3]))
    e = metrics.errors(noisy, t)
    result = metrics.consistency(e, np.tile(P, (len(t), 1, 1)))
    # 4000 samples of chi-square: the mean's relative sigma is sqrt(2 / (6 * 4000)) = 0.9 %; 4 sigma, 3 dof likewise.
    assert result['pose_nees_per_dof'] == pytest.approx(1.0, abs=0.04)
    assert result['position_nees_per_dof'] == pytest.approx(1.0, abs=0.055)
    assert result['attitude_nees_per_dof'] == pytest.approx(1.0, abs=0.055)
    assert result['pose_within_95'] == pytest.approx(0.95, abs=0.014)
    assert metrics.consistency(e, np.zeros((len(t), 6, 6))) == {}


def test_nees_sees_missing_cross_terms():
    rng = np.random.default_rng(4)
    P = np.diag([1e-4] * 3 + [1e-6] * 3)
    P[0, 4] = P[4, 0] = 0.95e-5
    t = trajectory(100.0, 20.0)
    d = rng.multivariate_normal(np.zeros(6), P, len(t))
    e = metrics.Errors(t.stamps_ns, d, t.T_map_body, t.T_map_body)
    wrong_sign = P.copy()
    wrong_sign[0, 4] = wrong_sign[4, 0] = -0.95e-5
    assert metrics.consistency(e, np.tile(wrong_sign, (len(t), 1, 1)))['pose_nees_per_dof'] > 5.0


def test_output_rate_pauses_and_steps():
    t = trajectory(200.0, 10.0)
    T = t.T_map_body.copy()
    T[1000:, 2, 3] += 0.03
    keep = np.ones(len(t), np.bool_)
    keep[500:520] = False
    result = metrics.output(Trajectory(t.stamps_ns, T).take(keep))
    assert result['rate_hz'] == pytest.approx(200.0)
    assert result['longest_pause_ms'] == pytest.approx(105.0)
    assert result['step_max_mm'] == pytest.approx(30.0, rel=0.05)
    assert result['poses'] == 1980


def test_samples_that_are_read_together_are_no_faster_and_no_steps():
    """80 samples a second in bursts were 7692, and the body jumped by 195 mm where nothing did."""
    stamps = START_NS + np.arange(800) // 4 * 50_000_000 + np.arange(800) % 4 * 130_000
    rounded = np.round(true_pose((stamps - START_NS) * 1e-9), 4)
    result = metrics.output(Trajectory(stamps, rounded))
    assert result['rate_hz'] == pytest.approx(80.0, rel=0.01)
    # By what its velocity changes in 50 ms at 2 m/s^2 at most.
    assert result['step_max_mm'] < 5.0


def test_motion_in_a_pause_is_no_step():
    """After a second the body is not where its velocity before would have brought it: it was 231 mm."""
    t = trajectory(200.0, 10.0)
    keep = (t.stamps_ns <= START_NS + 4 * 10**9) | (t.stamps_ns >= START_NS + 5 * 10**9)
    result = metrics.output(t.take(keep))
    assert result['step_max_mm'] < 1.0  # of smooth motion at 200 Hz
    assert result['rate_hz'] == pytest.approx(200.0)
    assert result['longest_pause_ms'] == pytest.approx(1000.0)


def test_path_length_is_that_of_the_path():
    stamps = START_NS + np.arange(0, 10**10 + 1, 5_000_000)
    angle = (stamps - START_NS) * 1e-9
    p = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    assert metrics.path_length(Trajectory(stamps, transform(np.eye(3), p))) == pytest.approx(10.0, rel=0.012)


def test_latency():
    assert metrics.latency(np.arange(101.0)) == {'p50_ms': 50.0, 'p99_ms': 99.0, 'max_ms': 100.0}
    assert metrics.latency(np.zeros(0)) == {}


@pytest.mark.parametrize('count', [0, 1, 2])
def test_runs_of_almost_nothing_have_measures_of_almost_nothing(count):
    few = trajectory().take(np.arange(count))
    e = metrics.errors(few, TRUTH)
    assert metrics.output(few) == {'poses': count}
    assert metrics.jitter(e) == {}
    assert metrics.relative_pose_error(e) == {}
    assert (metrics.accuracy(e) == {}) == (count == 0)


def test_agrees_with_evo():
    """The field's own tool, where it is installed, on stamps that truth has exactly."""
    evo_metrics = pytest.importorskip('evo.core.metrics')
    from evo.core.trajectory import PoseTrajectory3D

    rng = np.random.default_rng(5)
    noisy = Trajectory(TRUTH.stamps_ns, disturbed(TRUTH.T_map_body, np.array([5e-3] * 3 + [2e-3] * 3), rng))
    e = metrics.errors(noisy, TRUTH)
    paths = [
        PoseTrajectory3D(poses_se3=list(t.T_map_body), timestamps=(t.stamps_ns - START_NS) * 1e-9)
        for t in (TRUTH, noisy)
    ]
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data(tuple(paths))
    angle = evo_metrics.APE(evo_metrics.PoseRelation.rotation_angle_deg)
    angle.process_data(tuple(paths))
    result = metrics.accuracy(e)
    assert result['position_rms_mm'] == pytest.approx(
        1e3 * ape.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-6
    )
    assert result['attitude_rms_deg'] == pytest.approx(angle.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-4)
    rpe = evo_metrics.RPE(evo_metrics.PoseRelation.translation_part, 100, evo_metrics.Unit.frames, all_pairs=True)
    rpe.process_data(tuple(paths))
    # At the end two more pairs than evo's: the last stamp is within 20 ms of a second later.
    assert metrics.relative_pose_error(e)['position_mm'] == pytest.approx(
        1e3 * rpe.get_statistic(evo_metrics.StatisticsType.rmse), rel=1e-3
    )


def test_a_body_seen_from_the_wrong_side_is_no_small_error():
    """The inverse of a pose is a mistake that must not look like accuracy."""
    wrong = Trajectory(TRUTH.stamps_ns, inverse(TRUTH.T_map_body))
    assert metrics.accuracy(metrics.errors(wrong, TRUTH))['position_rms_mm'] > 1000.0
