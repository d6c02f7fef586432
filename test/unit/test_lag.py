"""Image motion and the removal of the bolometers' lag."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera, ImagePoints
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.vision.frame import Places
from thermal_fiducial.core.vision.lag import (
    camera_twist,
    interaction,
    markers_sharpened,
    MEMORY_AGE,
    model_error,
    MotionTracker,
    plausible,
    REMAINING,
    SmearField,
    Tracked,
    Twist,
    without_lag,
)

CAMERA = Camera(640, 512, [[529.0, 0, 319.5], [0, 529.0, 255.5], [0, 0, 1]], 'plumb_bob', [-0.3, 0.1, 0, 0, 0])
TWIST = np.array([0.5, -0.3, 0.8, 0.4, -0.6, 0.7])
LAG = 0.010


def moved(points, dt):
    """Points in the camera after it has moved with TWIST for ``dt``."""
    T = geometry.transform(geometry.so3_exp(TWIST[3:] * dt), TWIST[:3] * dt)
    return geometry.apply(geometry.inverse(T), points)


def test_interaction_is_the_derivative_of_the_projection():
    points = np.random.default_rng(0).uniform([-1, -1, 1], [1, 1, 4], (20, 3))
    x = points[:, :2] / points[:, 2:]
    step = 1e-6
    later = moved(points, step)
    earlier = moved(points, -step)
    numeric = (later[:, :2] / later[:, 2:] - earlier[:, :2] / earlier[:, 2:]) / (2 * step)
    np.testing.assert_allclose(interaction(x, points[:, 2]) @ TWIST, numeric, atol=1e-7)


def test_twist_of_the_camera_from_that_of_the_body():
    T_body_camera = geometry.transform(geometry.so3_exp([0.3, -1.0, 0.5]), [0.1, 0.2, -0.3])
    body = np.array([0.4, -0.2, 0.3, 0.5, 0.1, -0.7])
    dt = 1e-6
    T_body = geometry.transform(geometry.so3_exp(body[3:] * dt), body[:3] * dt)
    T_camera = geometry.inverse(T_body_camera) @ T_body @ T_body_camera
    numeric = np.concatenate([T_camera[:3, 3], geometry.so3_log(T_camera[:3, :3])]) / dt
    odometry = Odometry(0, np.eye(4), body[:3], body[3:], np.eye(6), np.eye(6))
    np.testing.assert_allclose(camera_twist(odometry, T_body_camera).value, numeric, atol=1e-5)


def test_tracker_finds_the_twist_from_two_frames():
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.8, -0.6, 2], [0.8, 0.6, 4], (5, 4, 3))
    tracker, ids, dt = MotionTracker(np.eye(4)), np.arange(5), 1 / 30
    later = moved(points, dt)
    x = [p[..., :2] / p[..., 2:] for p in (points, later)]
    tracker.remember(10**9, None, Tracked(ids, x[0], points[..., 2], np.full(5, 100.0)))
    assert tracker.predict(10**9 + 10**10, []) is None
    found = tracker.correct(10**9 + round(dt * 1e9), None, ids, x[1], later[..., 2], np.full(5, 1e-5))
    # A finite step of a thirtieth of a second differs from the derivative in second order; the prior pulls a little.
    np.testing.assert_allclose(found.value, TWIST, atol=0.03)
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0)


def test_twist_is_that_of_the_time_that_smears():
    """A camera that turns faster and faster: the lag of 10 ms shows how it turned 10 ms ago, its memory 14 ms."""
    points = np.random.default_rng(5).uniform([-0.6, -0.5, 2], [0.6, 0.5, 4], (5, 4, 3))
    lag, dt, acceleration = 0.010, 1 / 30, np.array([0.0, 6.0, 2.0])
    tracker, ids, twist = MotionTracker(np.eye(4), lag), np.arange(5), None
    for frame in range(8):
        turned = geometry.so3_exp(0.5 * acceleration * (frame * dt) ** 2)
        seen = points @ turned
        stamp = round(frame * dt * 1e9)
        x = seen[..., :2] / seen[..., 2:]
        twist = tracker.correct(stamp, tracker.predict(stamp, []), ids, x, seen[..., 2], np.full(5, 1e-5))
        tracker.remember(stamp, twist, Tracked(ids, x, seen[..., 2], np.full(5, 100.0)))
    ages = [lag, lag * MEMORY_AGE]
    # A frame ago it turned slower by 0.2 rad/s. What is left, that steps of 1/30 s curve, is half a thousandth of what
    # it turns in 10 ms: accelerations are expected to die down within a few frames.
    expected = [acceleration * (7 * dt - age) for age in ages]
    np.testing.assert_allclose([twist.ago(age)[3:] for age in ages], expected, atol=0.02)


def turning(stamp_ns, states, jitter_ns=0, seed=6):
    """Twists of frames that turn ever faster, where their stamps jitter, and what they should be one lag ago."""
    points = np.random.default_rng(5).uniform([-0.6, -0.5, 2], [0.6, 0.5, 4], (5, 4, 3))
    rng, acceleration, covariance = np.random.default_rng(seed), np.array([0.0, 6.0, 2.0]), np.diag([1e-4] * 6)
    tracker, ids = MotionTracker(np.eye(4), LAG), np.arange(5)
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
        seen = points @ geometry.so3_exp(0.5 * acceleration * (seen_ns * 1e-9) ** 2)
        x = seen[..., :2] / seen[..., 2:]
        twist = tracker.correct(stamp, tracker.predict(stamp, heard), ids, x, seen[..., 2], np.full(5, 1e-5))
        tracker.remember(stamp, twist, Tracked(ids, x, seen[..., 2], np.full(5, 100.0)))
        yield twist, acceleration * (at - LAG)


def test_states_of_the_filter_tell_the_twist_whatever_the_stamps_of_frames_do():
    """Jitter of 2 ms is a twentieth of a frame's period: differences alone would be wrong by as much of the turn."""
    stamps = [round(k * 1e9 / 30) for k in range(12)]
    told, alone = (
        np.array([twist.ago(LAG)[3:] - truth for twist, truth in list(turning(stamps, states, 2_000_000))[3:]])
        for states in (True, False)
    )
    # The mean of nine samples of a gyroscope with 0.01 rad/s of noise, and as much again for what the corners add.
    assert np.sqrt(np.mean(told**2)) < 0.007
    assert np.sqrt(np.mean(told**2)) < 0.2 * np.sqrt(np.mean(alone**2))


