"""Camera against IMU from poses and samples of simulated flights."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.signal import butter, sosfilt, sosfilt_zi
from support.flights import IMU
from support.scenes import camera_of
from support.wrong_lenses import drawn_lens

from thermal_fiducial.calibration.batch_adjustment import Problem
from thermal_fiducial.calibration.camera_imu import calibrate_camera_imu, calibrate_rolling_camera_imu
from thermal_fiducial.calibration.preintegration import AXES, ImuTrack, preintegrate
from thermal_fiducial.calibration.rig_state import first_state, imu_errors
from thermal_fiducial.calibration.rolling import FrameCorners
from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.error_model import CORNER_LENGTH, SystematicErrors
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.imu import ImuModel, SimulatedNoise
from thermal_fiducial.sim.scenario import named
from thermal_fiducial.sim.spline_trajectory import GRAVITY
from thermal_fiducial.sim.thermal_camera import plan, simulate_imu, START_NS
from thermal_fiducial.sim.vibration import Vibration

OFFSET = 0.024
SCENARIO = replace(named('fast'), camera_time_offset=OFFSET)
NO_NOISE = ImuModel(SimulatedNoise(0.0, 0.0, 0.0, 0.0), gyroscope_bias_sigma=0.0, accelerometer_bias_sigma=0.0)


def recording(scenario, seconds, seed, sigma_m=0.002, sigma_rad=0.0006):
    """Camera poses as from markers at a few metres, and IMU samples."""
    flight = plan(scenario, seconds, seed)
    trajectory = scenario.trajectory(seconds, seed)
    record = simulate_imu(scenario, seconds, seed)
    rng = np.random.default_rng([seed, 77])
    sigma = np.repeat([sigma_m, sigma_rad], 3)
    covariance = np.diag(np.maximum(sigma, 1e-5) ** 2)
    T = trajectory(np.array([flight.frame_time(k) for k in range(flight.frame_count)])).T_map_body
    T = T @ scenario.T_body_camera
    noise = rng.normal(0.0, 1.0, (len(T), 6)) * sigma
    T = se3.transform(se3.so3_exp(noise[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + noise[:, :3])
    poses = [CameraPose(flight.stamp_ns(k), pose, covariance) for k, pose in enumerate(T)]
    imu = ImuTrack((record.stamps_ns - START_NS) * 1e-9, record.angular_velocity, record.linear_acceleration)
    return poses, imu


def rolling_recording(scenario, seconds, seed, readout, sigma_px):
    """Corners as they are when their own rows are read out, and IMU samples."""
    flight, lens, markers = plan(scenario, seconds, seed), scenario.lens, scenario.markers
    trajectory, rng = scenario.trajectory(seconds, seed), np.random.default_rng([seed, 78])
    points = np.stack([marker.corners_map for marker in markers]).reshape(-1, 3)
    normals = np.repeat([marker.T_map_marker[:3, 2] for marker in markers], 4, axis=0)
    times = np.array([flight.frame_time(k) for k in range(flight.frame_count)])
    pixels = np.full((len(times), len(points), 2), lens.height / 2)
    for _ in range(5):
        delays = readout * (pixels[..., 1].clip(0, lens.height) / (lens.height - 1) - 0.5)
        T = trajectory((times[:, None] + delays).ravel()).T_map_body @ scenario.T_body_camera
        T = T.reshape(*delays.shape, 4, 4)
        away = points - T[..., :3, 3]
        local = (np.swapaxes(T[..., :3, :3], -1, -2) @ away[..., None])[..., 0]
        pixels = lens.project(np.where(local[..., 2:] > 0.3, local, [9.0, 9.0, 1.0]))
    visible = (local[..., 2] > 0.3) & (np.sum(away * normals, axis=-1) < 0)
    visible &= np.all((pixels > 5) & (pixels < [lens.width - 5, lens.height - 5]), axis=-1)
    visible &= np.linalg.norm(local[..., :2], axis=-1) < local[..., 2]
    pixels = (pixels + rng.normal(0.0, sigma_px, pixels.shape)).reshape(len(times), -1, 4, 2)
    visible = visible.reshape(len(times), -1, 4).all(axis=-1)
    covariance = max(sigma_px, 0.01) ** 2 * np.eye(2)
    T_map_marker, sizes = np.stack([m.T_map_marker for m in markers]), np.array([m.size for m in markers])
    frames = [
        FrameCorners(
            flight.stamp_ns(k),
            pixels[k, seen],
            np.tile(covariance, (seen.sum(), 4, 1, 1)),
            T_map_marker[seen],
            sizes[seen],
        )
        for k, seen in enumerate(visible)
        if seen.any()
    ]
    record = simulate_imu(scenario, seconds, seed)
    imu = ImuTrack((record.stamps_ns - START_NS) * 1e-9, record.angular_velocity, record.linear_acceleration)
    return frames, camera_of(scenario), imu


def error_of(result, scenario):
    """Rotation about the camera's axes, position, offset: in the order of the covariance."""
    difference = se3.inverse(result.T_body_camera) @ scenario.T_body_camera
    position = scenario.T_body_camera[:3, 3] - result.T_body_camera[:3, 3]
    return np.array([*se3.so3_log(difference[:3, :3]), *position, scenario.camera_time_offset - result.time_offset])


