"""Known markers that contradict each other, or odometry: which of them has moved, or is a second plate of its ID.

Of three markers one that has moved is an outlier of a robust fit. Of two either may have moved: the robust fit follows
one of them, now this and now that. What is unknown is discrete, which of them it is, and the camera as predicted by
odometry is the measurement that decides it. A marker alone in view has nothing but odometry to contradict.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from thermal_fiducial.core.error_model import INCONSISTENT_PX, of_single_error
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import difference
from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.mapping.localization import DECISIVE, names
from thermal_fiducial.core.mapping.located import (
    error_std_px,
    LocatedFrame,
    Location,
    MisplacedMarker,
    Refusal,
    Sight,
    squared_distance,
)
from thermal_fiducial.core.mapping.trust import DISAGREEMENT
from thermal_fiducial.core.measurements import CameraPose, in_moved_map
from thermal_fiducial.core.motion_prior import PredictedCamera
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Markers that must have agreed with odometry for it to count against another: two against one.
_WITNESSES = 2
#: A marker is misplaced from this distance on [m]: where odometry is wrong by less, following the marker costs less
#: than losing the pose.
_FAR = 0.2
#: An estimate that drifts away contradicts a marker in view a little at first. A marker that is misplaced is far away
#: at once: nothing has contradicted odometry for this long [ns].
_BEFORE_NS = SECOND_NS // 3
#: Odometry that for so long [ns] had no other marker says nothing any more; as ``reinitialise_after``.
_FORGOTTEN_NS = 60 * SECOND_NS


def are_two_that_contradict(location: Location) -> bool:
    """Whether the pose comes from two markers of which it does not fit at least one."""
    sight, seen = location.sight, location.seen
    if len(sight.markers) != 2:
        return False
    return bool(np.any(seen.errors_px > DISAGREEMENT * error_std_px(sight, seen, np.zeros((6, 6)))))


def settled(
    found: Location, camera: Camera, predicted: CameraPose, fit: Callable[[Sight], Location | Refusal]
) -> Location | Refusal:
    """The camera from the one of two contradicting markers that is where odometry predicts it.

    Where odometry does not decide, the pose is that of the marker nearer to the prediction, and may as well be that of
    the other: an error of the map.

    Parameters
    ----------
    found : the pose from both
    predicted : the camera by odometry, with its covariance
    fit : the pose from some of the markers
    """
    sight = found.sight
    apart = _distances(sight, camera, predicted)
    nearer = np.arange(2) == apart.argmin()
    if np.ptp(apart) > DECISIVE:
        return fit(sight.only(nearer))
    one, other = fit(sight.only(nearer)), fit(sight.only(~nearer))
    if isinstance(one, Refusal) or isinstance(other, Refusal):
        return contradicting(sight)
    spread = of_single_error(difference(other.pose.T_map_camera, one.pose.T_map_camera))
    pose = replace(
        found.pose,
        T_map_camera=one.pose.T_map_camera,
        covariance=one.pose.covariance + spread,
        map_covariance=one.pose.map_covariance + spread,
    )
    return replace(found, pose=pose)


def contradicting(sight: Sight) -> Refusal:
    """No pose from markers that contradict each other."""
    return Refusal(f'{names(sight)} contradict each other')


class MisplacedMarkers:
    """The marker, if any, that alone in view contradicts odometry and the markers which bear it out.

    From the marker's own views nothing can be learned about which is right: they all agree with each other, and after
    some seconds without another marker odometry has drifted so far that it contradicts nothing. So what the first
    view showed is remembered, until the marker is back in its place, is seen with another one, or a second marker
    contradicts odometry too: then it is odometry that is wrong.
    """

    def __init__(self) -> None:
        self._misplaced: MisplacedMarker | None = None
        #: IDs of markers that have agreed with odometry
        self._witnesses: set[int] = set()
        #: stamp of the last pose that contradicted it [ns]
        self._contradicted_ns: int | None = None

    def checked(self, frame: LocatedFrame) -> LocatedFrame:
        """The ``frame``, without its pose if that is from a misplaced marker."""
        outcome = frame.outcome
        if isinstance(outcome, Refusal) or len(outcome.pose.marker_ids) > 1:
            return frame
        known = self._misplaced
        if known is None or not 0 <= frame.stamp_ns - known.since_ns < _FORGOTTEN_NS:
            known = self._at_first_sight(frame, outcome)
        elif known.id not in outcome.pose.marker_ids or _is_back(known, outcome.pose, frame.predicted):
            known = None
        return frame if known is None else replace(frame, outcome=Refusal(known.reason, misplaced=known))

    def _at_first_sight(self, frame: LocatedFrame, location: Location) -> MisplacedMarker | None:
        """The only marker of ``location`` if it is misplaced."""
        (marker_id,), contradicted_ns = location.pose.marker_ids, self._contradicted_ns
        drifting = contradicted_ns is not None and 0 <= frame.stamp_ns - contradicted_ns < _BEFORE_NS
        outvoted = len(self._witnesses - {marker_id}) >= _WITNESSES
        if frame.predicted is None or not frame.contradicts_odometry or drifting or not outvoted:
            return None
        T_moved = location.pose.T_map_camera @ inverse(frame.predicted.pose.T_map_camera)
        T_map_marker = location.sight.T_map_marker[0]
        distance = float(np.linalg.norm((inverse(T_moved) @ T_map_marker - T_map_marker)[:3, 3]))
        return MisplacedMarker(marker_id, frame.stamp_ns, T_moved, distance) if distance >= _FAR else None

    def add(self, frame: LocatedFrame) -> None:
        """Update with a frame and its outcome."""
        outcome = frame.outcome
        if isinstance(outcome, Refusal):
            self._misplaced = outcome.misplaced or self._misplaced
            return
        ids = set(outcome.pose.marker_ids)
        if frame.contradicts_odometry:
            self._contradicted_ns = frame.stamp_ns
            if self._misplaced:
                # It is the second one.
                self._misplaced, self._witnesses = None, set()
        elif frame.predicted:
            self._witnesses |= ids
        if self._misplaced and self._misplaced.id in ids:
            self._misplaced = None


def _is_back(misplaced: MisplacedMarker, pose: CameraPose, predicted: PredictedCamera | None) -> bool:
    """Whether a marker is rather in its place in the map than where it was found, by odometry."""
    if predicted is None:
        return False
    elsewhere = in_moved_map(pose, inverse(misplaced.T_moved))
    return squared_distance(elsewhere, predicted.pose) - squared_distance(pose, predicted.pose) > DECISIVE


def _distances(sight: Sight, camera: Camera, predicted: CameraPose) -> FloatArray:
    """Squared Mahalanobis distances (N,), eight degrees of freedom, of N markers from where odometry predicts them."""
    seen = sight.reprojected(camera, predicted.T_map_camera)
    # A marker predicted behind the camera is not there.
    residuals = np.nan_to_num(seen.residuals, nan=float(camera.width)).reshape(-1, 8)
    of_camera = seen.J_camera @ predicted.covariance @ np.swapaxes(seen.J_camera, 1, 2)
    of_map = seen.J_marker @ sight.map_covariances @ np.swapaxes(seen.J_marker, 1, 2)
    own = (2.0 * sight.noise_px**2 + INCONSISTENT_PX**2)[:, None, None] * np.eye(8)
    weighted = np.linalg.solve(np.nan_to_num(of_camera + of_map) + own, residuals[..., None])[..., 0]
    return np.asarray((residuals * weighted).sum(axis=1))
