"""Odometry from the bytes of its message."""

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros import convert, odometry_bytes


def state(**other):
    rng = np.random.default_rng(3)
    T_map_body = se3.transform(se3.so3_exp(rng.standard_normal(3)), rng.standard_normal(3))
    values = dict(zip(('velocity_body', 'angular_velocity_body'), rng.standard_normal((2, 3)), strict=True))
    A, B = rng.standard_normal((2, 6, 6))
    covariances = {'pose_covariance': A @ A.T, 'twist_covariance': B @ B.T}
    return Odometry(
        **{'stamp_ns': 1_700_000_000_123_456_789, 'T_map_body': T_map_body, **values, **covariances, **other}
    )


def sent(odometry, frame_id='map', child_frame_id='base_link'):
    message = convert.odometry_frames(frame_id, child_frame_id)
    convert.fill_odometry(message, odometry)
    return message


@pytest.mark.parametrize('length', range(9))
def test_is_what_the_message_says(length):
    """Names of any length, as what follows them is aligned."""
    for names in (('m' * length, 'base_link'), ('map', 'b' * length)):
        said, message = state(), serialize_message(sent(state(), *names))
        read = odometry_bytes.odometry(message)
        assert read.stamp_ns == said.stamp_ns == odometry_bytes.stamp_ns(message)
        # A quaternion in between: the last digits of the rotation may differ.
        np.testing.assert_allclose(read.T_map_body, said.T_map_body, atol=1e-15)
        for name in ('velocity_body', 'angular_velocity_body', 'pose_covariance', 'twist_covariance'):
            np.testing.assert_array_equal(getattr(read, name), getattr(said, name))


@pytest.mark.parametrize('name', ['velocity_body', 'pose_covariance', 'twist_covariance'])
def test_what_is_not_finite_is_refused(name):
    broken = np.full_like(getattr(state(), name), np.nan)
    with pytest.raises(InputError, match='finite'):
        odometry_bytes.odometry(serialize_message(sent(state(**{name: broken}))))


def test_what_is_no_quaternion_is_refused():
    message = sent(state())
    message.pose.pose.orientation.w += 0.7
    with pytest.raises(InputError, match='quaternion'):
        odometry_bytes.odometry(serialize_message(message))


@pytest.mark.parametrize('name', ['pose_covariance', 'twist_covariance'])
@pytest.mark.parametrize('covariance', [np.zeros((6, 6)), -np.eye(6), 1e30 * np.eye(6), np.ones((6, 6))])
def test_what_is_no_covariance_is_refused(name, covariance):
    with pytest.raises(InputError, match='odometry with a covariance'):
        odometry_bytes.odometry(serialize_message(sent(state(**{name: covariance}))))


@pytest.mark.parametrize('cut', [0, 3, 8, 20, 100, -8])
def test_bytes_that_are_no_message_are_refused(cut):
    message = serialize_message(sent(state()))
    for broken in (message[:cut], b'\x00\x00' + message[2:]):
        with pytest.raises(InputError, match='odometry of'):
            odometry_bytes.odometry(broken)


def test_names_of_impossible_length_are_refused():
    message = bytearray(serialize_message(sent(state())))
    message[12:16] = (2**32 - 1).to_bytes(4, 'little')
    with pytest.raises(InputError, match='cut short'):
        odometry_bytes.odometry(bytes(message))


def test_names_of_kilobytes_are_not_kept():
    with pytest.raises(InputError, match='bytes'):
        odometry_bytes.stamp_ns(serialize_message(sent(state(), 'x' * 10_000)))
