"""Where the camera is on the robot: from TF, from a URDF, from the parameters."""

import sys
from types import ModuleType, SimpleNamespace

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.messages import frames, imu, pose
from support.ros_graph import ros_graph

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.output import in_frame
from thermal_fiducial.core.geometry.se3 import inverse, so3_exp, transform, transform_from_quaternion
from thermal_fiducial.core.measurements import Odometry as State
from thermal_fiducial.errors import InputError
from thermal_fiducial.nodes.aruco_detector import ArucoDetector
from thermal_fiducial.nodes.landing_target import LandingTarget
from thermal_fiducial.nodes.marker_mapper import MarkerMapperNode
from thermal_fiducial.nodes.pose_ekf import PoseEkfNode
from thermal_fiducial.nodes.tau2_camera import Tau2Camera
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import ERROR, WARN
from thermal_fiducial.ros.frames.frame_tree import fixed_joints, FrameTree
from thermal_fiducial.ros.frames.robot_frames import RobotFrames
from thermal_fiducial.ros.messages import convert

CAMERA = 'thermal_camera_optical'
#: As REP-103 has it: the housing looks along x, the optical frame along z.
URDF = """<robot name="drone">
  <link name="base_link"/><link name="imu_link"/><link name="tau2"/><link name="thermal_camera_optical"/>
  <joint name="imu" type="fixed"><parent link="base_link"/><child link="imu_link"/><origin xyz="0 0 0.05"/></joint>
  <joint name="mount" type="fixed"><parent link="base_link"/><child link="tau2"/><origin xyz="0.1 0 0.02"/></joint>
  <joint name="optics" type="fixed"><parent link="tau2"/><child link="thermal_camera_optical"/>
    <origin rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint>
  <joint name="rotor" type="continuous"><parent link="base_link"/><child link="propeller"/></joint>
</robot>"""
FORWARD = transform_from_quaternion([0.1, 0.0, 0.02], [-0.5, 0.5, -0.5, 0.5])


def in_force(node):
    return transform_from_quaternion(node.config.camera_position, node.config.camera_orientation)


def test_fixed_joints_of_a_urdf_make_a_tree():
    tree = FrameTree()
    for joint in fixed_joints(URDF):
        tree.add(*joint)
    np.testing.assert_allclose(tree.between('base_link', CAMERA), FORWARD, atol=1e-15)
    T_imu_base = transform(np.eye(3), [0.0, 0.0, -0.05])
    np.testing.assert_allclose(tree.between('imu_link', CAMERA), T_imu_base @ FORWARD, atol=1e-15)
    assert tree.between('base_link', 'propeller') is None


@pytest.mark.parametrize(
    ('urdf', 'words'),
    [
        ('<robot', 'not XML'),
        (URDF.replace('0.1 0 0.02', '0.1 zero'), "joint mount with an origin of '0.1 zero'"),
        (URDF.replace('0.1 0 0.02', '1e308 0 0'), "joint mount with an origin of '1e308 0 0'"),
        (f'<robot>{"<link/>" * 300_000}</robot>', 'of 2100015 characters'),
    ],
)
def test_an_invalid_robot_description_is_refused_with_a_reason(urdf, words):
    with pytest.raises(InputError, match=words):
        list(fixed_joints(urdf))


def test_a_tree_takes_no_more_frames_than_a_robot_has():
    tree = FrameTree()
    for k in range(10_000):
        tree.add('base_link', f'frame {k}', np.eye(4))
    with pytest.raises(InputError, match='more than 10000 frames'):
        tree.add('base_link', 'another', np.eye(4))
    tree.add('base_link', 'frame 7', FORWARD)
    np.testing.assert_allclose(tree.between('base_link', 'frame 7'), FORWARD)


def test_frames_in_a_circle_end():
    tree = FrameTree()
    tree.add('a', 'b', np.eye(4))
    tree.add('b', 'a', np.eye(4))
    assert tree.between('c', 'a') is None