def test_increments_are_those_of_the_flight():
    scenario = replace(SCENARIO, imu=NO_NOISE)
    _, imu = recording(scenario, 20.0, 1)
    times = np.arange(5.0, 12.0, 1 / 30)
    motion = scenario.trajectory(20.0, 1)(times)
    R, dt = motion.rotation.as_matrix(), np.diff(times)[:, None]
    g = np.array([0.0, 0.0, -GRAVITY])
    found = preintegrate(imu, times, np.zeros((len(dt), 6)), IMU)
    R0t = np.swapaxes(R[:-1], 1, 2)
    dv = np.einsum('nij,nj->ni', R0t, np.diff(motion.velocity, axis=0) - g * dt)
    dp = np.einsum('nij,nj->ni', R0t, np.diff(motion.position, axis=0) - motion.velocity[:-1] * dt - 0.5 * g * dt**2)
    # Samples of 200 Hz interpolated linearly: the error is their second derivative times (5 ms)^2 / 12.
    assert np.abs(se3.so3_log(np.swapaxes(found.R, 1, 2) @ R0t @ R[1:])).max() < 2e-5
    assert np.abs(found.v - dv).max() < 2e-4
    assert np.abs(found.p - dp).max() < 5e-6


def test_a_gap_leaves_the_work_for_other_intervals_as_it_is():
    scenario = replace(SCENARIO, imu=NO_NOISE)
    _, imu = recording(scenario, 20.0, 1)
    times = np.arange(5.0, 7.0, 1 / 30)
    bias = np.zeros((len(times), 6))
    found = preintegrate(imu, np.append(times, 9.0), bias, IMU)
    alone = preintegrate(imu, times, bias[1:], IMU)
    # As many steps give the same bits: with those of the gap, 400 instead of 7, a flight took six times as long.
    np.testing.assert_array_equal(found.p[:-1], alone.p)


@pytest.mark.parametrize(
    ('derivative', 'count', 'atol'),
    # Second order in h and in the turn of a step, 0.01 rad at most; by the axes times rates and forces of up to 20.
    [('by_bias', 6, 2e-6), ('by_axes', AXES, 4e-5), ('by_delay', 1, 4e-5)],
)
def test_derivatives_of_a_preintegration_against_differences(derivative, count, atol):
    _, imu = recording(SCENARIO, 20.0, 1)
    times = np.arange(5.0, 6.0, 1 / 30)
    zero = np.zeros((len(times) - 1, 6))
    base = preintegrate(imu, times, zero, IMU)
    h = 1e-5
    for column, step in enumerate(h * np.eye(count)):
        if derivative == 'by_bias':
            moved = preintegrate(imu, times, zero + step, IMU)
        elif derivative == 'by_axes':
            moved = preintegrate(imu.corrected(step, 0.0), times, zero, IMU)
        else:
            moved = preintegrate(imu.corrected(np.zeros(AXES), h), times, zero, IMU)
        turn = se3.so3_log(np.swapaxes(base.R, 1, 2) @ moved.R)
        difference = np.concatenate([turn, moved.v - base.v, moved.p - base.p], axis=1) / h
        found = getattr(base, derivative).reshape(-1, 9, count)
        assert found[:, :, column] == pytest.approx(difference, rel=2e-3, abs=atol)


