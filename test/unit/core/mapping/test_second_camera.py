"""A second camera: its poses join those of the first, or stand in for them."""

from dataclasses import replace

from geometry_msgs.msg import PoseWithCovarianceStamped
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from support import small_bag
from support.messages import frames, info

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector, rows_from_corners
from thermal_fiducial.core.error_model import covariance_of_mount
from thermal_fiducial.core.geometry.reprojection import corners_in_map, reproject
from thermal_fiducial.core.geometry.se3 import difference, inverse, so3_exp, transform
from thermal_fiducial.core.mapping.second_camera import intersection, SecondCamera, SecondClock, seen_from
from thermal_fiducial.core.measurements import CameraPose, MARKER_DTYPE, Odometry
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.files.marker_map import save_map
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.replay.settings import read_settings
from thermal_fiducial.ros.messages import clouds, convert

MS = 1_000_000
T_BODY_FIRST = small_bag.T_BODY_CAMERA
#: Beside the first, turned by half a radian.
T_BODY_SECOND = T_BODY_FIRST @ transform(so3_exp([0.0, 0.5, 0.0]), [0.2, 0.0, 0.0])
#: Covariance of a mount.
EXACT = np.zeros((6, 6))


def pose(stamp_ns, T, variances=(1e-4,) * 6):
    return CameraPose(stamp_ns, T, np.diag(variances))


def second_pose(stamp_ns, T_map_body, variances=(1e-4,) * 6):
    return pose(stamp_ns, T_map_body @ T_BODY_SECOND, variances)


def pair(mounts=EXACT, time_offset_std=0.0):
    return SecondCamera(T_BODY_FIRST, T_BODY_SECOND, mounts, time_offset_std, 0.0)


def flying(speed):
    """Odometry along x at ``speed`` [m/s], every 5 ms for 0.2 s."""
    prior = MotionPrior()
    for k in range(41):
        T = transform(np.eye(3), [speed * 0.005 * k, 0.0, 0.0])
        state = Odometry(5 * MS * k, T, np.array([speed, 0.0, 0.0]), np.zeros(3), 1e-6 * np.eye(6), 1e-6 * np.eye(6))
        prior.add(state.stamp_ns, state)
    return prior


def test_an_exact_pose_of_the_second_is_one_of_the_first():
    cameras = pair()
    alone = cameras.add_second(second_pose(0, np.eye(4)), MotionPrior())
    np.testing.assert_allclose(alone.T_map_camera, T_BODY_FIRST, atol=1e-15)
    assert cameras.alone == 1


def test_after_a_clock_that_was_set_back_the_second_stands_in_as_before():
    cameras, prior = pair(), MotionPrior()
    cameras.with_second(pose(1_000_000 * MS, T_BODY_FIRST), prior)
    stamps = [1000 * k * MS for k in (1001, 1002, 500, 501)]
    assert all(cameras.add_second(second_pose(stamp, np.eye(4)), prior) for stamp in stamps)


def test_a_pose_that_is_far_better_alone_stays_alone():
    """Ten times as good: with half of its information each, both together would be worse."""
    poor, good = pose(0, np.eye(4), (9e-6,) * 6), pose(0, transform(np.eye(3), [1e-3, 0.0, 0.0]), (9e-8,) * 6)
    for pair in ((poor, good), (good, poor)):
        np.testing.assert_array_equal(intersection(*pair).covariance, good.covariance)
        np.testing.assert_array_equal(intersection(*pair).T_map_camera, good.T_map_camera)
    # Of two that are as good the mean, at the covariance of each.
    both = intersection(poor, replace(poor, T_map_camera=good.T_map_camera))
    np.testing.assert_allclose(both.T_map_camera[0, 3], 0.5e-3, rtol=1e-9)