@pytest.mark.ros
@pytest.mark.parametrize('kind', [ArucoDetector, MarkerMapperNode, LandingTarget, PoseEkfNode])
def test_a_robot_description_decides_where_the_camera_is(graph, kind, capfd):
    node = graph.add(kind, camera_position=[0.3, 0.0, 0.0])
    graph.send('robot_description', String(data=URDF), profile=qos.LATCHED)
    np.testing.assert_allclose(in_force(node), FORWARD, atol=1e-12)
    lines = [line for line in capfd.readouterr().err.splitlines() if 'camera on the robot' in line]
    assert len(lines) == 1
    assert 'from robot_description, 0.201 m and 0.00 deg from the previous pose' in lines[0]
    # A parameter that is set while it runs brings nothing of the others back.
    dynamic = [
        parameter
        for name, parameter in node.get_parameters_by_prefix('').items()
        if hasattr(node.config, name) and not node.describe_parameter(name).read_only
    ]
    assert all(result.successful for result in node.set_parameters(dynamic[:1]))
    np.testing.assert_allclose(in_force(node), FORWARD, atol=1e-12)


@pytest.mark.ros
def test_parameters_may_name_frames_as_ros_1_does(graph):
    """They were frames that no robot has, so that the camera was taken to be where the parameters have it."""
    node = graph.add(PoseEkfNode, base_frame='/base_link', camera_frame=f'/{CAMERA}')
    graph.send('robot_description', String(data=URDF), profile=qos.LATCHED)
    np.testing.assert_allclose(in_force(node), FORWARD, atol=1e-12)
    assert (node.config.base_frame, node.config.camera_frame) == ('base_link', CAMERA)


@pytest.mark.ros
def test_parameters_hold_where_that_is_asked_for(graph, capfd):
    node = graph.add(PoseEkfNode, camera_position=[0.3, 0.0, 0.0], extrinsics='parameters')
    assert not [source for source in node.inputs if 'robot_description' in source.topic]
    assert node.config.camera_position == (0.3, 0.0, 0.0)
    assert 'from the parameters' in capfd.readouterr().err


@pytest.mark.ros
@pytest.mark.parametrize('extrinsics', ['auto', 'parameters'])
@pytest.mark.parametrize('kind', [ArucoDetector, MarkerMapperNode, LandingTarget, PoseEkfNode])
def test_a_camera_whose_place_was_never_given_is_named(graph, kind, extrinsics, capfd):
    """The robot flew 0.13 m off, without a word until it turned."""
    node = graph.add(kind, extrinsics=extrinsics)
    graph.diagnose(node)
    assert 'camera_position is [0, 0, 0], the default: poses are off by as much' in capfd.readouterr().err
    given = graph.add(kind, extrinsics=extrinsics, camera_position=[0.0, 0.0, 0.001])
    graph.diagnose(given)
    assert 'the default' not in capfd.readouterr().err


@pytest.mark.ros
def test_it_is_in_the_diagnostics_of_the_filter_until_something_says_where(graph):
    node = graph.add(PoseEkfNode)
    graph.send('imu/data', imu(0))
    level, reason, _ = graph.diagnose(node)
    assert level >= WARN
    assert 'camera_position is [0, 0, 0]' in reason
    graph.send('robot_description', String(data=URDF), profile=qos.LATCHED)
    assert 'camera_position' not in graph.diagnose(node)[1]


@pytest.mark.ros
@pytest.mark.parametrize('place', [[0.0, 0.0, 0.0], [0.0, 0.0, -0.05]])
def test_so_is_a_second_camera(graph, place):
    node = graph.add(MarkerMapperNode, second_camera='down', second_camera_position=place)
    assert any('second_camera_position is [0, 0, 0]' in line for line in node.remarks) == (not any(place))


@pytest.mark.ros
def test_a_broken_description_is_refused_and_the_node_lives(graph):
    node = graph.add(PoseEkfNode)
    graph.send('imu/data', imu(0))
    graph.send('robot_description', String(data='<robot>'), profile=qos.LATCHED)
    level, reason, _ = graph.diagnose(node)
    # An error beside it: there is no pose yet.
    assert (level, 'not XML' in reason, 'waiting for markers' in reason) == (ERROR, True, True)