def test_states_without_any_error_are_no_division_by_zero():
    certain = [
        Odometry(k * 5_000_000, np.eye(4), TWIST[:3], TWIST[3:], np.zeros((6, 6)), np.zeros((6, 6))) for k in range(6)
    ]
    twist = MotionTracker(np.eye(4)).predict(25_000_000, certain)
    # The prior, which knows nothing, pulls by the ratio of variances: what the acceleration may have changed by in half
    # the window makes a part in ten thousand, and what a change of it is expected to be a hundredth of a m/s^2.
    np.testing.assert_allclose(twist.value, TWIST, atol=2e-4)
    np.testing.assert_allclose(twist.acceleration, np.zeros(6), atol=0.01)


def test_twist_of_a_late_frame_is_carried_back():
    points = np.random.default_rng(5).uniform([-0.6, -0.5, 2], [0.6, 0.5, 4], (5, 4, 3))
    seen = Tracked(np.arange(5), points[..., :2] / points[..., 2:], points[..., 2], np.ones(5))
    acceleration, tracker, now = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]), MotionTracker(np.eye(4)), 10**9
    tracker.remember(now, Twist(TWIST, 1e-6 * np.eye(12), acceleration), seen)
    ahead, back = (tracker.predict(now + dt_ns, []) for dt_ns in (30_000_000, -30_000_000))
    # Accelerations last for 0.15 s: a tenth of them is gone on the way.
    np.testing.assert_allclose(back.value, TWIST - 0.030 * acceleration, rtol=0.1, atol=0.01)
    np.testing.assert_allclose(ahead.value + back.value, 2.0 * TWIST, atol=1e-12)
    np.testing.assert_allclose(np.diag(ahead.covariance), np.diag(back.covariance), atol=1e-12)
    # What both changes have in common with the acceleration is of the opposite sign.
    np.testing.assert_allclose(ahead.covariance[:6, 6:], -back.covariance[:6, 6:], atol=1e-12)