def test_the_covariance_follows_the_lever_arm():
    """Against numbers: the second camera's small errors, seen at the first."""
    T, T_there = T_BODY_SECOND, inverse(T_BODY_SECOND) @ T_BODY_FIRST
    A = np.random.default_rng(1).normal(size=(6, 6))
    found = seen_from(CameraPose(0, T, A @ A.T), T_there).covariance
    J, step = np.empty((6, 6)), 1e-6
    for k, d in enumerate(step * np.eye(6)):
        moved = transform(so3_exp(d[3:]) @ T[:3, :3], T[:3, 3] + d[:3]) @ T_there
        J[:, k] = np.r_[(moved - T @ T_there)[:3, 3], d[3:]] / step
    # Differences over 1e-6 are good to 1e-6 of numbers of about 10.
    np.testing.assert_allclose(found, J @ A @ A.T @ J.T, rtol=0, atol=1e-4)


def test_simultaneous_poses_are_weighted_by_covariance_and_claim_no_less_than_the_better():
    vague_in_x, vague_in_y = (1e-2, *(1e-4,) * 5), (1e-4, 1e-2, *(1e-4,) * 4)
    first, second = pose(0, np.eye(4), vague_in_x), pose(0, transform(np.eye(3), [0.02, 0.02, 0.0]), vague_in_y)
    joint = intersection(first, second)
    # A hundred to one.
    np.testing.assert_allclose(joint.T_map_camera[:2, 3], [0.02 * 100 / 101, 0.02 / 101], rtol=1e-9)
    np.testing.assert_allclose(np.diag(joint.covariance)[:3], [2e-2 / 101, 2e-2 / 101, 1e-4], rtol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0))
def test_the_map_s_share_of_a_joint_pose_is_a_part_of_its_covariance(seed, decades):
    """Whatever share it is of either: else the filter takes the joint pose for exact in some directions."""
    rng, poses = np.random.default_rng(seed), []
    for scale in (1.0, 10.0**decades):
        of_map, own = scale * 1e-2 * rng.normal(size=(2, 6, 6))
        of_map, own = of_map @ of_map.T, own @ own.T + 1e-9 * np.eye(6)
        poses.append(CameraPose(0, np.eye(4), of_map + own, of_map))
    joint = intersection(*poses)
    size = np.trace(joint.covariance)
    # To rounding.
    assert np.linalg.eigvalsh(joint.map_covariance)[0] > -1e-9 * size
    assert np.linalg.eigvalsh(joint.covariance - joint.map_covariance)[0] > -1e-9 * size
    # Of two poses on the map alone the joint one is, too.
    bare = intersection(*(replace(pose, covariance=pose.map_covariance + 1e-12 * np.eye(6)) for pose in poses))
    np.testing.assert_allclose(bare.map_covariance, bare.covariance, rtol=1e-2, atol=1e-9 * size)


def test_poses_that_contradict_each_other_are_not_joined():
    cameras = pair()
    first = pose(100 * MS, T_BODY_FIRST)
    cameras.with_second(pose(0, T_BODY_FIRST), MotionPrior())
    cameras.add_second(second_pose(100 * MS, transform(np.eye(3), [0.5, 0.0, 0.0])), MotionPrior())
    assert cameras.with_second(first, MotionPrior()) is first
    assert (cameras.joined, cameras.contradicted) == (0, 1)


def test_mounts_that_are_off_as_declared_contradict_nothing_and_are_claimed():
    """Two mounts good to 2 mm and 3 mrad, 300 rigs: poses of 0.3 mm and 0.3 mrad differ by their mounts alone."""
    rng, stds = np.random.default_rng(6), (2e-3, 3e-3)
    mounts, variances, squares = covariance_of_mount(*stds), (1e-7,) * 6, []
    contradicted = 0
    for _ in range(300):
        off = [transform(so3_exp(stds[1] * rng.normal(size=3)), stds[0] * rng.normal(size=3)) for _ in range(2)]
        cameras = pair(mounts)
        # Where the cameras are; the parameters have their places without these errors.
        first, second = T_BODY_FIRST @ off[0], T_BODY_SECOND @ off[1]
        alone = cameras.add_second(pose(0, second, variances), MotionPrior())
        error = difference(first, alone.T_map_camera)
        squares.append(error @ np.linalg.solve(alone.covariance, error) / 6.0)
        cameras.with_second(pose(100 * MS, first, variances), MotionPrior())
        cameras.add_second(pose(200 * MS, second, variances), MotionPrior())
        cameras.with_second(pose(200 * MS, first, variances), MotionPrior())
        contradicted += cameras.contradicted
    # One in a thousand is expected; a mean of 1800 squares scatters by 0.033.
    assert contradicted <= 3
    assert np.mean(squares) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize('lead_ms', [0, 50, -10])
