"""The path so far, kept as the bytes that are sent: thousands of message objects take long to make and much memory."""

from collections import deque
from itertools import islice
import struct

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.ros.messages import convert
from thermal_fiducial.ros.messages.message_bytes import behind_header

#: Least time between poses [ns], and number of poses: ten minutes.
_STEP_NS, _LENGTH = 200_000_000, 3000
#: Length of the header of the encoding, which a message has once.
_ENCODING = 4
_COUNT = struct.Struct('<I')


class PathBytes:
    """The latest ten minutes of a path in ``frame``, as nav_msgs/Path."""

    def __init__(self, frame: str) -> None:
        self._frame = frame
        self._poses: deque[bytes] = deque(maxlen=_LENGTH)
        self._newest_ns = 0

    def add(self, stamp_ns: int, T_map_body: FloatArray) -> None:
        """Add a pose (4, 4), unless the last one is less than 0.2 s older."""
        if self._poses and 0 <= stamp_ns - self._newest_ns < _STEP_NS:
            return
        self._newest_ns = stamp_ns
        pose = PoseStamped(header=convert.header(stamp_ns, self._frame), pose=convert.pose(T_map_body))
        self._poses.append(serialize_message(pose))

    def clear(self) -> None:
        """Start a new path after a discontinuity."""
        self._poses.clear()

    def message(self) -> bytes:
        """The path with the stamp of its newest pose; empty while it has no poses."""
        if not self._poses:
            return b''
        # Numbers are aligned to eight bytes. A pose ends with some, so the next one is aligned as by itself; where the
        # first one begins depends on the name of the frame.
        first = deserialize_message(self._poses[0], PoseStamped)
        one = serialize_message(Path(header=convert.header(self._newest_ns, self._frame), poses=[first]))
        begin = behind_header(one)
        head = one[:begin] + _COUNT.pack(len(self._poses)) + one[begin + _COUNT.size :]
        return b''.join((head, *(pose[_ENCODING:] for pose in islice(self._poses, 1, None))))