def test_markers_are_expected_where_the_motion_carries_them():
    rng = np.random.default_rng(4)
    points, dt = rng.uniform([-0.8, -0.6, 2], [0.8, 0.6, 4], (5, 4, 3)), 1 / 30
    later, twist = moved(points, dt), Twist(TWIST, np.eye(6))
    tracker = MotionTracker(np.eye(4))
    tracker.remember(0, twist, Tracked(np.arange(5), points[..., :2] / points[..., 2:], points[..., 2], np.ones(5)))
    expected = tracker.expected(round(dt * 1e9), twist)
    # The stamp is a whole number of nanoseconds.
    np.testing.assert_allclose(expected.x, later[..., :2] / later[..., 2:], atol=1e-8)
    np.testing.assert_allclose(expected.depth, later[..., 2], atol=1e-8)
    assert len(tracker.expected(10**9, twist).ids) == 0


def test_a_late_frame_disturbs_nothing_and_a_clock_set_back_is_followed():
    rng = np.random.default_rng(4)
    points, twist = rng.uniform([-0.8, -0.6, 2], [0.8, 0.6, 4], (5, 4, 3)), Twist(TWIST, np.eye(12))
    seen = Tracked(np.arange(5), points[..., :2] / points[..., 2:], points[..., 2], np.ones(5))
    tracker, now = MotionTracker(np.eye(4)), 10**9
    tracker.remember(now, twist, seen)
    ahead = tracker.expected(now + 33_000_000, twist)
    # Whose own markers are expected where they were then.
    late, before = tracker.expected(now - 66_000_000, twist), moved(points, -0.066)
    np.testing.assert_allclose(late.x, before[..., :2] / before[..., 2:], atol=1e-8)
    tracker.remember(now - 66_000_000, None, Tracked.none())
    np.testing.assert_array_equal(tracker.expected(now + 33_000_000, twist).x, ahead.x)
    assert tracker.predict(now + 33_000_000, []) is not None
    tracker.remember(now - 10**9, twist, seen)
    np.testing.assert_array_equal(tracker.expected(now - 10**9 + 33_000_000, twist).x, ahead.x)


def test_field_agrees_with_the_points():
    twist = Twist(TWIST, np.eye(6))
    field = SmearField(CAMERA).full(SmearField(CAMERA).at(twist, 3.0, 0.01))
    assert field.shape == (512, 640, 2)
    pixels = np.array([[100, 80], [320, 250], [550, 430]])
    x = CAMERA.normalise(pixels.astype(float))
    expected = Places.of(ImagePoints.seen_at(x, CAMERA), np.full(3, 3.0)).smear(twist, 0.01)
    # The coarse field is interpolated linearly between nodes 16 px apart.
    np.testing.assert_allclose(field[pixels[:, 1], pixels[:, 0]], expected, atol=0.01)


@pytest.mark.parametrize('lag_px', [1.0, 3.0, 6.0])
def test_lag_is_undone(lag_px):
    # A blurred vertical edge moving to the right, as bolometers lag behind it.
    u = np.linspace(-30, 89, 120 * 20)
    sharp = np.where(u < 50.0, 0.0, 100.0)
    ages = np.linspace(0.0, 12.0, 400)
    weights = np.exp(-ages) / np.exp(-ages).sum()
    lagging = sum(w * np.interp(u + lag_px * age, u, sharp) for w, age in zip(weights, ages, strict=True))

    def seen(signal):
        image = np.tile(signal.reshape(120, 20).mean(axis=1).astype(np.float32), (20, 1))
        return cv2.GaussianBlur(image, (0, 0), 0.6)

    shift = np.full((20, 120), -lag_px, dtype=np.float32)
    restored = without_lag(seen(lagging), shift, np.zeros_like(shift))
    middle = slice(20, 100)
    error = np.abs(restored - seen(sharp))[:, middle].max()
    # Nyquist's frequency has no derivative; a sixth of the lag's own error is what a blur of 0.66 px leaves of it.
    assert error < np.abs(seen(lagging) - seen(sharp))[:, middle].max() / 5