def test_a_pose_of_another_instant_is_carried_by_the_odometry(lead_ms):
    """At 4 m/s, the second seen ``lead_ms`` before the first: 20 cm in 50 ms, to a micrometre."""
    cameras, prior, stamp = pair(), flying(4.0), 100 * MS
    cameras.with_second(pose(30 * MS, T_BODY_FIRST), prior)
    seen = stamp - lead_ms * MS
    cameras.add_second(second_pose(seen, transform(np.eye(3), [4e-9 * seen, 0.0, 0.0])), prior)
    truth = transform(np.eye(3), [0.4, 0.0, 0.0]) @ T_BODY_FIRST
    joint = cameras.with_second(pose(stamp, truth), prior)
    assert (cameras.joined, joint.stamp_ns) == (1, stamp)
    np.testing.assert_allclose(joint.T_map_camera, truth, atol=1e-6)


@pytest.mark.parametrize('middle_ms', [92, 88])
def test_a_correction_of_the_filter_is_no_motion(middle_ms):
    """The odometry jumps by 5 cm between the instants of the two frames; nothing moves."""
    cameras, prior = pair(), MotionPrior()
    for k in range(41):
        T = transform(np.eye(3), [0.05 * (5 * k > middle_ms), 0.0, 0.0])
        prior.add(5 * MS * k, Odometry(5 * MS * k, T, np.zeros(3), np.zeros(3), 1e-6 * np.eye(6), 1e-6 * np.eye(6)))
    cameras.with_second(pose(30 * MS, T_BODY_FIRST), prior)
    cameras.add_second(second_pose(80 * MS, np.eye(4)), prior)
    joint = cameras.with_second(pose(100 * MS, T_BODY_FIRST), prior)
    np.testing.assert_allclose(joint.T_map_camera, T_BODY_FIRST, atol=1e-9)


def test_a_pose_that_is_carried_by_an_uncertain_velocity_claims_it():
    """A filter that has just begun: 1 m/s of doubt, 2 cm in 20 ms."""
    cameras, prior = pair(), MotionPrior()
    unsure = np.diag([1.0] * 3 + [1e-6] * 3)
    for k in range(41):
        prior.add(5 * MS * k, Odometry(5 * MS * k, np.eye(4), np.zeros(3), np.zeros(3), 1e-6 * np.eye(6), unsure))
    cameras.with_second(pose(30 * MS, T_BODY_FIRST), prior)
    vague = (1.0,) * 6
    cameras.add_second(second_pose(80 * MS, np.eye(4), (1e-8,) * 6), prior)
    joint = cameras.with_second(pose(100 * MS, T_BODY_FIRST, vague), prior)
    # The first's says nothing beside it: (1 m/s x 20 ms)^2, and 1e-8 of the lever arm.
    np.testing.assert_allclose(np.diag(joint.covariance)[:3], 0.02**2, rtol=2e-3)


def test_each_pose_counts_once_and_an_old_one_not_at_all():
    cameras = pair()
    cameras.with_second(pose(0, T_BODY_FIRST), flying(0.0))
    cameras.add_second(second_pose(20 * MS, np.eye(4)), flying(0.0))
    for stamp in (33, 66):
        cameras.with_second(pose(stamp * MS, T_BODY_FIRST), flying(0.0))
    assert cameras.joined == 1
    cameras.add_second(second_pose(80 * MS, np.eye(4)), flying(0.0))
    late = pose(180 * MS, T_BODY_FIRST)
    assert cameras.with_second(late, flying(0.0)) is late


