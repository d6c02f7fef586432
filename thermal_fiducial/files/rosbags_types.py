"""ROS messages as rosbags objects, for all writers of bags."""

from typing import Any

from rosbags.typesys import get_typestore, Stores

from thermal_fiducial.core.types import SECOND_NS

CAMERA_FRAME, BODY_FRAME, MAP_FRAME = 'thermal_camera_optical', 'base_link', 'map'

_TYPES = get_typestore(Stores.ROS2_JAZZY).types


def make(kind: str, *args: Any, **fields: Any) -> Any:
    """A message of type ``kind``, e.g. 'std_msgs/msg/Header', from its fields by position or name."""
    return _TYPES[kind](*args, **fields)


def header(stamp_ns: int, frame_id: str) -> Any:
    """std_msgs/msg/Header."""
    time = make('builtin_interfaces/msg/Time', *divmod(int(stamp_ns), SECOND_NS))
    return make('std_msgs/msg/Header', stamp=time, frame_id=frame_id)
