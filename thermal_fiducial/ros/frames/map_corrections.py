"""Map corrections during the delay of poses, at the publisher and at the subscriber of ``camera_pose``."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped

from thermal_fiducial.core.error_model import at_most_claimed
from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.measurements import CameraPose, MOST_LATE_NS
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.messages import convert, message_bytes

#: Number of corrections and of map covariances kept.
_REMEMBERED = 10


class _Corrections:
    """The last corrections of the map, each with the stamp of the newest frame before it."""

    def __init__(self) -> None:
        self._log: deque[tuple[int, FloatArray]] = deque(maxlen=_REMEMBERED)

    def add(self, stamp_ns: int, T_new_old: FloatArray) -> None:
        """Log that the map moved by ``T_new_old`` (4, 4) after the frame of ``stamp_ns``."""
        self._log.append((stamp_ns, T_new_old))

    def since(self, stamp_ns: int) -> list[FloatArray]:
        """Corrections (4, 4) after a frame, the oldest first; larger differences of stamps are due to another clock."""
        return [T_new_old for after_ns, T_new_old in self._log if 0 <= after_ns - stamp_ns <= MOST_LATE_NS]


class LatePoses:
    """For the publisher: transforms poses of frames processed after a correction into the map as of their stamps."""

    def __init__(self) -> None:
        #: stamp of the newest frame so far
        self.newest_ns = 0
        self._corrections = _Corrections()

    def add(self, stamp_ns: int) -> None:
        """Log the stamp of a frame; a much older stamp means a backward clock jump."""
        self.newest_ns = max(stamp_ns, self.newest_ns) if stamp_ns >= self.newest_ns - MOST_LATE_NS else stamp_ns

    def moved(self, T_new_old: FloatArray) -> None:
        """Log that the map moved by ``T_new_old`` (4, 4) after the newest frame."""
        self._corrections.add(self.newest_ns, T_new_old)

    def as_of_its_stamp(self, pose: CameraPose) -> CameraPose:
        """``pose``, given in the present map, in the map as of its stamp."""
        for T_new_old in reversed(self._corrections.since(pose.stamp_ns)):
            pose = pose.in_moved_map(inverse(T_new_old))
        return pose


class MapCorrections:
    """For the subscriber: transforms poses into the present map and adds the covariance of the map's error."""

    def __init__(self) -> None:
        self._corrections = _Corrections()
        self._errors: deque[CameraPose] = deque(maxlen=_REMEMBERED)
        #: the last map error received with a pose
        self._error: CameraPose | None = None

    def follow(self, node: CountingNode, on_moved: Callable[[FloatArray], None]) -> None:
        """Subscribe to errors and corrections of the map; ``on_moved`` is called with T_new_old (4, 4) of each."""

        def on_error(message: bytes) -> None:
            self.note_error(message_bytes.map_error(message))

        errors = node.subscribe_lazily(PoseWithCovarianceStamped, 'camera_pose/map_error', on_error, qos.RESULT)
        # It comes with each pose: that there are none is said of these.
        errors.regular = False
        self.follow_moves(node, on_moved)

    def follow_moves(self, node: CountingNode, on_moved: Callable[[FloatArray], None] | None = None) -> None:
        """Subscribe to corrections of the map alone."""

        def on_correction(message: TransformStamped) -> None:
            stamp_ns, T_new_old = convert.correction_of(message)
            self.add(stamp_ns, T_new_old)
            if on_moved is not None:
                on_moved(T_new_old)

        node.subscribe(TransformStamped, 'map_correction', on_correction, qos.RESULT)

    def add(self, stamp_ns: int, T_new_old: FloatArray) -> None:
        """Log that the map moved by ``T_new_old`` (4, 4) after the frame of ``stamp_ns``."""
        self._corrections.add(stamp_ns, T_new_old)

    def note_error(self, error: CameraPose) -> None:
        """Log the map's error at a pose (the covariance of ``error``)."""
        self._errors.append(error)

    def in_present_map(self, pose: CameraPose) -> CameraPose:
        """``pose``, given in the map as of its stamp, in the present map, with the covariance of the map's error."""
        # The newest first: a clock that was set back repeats stamps.
        of_stamp = (error for error in reversed(self._errors) if error.stamp_ns == pose.stamp_ns)
        self._error = next(of_stamp, self._error)
        error = self._error
        if error is not None and abs(pose.stamp_ns - error.stamp_ns) <= MOST_LATE_NS:
            # It changes slowly: that of another pose is used where that of this one is missing.
            pose = replace(pose, map_covariance=at_most_claimed(error.covariance, pose.covariance))
        for T_new_old in self._corrections.since(pose.stamp_ns):
            pose = pose.in_moved_map(T_new_old)
        return pose