@pytest.mark.parametrize('rate', [7.5, 8.6, 30.0, 60.0])
@pytest.mark.parametrize('lead', [0.05, 0.5, 0.95])
def test_two_cameras_of_any_frame_rate_are_joined_and_never_take_turns(rate, lead):
    """The second's frames come a ``lead`` of a period before the first's: all but the first few have a partner."""
    cameras, prior = pair(), MotionPrior()
    cameras.with_second(pose(0, T_BODY_FIRST), prior)
    for k in range(1, 31):
        second_ns, first_ns = (round((k - ahead) / rate * 1e9) for ahead in (lead, 0.0))
        for stamp_ns in range(first_ns - 130 * MS, first_ns + MS, 5 * MS):
            prior.add(stamp_ns, Odometry(stamp_ns, np.eye(4), np.zeros(3), np.zeros(3), *[1e-6 * np.eye(6)] * 2))
        assert cameras.add_second(second_pose(second_ns, np.eye(4)), prior) is None or k < 3
        cameras.with_second(pose(first_ns, T_BODY_FIRST), prior)
    assert cameras.joined >= 27


def swung(seconds):
    """Pose of a robot that swings along x, by 0.5 m at up to 1 m/s."""
    return transform(np.eye(3), [0.5 * np.sin(2.0 * seconds), 0.0, 0.0])


def swing(seconds):
    """Its odometry."""
    velocity = np.array([np.cos(2.0 * seconds), 0.0, 0.0])
    small = 1e-6 * np.eye(6)
    return Odometry(round(seconds * 1e9), swung(seconds), velocity, np.zeros(3), small, small)


def swings(cameras, behind_s, frames, rng):
    """Both cameras on that robot; the second's stamps are ``behind_s`` too early. Returns the odometry."""
    prior, sigma = MotionPrior(), 4e-3
    for k in range(5 * frames):
        prior.add(swing(k / 150).stamp_ns, swing(k / 150))
        if k % 5:
            continue
        for add, T, behind in (
            (cameras.add_second, T_BODY_SECOND, behind_s),
            (cameras.with_second, T_BODY_FIRST, 0.0),
        ):
            noisy = transform(np.eye(3), sigma * rng.normal(size=3)) @ swung(k / 150) @ T
            add(pose(round((k / 150 - behind) * 1e9), noisy, (sigma**2,) * 3 + (1e-6,) * 3), prior)
    return prior


@pytest.mark.parametrize('behind_ms', [0, 20, -20, 50])
def test_the_difference_of_the_clocks_is_learned_and_poses_of_the_second_alone_follow_it(behind_ms):
    cameras = pair(time_offset_std=0.03)
    prior = swings(cameras, behind_ms / 1e3, 90, np.random.default_rng(4))
    error, std = cameras.clock.seconds - behind_ms / 1e3, np.sqrt(cameras.clock.variance)
    # 90 poses of 4 mm at 0.7 m/s that count as three.
    assert std < 5e-3
    assert abs(error) < 3.0 * std
    assert cameras.contradicted <= 1
    # 0.2 s later the first still has no pose. At a speed of 1 m/s the stamps alone put the second's off by 20 mm.
    at = 89 / 30 + 0.2
    for k in range(450, 480):
        prior.add(swing(k / 150).stamp_ns, swing(k / 150))
    stamp_ns = round((at - behind_ms / 1e3) * 1e9)
    alone = cameras.add_second(pose(stamp_ns, swung(at) @ T_BODY_SECOND), prior)
    assert alone.stamp_ns == stamp_ns
    truth = swung(at - behind_ms / 1e3) @ T_BODY_FIRST
    assert abs(alone.T_map_camera[0, 3] - truth[0, 3]) < 3.0 * std
    assert alone.covariance[0, 0] > 1e-4 + 0.5 * (std * np.cos(2.0 * at)) ** 2


def test_contradictions_make_the_clocks_uncertain_again():
    """A step of 60 ms of the second's clock is found."""
    cameras, rng = pair(time_offset_std=0.03), np.random.default_rng(5)
    swings(cameras, 0.0, 90, rng)
    swings(cameras, 0.06, 90, rng)
    assert cameras.contradicted > 0
    assert abs(cameras.clock.seconds - 0.06) < 3.0 * np.sqrt(cameras.clock.variance)