@pytest.mark.ros
@pytest.mark.parametrize(
    ('joint', 'what'), [('0 0 0.05', 'robot 11 m from its IMU'), ('0.1 0 0.02', 'camera_position')]
)
def test_a_robot_that_is_too_large_is_refused_and_another_one_taken(graph, joint, what):
    """The IMU, or the camera, 11 m from the rest of the robot."""
    node = graph.add(PoseEkfNode)
    message = imu(0)
    message.header.frame_id = 'imu_link'
    graph.send('imu/data', message)
    graph.send('robot_description', String(data=URDF.replace(joint, '0 0 11')), profile=qos.LATCHED)
    assert what in node.last_refusal
    assert node.config.camera_position == (0.0, 0.0, 0.0)
    graph.send('robot_description', String(data=URDF), profile=qos.LATCHED)
    np.testing.assert_allclose(in_force(node), transform(np.eye(3), [0.0, 0.0, -0.05]) @ FORWARD, atol=1e-12)
    dynamic = node.set_parameters([Parameter('gate', value=20.0)])
    assert all(result.successful for result in dynamic)


@pytest.mark.ros
def test_an_imu_frame_that_nothing_connects_with_the_robot_is_named(graph, capfd):
    node = graph.add(PoseEkfNode)

    def diagnosed(k):
        message = imu(k)
        message.header.frame_id = 'imu'
        graph.send('imu/data', message)
        return graph.diagnose(node)[1]

    # As long as nothing but parameters says where the camera is, there is nothing to compare with.
    assert 'taken for' not in diagnosed(0)
    graph.send('robot_description', String(data=URDF), profile=qos.LATCHED)
    unknown = "IMU in frame 'imu', not connected with base_link by robot_description: taken for base_link"
    assert all(unknown in diagnosed(k) for k in (1, 2))
    assert capfd.readouterr().err.count(unknown) == 1
    graph.send('robot_description', String(data=URDF.replace('imu_link', 'imu')), profile=qos.LATCHED)
    assert 'taken for' not in diagnosed(3)


@pytest.mark.ros
def test_an_imu_beside_the_robots_origin_gives_the_pose_of_the_robot(graph):
    """Camera poses of a robot at rest in the origin, whose IMU is 5 cm above it."""
    node = graph.add(PoseEkfNode)
    graph.listen(PoseWithCovarianceStamped, 'pose')
    graph.listen(Odometry, 'odometry')
    graph.send('robot_description', String(data=URDF), profile=qos.LATCHED)
    for k in range(60):
        message = imu(k)
        message.header.frame_id = 'imu_link'
        graph.send('imu/data', message)
        if k % 6 == 5:
            graph.send('camera_pose', pose(k - 4, FORWARD))
    graph.spin_until(lambda: len(graph.heard['pose']) > 20)
    # The made-up poses are exact; what is left is the filter's start.
    np.testing.assert_allclose(node.filter.state.T_map_body[:3, 3], [0.0, 0.0, 0.05], atol=0.002)
    np.testing.assert_allclose(convert.transform_of(graph.heard['pose'][-1].pose.pose), np.eye(4), atol=0.002)
    assert graph.heard['odometry'][-1].child_frame_id == 'base_link'


class Robot(SimpleNamespace):
    """A node as RobotFrames needs it, its callbacks by topic."""

    def __init__(self, **values):
        said, adopted, events, taken = [], [], {}, {}
        super().__init__(
            config=PoseEkfConfig(**values), live=False, frame_prefix='', said=said, adopted=adopted, events=events,
            taken=taken,            subscribe=lambda kind, topic, callback, profile: taken.update({topic: callback}),
            get_logger=lambda: SimpleNamespace(info=said.append),
            console=SimpleNamespace(event=events.__setitem__),
        )  # fmt: skip

    def guard(self, callback, message):
        try:
            callback(message)
        except InputError as error:
            self.said.append(str(error))

    def derive(self, **values):
        self.config = PoseEkfConfig(**values)

    def configure(self, config):
        self.adopted.append(config.camera_position)


@pytest.fixture
def tf2_msgs(monkeypatch):
    """A stand-in of tf2_msgs, of which there is no wheel."""
    module = ModuleType('tf2_msgs.msg')
    module.TFMessage = object
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', module)


def static(parent, child, T):
    return SimpleNamespace(transforms=[convert.transform_message(T, 0, parent, child)])


