"""Statistics of residuals: running error of each marker, quarantine of inconsistent markers, bias of the corners.

A marker that was moved or duplicated, or has a wrong pose in the map, has large residuals against a pose from the other
markers. One such frame is an outlier; most frames of a second are evidence against the marker.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from statistics import median

import numpy as np

from thermal_fiducial.core.error_model import CHI2_OF_VIEW, INCONSISTENT_PX, shown_errors, ShownErrors, SystematicErrors
from thermal_fiducial.core.mapping.located import Location
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.types import BoolArray, FloatArray, ObjectArray, TINY

#: Reason of quarantine of markers that the map file already had there.
FROM_FILE = 'in quarantine since before the map was loaded'
#: Weight of a new frame in running error and share of inconsistent frames: a memory of 20 frames.
MEMORY = 0.05
#: Share of inconsistent frames above which a marker is put in quarantine, and below which it is released.
QUARANTINE, RELEASE = 0.7, 0.1
#: Ratio of an error to its standard deviation above which a frame counts as inconsistent.
DISAGREEMENT = 4.0
#: Systematic errors of corners: weight of the prior in frames, and forgetting factor per frame, a memory of 300 frames.
BIAS_PRIOR, BIAS_MEMORY = 5.0, 1.0 - 1.0 / 300.0
#: Residuals of a marker beyond this many standard deviations of the bias count as so many.
BIAS_OUTLIER = 2.0
#: The same of the shape, as a variance in units of the noise: 99.9 % of markers with noise alone.
LARGEST_SHAPE = CHI2_OF_VIEW / 8.0
#: Part of the variance of independent corners that is left without their mean.
SHAPE_VISIBLE = 0.75
#: Fewest markers for the corner bias: the pose absorbs nearly all of the error of fewer.
FEWEST_MARKERS = 3
# Longest time between frames whose residuals are compared [ns]: later the corners are elsewhere in the image.
_SUCCESSIVE_NS = 150_000_000


@dataclass
class _Record:
    mean_square_px: float
    observations: int
    disagreement: float = 0.0


class Trust:
    """Running errors and shares of inconsistent frames of all markers, and the quarantine of a map's ``markers``."""

    def __init__(self, markers: Mapping[int, MapMarker]) -> None:
        self._records: dict[int, _Record] = {}
        #: markers in quarantine, each with the reason in words
        self.quarantined = {key: FROM_FILE for key, marker in markers.items() if not marker.trusted}

    def running_errors(self, markers: Iterable[MapMarker]) -> np.ndarray:
        """Running rms re-projection error of each of ``markers`` [px]."""
        return np.sqrt([self._record(marker).mean_square_px for marker in markers])

    def update(
        self,
        markers: dict[int, MapMarker],
        known: ObjectArray,
        errors_px: np.ndarray,
        error_std_px: np.ndarray,
        left_out: BoolArray,
    ) -> bool:
        """Update with a frame; persistently inconsistent markers are put in quarantine, consistent ones released.

        Parameters
        ----------
        markers : of the map; those that enter or leave quarantine are replaced
        known : the N of them in the frame
        errors_px, error_std_px : (N,) their rms re-projection errors, and the standard deviations of these
        left_out : (N,) which of them the pose left out, as odometry contradicts them: inconsistent

        Returns
        -------
        Whether any marker entered or left quarantine.
        """
        records = [self._record(marker) for marker in known]
        for record, error in zip(records, errors_px.tolist(), strict=True):
            record.observations += 1
            gain = max(1.0 / record.observations, MEMORY)
            record.mean_square_px += gain * (error**2 - record.mean_square_px)
        if len(known) < 2:
            return False
        ratios = errors_px / error_std_px
        blamed = ratios > DISAGREEMENT
        if blamed.any():
            blamed = inconsistent(blamed, known.tolist())
        blamed = blamed | left_out
        changed = False
        columns = blamed.tolist(), errors_px.tolist(), ratios.tolist()
        for marker, record, bad, error, ratio in zip(known, records, *columns, strict=True):
            record.disagreement += MEMORY * (bad - record.disagreement)
            if marker.trusted and record.disagreement > QUARANTINE:
                in_frames = f'in most of the last {1.0 / MEMORY:.0f} frames'
                self._set_standing(markers, marker.id, f'{error:.1f} px off, {ratio:.1f} sigma, {in_frames}')
            elif not marker.trusted and record.disagreement < RELEASE:
                self._set_standing(markers, marker.id, '')
            else:
                continue
            changed = True
        return changed

    def flag(self, markers: dict[int, MapMarker], outliers: Mapping[int, float]) -> None:
        """Put markers in quarantine that a bundle adjustment found inconsistent; frames may release them later.

        Parameters
        ----------
        outliers : ID to the share of its views that are inconsistent
        """
        for marker_id, share in outliers.items():
            if marker_id not in markers or not markers[marker_id].trusted:
                continue
            self._record(markers[marker_id]).disagreement = 1.0
            reason = f'{100.0 * share:.0f} % of its views contradict the joint refinement'
            self._set_standing(markers, marker_id, reason)

    def _set_standing(self, markers: dict[int, MapMarker], marker_id: int, reason: str) -> None:
        """Put one of ``markers`` in quarantine for a ``reason``, or release it if that is empty."""
        markers[marker_id] = replace(markers[marker_id], trusted=not reason)
        self.quarantined.pop(marker_id, None)
        if reason:
            self.quarantined[marker_id] = reason

    def _record(self, marker: MapMarker) -> _Record:
        record = self._records.get(marker.id)
        if record is None:
            # A marker that the file has in quarantine stays there until frames release it.
            record = _Record(marker.reprojection_error_px**2, marker.observations, 0.0 if marker.trusted else 1.0)
            self._records[marker.id] = record
        return record


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
    preference = _preference(markers[a], markers[b])
    if preference:
        blamed[b if preference > 0 else a] = True
    return np.asarray(blamed)