def test_parameters_in_the_second_cameras_namespace_are_its_own(tmp_path):
    path = tmp_path / 'rig.yaml'
    path.write_text(
        '/**: {ros__parameters: {second_camera: down, camera_position: [0.1, 0.0, 0.0]}}\n'
        '/down/**: {ros__parameters: {camera_position: [0.0, 0.0, -0.1]}}\n'
    )
    assert read_settings(path, {}).aruco_detector.camera_position == (0.1, 0.0, 0.0)


def test_the_clock_drifts_as_the_parameter_says():
    clock, still, moving = SecondClock(0.03, random_walk=1e-3), np.zeros(6), np.ones(6)
    clock.add(0, np.zeros(6), moving, 1e-6 * np.eye(6))
    known = clock.variance
    # A camera at rest says nothing about the clock. Four seconds of (1 ms)^2/s; exact but for rounding.
    clock.add(4_000_000_000, np.zeros(6), still, np.eye(6))
    assert clock.variance == pytest.approx(known + 4e-6)


def corners_in_view(stamp_ns, moved):
    """The message of a frame that shows the markers of the small bag; marker 3 is 5 cm away if ``moved``."""
    ids = np.arange(4)
    T_map_marker = np.stack([marker.T_map_marker for marker in small_bag.map_of(range(4)).markers.values()])
    T_map_marker[3, 1, 3] += 0.05 * moved
    sizes, covariances = np.full(4, small_bag.SIZE), np.broadcast_to(1e-3 * np.eye(2), (4, 4, 2, 2))
    T_map_camera = np.broadcast_to(T_BODY_FIRST, (4, 4, 4))
    pixels = reproject(small_bag.CAMERA, T_map_camera, corners_in_map(T_map_marker, sizes))
    rows = rows_from_corners(ids, pixels, covariances, sizes, small_bag.CAMERA)
    return clouds.cloud(rows, convert.header(stamp_ns, 'camera'))


@pytest.fixture
def mapper_of_two(graph, tmp_path):
    """The node with the map of the small bag and a second camera at the place of the first; both are calibrated."""
    whole = small_bag.side_files(tmp_path, ids=(0, 1, 2, 3))[0]
    place = {f'{name}camera_position': list(T_BODY_FIRST[:3, 3]) for name in ('', 'second_')}
    node = graph.add(MarkerMapperNode, map_file=str(whole), second_camera='down', **place)
    for topic in ('thermal/camera_info', 'down/thermal/camera_info'):
        graph.send(topic, info())
    return node


@pytest.mark.ros
def test_what_the_second_camera_sees_changes_nothing_in_the_map(graph, mapper_of_two):
    """A marker that it sees elsewhere, for twice as many frames as put it into quarantine of the first camera."""
    before = dict(mapper_of_two.mapper.map.markers)
    for k in range(60):
        graph.send('down/markers', corners_in_view(small_bag.START_NS + k * 33 * MS, moved=True))
    assert mapper_of_two.mapper.map.markers == before
    for k in range(60, 120):
        graph.send('markers', corners_in_view(small_bag.START_NS + k * 33 * MS, moved=True))
    assert not mapper_of_two.mapper.map.markers[3].trusted


@pytest.mark.ros
def test_what_waits_of_the_second_camera_is_not_joined_in_another_map(graph, mapper_of_two, tmp_path):
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    shifted = small_bag.map_of(range(4))
    T_new_old = transform(np.eye(3), [0.01, 0.0, 0.0])
    for key, marker in shifted.markers.items():
        shifted.markers[key] = replace(marker, T_map_marker=T_new_old @ marker.T_map_marker)
    later_ns = small_bag.START_NS + 33 * MS
    graph.send('markers', corners_in_view(small_bag.START_NS, moved=False))
    graph.send('down/markers', corners_in_view(later_ns, moved=False))
    save_map(mapper_of_two.config.map_file, shifted)
    assert graph.call(Trigger, 'marker_mapper/load', Trigger.Request()).success
    graph.send('markers', corners_in_view(later_ns, moved=False))
    graph.spin_until(lambda: len(graph.heard['camera_pose']) == 2)
    before, after = (convert.transform_of(message.pose.pose)[:3, 3] for message in graph.heard['camera_pose'])
    # The corners are exact, but for their single precision.
    np.testing.assert_allclose(after - before, T_new_old[:3, 3], atol=1e-4)
    assert graph.diagnose(mapper_of_two)[2]['second camera: joined'] == '0'


