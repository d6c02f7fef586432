"""Messages that cannot be: each is refused in words, costs nothing else, and a good stream gives a good pose after."""

from array import array
from copy import deepcopy
from dataclasses import replace

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image, Imu, PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support import small_bag
from support.messages import FRAME_NS, frames, imu, IMU_NS, info, odometry, pose, pose_with_covariance, START

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import MAP_DTYPE, MARKER_DTYPE
from thermal_fiducial.core.measurements import Odometry as State
from thermal_fiducial.errors import INTERNAL_ERROR
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.nodes.tau2_camera import Tau2Camera
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import OK
from thermal_fiducial.ros.messages import clouds, convert

pytestmark = pytest.mark.ros
EYE = np.eye(4)
GOOD = np.diag([1e-6] * 3 + [1e-7] * 3)


def at(stamp_ns, frame_id='map'):
    return convert.header(stamp_ns, frame_id)


def camera_pose(T=EYE, covariance=GOOD):
    return pose_with_covariance(T, covariance, at(START + IMU_NS))


def moved(distance):
    T = np.eye(4)
    T[0, 3] = distance
    return T


def impossible_stamp(message):
    message.header.stamp.nanosec = 4_000_000_000
    return message


def skewed(covariance, value):
    """One that is not symmetric: indefinite, once its symmetric part is taken."""
    result = covariance.copy()
    result[0, 5] = value
    return result


HOSTILE_POSES = {
    'negative': lambda: camera_pose(covariance=-1e-4 * np.eye(6)),
    'zero': lambda: camera_pose(covariance=np.zeros((6, 6))),
    'indefinite': lambda: camera_pose(covariance=skewed(np.eye(6), 5.0)),
    'singular': lambda: camera_pose(covariance=np.ones((6, 6))),
    # LAPACK's answer where squares overflow is no refusal.
    'vast correlation': lambda: camera_pose(covariance=skewed(GOOD, 1.7e308)),
    'all vast correlations': lambda: camera_pose(covariance=GOOD + 1.7e308 * (1.0 - np.eye(6))),
    'infinite correlation': lambda: camera_pose(covariance=skewed(GOOD, np.inf)),
    'vast': lambda: camera_pose(covariance=1e200 * np.eye(6)),
    'far': lambda: camera_pose(moved(1e200)),
    'not finite': lambda: camera_pose(moved(np.nan)),
    'stamp': lambda: impossible_stamp(camera_pose()),
}
HOSTILE_IMU = {
    'vast': lambda: imu(1, force=(1e200, 0.0, 9.8)),
    'fast': lambda: imu(1, rate=(0.0, 0.0, 1e150)),
    'not finite': lambda: imu(1, force=(np.inf, 0.0, 9.8)),
    'stamp': lambda: impossible_stamp(imu(1)),
}
HOSTILE_CORRECTIONS = {
    'vast': lambda: convert.transform_message(moved(1e308), START, 'map', 'map_before'),
    'not finite': lambda: convert.transform_message(moved(np.inf), START, 'map', 'map_before'),
}
FOR_FILTER = (
    [('camera_pose', message) for message in HOSTILE_POSES.values()]
    # A map may be exact, or uncertain in one direction alone.
    + [('camera_pose/map_error', HOSTILE_POSES[key]) for key in HOSTILE_POSES if key not in ('zero', 'singular')]
    + [('imu/data', message) for message in HOSTILE_IMU.values()]
    + [('map_correction', message) for message in HOSTILE_CORRECTIONS.values()]
)


def refusals(graph, node):
    """How many messages were refused so far; none of them for a reason that nobody foresaw."""
    figures = graph.diagnose(node)[2]
    assert INTERNAL_ERROR not in figures['last refusal'], figures['last refusal']
    return int(figures['refused messages'])


def at_rest(first, last):
    return [m for k in range(first, last) for m in ([imu(k), pose(k - 4)] if k % 6 == 5 else [imu(k)])]