@pytest.mark.usefixtures('tf2_msgs')
def test_tf_stands_before_a_urdf_and_does_not_move_the_camera_in_flight():
    robot, moved = Robot(), []
    frames = RobotFrames(robot, lambda: moved.append(len(robot.adopted)))
    robot.taken['/tf_static'](static('base_link', 'somewhere', np.eye(4)))
    assert robot.adopted == []
    robot.taken['robot_description'](String(data=URDF))
    robot.taken['/tf_static'](static('base_link', CAMERA, transform(np.eye(3), [0.5, 0.0, 0.0])))
    assert [position[0] for position in robot.adopted] == pytest.approx([0.1, 0.5])
    assert frames.source == '/tf_static'
    robot.taken['robot_description'](String(data=URDF))
    robot.taken['/tf_static'](static('base_link', CAMERA, transform(np.eye(3), [0.7, 0.0, 0.0])))
    assert moved == [1, 2]
    assert 'ignored until' in robot.events['frames']
    assert len(robot.said) == 2


@pytest.mark.usefixtures('tf2_msgs')
def test_tf_that_agrees_with_the_parameters_changes_nothing():
    robot = Robot(camera_position=(0.1, 0.0, 0.02))
    RobotFrames(robot)
    robot.taken['/tf_static'](static('base_link', CAMERA, FORWARD))
    assert robot.adopted == []
    assert robot.said == [f'camera on the robot ({CAMERA} in base_link): from /tf_static']


@pytest.mark.usefixtures('tf2_msgs')
@pytest.mark.parametrize(('place', 'w'), [([5e5, 5.4e6, 0.0], 1.0), ([0.0, 0.0, 0.0], 0.0)])
def test_a_frame_that_is_none_keeps_no_other_one_of_its_message_back(place, w):
    """The grid of a survey, and a rotation that was not filled in."""
    robot = Robot()
    frames = RobotFrames(robot)
    other = convert.transform_message(transform(np.eye(3), place), 0, 'utm', 'map')
    other.transform.rotation.w = w
    (camera,) = static('base_link', CAMERA, FORWARD).transforms
    robot.taken['/tf_static'](SimpleNamespace(transforms=[other, camera]))
    assert '/tf_static: map' in robot.said[0]
    assert frames.source == '/tf_static'
    np.testing.assert_allclose(in_force(robot), FORWARD, atol=1e-12)


@pytest.mark.usefixtures('tf2_msgs')
@pytest.mark.parametrize('slash', ['', '/'])
def test_the_frame_of_the_imu_is_that_of_its_messages_where_tf_has_it(slash):
    """Also with the slash that names of ROS 1 begin with."""
    robot = Robot()
    frames = RobotFrames(robot)
    robot.taken['/tf_static'](static(f'{slash}base_link', f'{slash}{CAMERA}', FORWARD))
    T_base_imu = transform(so3_exp([0.0, 0.0, 0.5]), [0.0, 0.1, 0.0])
    robot.taken['/tf_static'](static('base_link', 'imu_link', T_base_imu))
    frames.note_imu_frame('unheard_of')
    assert frames.T_imu_base is None
    frames.note_imu_frame(f'{slash}imu_link')
    np.testing.assert_allclose(frames.T_imu_base, inverse(T_base_imu), atol=1e-12)
    np.testing.assert_allclose(in_force(robot), inverse(T_base_imu) @ FORWARD, atol=1e-12)
    # A message of another source, or a garbled one, moves no camera in flight.
    for frame in ('base_link', ''):
        frames.note_imu_frame(frame)
        assert repr(frame) in robot.events['imu']
    assert len(robot.adopted) == 2
    np.testing.assert_allclose(frames.T_imu_base, inverse(T_base_imu), atol=1e-12)


@pytest.mark.usefixtures('tf2_msgs')
def test_tf_does_not_move_an_imu_with_its_camera_in_flight():
    """Where the camera is mounted on the IMU the pose of the robot jumped, and nothing said so."""
    robot = Robot()
    frames = RobotFrames(robot)
    T_base_imu = transform(np.eye(3), [0.0, 0.1, 0.0])
    robot.taken['/tf_static'](static('imu_link', CAMERA, FORWARD))
    robot.taken['/tf_static'](static('base_link', 'imu_link', T_base_imu))
    frames.note_imu_frame('imu_link')
    np.testing.assert_allclose(frames.T_imu_base, inverse(T_base_imu), atol=1e-12)
    robot.taken['/tf_static'](static('base_link', 'imu_link', transform(np.eye(3), [0.0, 0.3, 0.0])))
    np.testing.assert_allclose(frames.T_imu_base, inverse(T_base_imu), atol=1e-12)
    assert '/tf_static has moved the IMU on the robot: ignored until' in robot.events['frames']
    # The diagnostics say so until it is back.
    assert frames.doubt == robot.events['frames']
    robot.taken['/tf_static'](static('base_link', 'imu_link', T_base_imu))
    assert frames.doubt == ''