@pytest.mark.parametrize('steps', [None, 4, 8])
def test_sharpened_corners_do_not_depend_on_the_form_of_the_lag(steps):
    """A square seen through lag that is continuous, or integrated in steps of a frame of 1/30 s."""
    tau, frame, velocity = 0.010, 1 / 30, np.array([300.0, -120.0])
    duration = 2e-4 if steps is None else frame / steps
    ages = np.arange(0.0, 8.0 * tau, duration)
    weights = np.exp(-ages / tau) / np.exp(-ages / tau).sum()
    pixel = np.arange(100.0)
    low, high = 30.2, 64.7
    seen = np.zeros((100, 100))
    for age, weight in zip(ages, weights, strict=True):
        # at a time before the stamp the square was farther back along its way
        column, row = (
            np.clip(np.minimum(pixel + 0.5, high - v * age) - np.maximum(pixel - 0.5, low - v * age), 0.0, 1.0)
            for v in velocity
        )
        seen += weight * np.outer(row, column)
    image = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), 0.6)
    corners = np.array([[low, low], [high, low], [high, high], [low, high]])
    smeared = np.broadcast_to(-tau * velocity, (1, 4, 2))
    sharp = markers_sharpened(image, corners[None], smeared, 60)
    v, u = np.mgrid[:100, :100]
    centre = np.array([(sharp * u).sum(), (sharp * v).sum()]) / sharp.sum()
    mean_age = float(weights @ ages)
    # What was taken out is known, so what is left is the response's own mean delay. Lanczos interpolation is exact for
    # what optics leave of edges, not for means: 0.0138 px times 0.9 at a quarter of a pixel.
    expected = corners.mean(axis=0) - velocity * (mean_age - (1.0 - REMAINING) * tau)
    np.testing.assert_allclose(centre, expected, atol=0.014)
    wide = np.sqrt((sharp * (u - centre[0]) ** 2).sum() / sharp.sum())
    before = np.sqrt((image * (u - (image * u).sum() / image.sum()) ** 2).sum() / image.sum())
    assert wide < before


@pytest.mark.parametrize('smear', [0.3, 0.7, 2.1])
def test_sharpened_edges_are_those_of_a_response_that_forgets(smear):
    """Across a vertical side the image is the one of a bolometer that remembers no longer than the memory's age."""
    ages = np.arange(0.0, 10.0, 0.002)
    weights = np.exp(-ages)

    def seen(kept):
        profile = sum(
            w * np.clip(np.minimum(np.arange(100.0) + 0.5, 64.7 - smear * a) - (np.arange(100.0) - 0.5), 0.0, 1.0)
            for w, a in zip(weights[kept] / weights[kept].sum(), ages[kept], strict=True)
        )
        return cv2.GaussianBlur(np.tile(profile, (60, 1)).astype(np.float32), (0, 0), 0.6)

    corners = np.array([[[44.7, 20.0], [64.7, 20.0], [64.7, 40.0], [44.7, 40.0]]])
    smeared = np.broadcast_to([-smear, 0.0], (1, 4, 2))
    sharp, young = markers_sharpened(seen(ages < 10.0), corners, smeared, 12)[30], seen(ages < 0.75)[30]
    slope = np.gradient(young)
    side = slice(59, 70)
    displaced = slope[side] @ (sharp - young)[side] / (slope[side] @ slope[side])
    # Linear interpolation displaces it by 0.019, 0.044 and 0.028 px, Lanczos's by at most 0.0144 px.
    assert abs(displaced) < 0.015


def test_model_error_leaves_the_common_shift_out():
    common = np.broadcast_to([3.0, 0.0], (1, 4, 2))
    turning = common + 0.2 * np.array([[[0, -1], [1, 0], [0, 1], [-1, 0]]])
    cell = np.array([10.0])
    still = model_error(0.0 * common, cell)
    np.testing.assert_array_equal(still, 0.0)
    shape = model_error(turning, cell) - model_error(common, cell)
    # The lag constant may be off by a third, which turns the marker by so much.
    np.testing.assert_allclose(np.trace(shape, axis1=-2, axis2=-1), (0.35 * 0.2) ** 2, rtol=1e-6)
    assert np.all(model_error(common, 0.5 * cell) > model_error(common, cell) - 1e-12)


@pytest.mark.parametrize(('velocity', 'turn'), [(1e3, 0.0), (0.0, 1e3), (np.nan, 0.0)])
def test_implausible_odometry_is_known(velocity, turn):
    odometry = Odometry(0, np.eye(4), np.array([velocity, 0, 0]), np.array([0, turn, 0]), np.eye(6), np.eye(6))
    assert not plausible(odometry)
    assert plausible(replace(odometry, velocity_body=np.zeros(3), angular_velocity_body=np.zeros(3)))


def test_windows_outside_or_without_numbers_are_skipped():
    image = np.random.default_rng(2).normal(size=(60, 80)).astype(np.float32)
    square = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]])
    corners = np.stack([square + 500.0, square - 500.0, square + np.nan])
    np.testing.assert_array_equal(markers_sharpened(image, corners, np.ones((3, 4, 2)), 16), image)