@pytest.mark.parametrize('running', [False, True])
def test_the_filter_refuses_each_and_gives_a_good_pose_after_all(graph, running):
    node = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    streams = {Imu: 'imu/data', PoseWithCovarianceStamped: 'camera_pose'}
    for message in at_rest(0, 60 if running else 0):
        graph.send(streams[type(message)], message)
    for count, (topic, message) in enumerate(FOR_FILTER, start=1):
        graph.send(topic, message())
        assert refusals(graph, node) == count, topic
    for message in at_rest(60, 120):
        graph.send(streams[type(message)], message)
    graph.send('camera_pose/map_error', HOSTILE_POSES['zero']())
    assert graph.diagnose(node)[:2] == (OK, 'tracking')
    # As in the same flight without any of it: at rest at the origin, good to the floor of the made-up poses.
    np.testing.assert_allclose(node.filter.state.T_map_body, EYE, atol=0.01)


# --- odometry as a hint -------------------------------------------------------------------------------


def state(stamp_ns, **other):
    """What a filter says at ``stamp_ns`` of a robot in the flight of the frames."""
    T_map_body = small_bag.true_pose((stamp_ns - START) * 1e-9)
    return replace(State(stamp_ns, T_map_body, np.zeros(3), np.zeros(3), GOOD, GOOD), **other)


HOSTILE_STATES = {
    'NaN position': {'T_map_body': moved(np.nan)},
    'far': {'T_map_body': moved(1e200)},
    'NaN velocity': {'velocity_body': np.full(3, np.nan)},
    'fast': {'velocity_body': np.full(3, 1e200)},
    'zero covariances': {'pose_covariance': np.zeros((6, 6)), 'twist_covariance': np.zeros((6, 6))},
    'negative covariance': {'pose_covariance': -np.eye(6)},
    'negative twist covariance': {'twist_covariance': -np.eye(6)},
    'vast correlations': {'twist_covariance': GOOD + 1.7e308 * (1.0 - np.eye(6))},
}


@pytest.fixture(scope='module')
def detections():
    """The detector's answers to a second of frames: enough for new markers to enter a map."""
    detector = MarkerDetector(ArucoDetectorConfig(marker_size=small_bag.SIZE), load_dictionary('DICT_4X4_50'))
    rows = [
        (image.header, detector.detect(START + k * FRAME_NS, image_to_array(image), small_bag.CAMERA))
        for k, image in enumerate(frames(30))
    ]
    return [clouds.cloud(markers, head) for head, markers in rows]


@pytest.mark.parametrize('values', HOSTILE_STATES.values(), ids=HOSTILE_STATES)
def test_hostile_odometry_costs_no_pose_and_keeps_no_marker_out_of_the_map(graph, tmp_path, detections, values):
    """Of a hint that cannot be used the frame goes without: all is as without any odometry."""
    map_file = small_bag.side_files(tmp_path)[0]
    node = graph.add(MarkerMapperNode, **small_bag.PARAMETERS, map_file=str(map_file))
    graph.send('thermal/camera_info', info())
    for k, message in enumerate(detections):
        graph.send('odometry', odometry(state(START + k * FRAME_NS, **values)))
        graph.send('markers', message)
    assert sorted(node.mapper.map.markers) == [0, 1, 2, 3]
    assert graph.published(node, 'camera_pose') == len(detections)
    assert refusals(graph, node) > 0
    assert 'odometry' in graph.diagnose(node)[2]['last refusal']


@pytest.mark.parametrize('values', HOSTILE_STATES.values(), ids=HOSTILE_STATES)
def test_hostile_odometry_costs_no_detection(graph, values):
    node = graph.add(ArucoDetector, **small_bag.PARAMETERS)
    graph.send('thermal/camera_info', info())
    graph.send('odometry', odometry(state(START, **values)))
    graph.listen(PointCloud2, 'markers')
    graph.send('thermal/image', *frames(1))
    graph.spin_until(lambda: graph.heard['markers'])
    assert clouds.markers(graph.heard['markers'][0])['id'].tolist() == [0, 1, 2, 3]
    assert refusals(graph, node) > 0


# --- calibrations -------------------------------------------------------------------------------------


def absurd(**fields):
    message = info()
    for name, value in fields.items():
        setattr(message, name, value)
    return message


