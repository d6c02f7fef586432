"""Motion of the camera from frame to frame."""

import numpy as np
from support.scenes import motion_prior

from thermal_fiducial.core.detection.prediction.known_markers import ExpectedMarkers
from thermal_fiducial.core.detection.prediction.tracking import MeasuredCorners, MotionTrack, predict_frame
from thermal_fiducial.core.detection.prediction.twist import Twist, twist_by_odometry, UNKNOWN_TWIST
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import interaction
from thermal_fiducial.core.geometry.se3 import twist_transfer
from thermal_fiducial.core.measurements import Odometry

CAMERA = Camera(640, 512, [[529.0, 0, 319.5], [0, 529.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.3, 0.1, 0, 0, 0])
TWIST = np.array([0.5, -0.3, 0.8, 0.4, -0.6, 0.7])
LAG = 0.010


def moved(points, dt):
    """Points in the camera after it has moved with TWIST for ``dt``."""
    T = se3.transform(se3.so3_exp(TWIST[3:] * dt), TWIST[:3] * dt)
    return se3.apply(se3.inverse(T), points)


def test_interaction_is_the_derivative_of_the_projection():
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 4], (20, 3))
    x = points[:, :2] / points[:, 2:]
    step = 1e-6
    later = moved(points, step)
    earlier = moved(points, -step)
    numeric = (later[:, :2] / later[:, 2:] - earlier[:, :2] / earlier[:, 2:]) / (2 * step)
    np.testing.assert_allclose(interaction(x, points[:, 2]) @ TWIST, numeric, atol=1e-7)


def test_twist_of_the_camera_from_that_of_the_body():
    T_body_camera = se3.transform(se3.so3_exp([0.3, -1.0, 0.5]), [0.1, 0.2, -0.3])
    body = np.array([0.4, -0.2, 0.3, 0.5, 0.1, -0.7])
    dt = 1e-6
    T_body = se3.transform(se3.so3_exp(body[3:] * dt), body[:3] * dt)
    T_camera = se3.inverse(T_body_camera) @ T_body @ T_body_camera
    numeric = np.concatenate([T_camera[:3, 3], se3.so3_log(T_camera[:3, :3])]) / dt
    odometry = Odometry(0, np.eye(4), body[:3], body[3:], np.eye(6), np.eye(6))
    found = twist_by_odometry(0, [odometry], twist_transfer(T_body_camera), LAG, 0.0)
    np.testing.assert_allclose(found.value, numeric, atol=1e-5)
    # One state shows no acceleration.
    np.testing.assert_array_equal(found.acceleration, np.zeros(6))


def test_the_noise_of_the_rates_averages_out_in_the_velocity_of_a_camera_with_a_lever_arm_too():
    """Ten states of a poor gyroscope; what of its noise were left in one place alone would be no covariance."""
    T_body_camera = se3.transform(se3.so3_exp([0.3, -1.0, 0.5]), [0.3, -0.2, 0.9])
    velocity, rate = np.full(3, 1e-2), np.full(3, 0.3)
    covariance = np.diag(np.concatenate([velocity, rate]) ** 2)
    stamps = np.arange(-9, 10, 2) * 1_000_000
    states = [Odometry(int(t), np.eye(4), np.zeros(3), np.zeros(3), np.eye(6), covariance) for t in stamps]
    transfer = twist_transfer(T_body_camera)
    found = twist_by_odometry(0, states, transfer, 0.0, 0.0).covariance
    rng = np.random.default_rng(0)
    of_body = np.concatenate(
        [velocity * rng.normal(size=(100_000, 3)), rate * rng.normal(size=(100_000, 10, 3)).mean(axis=1)], axis=1
    )
    # Of 100,000 draws: half a per cent of the largest.
    np.testing.assert_allclose(found, np.cov(transfer @ of_body.T), atol=0.01 * found.max())
    assert np.linalg.eigvalsh(found).min() > 0.0


def test_tracker_finds_the_twist_from_two_frames():
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.8, -0.6, 2], [0.8, 0.6, 4], (5, 4, 3))
    tracker, ids, dt = MotionTrack(np.eye(4), 0.0), np.arange(5), 1 / 30
    later = moved(points, dt)
    x = [p[..., :2] / p[..., 2:] for p in (points, later)]
    tracker = tracker.after(10**9, None, ExpectedMarkers(ids, x[0], points[..., 2], np.full(5, 100.0)))
    assert tracker.predict(10**9 + 10**10) is None
    found = tracker.correct(10**9 + round(dt * 1e9), None, MeasuredCorners(ids, x[1], later[..., 2], np.full(5, 1e-5)))
    # A finite step of a thirtieth of a second differs from the derivative in second order; the prior pulls a little.
    np.testing.assert_allclose(found.value, TWIST, atol=0.03)
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0)


