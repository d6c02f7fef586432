"""Messages from their bytes, and bytes of messages."""

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu
from support.messages import odometry, pose_of, pose_with_covariance

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.ros.messages import convert, message_bytes


def state(**other):
    rng = np.random.default_rng(3)
    T_map_body = se3.transform(se3.so3_exp(rng.standard_normal(3)), rng.standard_normal(3))
    values = dict(zip(('velocity_body', 'angular_velocity_body'), rng.standard_normal((2, 3)), strict=True))
    A, B = rng.standard_normal((2, 6, 6))
    covariances = {'pose_covariance': A @ A.T, 'twist_covariance': B @ B.T}
    return Odometry(
        **{'stamp_ns': 1_700_000_000_123_456_789, 'T_map_body': T_map_body, **values, **covariances, **other}
    )


@pytest.mark.parametrize('length', range(9))
def test_bytes_are_decoded_as_rclpy_does(length):
    """Names of any length, as what follows them is aligned."""
    for names in (('m' * length, 'base_link'), ('map', 'b' * length)):
        said, message = state(), serialize_message(odometry(state(), *names))
        (read,) = message_bytes.odometry([message])
        assert read.stamp_ns == said.stamp_ns == message_bytes.stamp_ns(message)
        # A quaternion in between: the last digits of the rotation may differ.
        np.testing.assert_allclose(read.T_map_body, said.T_map_body, atol=1e-15)
        for name in ('velocity_body', 'angular_velocity_body', 'pose_covariance', 'twist_covariance'):
            np.testing.assert_array_equal(getattr(read, name), getattr(said, name))


def test_a_batch_is_decoded_like_single_messages():
    messages = [serialize_message(odometry(state(velocity_body=np.full(3, 0.1 * k)), 'm' * k)) for k in range(5)]
    for one, message in zip(message_bytes.odometry(messages), messages, strict=True):
        (alone,) = message_bytes.odometry([message])
        # To the last bit: which states are read together must not matter.
        for name in ('stamp_ns', 'T_map_body', 'velocity_body', 'angular_velocity_body', 'pose_covariance'):
            np.testing.assert_array_equal(getattr(one, name), getattr(alone, name))


@pytest.mark.parametrize('name', ['velocity_body', 'pose_covariance', 'twist_covariance'])
def test_what_is_not_finite_is_refused(name):
    broken = np.full_like(getattr(state(), name), np.nan)
    with pytest.raises(InputError, match='finite'):
        message_bytes.odometry([serialize_message(odometry(state(**{name: broken})))])


@pytest.mark.parametrize('name', ['velocity_body', 'angular_velocity_body'])
def test_what_is_faster_than_any_camera_that_sees_markers_is_refused(name):
    # Far beyond a brisk flight, and beyond the full scale of a gyroscope.
    possible, impossible = (state(**{name: np.array([0.0, -speed, 0.0])}) for speed in (49.0, 51.0))
    assert len(message_bytes.odometry([serialize_message(odometry(possible))])) == 1
    with pytest.raises(InputError, match='beyond all bounds'):
        message_bytes.odometry([serialize_message(odometry(impossible))])


def test_a_filter_that_is_lost_is_no_fault_of_its_messages():
    """With a map in centimetres it diverges: 369 refusals hid why there was no pose."""
    lost = state(velocity_body=np.array([0.0, 80.0, 0.0]), pose_covariance=np.diag([4.0, 1e4, 4.0, 1.0, 1.0, 1.0]))
    messages = [serialize_message(odometry(one)) for one in (state(), lost)]
    assert [one.stamp_ns for one in message_bytes.odometry(messages)] == [state().stamp_ns]
    assert message_bytes.odometry(messages[1:]) == []


def test_what_is_no_quaternion_is_refused():
    message = odometry(state())
    message.pose.pose.orientation.w += 0.7
    with pytest.raises(InputError, match='quaternion'):
        message_bytes.odometry([serialize_message(message)])


@pytest.mark.parametrize('name', ['pose_covariance', 'twist_covariance'])
@pytest.mark.parametrize('covariance', [np.zeros((6, 6)), -np.eye(6), 1e30 * np.eye(6), np.ones((6, 6))])
def test_what_is_no_covariance_is_refused(name, covariance):
    with pytest.raises(InputError, match='odometry with a covariance'):
        message_bytes.odometry([serialize_message(odometry(state(**{name: covariance})))])


@pytest.mark.parametrize('cut', [0, 3, 8, 20, 100, -8])
def test_bytes_that_are_no_message_are_refused(cut):
    message = serialize_message(odometry(state()))
    for broken in (message[:cut], b'\x00\x00' + message[2:]):
        with pytest.raises(InputError, match='odometry of'):
            message_bytes.odometry([broken])


def test_names_of_impossible_length_are_refused():
    message = bytearray(serialize_message(odometry(state())))
    message[12:16] = (2**32 - 1).to_bytes(4, 'little')
    with pytest.raises(InputError, match='cut short'):
        message_bytes.odometry([bytes(message)])


def test_names_of_kilobytes_are_not_kept():
    with pytest.raises(InputError, match='bytes'):
        message_bytes.stamp_ns(serialize_message(odometry(state(), 'x' * 10_000)))


@pytest.mark.parametrize('length', range(9))
def test_bytes_of_a_state_are_those_of_its_messages(length):
    for names in (('m' * length, 'base_link'), ('map', 'b' * length)):
        written, message = message_bytes.StateBytes(*names), odometry(state(), *names)
        written.fill(state())
        # As read again: what serialisation leaves between the fields is anything.
        assert len(written.odometry) == len(serialize_message(message))
        assert deserialize_message(written.odometry, type(message)) == message
        pose = pose_of(message)
        assert len(written.pose) == len(serialize_message(pose))
        assert deserialize_message(written.pose, PoseWithCovarianceStamped) == pose