def test_scale_errors_and_misalignments_are_found():
    poses, imu = recording(SCENARIO, 40.0, 1)
    axes = 0.005 * np.random.default_rng(3).normal(size=AXES)
    result = calibrate_camera_imu(poses[::3], imu.corrected(axes, 0.0), START_NS, IMU)
    # What takes away the errors of the samples: the negative of what was put in, but for its square.
    assert np.all(np.abs(result.axes + axes) < 4.0 * result.axes_sigma + 5e-5)
    # A level flight shows these; that it is level leaves most of the accelerometer's at their prior.
    assert np.all(result.axes_sigma[[0, 4, 8, 14]] < 0.001)
    error = error_of(result, SCENARIO)
    # Chi-square of seven degrees of freedom, 99.9 %.
    assert error @ np.linalg.solve(result.covariance, error) < 24.3
    assert np.linalg.norm(error[3:6]) < 0.002


def test_an_accelerometer_that_is_filtered_more_than_the_gyroscope_is_found():
    """At 10 Hz beside a gyroscope as it is: the lever arm was 5 mm off."""
    poses, imu = recording(SCENARIO, 40.0, 1)
    sections = butter(2, 10.0, fs=200.0, output='sos')
    at_rest = sosfilt_zi(sections)[:, :, None] * imu.force[0]
    late = replace(imu, force=sosfilt(sections, imu.force, axis=0, zi=at_rest)[0])
    result = calibrate_camera_imu(poses[::3], late, START_NS, IMU)
    # Group delay of the bilinear transform at rest.
    delay = 0.005 / (np.sqrt(2.0) * np.tan(np.pi * 10.0 / 200.0))
    assert abs(result.force_delay - delay) < 4.0 * result.force_delay_sigma
    assert result.force_delay_sigma < 0.001
    error = error_of(result, SCENARIO)
    # Chi-square of seven degrees of freedom, 99.9 %.
    assert error @ np.linalg.solve(result.covariance, error) < 24.3
    assert np.linalg.norm(error[3:6]) < 0.002


