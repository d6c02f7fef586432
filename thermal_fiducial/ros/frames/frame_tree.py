"""Static frames of a robot: from /tf_static, or the fixed joints of a URDF."""

from collections.abc import Iterator
import math
from typing import TYPE_CHECKING

import numpy as np

from thermal_fiducial.core.geometry.se3 import inverse, transform
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

#: Longest chain of links; a longer one is a cycle.
_LONGEST = 100
#: Most frames of a robot, and characters of its URDF: ten times those of a humanoid with all its fingers.
_MOST_FRAMES, _LONGEST_TEXT = 10_000, 2_000_000


class FrameTree:
    """Pose of each frame in its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, FloatArray]] = {}

    def add(self, parent: str, child: str, T_parent_child: FloatArray) -> None:
        """Set the pose of ``child``; it replaces an earlier one.

        Raises
        ------
        InputError
            The tree has too many frames.
        """
        if len(self._parents) >= _MOST_FRAMES and child not in self._parents:
            raise InputError(f'more than {_MOST_FRAMES} frames on the robot')
        self._parents[child] = (parent, T_parent_child)

    def between(self, a: str, b: str) -> FloatArray | None:
        """T_a_b (4, 4); None if the frames are not connected."""
        (root_a, T_root_a), (root_b, T_root_b) = self._in_root(a), self._in_root(b)
        return inverse(T_root_a) @ T_root_b if root_a == root_b else None

    def _in_root(self, frame: str) -> tuple[str, FloatArray]:
        T_root_frame = np.eye(4)
        for _ in range(_LONGEST):
            if frame not in self._parents:
                break
            frame, T_parent_child = self._parents[frame]
            T_root_frame = T_parent_child @ T_root_frame
        return frame, T_root_frame


def fixed_joints(urdf: str) -> Iterator[tuple[str, str, FloatArray]]:
    """Parent, child and T_parent_child (4, 4) of each fixed joint of a robot's description.

    Raises
    ------
    InputError
        Not a URDF, too long, or a joint with unusable attributes.
    """
    # Imported only if a robot has a URDF: the import takes a tenth of a node's start.
    from xml.etree import ElementTree

    if len(urdf) > _LONGEST_TEXT:
        raise InputError(f'robot_description of {len(urdf)} characters, not {_LONGEST_TEXT} at most')
    try:
        robot = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise InputError(f'robot_description that is not XML: {error}') from None
    for joint in robot.iter('joint'):
        parent, child = joint.find('parent'), joint.find('child')
        if joint.get('type') == 'fixed' and parent is not None and child is not None:
            yield parent.get('link', ''), child.get('link', ''), _origin(joint)


def _origin(joint: 'Element') -> FloatArray:
    origin = joint.find('origin')
    name = joint.get('name', '')
    xyz, rpy = (_three(name, '' if origin is None else origin.get(key, '')) for key in ('xyz', 'rpy'))
    (cr, cp, cy), (sr, sp, sy) = (tuple(map(f, rpy)) for f in (math.cos, math.sin))
    # Fixed axes: roll about x, then pitch about y, then yaw about z (URDF's specification of <origin>).
    R = np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip
    return transform(R, xyz)


def _three(joint: str, text: str) -> FloatArray:
    """Three numbers (3,) of an attribute; zeros if it is missing."""
    try:
        values = np.array([float(word) for word in text.split()] or [0.0] * 3)
    except ValueError:
        values = np.empty(0)
    if values.shape != (3,) or not (np.abs(values) < LARGEST_COORDINATE).all():
        raise InputError(f'robot_description: joint {joint} with an origin of {text!r}')
    return values