def imu_message(frame, **changes):
    message = Imu(header=convert.header(1_700_000_000_123_456_789, frame))
    message.angular_velocity = convert.vector(np.array([0.1, -0.2, 0.3]))
    message.linear_acceleration = convert.vector(np.array([1.0, -2.0, 9.0]))
    message.orientation.w = 0.5
    for name, value in changes.items():
        getattr(message, name)[0] = value
    return message


@pytest.mark.parametrize('frame', ['', 'imu', 'imu_link', 'robot_1/imu'])
def test_an_imu_message_is_decoded(frame):
    message = imu_message(frame)
    read, said = message_bytes.imu_sample(serialize_message(message)), convert.imu_sample(message)
    assert read.stamp_ns == said.stamp_ns
    np.testing.assert_array_equal(read.angular_velocity, said.angular_velocity)
    np.testing.assert_array_equal(read.linear_acceleration, said.linear_acceleration)
    assert message_bytes.frame_id(serialize_message(message)) == frame


@pytest.mark.parametrize('name', ['angular_velocity_covariance', 'linear_acceleration_covariance'])
def test_an_imu_message_without_measurements_is_refused(name):
    with pytest.raises(InputError, match='without angular velocity'):
        message_bytes.imu_sample(serialize_message(imu_message('imu', **{name: -1.0})))


def test_an_imu_message_that_is_cut_short_is_refused():
    whole = serialize_message(imu_message('imu_link'))
    for length in range(0, len(whole), 7):
        with pytest.raises(InputError):
            message_bytes.imu_sample(whole[:length])
    with pytest.raises(InputError, match='frame_id'):
        message_bytes.frame_id(whole[:14])


@pytest.mark.parametrize('length', range(9))
def test_a_camera_pose_is_decoded(length):
    """Written as the mapper does, read as the filter does."""
    said, frame = state(), 'm' * length
    written = message_bytes.PoseBytes(frame)
    written.fill(said.stamp_ns, said.T_map_body)
    head = convert.header(said.stamp_ns, frame)
    for covariance in (said.pose_covariance, said.twist_covariance):
        message = pose_with_covariance(said.T_map_body, covariance, head)
        assert deserialize_message(written.of(covariance), PoseWithCovarianceStamped) == message
        read = message_bytes.camera_pose(serialize_message(message))
        assert read.stamp_ns == said.stamp_ns
        np.testing.assert_array_equal(read.T_map_camera, convert.transform_of(message.pose.pose))
        np.testing.assert_array_equal(read.covariance, covariance)


def test_errors_of_the_map_may_have_no_variance_in_some_directions():
    """The pose itself may not."""
    written = message_bytes.PoseBytes('map')
    written.fill(1, np.eye(4))
    variances = [1e-4, 1e-4, 0.0, 1e-6, 0.0, 0.0]
    message = written.of(np.diag(variances))
    np.testing.assert_array_equal(message_bytes.map_error(message).covariance.diagonal(), variances)
    with pytest.raises(InputError, match='variance of 0'):
        message_bytes.camera_pose(message)


@pytest.mark.parametrize('frame', ['', 'a', 'ab', 'abc', 'camera'])
@pytest.mark.parametrize('kind', [np.uint8, np.uint16])
def test_an_image_is_decoded(frame, kind):
    pixels = np.arange(15, dtype=kind).reshape(3, 5)
    message = convert.image(pixels, convert.header(1_700_000_000_123_456_789, frame))
    whole = bytes(serialize_message(message))
    read = message_bytes.image(whole)
    assert (read.stamp_ns, read.frame_id) == (1_700_000_000_123_456_789, frame)
    np.testing.assert_array_equal(image_to_array(read), pixels)
    for name in ('height', 'width', 'encoding', 'is_bigendian', 'step'):
        assert getattr(read, name) == getattr(message, name)
    for length in range(whole.index(bytes(pixels.data)) + pixels.nbytes):
        with pytest.raises(InputError):
            image_to_array(message_bytes.image(whole[:length]))


@pytest.mark.parametrize('frame', ['', 'a', 'ab', 'abc', 'abcd'])
def test_a_clock_reference_is_decoded(frame):
    message = convert.clock_reference(1_700_000_000_999_999_000, 0.0123456)
    message.header.frame_id = frame
    whole = serialize_message(message)
    assert message_bytes.clock_offset(whole) == pytest.approx(0.0123456, abs=1e-9)
    # Behind both stamps comes the name of the source, which nobody reads.
    end = whole.index(b'camera') - 4
    for length in range(end):
        with pytest.raises(InputError):
            message_bytes.clock_offset(whole[:length])


def test_clocks_may_be_far_apart():
    """A camera that counts from its start, or from 1970."""
    message = convert.clock_reference(100_000_000_000, 1.6e9)
    assert message_bytes.clock_offset(serialize_message(message)) == pytest.approx(1.6e9, abs=1e-6)


@pytest.mark.parametrize('read', [message_bytes.camera_pose, message_bytes.map_error])
def test_a_pose_that_is_cut_short_is_refused(read):
    written = message_bytes.PoseBytes('map')
    written.fill(1, np.eye(4))
    whole = written.of(np.eye(6))
    read(whole)
    for length in range(0, len(whole), 7):
        with pytest.raises(InputError):
            read(whole[:length])