def _preference(a: MapMarker, b: MapMarker) -> int:
    if a.fixed != b.fixed:
        return 1 if a.fixed else -1
    if a.observations > 4 * b.observations:
        return 1
    return -1 if b.observations > 4 * a.observations else 0


class CornerBias:
    """Systematic errors of the corners (lens, detector), from the correlation of residuals of successive frames.

    White noise of two frames is independent, so the mean product of a corner's residuals in successive frames is the
    variance of the systematic error, less the part that the pose absorbs: most of an error that is smooth over the
    image, hardly any of errors that each corner has for itself. These the detector claims in the corners' noise
    already; the rest is the bias. Without the mean over each marker's corners the product is that of the markers'
    shapes. Errors of partially visible markers are correlated for other reasons; in the bias markers are weighted by
    their claimed noise.
    """

    def __init__(self) -> None:
        #: standard deviations: of the bias [px], and of the shapes as a share of the corners' noise
        self.px, self.shape = SystematicErrors().corner_px, SystematicErrors().marker_shape
        # Sums over frames: their number, the weights of their markers, shapes, what is known of corners' own errors,
        # and what residuals show.
        self._sums = np.zeros(9)
        #: the last frame, and the weights (N,) of its markers
        self._last: tuple[Location | None, FloatArray] = None, np.zeros(0)

    def add(self, location: Location) -> None:
        """Update with the residuals of a located frame."""
        (last, before), noise = self._last, location.sight.noise_px
        # Markers with more noise than the frame's median have less weight.
        shares = np.minimum(1.0, (median(noise.tolist()) / noise) ** 2)
        self._last = location, shares
        if last is None or not 0 < location.pose.stamp_ns - last.pose.stamp_ns < _SUCCESSIVE_NS:
            return
        places = {key: place for place, key in enumerate(last.pose.marker_ids)}
        now = [place for place, key in enumerate(location.pose.marker_ids) if key in places]
        then = [places[location.pose.marker_ids[place]] for place in now]
        if len(now) < FEWEST_MARKERS:
            return
        residuals, former = location.seen.residuals[now], last.seen.residuals[then]
        products = (residuals * former).sum(axis=(1, 2)) / 8.0
        of_shape = products - (residuals.mean(axis=1) * former.mean(axis=1)).sum(axis=1) / 2.0
        of_shape = np.clip(of_shape / (noise[now] * last.sight.noise_px[then]), -LARGEST_SHAPE, LARGEST_SHAPE)
        shares = shares[now] * before[then]
        # Residuals of moved or mistaken markers are correlated too.
        limit = min(INCONSISTENT_PX, BIAS_OUTLIER * self.px) ** 2
        bound = np.minimum(1.0, limit / np.maximum(np.abs(products), TINY))
        corners = np.repeat(np.isin(np.arange(len(noise)), now), 4)
        weights, scale = (np.repeat(np.sqrt(values), 4)[:, None] for values in (shares, shares * bound))
        shown = shown_errors(
            weights[..., None] * location.seen.J_camera[now].reshape(-1, 2, 6),
            weights * location.correlations[corners][:, corners] * weights.T,
            scale * residuals.reshape(-1, 2),
            scale * former.reshape(-1, 2),
        )
        known = shown.own * float(shares @ location.sight.observed.detector_px[now] ** 2) / len(now)
        sums = (1.0, shares.mean(), of_shape.mean() / SHAPE_VISIBLE, known, *shown)
        self._sums = BIAS_MEMORY * self._sums + sums
        frames, weight, shapes, known, *sums_shown = self._sums.tolist()
        prior = SystematicErrors()
        self.px = _learned(prior.corner_px, ShownErrors(*sums_shown).smooth_variance(known), weight)
        # Not all that lasts until the next frame is alike in all views: the shape is never more than at first.
        self.shape = min(_learned(prior.marker_shape, shapes / frames, frames), prior.marker_shape)


def _learned(prior: float, variance: float, frames: float) -> float:
    """Standard deviation by its prior and by the ``variance`` that a number of ``frames`` show."""
    return math.sqrt((BIAS_PRIOR * prior**2 + frames * max(variance, 0.0)) / (BIAS_PRIOR + frames))
