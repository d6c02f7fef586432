"""The path of the filter as bytes: what message objects serialise to, but smaller."""

import tracemalloc

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

from thermal_fiducial.core.geometry.se3 import transform_from_quaternion
from thermal_fiducial.ros.messages import convert, path_bytes
from thermal_fiducial.ros.messages.path_bytes import PathBytes

START, STEP = 1_700_000_000_900_000_000, 200_000_000


@pytest.mark.parametrize('frame', ['m', 'ma', 'map', 'maps', 'map_1', 'kärtchen', 'drone1/map', ''])
def test_a_path_is_what_its_message_serialises_to(frame):
    """Of whatever length the frame's name is, which shifts all numbers."""
    rng = np.random.default_rng(1)
    path, poses = PathBytes(frame), []
    for number in range(5):
        quaternion = rng.standard_normal(4)
        T = transform_from_quaternion(rng.standard_normal(3), quaternion / np.linalg.norm(quaternion))
        stamp = START + number * STEP
        path.add(stamp, T)
        poses.append(PoseStamped(header=convert.header(stamp, frame), pose=convert.pose(T)))
        expected = Path(header=convert.header(stamp, frame), poses=poses)
        message = path.message()
        assert deserialize_message(message, Path) == expected
        # Bytes that pad are whatever was in the memory.
        assert len(message) == len(serialize_message(expected))


def test_poses_are_at_least_a_fifth_of_a_second_apart_and_a_step_back_is_followed():
    path = PathBytes('map')
    for stamp in (START, START + STEP - 1, START + STEP, START - STEP):
        path.add(stamp, np.eye(4))
    assert stamps(path) == [START, START + STEP, START - STEP]


def test_a_path_is_empty_at_first_and_again_after_a_discontinuity():
    path = PathBytes('map')
    assert path.message() == b''
    path.add(START, np.eye(4))
    path.clear()
    assert path.message() == b''
    path.add(START + 1, np.eye(4))
    assert stamps(path) == [START + 1]


def test_a_long_flight_keeps_ten_minutes_in_half_the_memory_of_messages():
    path = PathBytes('map')
    # Deep enough for what rclpy serialises for it.
    tracemalloc.start(3)
    for number in range(4000):
        path.add(START + number * STEP, np.eye(4))
    # Of that file alone: other threads of the process allocate too.
    own = tracemalloc.Filter(True, path_bytes.__file__, all_frames=True)
    made = tracemalloc.take_snapshot().filter_traces([own])
    tracemalloc.stop()
    kept = sum(trace.size for trace in made.traces)
    # 76 bytes a pose, half as much for an object of Python and its place, and what serialising leaves behind: measured
    # 0.40 to 0.51 MB. Message objects take 1.4 MB.
    assert 0.2e6 < kept < 0.7e6
    assert len(stamps(path)) == 3000


def stamps(path):
    """Stamps of the poses of a path [ns]."""
    message = deserialize_message(path.message(), Path)
    return [convert.stamp_ns(pose.header.stamp) for pose in message.poses]