HOSTILE_CALIBRATIONS = {
    'singular': absurd(k=[745.0, 745.0, 319.5, 745.0, 745.0, 255.5, 0.0, 0.0, 1.0]),
    'last row': absurd(k=[745.0, 0.0, 319.5, 0.0, 745.0, 255.5, 0.0, 0.0, 0.0]),
    'far centre': absurd(k=[745.0, 0.0, 1e9, 0.0, 745.0, 255.5, 0.0, 0.0, 1.0]),
    'vast focal length': absurd(k=[1e200, 0.0, 319.5, 0.0, 745.0, 255.5, 0.0, 0.0, 1.0]),
    'tiny focal length': absurd(k=[745.0, 0.0, 319.5, 0.0, 1e-200, 255.5, 0.0, 0.0, 1.0]),
    'distortion': absurd(d=[1e300, 0.0, 0.0, 0.0, 0.0]),
    'folded distortion': absurd(d=[-30.0, 0.0, 0.0, 0.0, 0.0]),
    'fisheye': absurd(d=[1e300, 0.0, 0.0, 0.0], distortion_model='equidistant'),
    'rational': absurd(d=[0.0, 0.0, 0.0, 0.0, 0.0, -1e9, 0.0, 0.0], distortion_model='rational_polynomial'),
    'not finite': absurd(d=[float('nan')] * 5),
    'vast image': absurd(width=2**32 - 1),
    'none': CameraInfo(width=640, height=512),
}


@pytest.mark.parametrize('message', HOSTILE_CALIBRATIONS.values(), ids=HOSTILE_CALIBRATIONS)
def test_an_absurd_calibration_does_not_replace_a_good_one(graph, message):
    node = graph.add(ArucoDetector, marker_size=small_bag.SIZE)
    graph.listen(PointCloud2, 'markers')
    graph.send('thermal/camera_info', info(), message)
    assert refusals(graph, node) == 1
    graph.send('thermal/image', *frames(1))
    graph.spin_until(lambda: graph.heard['markers'])
    rows = clouds.markers(graph.heard['markers'][0])
    # Flat pictures at 2.4 m: a few centimetres.
    np.testing.assert_allclose(rows['z'], np.full(4, 2.4), atol=0.1)


REAL_LENSES = {
    'none': Camera(640, 512, np.array([[745.0, 0.0, 319.5], [0.0, 745.0, 255.5], [0.0, 0.0, 1.0]])),
    'wide Tau 2': Camera(
        640, 512, np.array([[443.0, 0.0, 317.2], [0.0, 443.6, 241.9], [0.0, 0.0, 1.0]]), 'equidistant',
        np.array([0.03, -0.01, 0.005, -0.001]),
    ),
    'barrel': Camera(
        640, 480, np.array([[380.0, 0.0, 320.0], [0.0, 381.0, 240.0], [0.0, 0.0, 1.0]]), 'plumb_bob',
        np.array([-0.31, 0.11, 0.0002, -0.0004, -0.02]),
    ),
    'rational': Camera(
        1280, 1024, np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 512.0], [0.0, 0.0, 1.0]]), 'rational_polynomial',
        np.array([8.1, 3.2, 1e-4, 1e-4, 0.1, 8.5, 5.8, 0.8]),
    ),
    'long': Camera(640, 512, np.array([[5900.0, 0.0, 319.5], [0.0, 5900.0, 255.5], [0.0, 0.0, 1.0]])),
    'lepton': Camera(80, 60, np.array([[89.0, 0.0, 40.0], [0.0, 89.0, 30.0], [0.0, 0.0, 1.0]])),
}  # fmt: skip


@pytest.mark.parametrize('lens', REAL_LENSES.values(), ids=REAL_LENSES)
def test_calibrations_of_real_lenses_are_taken(lens):
    assert convert.camera(convert.camera_info(lens, at(START))).matches(lens)


# --- images -------------------------------------------------------------------------------------------


