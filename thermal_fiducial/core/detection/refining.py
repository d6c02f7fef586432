"""Corners refined in frames that motion and the bolometers' lag blur.

The motion blur of each marker follows from the camera's twist. Where it matters it is taken out round the marker, as
far as that holds whatever the response is like; the edges are fitted with the blur that remains, and what lag has
displaced them by is taken out of the corners. These correct the twist: where that changes the blur much, it is done
once more.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.refinement import refine_corners, RefinedCorners
from thermal_fiducial.core.detection.frame import (
    delays,
    Frame,
    lag_tail,
    Places,
    rolling_displacement,
)
from thermal_fiducial.core.detection.known_markers import Found
from thermal_fiducial.core.detection.lag import (
    common_error,
    lag_tail_maps,
    LagTails,
    markers_deblurred,
    model_error,
    REMAINING,
    SPREAD,
)
from thermal_fiducial.core.detection.tracking import MotionTrack
from thermal_fiducial.core.detection.twist import Twist, unknown_twist
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

#: Blur by lag below which the shape of an edge doesn't change [px].
BLUR_THAT_MATTERS_PX = 0.4
# What both ways to measure blurred corners cost: deblurring adds noise, in pixels times contrast over noise times root
# of the side; without it the tail of the lag passes for a symmetric blur, which displaces corners by so much of the
# square of the motion blur over a cell.
_NOISE_OF_DEBLURRING, _COST_OF_BLUR = 6.5, 0.22
#: Contrast over noise below which a marker is faint; a clearer one shows at full and at half the resolution.
CLEAR_CNR = 20.0
# A clear marker is deblurred whatever its motion, as its corners are so good that even a short tail shows in what they
# have in common; but not where there is hardly any [px].
_HARDLY_BLURRED_PX = 0.2
# Columns of pixels used of a cell; all of a faint marker's count.
_COLUMNS, _COLUMNS_FAINT = 6, 12
_ROUNDS = 2
_NEXT, _EYE = np.array([1, 2, 3, 0]), np.eye(2)


@dataclass(frozen=True, slots=True)
class DeblurredView:
    """A frame in which the motion blur of N markers is short."""

    #: as it is, and what is to be taken out of it
    image: Float32Array
    lag_tails: LagTails | None
    #: (N, 4, 2) where the corners appear in the view, off their places at the stamp [px]
    shift: FloatArray
    #: (N, 4, 2) how much of the motion blur's shift is taken out
    removed: FloatArray
    #: (N, 2) standard deviation of what is left of the motion blur, along it
    spread: FloatArray

    def only(self, keep: BoolArray) -> 'DeblurredView':
        """That of the markers ``keep`` (N,)."""
        tails = None if self.lag_tails is None else self.lag_tails.only(keep)
        return DeblurredView(self.image, tails, self.shift[keep], self.removed[keep], self.spread[keep])

    def round_markers(self, corners_px: FloatArray, which: IntArray) -> Float32Array:
        """The image freed of lag tails round those of the markers ``which``, with corners (N, 4, 2)."""
        if self.lag_tails is None or not self.lag_tails.unwanted[which].any():
            return self.image
        which = which[self.lag_tails.unwanted[which]]
        return markers_deblurred(self.image, corners_px[which], self.lag_tails.maps[which])


@dataclass(frozen=True, slots=True)
class RefinedMarkers:
    """Refined corners of N markers."""

    #: as the view shows them
    view: DeblurredView
    observed: RefinedCorners
    #: at the stamp, with what is unknown of the motion
    corners: RefinedCorners
    places: Places
    twist: Twist | None

    def only(self, keep: BoolArray) -> 'RefinedMarkers':
        """That of the markers ``keep`` (N,)."""
        if keep.all():
            return self
        view, places = self.view.only(keep), self.places.only(keep)
        return replace(
            self, view=view, observed=self.observed.only(keep), corners=self.corners.only(keep), places=places
        )


class Refiner:
    """Refines markers of a dictionary in moving frames.

    Parameters
    ----------
    behind : (M, 4, m, 2) of :func:`thermal_fiducial.core.detection.corners.sides.edges_behind`
    """

    def __init__(self, behind: Float32Array) -> None:
        self._behind = behind

    def refine(
        self,
        frame: Frame,
        found: Found,
        places: Places,
        track: MotionTrack,
        config: ArucoDetectorConfig,
    ) -> RefinedMarkers:
        """Corners of N markers.

        Parameters
        ----------
        found : the markers
        places : where they roughly are at the stamp
        track : the frames before, which with the corners give the twist
        """
        cell = sides_px(found.corners_px) / self._behind.shape[2]
        columns = _COLUMNS if np.abs(found.cnr).min() > CLEAR_CNR else _COLUMNS_FAINT
        twist = frame.twist
        for _ in range(_ROUNDS):
            view = self._view(frame, places, twist, cell, found.cnr)
            start = places.at.moved(view.shift, frame.camera)
            behind = self._behind[found.ids]
            blur = config.blur_px, view.spread
            seen = refine_corners(view.image, start, frame.camera, behind, *blur, columns, view.lag_tails)
            refinement = self._at_stamp(frame, found, places, view, seen, twist, track)
            change = np.abs(refinement.corners.corners_px - seen.corners_px + view.shift)
            if refinement.twist is None or change.max(initial=0.0) < BLUR_THAT_MATTERS_PX:
                break
            twist, places = refinement.twist, refinement.places
        return refinement

    def _view(
        self, frame: Frame, places: Places, twist: Twist | None, cell: FloatArray, cnr: FloatArray
    ) -> DeblurredView:
        """The frame with the known motion blur of all markers, taken out where that is worth its noise."""
        if twist is None:
            lag_blur = old = np.zeros_like(places.at.px)
        else:
            lag_blur, old = places.lag_blur(twist, frame.lag), lag_tail(places, twist, frame)
        mean = 0.25 * lag_blur.sum(axis=1)
        deblur = worth_deblurring((mean * mean).sum(axis=1), cell, self._behind.shape[2], cnr)
        removed = (1.0 - REMAINING) * old * deblur[:, None, None]
        shift = lag_blur - removed + rolling_displacement(places, twist, frame)
        tails = LagTails(lag_tail_maps(places.at.px + shift, old), deblur) if deblur.any() else None
        return DeblurredView(frame.image, tails, shift, removed, mean * np.where(deblur, SPREAD, 1.0)[:, None])

    def _at_stamp(
        self,
        frame: Frame,
        found: Found,
        places: Places,
        view: DeblurredView,
        seen: RefinedCorners,
        known: Twist | None,
        track: MotionTrack,
    ) -> RefinedMarkers:
        """The corners without lag and as if all rows were seen at once, by the twist that they themselves correct."""
        at = places.at.moved(seen.corners_px - view.shift - places.at.px, frame.camera)
        variance = seen.covariances[..., 0, 0] + seen.covariances[..., 1, 1]
        deviation = np.sqrt(0.125 * variance.sum(axis=1)) / frame.camera.focal_px
        # Corners that make no square are those of something else.
        doubted = seen.covariances + seen.doubt[:, None, None, None] * _EYE
        # The same displacement in two frames in a row hides from the first twist; once freed, they are not alike.
        twist = known
        if frame.twist is not None or known is None:
            twist = track.correct(frame.stamp_ns, frame.twist, found.ids, at.x, places.depth, deviation)
        if twist is None:
            unsure = doubted + self._never_seen(frame, places, seen, unknown_twist())
            return RefinedMarkers(view, seen, replace(seen, covariances=unsure), replace(places, at=at), None)
        lag_blur = places.lag_blur(twist, frame.lag)
        rolling = rolling_displacement(places, twist, frame, (seen.corners_px + view.removed)[..., 1])
        corners = seen.corners_px - lag_blur + view.removed - rolling
        unknown = places.unknown(twist, frame.lag) + model_error(lag_blur, places.at.px, self._behind.shape[2])
        if frame.twist is None:
            unknown = unknown + self._never_seen(frame, places, seen, twist)
        refined = replace(seen, corners_px=corners, covariances=doubted + unknown)
        return RefinedMarkers(view, seen, refined, replace(places, at=at.at_pixels(corners)), twist)

    def _never_seen(self, frame: Frame, places: Places, seen: RefinedCorners, twist: Twist) -> FloatArray:
        """Covariances (N, 4, 2, 2) [px^2] by a motion that the frames before show nothing of."""
        since = frame.lag - delays(seen.corners_px[..., 1], frame)
        unsharpness = seen.noise / np.maximum(np.abs(seen.contrast), 1e-6)
        cell = sides_px(seen.corners_px) / self._behind.shape[2]
        return common_error(since[..., None, None] * places.flow, twist.covariance_ago(frame.lag), unsharpness, cell)


def worth_deblurring(square: FloatArray, cell: FloatArray, cells: int, cnr: FloatArray) -> BoolArray:
    """For which markers with squares of the blur (N,) and cells (N,) [px] it costs more than deblurring's noise."""
    systematic, noise = _COST_OF_BLUR * square / cell, _NOISE_OF_DEBLURRING / np.sqrt(cells * cell)
    worth = (np.abs(cnr) > CLEAR_CNR) | (systematic * np.abs(cnr) > noise)
    return np.asarray(worth & (square > _HARDLY_BLURRED_PX**2))


def sides_px(corners: FloatArray) -> FloatArray:
    """Mean sides (N,) of quadrilaterals (N, 4, 2)."""
    span = corners.take(_NEXT, axis=1) - corners
    return np.asarray(0.25 * np.sqrt((span * span).sum(axis=-1)).sum(axis=1))
