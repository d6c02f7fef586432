"""Which known markers are where the map has them.

One that was moved, exists twice or has a wrong pose in the map contradicts the others in view, or odometry. Of three
such a marker is an outlier of a robust fit. Of two either may have moved, and the robust fit follows one of them in
some frames and the other one in others. The camera as predicted by odometry decides which of them has moved (a test of
two hypotheses). A marker alone in view has nothing but odometry to contradict. One such frame is an outlier; most
frames of a second are evidence, and put the marker in quarantine.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from thermal_fiducial.core.error_model import covariance_of_one_error, INCONSISTENT_PX
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import difference, inverse, rotation_angle
from thermal_fiducial.core.mapping.contradicted_map import ContradictedMap, MOST, most_px
from thermal_fiducial.core.mapping.located import (
    error_std_px,
    LocatedFrame,
    Location,
    MisplacedMarker,
    Refusal,
    Sight,
    squared_distance,
)
from thermal_fiducial.core.mapping.map_data import MapMarker, NEW_FRAME_SHARE
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.motion_prior import PredictedCamera
from thermal_fiducial.core.two_poses import DECISIVE
from thermal_fiducial.core.types import BoolArray, FloatArray, SECOND_NS

#: Reason of quarantine of markers that the map file already had there.
FROM_FILE = 'in quarantine since before the map was loaded'
#: Share of inconsistent frames above which a marker is put in quarantine, and below which it is released: by
#: ``NEW_FRAME_SHARE`` the 24th inconsistent frame in a row puts it there, the 45th consistent one releases it.
QUARANTINE, RELEASE = MOST, 0.1
#: Ratio of an error to its standard deviation above which a frame counts as inconsistent.
DISAGREEMENT = 4.0
#: Markers that must have agreed with odometry for it to count against another: two against one.
_WITNESSES = 2
#: A marker is misplaced from this distance on [m], or from this angle on [rad]: where odometry is wrong by less,
#: following the marker costs less than losing the pose. At 1 m from the marker the angle displaces by as much.
_FAR, _TURNED = 0.2, 0.2
#: An estimate that drifts away contradicts a marker in view a little at first. A marker that is misplaced is far away
#: at once: nothing has contradicted odometry for this long [ns].
_BEFORE_NS = SECOND_NS // 3
#: Odometry that for so long [ns] had no other marker says nothing any more; as ``reinitialise_after``.
_FORGOTTEN_NS = 60 * SECOND_NS


def from_consistent_markers(
    sight: Sight, camera: Camera, predicted: PredictedCamera | None, fit: Callable[[Sight], Location | Refusal]
) -> Location | Refusal:
    """The camera from all markers; from two that contradict each other, by the one where odometry predicts it.

    Where odometry does not decide, the pose is that of the marker nearer to the prediction, and may as well be that of
    the other: an error of the map.

    Parameters
    ----------
    sight : at least one trusted marker
    predicted : the camera by odometry
    fit : the pose from some of the markers
    """
    found = fit(sight)
    if isinstance(found, Refusal) or len(found.sight.sizes) != 2:
        return found
    sight, reprojection = found.sight, found.reprojection
    if not np.any(reprojection.errors_px > DISAGREEMENT * error_std_px(sight, reprojection, np.zeros((6, 6)))):
        return found
    contradiction = Refusal(f'{sight.names} contradict each other')
    if predicted is None:
        return contradiction
    apart = _distances(sight, camera, predicted.pose)
    nearer = np.arange(2) == apart.argmin()
    if np.ptp(apart) > DECISIVE:
        return fit(sight.only(nearer))
    one, other = fit(sight.only(nearer)), fit(sight.only(~nearer))
    if isinstance(one, Refusal) or isinstance(other, Refusal):
        return contradiction
    spread = covariance_of_one_error(difference(other.pose.T_map_camera, one.pose.T_map_camera))
    pose = replace(
        found.pose,
        T_map_camera=one.pose.T_map_camera,
        covariance=one.pose.covariance,
        map_covariance=one.pose.map_covariance + spread,
    )
    return replace(found, pose=pose).unsettled(spread)


class Consistency:
    """What the frames say of the known markers: a quarantine, and the marker that alone in view is misplaced.

    Views of a marker that is alone in view cannot decide between it and odometry: they agree with each other, and after
    some seconds without another marker odometry has drifted so far that it contradicts nothing. So what the first view
    showed is remembered, until the marker is back in its place, is seen with another one, or a second marker
    contradicts odometry too: then it is odometry that is wrong.
    """

    def __init__(self, markers: Mapping[int, MapMarker]) -> None:
        """``markers``: of the map."""
        #: markers in quarantine, each with the reason in words
        self.quarantined = {key: FROM_FILE for key, marker in markers.items() if not marker.trusted}
        # Shares of inconsistent frames by ID: markers that the file has in quarantine stay until frames release them.
        self._shares = dict.fromkeys(self.quarantined, 1.0)
        #: whether most markers contradict the map
        self.of_map = ContradictedMap()
        #: whether odometry has agreed with any marker since the map was loaded
        self.odometry_agreed = False
        #: IDs of markers that have agreed with odometry
        self._witnesses: set[int] = set()
        self._misplaced: MisplacedMarker | None = None
        #: stamp of the last pose that contradicted it [ns]
        self._contradicted_ns: int | None = None

    def checked(self, frame: LocatedFrame) -> LocatedFrame:
        """The ``frame``, without its pose if that is from a misplaced marker, or from a map that most contradict."""
        if self.of_map.doubt:
            return replace(frame, contradicts_map=True)
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
        angle = float(rotation_angle(T_moved[:3, :3]))
        is_misplaced = distance >= _FAR or angle >= _TURNED
        return MisplacedMarker(marker_id, frame.stamp_ns, T_moved, distance, angle) if is_misplaced else None

    def add(self, frame: LocatedFrame) -> None:
        """Note whether a frame and its outcome agree with odometry."""
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
            self.odometry_agreed = True
            self._witnesses |= ids
        if self._misplaced and self._misplaced.id in ids:
            self._misplaced = None

    def weigh_map(self, frame: LocatedFrame) -> None:
        """Note which markers of a frame agree with the map; where two poses are possible, by the likelier one."""
        known, outcome = frame.known, frame.outcome
        if isinstance(outcome, Location):
            errors, error_stds = frame.known_errors
            self.of_map.add(known, errors <= np.minimum(DISAGREEMENT * error_stds, most_px(known)))
        elif outcome.compared:
            sight, reprojection = outcome.compared
            self.of_map.add(sight, reprojection.errors_px <= most_px(sight))

    def judge(
        self,
        markers: dict[int, MapMarker],
        ids: Sequence[int],
        errors_px: FloatArray,
        error_std_px: FloatArray,
        used: Collection[int],
    ) -> bool:
        """Put persistently inconsistent markers in quarantine after a frame, and release consistent ones.

        Parameters
        ----------
        markers : of the map; those that enter or leave quarantine are replaced
        ids : the N of them in the frame
        errors_px, error_std_px : (N,) their rms re-projection errors, and the standard deviations of these
        used : IDs of those that the pose is from; trusted ones that it left out contradict odometry

        Returns
        -------
        Whether any marker entered or left quarantine.
        """
        if len(ids) < 2:
            return False
        known, ratios = [markers[key] for key in ids], errors_px / error_std_px
        left_out = np.array([marker.trusted and marker.id not in used for marker in known])
        blamed = self._blamed(ratios > DISAGREEMENT, left_out, known)
        changed = False
        columns = blamed.tolist(), errors_px.tolist(), ratios.tolist()
        for marker, bad, error, ratio in zip(known, *columns, strict=True):
            share = self._shares.get(marker.id, 0.0)
            share += NEW_FRAME_SHARE * (bad - share)
            self._shares[marker.id] = share
            if marker.trusted and share > QUARANTINE:
                in_frames = f'in most of the last {1.0 / NEW_FRAME_SHARE:.0f} frames'
                self._set_trusted(markers, marker.id, f'{error:.1f} px off, {ratio:.1f} sigma, {in_frames}')
            elif not marker.trusted and share < RELEASE:
                self._set_trusted(markers, marker.id, '')
            else:
                continue
            changed = True
        return changed

    def _blamed(self, disagrees: BoolArray, left_out: BoolArray, known: list[MapMarker]) -> BoolArray:
        """Which of N markers (N,) a frame is evidence against.

        One that odometry has agreed with before, and contradicts now, has moved. Odometry that has not may come from
        the other one alone, and decides only where neither is known better.
        """
        either = disagrees | left_out
        if not either.any():
            return either
        by_map = inconsistent(either, known)
        if not left_out.any():
            return by_map
        has_agreed = np.array([marker.id in self._witnesses for marker in known])
        better_known = np.array([marker.trusted for marker in known]) & by_map
        return by_map if better_known.any() and not np.any(left_out & has_agreed) else either

    def quarantine(self, markers: dict[int, MapMarker], outliers: Mapping[int, float]) -> None:
        """Put markers in quarantine that a bundle adjustment found inconsistent; frames may release them later.

        Parameters
        ----------
        outliers : ID to the share of its views that are inconsistent
        """
        for marker_id, share in outliers.items():
            if marker_id not in markers or not markers[marker_id].trusted:
                continue
            self._shares[marker_id] = 1.0
            reason = f'{100.0 * share:.0f} % of its views contradict the joint refinement'
            self._set_trusted(markers, marker_id, reason)

    def _set_trusted(self, markers: dict[int, MapMarker], marker_id: int, reason: str) -> None:
        """Put one of ``markers`` in quarantine for a ``reason``, or release it if that is empty."""
        markers[marker_id] = replace(markers[marker_id], trusted=not reason)
        self.quarantined.pop(marker_id, None)
        if reason:
            self.quarantined[marker_id] = reason


def inconsistent(disagrees: np.ndarray, markers: Sequence[MapMarker]) -> np.ndarray:
    """Which of the disagreeing markers count as inconsistent, (N,) bool.

    With three or more, all that disagree: a robust pose follows the majority. Of two, not the fixed one, nor the one
    observed more than four times as often; if neither applies, none.
    """
    trusted = np.array([marker.trusted for marker in markers], dtype=bool)
    if np.count_nonzero(trusted) != 2 or not np.any(disagrees & trusted):
        return disagrees
    a, b = np.flatnonzero(trusted).tolist()
    blamed = disagrees & ~trusted
    blamed[a], blamed[b] = _better_known(markers[b], markers[a]), _better_known(markers[a], markers[b])
    return np.asarray(blamed)


def _better_known(marker: MapMarker, other: MapMarker) -> bool:
    """Whether ``marker`` is preferred to the ``other`` one, by survey, then by observations."""
    if marker.fixed != other.fixed:
        return marker.fixed
    return marker.observations > 4 * other.observations


def _is_back(misplaced: MisplacedMarker, pose: CameraPose, predicted: PredictedCamera | None) -> bool:
    """Whether a marker is rather in its place in the map than where it was found, by odometry."""
    if predicted is None:
        return False
    elsewhere = pose.in_moved_map(inverse(misplaced.T_moved))
    return squared_distance(elsewhere, predicted.pose) - squared_distance(pose, predicted.pose) > DECISIVE


def _distances(sight: Sight, camera: Camera, predicted: CameraPose) -> FloatArray:
    """Squared Mahalanobis distances (N,), eight degrees of freedom, of N markers from where odometry predicts them."""
    reprojection = sight.reprojected(camera, predicted.T_map_camera)
    # A marker predicted behind the camera is not there.
    residuals = np.nan_to_num(reprojection.residuals, nan=float(camera.width)).reshape(-1, 8)
    of_camera = reprojection.J_camera @ predicted.covariance @ np.swapaxes(reprojection.J_camera, 1, 2)
    of_map = reprojection.J_marker @ sight.map_covariances @ np.swapaxes(reprojection.J_marker, 1, 2)
    own = (2.0 * sight.noise_px**2 + INCONSISTENT_PX**2)[:, None, None] * np.eye(8)
    weighted = np.linalg.solve(np.nan_to_num(of_camera + of_map) + own, residuals[..., None])[..., 0]
    return np.asarray((residuals * weighted).sum(axis=1))