@pytest.mark.ros
def test_poses_of_the_second_camera_alone_claim_what_both_mounts_leave(graph, mapper_of_two):
    """The cameras are at one place: twice what the parameters say by default, with what the corners leave."""
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    graph.send('down/markers', corners_in_view(small_bag.START_NS, moved=False))
    graph.spin_until(lambda: graph.heard['camera_pose'])
    covariance = np.reshape(graph.heard['camera_pose'][0].pose.covariance, (6, 6))
    assert np.all(np.diag(covariance) > 2.0 * np.diag(covariance_of_mount(2e-3, 3e-3)))


@pytest.mark.ros
def test_the_diagnostics_say_why_the_second_camera_gives_no_pose(graph, mapper_of_two):
    graph.send('down/markers', corners_in_view(small_bag.START_NS, moved=False))
    assert graph.diagnose(mapper_of_two)[2]['second camera: no pose'] == ''
    empty = clouds.cloud(np.zeros(0, MARKER_DTYPE), convert.header(small_bag.START_NS + 33 * MS, 'camera'))
    graph.send('down/markers', empty)
    assert graph.diagnose(mapper_of_two)[2]['second camera: no pose'] == 'no known marker in view'


@pytest.mark.ros
def test_a_dynamic_parameter_leaves_the_second_camera_as_it_is(graph, mapper_of_two):
    for topic in ('markers', 'down/markers', 'markers'):
        graph.send(topic, corners_in_view(small_bag.START_NS, moved=False))
    assert graph.diagnose(mapper_of_two)[2]['second camera: joined'] == '1'
    mapper_of_two.set_parameters([Parameter('refinement_period', value=5.0)])
    assert graph.diagnose(mapper_of_two)[2]['second camera: joined'] == '1'


@pytest.mark.ros
def test_the_mapper_uses_both_cameras_and_continues_with_the_second_alone(graph, tmp_path):
    """Twice the same camera: frames 0 and 1 of both, frames 4 and 8 of the second alone."""
    detector = MarkerDetector(ArucoDetectorConfig(marker_size=small_bag.SIZE), load_dictionary('DICT_4X4_50'))
    seen = [
        clouds.cloud(
            detector.detect(convert.stamp_ns(image.header.stamp), image_to_array(image), small_bag.CAMERA), image.header
        )
        for image in frames(9)
    ]
    place = {f'{name}camera_position': list(T_BODY_FIRST[:3, 3]) for name in ('', 'second_')}
    whole = small_bag.side_files(tmp_path, ids=(0, 1, 2, 3))[0]
    node = graph.add(MarkerMapperNode, map_file=str(whole), second_camera='down', **place)
    graph.listen(PoseWithCovarianceStamped, 'camera_pose')
    graph.send('down/markers', seen[0])
    assert 'no camera_info of down' in graph.diagnose(node)[2]['last refusal']
    for topic in ('thermal/camera_info', 'down/thermal/camera_info'):
        graph.send(topic, info())
    for topic, k in (('markers', 0), ('down/markers', 1), ('markers', 1), ('down/markers', 4), ('down/markers', 8)):
        graph.send(topic, seen[k])
    # Frame 4 is 100 ms after the first camera's last: it might still come.
    graph.spin_until(lambda: len(graph.heard['camera_pose']) == 3)
    figures = graph.diagnose(node)[2]
    assert (figures['second camera: joined'], figures['second camera: alone']) == ('1', '1')
    stamps = [convert.stamp_ns(message.header.stamp) for message in graph.heard['camera_pose']]
    assert stamps == [convert.stamp_ns(seen[k].header.stamp) for k in (0, 1, 8)]
    for message, k in zip(graph.heard['camera_pose'], (0, 1, 8), strict=True):
        truth = small_bag.true_pose(k / 30) @ T_BODY_FIRST
        # Flat pictures are good to a centimetre or two.
        np.testing.assert_allclose(convert.transform_of(message.pose.pose)[:3, 3], truth[:3, 3], atol=0.05)