@pytest.mark.parametrize('size', [(512, 641), (510, 637), (120, 161), (16, 16), (16, 17), (17, 16)])
@pytest.mark.parametrize('dtype', [np.uint16, np.uint8])
def test_images_of_odd_sizes_go_through(graph, size, dtype):
    """A width of 1 modulo 4, and next to nothing of an image."""
    camera = graph.add(Tau2Camera)
    detector = graph.add(ArucoDetector, marker_size=small_bag.SIZE)
    height, width = size
    K = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    graph.send('thermal/camera_info', info(Camera(width, height, K)))
    rows, columns = np.mgrid[:height, :width]
    for k in range(3):
        picture = (100 * (columns > width // 2) + 50 * (rows > height // 2) + 10 * k + rows % 5).astype(dtype)
        graph.send('thermal/image_raw', convert.image(picture, at(START + k * FRAME_NS, 'camera')))
    graph.spin_until(lambda: graph.published(detector, 'markers') == 3)
    assert (refusals(graph, camera), refusals(graph, detector)) == (0, 0)


HOSTILE_IMAGES = {
    'one pixel': convert.image(np.zeros((1, 1), np.uint16), at(START)),
    'no pixel': Image(encoding='mono16'),
    'promises': Image(encoding='mono16', height=2**31, width=2**31, step=2**32 - 1, data=array('B', bytes(8))),
    'no rows apart': Image(encoding='mono8', height=512, width=640, step=0, data=array('B', bytes(640))),
    'colour': Image(encoding='bgr8', height=2, width=2, step=6, data=array('B', bytes(12))),
    'stamp': impossible_stamp(convert.image(np.zeros((512, 640), np.uint16), at(START))),
}


def test_hostile_images_are_refused_and_the_next_one_taken(graph):
    camera = graph.add(Tau2Camera)
    for count, message in enumerate(HOSTILE_IMAGES.values(), start=1):
        graph.send('thermal/image_raw', message)
        assert refusals(graph, camera) == count
    graph.send('thermal/image_raw', *frames(1))
    assert graph.diagnose(camera)[2]['published /thermal/image'] == '1'


# --- clouds -------------------------------------------------------------------------------------------


def cloud(dtype, **values):
    row = np.zeros(1, dtype)
    for name in dtype.names:
        row[name] = 1.0
    for axis in ('qx', 'qy', 'qz'):
        row[axis] = 0.0
    for name, value in values.items():
        row[name] = value
    return deepcopy(clouds.cloud(row, at(START)))


def promising(message):
    """Four billion points of no bytes."""
    message.width, message.point_step, message.row_step = 2**32 - 1, 0, 0
    return message


def fractional(message):
    """An ID that is a fraction."""
    next(field for field in message.fields if field.name == 'id').datatype = 7
    return message


HOSTILE_MARKERS = {
    'NaN corner': cloud(MARKER_DTYPE, u0=np.nan),
    'far corner': cloud(MARKER_DTYPE, v3=1e30),
    'no variance': cloud(MARKER_DTYPE, c0uu=0.0),
    'NaN covariance': cloud(MARKER_DTYPE, c0uv=np.nan, c0uu=np.nan),
    'vast covariance': cloud(MARKER_DTYPE, c2vv=1e30),
    'far pose': cloud(MARKER_DTYPE, x=1e30),
    'ID that no map can hold': cloud(MARKER_DTYPE, id=3_000_000_000),
    'promises': promising(cloud(MARKER_DTYPE)),
    'fractional': fractional(cloud(MARKER_DTYPE)),
    'stamp': impossible_stamp(cloud(MARKER_DTYPE)),
}
HOSTILE_MAPS = {
    'NaN': cloud(MAP_DTYPE, x=np.nan),
    'far': cloud(MAP_DTYPE, y=1e30),
    'no rotation': cloud(MAP_DTYPE, qw=0.0),
    'no size': cloud(MAP_DTYPE, size=0.0),
    'vast size': cloud(MAP_DTYPE, size=1e20),
    'promises': promising(cloud(MAP_DTYPE)),
}


def test_everything_hostile_and_then_a_good_flight(graph, tmp_path):
    """All that is above on the topics of three running nodes; the flight after it is located as well as ever."""
    map_file = small_bag.side_files(tmp_path, ids=(0, 1, 2, 3))[0]
    detector = graph.add(ArucoDetector, **small_bag.PARAMETERS)
    mapper = graph.add(MarkerMapperNode, **small_bag.PARAMETERS, map_file=str(map_file))
    ekf = graph.add(PoseEkfNode, camera_position=[0.1, 0.0, 0.0])
    graph.listen(Odometry, 'odometry')
    graph.send('thermal/camera_info', info(), *HOSTILE_CALIBRATIONS.values())
    for topic, messages in (
        ('odometry', [odometry(state(START, **values)) for values in HOSTILE_STATES.values()]),
        ('thermal/image', list(HOSTILE_IMAGES.values())),
        ('markers', list(HOSTILE_MARKERS.values())),
        *((topic, [message()]) for topic, message in FOR_FILTER),
    ):
        graph.send(topic, *messages)
    graph.send('marker_map', *HOSTILE_MAPS.values(), profile=qos.LATCHED)
    for node in (detector, mapper, ekf):
        assert refusals(graph, node) > 0
    fly(graph, detector, 1.5)
    assert graph.diagnose(ekf)[:2] == (OK, 'tracking')
    last = graph.heard['odometry'][-1]
    truth = small_bag.true_pose((convert.stamp_ns(last.header.stamp) - START) * 1e-9)
    # The flight ends 0.2 mm off; 5 mm is far below what a wrong calibration, map or correction would cost.
    np.testing.assert_allclose(convert.transform_of(last.pose.pose), truth, atol=0.005)


def fly(graph, detector, seconds):
    """The sway of the small bag: IMU and frames in the order of their stamps."""
    samples = small_bag.true_imu(np.arange(round(200 * seconds)) * 0.005)
    pictures = frames(round(30 * seconds))
    events = [(START + k * IMU_NS, 'imu/data', imu(k, row[:3], row[3:])) for k, row in enumerate(samples)]
    events += [(convert.stamp_ns(image.header.stamp) + 1, 'thermal/image', image) for image in pictures]
    for _, topic, message in sorted(events, key=lambda event: event[0]):
        graph.send(topic, message)


# --- the guard ----------------------------------------------------------------------------------------


def fail(*_):
    raise ZeroDivisionError('not foreseen')


def test_services_timers_and_parameters_that_fail_end_nothing(graph, monkeypatch):
    node = graph.add(PoseEkfNode, live=True)
    with monkeypatch.context() as fault:
        fault.setattr(node.filter, 'reset', fail)
        response = graph.call(Trigger, 'pose_ekf/reset', Trigger.Request())
        assert (response.success, 'ZeroDivisionError' in response.message) == (False, True)
        fault.setattr(node, 'figures', fail)
        graph.spin_until(lambda: node.refused > 0)
    assert graph.call(Trigger, 'pose_ekf/reset', Trigger.Request()).success


def test_what_is_wrong_with_a_message_is_one_line(graph):
    """Whatever it quotes: it goes to the console of a pilot, and with the diagnostics to the ground."""
    camera, ekf = graph.add(Tau2Camera), graph.add(PoseEkfNode)
    graph.send('thermal/image_raw', Image(encoding='\x1b[2J\n' + 100_000 * 'x'))
    origin = '<joint type="fixed"><parent link="a"/><child link="b"/><origin xyz="%s"/></joint>' % (100_000 * '1 ')
    graph.send('robot_description', String(data=f'<robot>{origin}</robot>'), profile=qos.LATCHED)
    for node, words in ((camera, 'image of encoding'), (ekf, 'robot_description')):
        reason = graph.diagnose(node)[2]['last refusal']
        assert words in reason
        assert reason.isprintable()
        assert len(reason) < 500


def test_a_pose_of_a_map_that_is_no_transform_is_refused(graph):
    node = graph.add(PoseEkfNode)
    graph.send('map_correction', TransformStamped(header=at(START)))
    assert refusals(graph, node) == 0
    broken = TransformStamped(header=at(START))
    broken.transform.rotation.w = 0.0
    graph.send('map_correction', broken)
    assert refusals(graph, node) == 1