@pytest.mark.usefixtures('tf2_msgs')
def test_two_robots_that_share_the_names_of_their_frames_are_in_the_diagnostics():
    """Which camera was taken for one's own was left to chance, and only the console said that there are two."""
    robot = Robot()
    frames = RobotFrames(robot)
    for x in (0.1, 0.5):
        robot.taken['/tf_static'](static('base_link', CAMERA, transform(np.eye(3), [x, 0.0, 0.0])))
    assert 'two robots need prefix_frames' in frames.doubt
    np.testing.assert_allclose(in_force(robot)[:3, 3], [0.1, 0.0, 0.0], atol=1e-12)


def test_a_state_in_another_frame_of_the_body():
    """Against numbers: the same small errors of pose and twist, seen from both frames."""
    rng = np.random.default_rng(4)
    T_map_body, T_body_frame = (transform(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
    v, w = rng.normal(size=(2, 3))
    A, B = rng.normal(size=(2, 6, 6))
    there = in_frame(State(1, T_map_body, v, w, A @ A.T, B @ B.T), T_body_frame)
    T = T_map_body @ T_body_frame
    np.testing.assert_allclose(there.T_map_body, T, atol=1e-12)

    def velocity(twist):
        R, p = T_body_frame[:3, :3], T_body_frame[:3, 3]
        return np.concatenate([R.T @ (twist[:3] + np.cross(twist[3:], p)), R.T @ twist[3:]])

    np.testing.assert_allclose(np.r_[there.velocity_body, there.angular_velocity_body], velocity(np.r_[v, w]))
    step, pose_jacobian, twist_jacobian = 1e-6, np.empty((6, 6)), np.empty((6, 6))
    for k in range(6):
        d = step * np.eye(6)[k]
        moved = transform(so3_exp(d[3:]) @ T_map_body[:3, :3], T_map_body[:3, 3] + d[:3]) @ T_body_frame
        # The turn is the same for all that is fixed on the body.
        pose_jacobian[:, k] = np.r_[(moved - T)[:3, 3], d[3:]] / step
        twist_jacobian[:, k] = (velocity(np.r_[v, w] + d) - velocity(np.r_[v, w])) / step
    # Differences over 1e-6 are good to 1e-6 of numbers of about 10.
    np.testing.assert_allclose(there.pose_covariance, pose_jacobian @ A @ A.T @ pose_jacobian.T, rtol=0, atol=1e-4)
    np.testing.assert_allclose(there.twist_covariance, twist_jacobian @ B @ B.T @ twist_jacobian.T, rtol=0, atol=1e-4)


@pytest.mark.ros
def test_frames_of_the_robot_have_its_namespace_before_them_on_request():
    with ros_graph('-r', '__ns:=/drone1', '-p', 'prefix_frames:=true') as graph:
        node = graph.add(PoseEkfNode)
        frames_of = node.config.map_frame, node.config.base_frame, node.config.camera_frame, node.config.odom_frame
        assert frames_of == ('map', 'drone1/base_link', f'drone1/{CAMERA}', '')
        camera = graph.add(Tau2Camera)
        graph.listen(Image, 'thermal/image')
        graph.send('thermal/image_raw', *frames(1))
        graph.spin_until(lambda: graph.heard['thermal/image'])
        assert graph.heard['thermal/image'][0].header.frame_id == f'drone1/{CAMERA}'
        # Live parameters leave the prefix alone.
        assert camera.set_parameters([Parameter('settle_frames', value=3)])[0].successful
        assert (camera.config.settle_frames, camera.config.frame_id) == (3, f'drone1/{CAMERA}')
        # A URDF has the names without it, as robot_state_publisher does.
        graph.send('robot_description', String(data=URDF), profile=qos.LATCHED)
        np.testing.assert_allclose(in_force(node), FORWARD, atol=1e-12)