def test_errors_that_last_for_seconds_widen_the_claim():
    poses, imu = recording(SCENARIO, 24.0, 2)
    poses = poses[::2]
    white = calibrate_camera_imu(poses, imu, START_NS, IMU)
    rng = np.random.default_rng(6)
    # A pose is off by the same for a second at a time, as much as the noise of a single one.
    views = rng.normal(0.0, 1.0, (len(poses) // 15 + 1, 6)) * np.repeat([0.002, 0.0006], 3)
    biased = []
    for index, pose in enumerate(poses):
        off, T = views[index // 15], pose.T_map_camera
        biased.append(replace(pose, T_map_camera=se3.transform(se3.so3_exp(off[3:]) @ T[:3, :3], T[:3, 3] + off[:3])))
    lasting = calibrate_camera_imu(biased, imu, START_NS, IMU)
    assert np.sqrt(np.trace(lasting.covariance[3:6, 3:6]) / np.trace(white.covariance[3:6, 3:6])) > 2.0
    error = error_of(lasting, SCENARIO)
    # Of eight groups the deviation itself is known to a quarter: t of seven degrees of freedom, 99.9 %, for each.
    assert np.all(np.abs(error) < 5.4 * np.sqrt(np.diag(lasting.covariance)))


def test_derivatives_of_the_batch_against_differences():
    poses, imu = recording(SCENARIO, 20.0, 3)
    chosen = poses[150:210]
    stamps = np.array([(pose.stamp_ns - START_NS) * 1e-9 for pose in chosen])
    measured = np.stack([pose.T_map_camera for pose in chosen])
    root = np.tile(np.eye(6), (len(chosen), 1, 1))
    problem = Problem(stamps, measured, root, imu, IMU)
    state = first_state(stamps, measured, imu, GRAVITY)
    state = replace(state, p_body_camera=np.array([0.1, 0.0, -0.05]))
    increments = preintegrate(imu, stamps + state.offset, state.bias[:-1], IMU)
    _, pose_own, pose_shared = problem.pose_errors(state)
    _, first, second, imu_shared = imu_errors(state, increments, IMU)
    count, h = len(chosen), 1e-6

    def both(moved):
        return problem.pose_errors(moved)[0], imu_errors(moved, increments, IMU)[0]

    def derivative(own, shared):
        ahead, behind = (both(problem.moved(state, sign * own, sign * shared)) for sign in (1.0, -1.0))
        return [(a - b) / (2.0 * h) for a, b in zip(ahead, behind, strict=True)]

    for column in range(15):
        own = np.zeros((count, 15))
        own[:, column] = h
        by_pose, by_imu = derivative(own, np.zeros(26))
        # Rotation errors of noisy poses are up to 0.01 rad: their right and left derivatives differ by half of that.
        assert by_pose == pytest.approx(pose_own[:, :, column], abs=2e-2)
        if column < 9:
            expected = first[:, :, column] + second[:, :, column]
            assert by_imu == pytest.approx(expected, rel=1e-3, abs=1e-3 * np.abs(expected).max() + 1e-3)
    for column in (0, 1, 2, 3, 4, 5, 7, 8):
        shared = np.zeros(26)
        shared[column] = h
        by_pose, by_imu = derivative(np.zeros((count, 15)), shared)
        assert by_pose == pytest.approx(pose_shared[:, :, column], abs=2e-2)
        assert by_imu == pytest.approx(imu_shared[:, :, column], rel=1e-3, abs=1e-3 * np.abs(imu_shared).max())


def test_noiseless_recording_gives_the_extrinsics_back():
    scenario = replace(SCENARIO, imu=NO_NOISE)
    poses, imu = recording(scenario, 20.0, 2, sigma_m=0.0, sigma_rad=0.0)
    result = calibrate_camera_imu(poses[::3], imu, START_NS, IMU)
    error = np.abs(error_of(result, scenario))
    # Samples between frames are interpolated: 1e-5 rad, a few hundredths of a millimetre, some microseconds.
    assert np.all(error[:3] < 2e-5)
    assert np.all(error[3:6] < 1e-4)
    assert error[6] < 2e-5


@pytest.mark.parametrize(
    ('seed', 'every'), [(1, 4), *(pytest.param(seed, 1, marks=pytest.mark.nightly) for seed in (1, 2, 3))]
)
def test_a_minute_is_enough(seed, every):
    """Of all poses that a camera gives, at night; by day of a quarter of them, which is enough for seed 1 alone."""
    poses, imu = recording(SCENARIO, 60.0, seed)
    result = calibrate_camera_imu(poses[::every], imu, START_NS, IMU)
    error = error_of(result, SCENARIO)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.05
    assert np.linalg.norm(error[3:6]) < 0.002
    assert abs(error[6]) < 0.0005
    # Chi-square of seven degrees of freedom, 99.9 %.
    assert error @ np.linalg.solve(result.covariance, error) < 24.3
    assert result.gravity_map == pytest.approx([0.0, 0.0, -GRAVITY], abs=0.02)


def test_wrong_poses_hardly_matter():
    poses, imu = recording(SCENARIO, 30.0, 4)
    poses = poses[::2]
    rng = np.random.default_rng(5)
    for index in rng.choice(len(poses), 10, replace=False).tolist():
        T = poses[index].T_map_camera @ se3.transform(se3.so3_exp([0.0, 0.3, 0.0]), [0.3, 0.0, 0.1])
        poses[index] = replace(poses[index], T_map_camera=T)
    error = error_of(calibrate_camera_imu(poses, imu, START_NS, IMU), SCENARIO)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.1
    assert np.linalg.norm(error[3:6]) < 0.004


def swinging(axes):
    """Camera poses and samples of 20 s of turns by ``axes`` (3, 3) from three sines, and of shifts by three others."""
    rng, seconds, times = np.random.default_rng(0), np.arange(0.0, 20.0, 0.005), np.arange(0.5, 19.5, 0.05)

    def body(t):
        angles = 0.25 * np.sin(t[:, None] * [4.0, 5.0, 6.0] + [0.0, 1.0, 2.0])
        return se3.so3_exp(angles @ np.array(axes)), 0.3 * np.sin(t[:, None] * [3.0, 4.3, 5.0])

    (R, p), (R_back, p_back), (R_ahead, p_ahead) = (body(seconds + late) for late in (0.0, -1e-4, 1e-4))
    rate = se3.so3_log(np.swapaxes(R_back, 1, 2) @ R_ahead) / 2e-4
    pushed = (p_ahead - 2.0 * p + p_back) / 1e-8 + [0.0, 0.0, GRAVITY]
    force = (np.swapaxes(R, 1, 2) @ pushed[:, :, None])[:, :, 0]
    imu = ImuTrack(seconds, *(signal + 0.01 * rng.normal(size=signal.shape) for signal in (rate, force)))
    sigma = np.repeat([0.002, 0.0006], 3)
    T, off = se3.transform(*body(times)) @ SCENARIO.T_body_camera, sigma * rng.normal(size=(len(times), 6))
    T = se3.transform(se3.so3_exp(off[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + off[:, :3])
    poses = [CameraPose(round(t * 1e9), pose, np.diag(sigma**2)) for t, pose in zip(times.tolist(), T, strict=True)]
    return poses, imu


@pytest.mark.parametrize('missing', [0.0, 0.3, 1.0])
def test_samples_may_be_missing(missing):
    """Motion in a gap was taken for linear: with 0.3 s the camera was 13 mm off, with 1 s the IMU "contradicted" it."""
    poses, imu = swinging(np.eye(3))
    there = np.abs(imu.seconds - 8.0) >= 0.5 * missing
    imu = ImuTrack(imu.seconds[there], imu.rate[there], imu.force[there])
    error = error_of(calibrate_camera_imu(poses, imu, 0, IMU), replace(SCENARIO, camera_time_offset=0.0))
    # Without a gap 0.9 mm.
    assert np.linalg.norm(error[3:6]) < 0.002


def test_unusable_recordings_are_refused():
    poses, imu = recording(SCENARIO, 20.0, 1)
    with pytest.raises(InputError, match='camera poses'):
        calibrate_camera_imu(poses[:50], imu, START_NS, IMU)
    still = [replace(pose, T_map_camera=poses[0].T_map_camera) for pose in poses]
    with pytest.raises(InputError, match='three axes'):
        calibrate_camera_imu(still, imu, START_NS, IMU)


@pytest.mark.parametrize('axis', [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
def test_turns_about_one_axis_are_refused(axis):
    """As of a robot on wheels, whatever its camera's axes are: noise made it three, and a lever arm of a kilometre."""
    poses, imu = swinging([axis, np.zeros(3), np.zeros(3)])
    with pytest.raises(InputError, match='turn together about fewer than two axes'):
        calibrate_camera_imu(poses, imu, 0, IMU)


def _with_another(imu):
    """A second IMU on the same topic, turned by 90 degrees, whose samples come 1 ms later."""
    turned = [np.stack([signal, signal[:, [1, 0, 2]] * [1.0, -1.0, 1.0]], axis=1) for signal in (imu.rate, imu.force)]
    seconds = imu.seconds[:, None] + np.array([0.0, 0.001])
    return ImuTrack(seconds.ravel(), *(signal.reshape(-1, 3) for signal in turned))


@pytest.mark.parametrize(
    ('change', 'sensor'),
    [
        (lambda imu: replace(imu, rate=np.degrees(imu.rate)), 'gyroscope'),
        (lambda imu: replace(imu, rate=-imu.rate), 'gyroscope'),
        (lambda imu: replace(imu, rate=imu.rate * [-1.0, 1.0, 1.0]), 'gyroscope'),
        (lambda imu: replace(imu, force=-imu.force), 'accelerometer'),
        (_with_another, 'gyroscope'),
    ],
)
def test_an_imu_that_contradicts_the_camera_is_refused(change, sensor):
    """A camera that is metres from the IMU was written, with the advice to record a minute."""
    poses, imu = recording(SCENARIO, 20.0, 1)
    with pytest.raises(InputError, match=f'contradict each other, the {sensor} by .*sign and units of the IMU'):
        calibrate_camera_imu(poses[::4], change(imu), START_NS, IMU)


# --- rolling read-out ---------------------------------------------------------------------------------

READOUT = 0.016


@pytest.mark.parametrize('readout', [READOUT, -READOUT])
def test_noiseless_rolling_recording_gives_the_readout_time_back(readout):
    """Also that of a camera whose driver turns pictures upside down, which was written as none."""
    scenario = replace(SCENARIO, imu=NO_NOISE)
    frames, camera, imu = rolling_recording(scenario, 13.0, 2, readout, sigma_px=0.0)
    result = calibrate_rolling_camera_imu(frames[::3], camera, imu, START_NS, IMU)
    error = np.abs(error_of(result, scenario))
    # As without a read-out: samples are interpolated. A microsecond at 1000 px/s is 0.001 px.
    assert abs(result.readout_time - readout) < 1e-6
    assert np.all(error[:3] < 2e-5)
    assert np.all(error[3:6] < 1e-4)
    assert error[6] < 2e-6


def test_a_map_that_is_not_the_one_in_view_is_named():
    """In millimetres, say: the adjustment ended in a matrix without an inverse."""
    frames, camera, imu = rolling_recording(SCENARIO, 13.0, 1, 0.0, sigma_px=0.1)
    for frame in frames:
        frame.T_map_marker[:, :3, 3] *= 1000.0
    with pytest.raises(InputError, match='px from where the map has them'):
        calibrate_rolling_camera_imu(frames[::3], camera, imu, START_NS, IMU)


def test_an_imu_of_the_other_sign_is_refused_before_corners_are_moved_along_its_motion():
    """They left all bounds: "Eigenvalues did not converge", with a traceback."""
    frames, camera, imu = rolling_recording(SCENARIO, 13.0, 1, 0.0, sigma_px=0.1)
    with pytest.raises(InputError, match='contradict each other'):
        calibrate_rolling_camera_imu(frames[::3], camera, replace(imu, rate=-imu.rate), START_NS, IMU)


@pytest.mark.parametrize('share', [1.0, pytest.param(0.1, marks=pytest.mark.nightly)])
def test_densities_that_are_too_small_contradict_nothing(share):
    """Scale errors take up what is declared away, before the noise of the samples is known: 14 % of a shaken IMU."""
    noise = ImuNoise(*(share * value for value in astuple(ImuNoise())[:6]))
    frames, camera, imu = rolling_recording(replace(SCENARIO, imu=named('rough').imu), 20.0, 1, 0.0, sigma_px=0.1)
    result = calibrate_rolling_camera_imu(frames[::3], camera, imu, START_NS, noise)
    # True ones are zero, 0.3 % is what 20 s leave.
    assert np.abs(result.axes).max() < 0.01


@pytest.mark.parametrize('readout', [pytest.param(0.0, marks=pytest.mark.nightly), READOUT])
def test_readout_time_and_extrinsics_within_their_errors(readout):
    frames, camera, imu = rolling_recording(SCENARIO, 15.0, 1, readout, sigma_px=0.1)
    result = calibrate_rolling_camera_imu(frames[::3], camera, imu, START_NS, IMU)
    # White noise and the scatter of parts leave 0.05 to 0.1 ms, what is declared of lens and focal length 0.1 ms.
    assert 1e-5 < result.readout_sigma < 2e-4
    # Four standard deviations; exactly zero where it is not clearly more.
    assert abs(result.readout_time - readout) < 4.0 * result.readout_sigma
    assert (result.readout_time == 0.0) == (readout == 0.0)
    error = error_of(result, SCENARIO)
    # Chi-square of seven degrees of freedom, 99.9 %.
    assert error @ np.linalg.solve(result.covariance, error) < 24.3
    # These stamps are exact; a tenth of a pixel at 300 px/s is 0.3 ms a corner.
    assert result.stamp_jitter < 1e-4


def test_stamps_that_jitter_and_an_imu_that_shakes_are_allowed_for():
    shaking = replace(SCENARIO.imu, gyroscope_rattle=0.015, accelerometer_rattle=0.3)
    rough = replace(SCENARIO, stamp_jitter=0.002, imu=shaking, vibration=Vibration())
    frames, camera, imu = rolling_recording(rough, 15.0, 3, READOUT, sigma_px=0.1)
    result = calibrate_rolling_camera_imu(frames[::2], camera, imu, START_NS, IMU)
    # Most exponential stamps are nearer to their mean than normal ones: the median says 0.94 of the deviation; and the
    # states of an IMU that shakes follow part of what is left.
    assert 0.0012 < result.stamp_jitter < 0.0022
    assert abs(result.readout_time - READOUT) < 4.0 * result.readout_sigma
    error = error_of(result, rough)
    # Chi-square of seven degrees of freedom, 99.9 %.
    assert error @ np.linalg.solve(result.covariance, error) < 24.3
    assert 0.9 < result.scale < 1.5


def test_white_noise_is_estimated_from_the_samples():
    shaking = replace(SCENARIO.imu, gyroscope_rattle=0.015, accelerometer_rattle=0.3)
    _, imu = recording(replace(SCENARIO, imu=shaking), 20.0, 1)
    known = ImuNoise(0.05, 0.5, 3e-4, 8e-3, gyroscope_instability=4e-4, accelerometer_instability=6e-3)
    noise = imu.noise(ImuNoise())
    # 4000 samples of three axes: 1 % of statistics, and motion adds a little.
    assert noise.gyroscope_noise_density == pytest.approx(0.015 / np.sqrt(200.0), rel=0.05)
    assert noise.accelerometer_noise_density == pytest.approx(0.3 / np.sqrt(200.0), rel=0.05)
    # Above what the samples show: as given, walks with the bias instability of a second.
    assert astuple(imu.noise(known)) == pytest.approx((0.05, 0.5, 5e-4, 1e-2))


def test_samples_may_shake_by_more_than_any_imu_has_at_rest():
    shaking = replace(SCENARIO.imu, gyroscope_rattle=3.0, accelerometer_rattle=30.0)
    _, imu = recording(replace(SCENARIO, imu=shaking), 20.0, 1)
    noise = imu.noise(IMU)
    # As above.
    assert noise.gyroscope_noise_density == pytest.approx(3.0 / np.sqrt(200.0), rel=0.05)
    assert noise.accelerometer_noise_density == pytest.approx(30.0 / np.sqrt(200.0), rel=0.05)


def test_poses_alone_say_nothing_of_the_readout_time():
    poses, imu = recording(SCENARIO, 20.0, 1)
    result = calibrate_camera_imu(poses[::3], imu, START_NS, IMU)
    assert result.readout_time == 0.0
    assert np.isinf(result.readout_sigma)


def wrongly_calibrated(frames, camera, rng):
    """Frames and camera with one draw of what is declared of lens, focal length and sides, alike in all frames."""
    errors = SystematicErrors()
    lens = drawn_lens(rng, errors.corner_px, length=CORNER_LENGTH)
    K, size = camera.K.copy(), 1.0 + errors.marker_size_std * rng.normal()
    K[:2, :2] *= 1.0 + errors.focal_length_std * rng.normal()
    wrong = []
    for frame in frames:
        T_map_marker = frame.T_map_marker.copy()
        T_map_marker[:, :3, 3] *= size
        corners = frame.corners_px + lens(frame.corners_px)
        wrong.append(replace(frame, corners_px=corners, T_map_marker=T_map_marker, sizes=size * frame.sizes))
    return wrong, replace(camera, K=K)


@pytest.mark.parametrize('rigs', [3, pytest.param(12, marks=pytest.mark.nightly)])
def test_what_all_frames_owe_to_the_calibration_is_in_the_claim(rigs):
    """No part of a recording differs from another by it: the scatter of parts does not show it."""
    frames, camera, imu = rolling_recording(SCENARIO, 13.0, 1, 0.0, sigma_px=0.05)
    squares = []
    for seed in range(rigs):
        off, lens = wrongly_calibrated(frames[::3], camera, np.random.default_rng(seed))
        result = calibrate_rolling_camera_imu(off, lens, imu, START_NS, IMU)
        squares.append(error_of(result, SCENARIO)[:6] ** 2 / np.diag(result.covariance)[:6])
    # Those of a rig are some three independent numbers: the mean of nine squares, 1 within two deviations. The scatter
    # of parts has some of it already. Without it 30, and 11 over eight rigs.
    assert 0.1 < np.mean(squares) < 1.9
