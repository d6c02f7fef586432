"""A robot that hovers before one small marker, through mapper and filter."""

import numpy as np
import pytest
from support.flights import CAMERA_ORIENTATION, CAMERA_POSITION, IMU, in_order, Motion, START_NS, T_BODY_CAMERA
from support.walls import CAMERA, see, SIZE

from thermal_fiducial.config import MarkerMapperConfig, PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.se3 import so3_exp, so3_log, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.motion_prior import MotionPrior

SECONDS, DELAY_NS = 6.0, 30_000_000
RIG = {'camera_position': CAMERA_POSITION, 'camera_orientation': CAMERA_ORIENTATION}


def hover(distance, seed, tilt=0.0, heading=0.0):
    """Time [s], error [m] and NEES a degree of freedom of each pose that is not lost, in front of one marker.

    ``tilt`` and ``heading`` [rad] of the marker, from where it faces the camera.
    """
    rng = np.random.default_rng(seed)
    motion = Motion.random(rng, speed=0.1, turn=0.05)
    T_camera_marker = transform(
        so3_exp([tilt, heading, 0.0]) @ np.diag([1.0, -1.0, -1.0]), [*0.1 * rng.normal(size=2), distance]
    )
    poses = {0: motion.pose(0.0) @ T_BODY_CAMERA @ T_camera_marker}
    mapper = MarkerMapper(
        MarkerMapperConfig(mode='localization', marker_size=SIZE, **RIG),
        MarkerMap({0: MapMarker(0, SIZE, True, poses[0])}),
    )
    ekf, odometry, scores = PoseEkf(PoseEkfConfig(imu=IMU, **RIG)), MotionPrior(), []
    densities = np.repeat((IMU.gyroscope_noise_density, IMU.accelerometer_noise_density), 3)
    for stamp_ns, is_frame in instants():
        t = (stamp_ns - START_NS) * 1e-9
        if is_frame:
            rows = see(motion.pose(t) @ T_BODY_CAMERA, poses, 0.1, rng)
            pose = mapper.process(stamp_ns, rows, CAMERA, odometry).pose
            if pose is not None:
                ekf.add_pose(pose)
            if ekf.camera_time_offset is not None:
                odometry.set_clock_offset(ekf.camera_time_offset)
            continue
        imu = motion.imu(t) + densities * np.sqrt(200.0) * rng.normal(size=6)
        state = ekf.add_imu(ImuSample(stamp_ns, imu[:3], imu[3:]))
        if state is None:
            continue
        odometry.add(state.stamp_ns, state)
        truth = motion.pose(t)
        turn = so3_log(truth[:3, :3] @ state.T_map_body[:3, :3].T)
        error = np.concatenate((truth[:3, 3] - state.T_map_body[:3, 3], turn))
        if not ekf.lost:
            nees = error @ np.linalg.solve(state.pose_covariance, error) / 6.0
            scores.append((t, np.linalg.norm(error[:3]), nees))
    return np.array(scores).reshape(-1, 3)


def instants():
    """Stamps of the samples at 200 Hz and of the frames at 30 Hz, which come late, in the order of their arrival."""
    samples = [START_NS + 5_000_000 * k for k in range(round(200 * SECONDS))]
    frames = [START_NS + round(k * 1e9 / 30.0) for k in range(round(30 * SECONDS))]
    arrivals = [(stamp, 0, (stamp, False)) for stamp in samples]
    return in_order(arrivals + [(stamp + DELAY_NS, 1, (stamp, True)) for stamp in frames])


@pytest.mark.slow
@pytest.mark.parametrize(('distance', 'limit'), [pytest.param(5.0, 1.2, marks=pytest.mark.nightly), (8.0, 3.0)])
def test_a_marker_from_the_front_confirms_no_error_of_the_odometry(distance, limit):
    """32 and 20 px. NEES is 0.4 and 0.9; with the fit to the corners alone it was 2.5 and 15."""
    nees = np.concatenate([hover(distance, seed)[:, 2] for seed in range(3)])
    assert len(nees) > 500
    # Errors last for the whole flight, so three flights are three draws: three times what was measured.
    assert np.mean(nees) < limit


@pytest.mark.slow
@pytest.mark.parametrize('seed', [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))])
def test_gravity_settles_the_first_pose_before_a_tilted_marker(seed):
    """20 px, 15 deg: two poses that are 30 deg and 4 m apart, and the corners do not show which one is right."""
    times, errors, nees = hover(8.0, seed, tilt=np.radians(15.0)).T
    # 0.2 to 0.6 s, 0.05 to 0.1 m rms, NEES 0.1 to 0.3 in six flights; without gravity there is no pose in 8 s.
    assert times[0] < 1.5
    assert np.sqrt(np.mean(errors**2)) < 0.3
    assert np.mean(nees) < 1.0


@pytest.mark.slow
def test_two_poses_that_differ_in_heading_are_followed_until_one_is_left():
    """As above, but the two poses differ in heading: the wrong one turns with the line of sight."""
    scores = [hover(8.0, seed, heading=np.radians(30.0)) for seed in range(3)]
    begun = [flight[0, 0] for flight in scores if len(flight)]
    # 2.7 to 3.5 s, at most 0.09 m off, NEES 0.1 to 0.2; without a second hypothesis there is no pose.
    assert len(begun) >= 2
    for _, errors, nees in (flight.T for flight in scores if len(flight)):
        assert np.all(errors < 1.5)
        assert np.mean(nees) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ('distance', 'seed'),
    [(8.0, 0), (10.0, 0), *(pytest.param(12.0, seed, marks=pytest.mark.nightly) for seed in range(6))],
)
def test_a_marker_that_is_turned_a_little_begins_no_wrong_pose(distance, seed):
    """Frames that show a turn of 10 deg, and frames that do not: the latter took both poses to the one in between."""
    errors, nees = hover(distance, seed, heading=np.radians(10.0))[:, 1:].T
    # Of twelve flights at 8 to 12 m five have a pose within 6 s, at most 0.32 m off, NEES 0.7 in the mean. Three began
    # at wrong ones, 1.7 to 4.7 m off at a NEES of 22 to 132.
    assert np.all(errors < 1.0)
    assert np.all(nees < 5.0)