def test_a_frame_that_lags_by_all_of_the_time_since_the_last_one_shows_no_motion():
    """At 100 Hz, of a filter that diverges: its twist is not used, and the corners are where they were 10 ms ago."""
    ids, depth = np.array([3]), np.ones((1, 4))
    x = 0.1 * np.array([[[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]])
    markers = ExpectedMarkers(ids, x, depth, np.ones(1))
    track = MotionTrack(np.eye(4), LAG).after(10**9, Twist(TWIST, np.eye(6)), markers)
    found = track.correct(10**9 + round(LAG * 1e9), None, MeasuredCorners(ids, x, depth, np.full(1, 1e-4)))
    np.testing.assert_array_equal(found.value, np.zeros(6))
    np.testing.assert_array_equal(found.covariance, UNKNOWN_TWIST.covariance)


def turning(stamp_ns, states, jitter_ns=0, seed=6):
    """Twists of frames that turn ever faster, where their stamps jitter, and what they should be one lag ago."""
    points = np.random.default_rng(5).uniform([-0.6, -0.5, 2], [0.6, 0.5, 4], (5, 4, 3))
    rng, acceleration, covariance = np.random.default_rng(seed), np.array([0.0, 6.0, 2.0]), np.diag([1e-4] * 6)
    tracker, ids = MotionTrack(np.eye(4), LAG), np.arange(5)
    for stamp in stamp_ns:
        at = stamp * 1e-9
        ages_ns = np.arange(-2, 7)[::-1] * 5_000_000 if states else []
        noise = 0.01 * rng.standard_normal((len(ages_ns), 3))
        heard = [
            Odometry(
                stamp - int(age), np.eye(4), np.zeros(3), acceleration * (at - 1e-9 * age) + e, covariance, covariance
            )
            for age, e in zip(ages_ns, noise, strict=True)
        ]
        seen_ns = int(stamp + jitter_ns * rng.standard_normal())
        seen = points @ se3.so3_exp(0.5 * acceleration * (seen_ns * 1e-9) ** 2)
        x = seen[..., :2] / seen[..., 2:]
        predicted = twist_by_odometry(stamp, heard, np.eye(6), LAG, 0.0) if states else tracker.predict(stamp)
        twist = tracker.correct(stamp, predicted, MeasuredCorners(ids, x, seen[..., 2], np.full(5, 1e-5)))
        tracker = tracker.after(stamp, twist, ExpectedMarkers(ids, x, seen[..., 2], np.full(5, 100.0)))
        yield twist, acceleration * (at - LAG)


def test_without_odometry_the_twist_is_that_of_the_last_frames_and_claims_no_more():
    """A camera that turns faster and faster: the lag shows how it turned 10 ms ago, two frames how 17 ms ago."""
    stamps = [round(k * 1e9 / 30) for k in range(8)]
    twist, truth = list(turning(stamps, states=False))[-1]
    error = np.abs(twist.ago(LAG)[3:] - truth)
    # 0.04 rad/s of 6 rad/s^2 by the difference in time, and 0.03 by the frame before, as stamps may jitter by 1 ms.
    assert np.all(error < 0.075)
    assert np.all(error < 2.0 * np.sqrt(np.diag(twist.covariance)[3:]))


def test_states_of_the_filter_show_the_twist_whatever_the_stamps_of_frames_do():
    """Jitter of 2 ms is a twentieth of a frame's period: differences alone would be wrong by as much of the turn."""
    stamps = [round(k * 1e9 / 30) for k in range(12)]
    with_prior, alone = (
        np.array([twist.ago(LAG)[3:] - truth for twist, truth in list(turning(stamps, states, 2_000_000))[3:]])
        for states in (True, False)
    )
    # The mean of nine samples of a gyroscope with 0.01 rad/s of noise, and as much again for what the corners add.
    assert np.sqrt(np.mean(with_prior**2)) < 0.007
    assert np.sqrt(np.mean(with_prior**2)) < 0.2 * np.sqrt(np.mean(alone**2))


def test_states_without_any_error_are_no_division_by_zero():
    certain = [
        Odometry(k * 5_000_000, np.eye(4), TWIST[:3], TWIST[3:], np.zeros((6, 6)), np.zeros((6, 6))) for k in range(6)
    ]
    twist = twist_by_odometry(25_000_000, certain, np.eye(6), 0.0, 0.0)
    # The least noise that is assumed of states, 1e-6, over the least acceleration that six show, pulls by a thousandth.
    np.testing.assert_allclose(twist.value, TWIST, atol=2e-4)
    np.testing.assert_allclose(twist.acceleration, np.zeros(6), atol=0.01)


def test_twist_of_a_late_frame_is_carried_back():
    points = np.random.default_rng(5).uniform([-0.6, -0.5, 2], [0.6, 0.5, 4], (5, 4, 3))
    seen = ExpectedMarkers(np.arange(5), points[..., :2] / points[..., 2:], points[..., 2], np.ones(5))
    tracker, now = MotionTrack(np.eye(4), 0.0), 10**9
    tracker = tracker.after(now, Twist(TWIST, 1e-6 * np.eye(6), np.ones(6)), seen)
    ahead, back = (tracker.predict(now + dt_ns) for dt_ns in (30_000_000, -30_000_000))
    for twist in (ahead, back):
        np.testing.assert_array_equal(twist.value, TWIST)
        # What an unknown acceleration of 3 m/s^2 and 4 rad/s^2 makes of 30 ms.
        np.testing.assert_allclose(np.sqrt(np.diag(twist.covariance)), np.repeat([0.09, 0.12], 3), rtol=1e-3)


def test_markers_are_expected_where_the_motion_carries_them():
    rng = np.random.default_rng(4)
    points, dt = rng.uniform([-0.8, -0.6, 2], [0.8, 0.6, 4], (5, 4, 3)), 1 / 30
    later, twist = moved(points, dt), Twist(TWIST, np.eye(6))
    tracker = MotionTrack(np.eye(4), 0.0)
    tracker = tracker.after(
        0, twist, ExpectedMarkers(np.arange(5), points[..., :2] / points[..., 2:], points[..., 2], np.ones(5))
    )
    expected = tracker.expected(round(dt * 1e9), twist)
    # The stamp is a whole number of nanoseconds.
    np.testing.assert_allclose(expected.x, later[..., :2] / later[..., 2:], atol=1e-8)
    np.testing.assert_allclose(expected.depth, later[..., 2], atol=1e-8)
    assert len(tracker.expected(10**9, twist).ids) == 0


def test_a_late_frame_disturbs_nothing_and_a_clock_set_back_is_followed():
    rng = np.random.default_rng(4)
    points, twist = rng.uniform([-0.8, -0.6, 2], [0.8, 0.6, 4], (5, 4, 3)), Twist(TWIST, np.eye(6))
    seen = ExpectedMarkers(np.arange(5), points[..., :2] / points[..., 2:], points[..., 2], np.ones(5))
    tracker, now = MotionTrack(np.eye(4), 0.0), 10**9
    tracker = tracker.after(now, twist, seen)
    ahead = tracker.expected(now + 33_000_000, twist)
    # Whose own markers are expected where they were then.
    late, before = tracker.expected(now - 66_000_000, twist), moved(points, -0.066)
    np.testing.assert_allclose(late.x, before[..., :2] / before[..., 2:], atol=1e-8)
    tracker = tracker.after(now - 66_000_000, None, ExpectedMarkers.none())
    np.testing.assert_array_equal(tracker.expected(now + 33_000_000, twist).x, ahead.x)
    assert tracker.predict(now + 33_000_000) is not None
    tracker = tracker.after(now - 10**9, twist, seen)
    np.testing.assert_array_equal(tracker.expected(now - 10**9 + 33_000_000, twist).x, ahead.x)


def test_motion_that_shows_no_markers_is_forgotten():
    """A wrong one would blur them away in frame after frame; the filter's states are heard all the same."""
    tracker, period_ns = MotionTrack(np.eye(4), 0.0), 33_333_333
    tracker = tracker.after(
        0,
        Twist(np.full(6, 9.0), np.eye(6)),
        ExpectedMarkers(np.arange(1), *(np.ones(s) for s in ((1, 4, 2), (1, 4), 1))),
    )
    for frame in range(1, 8):
        twist = tracker.predict(frame * period_ns)
        assert (twist is None) == (frame * period_ns > 150_000_000)
        tracker = tracker.after(frame * period_ns, twist, ExpectedMarkers.none())
    state = Odometry(8 * period_ns, np.eye(4), TWIST[:3], TWIST[3:], 1e-6 * np.eye(6), 1e-6 * np.eye(6))
    # The twist of which nothing is known pulls by its share of the variance.
    heard, _ = predict_frame(8 * period_ns, motion_prior(state), tracker, 0.03)
    np.testing.assert_allclose(heard.value, TWIST, atol=1e-5)
