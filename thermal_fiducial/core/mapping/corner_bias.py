"""Systematic errors of the corners (lens, detector), learned from residuals that last."""

from dataclasses import dataclass
import math
from statistics import median
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.error_model import INCONSISTENT_PX
from thermal_fiducial.core.mapping.located import Location, not_taken_up
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray, Stacked, TINY

#: What is known of the variance of the corners' bias at first, an inverse gamma distribution: a sum of squares [px^2]
#: and its degrees of freedom. Its mode is 0.1 px, which good calibrations leave, its mean 0.3 px: published lenses of
#: seven recordings are off by 0.1 to 1.0 px. These alone are likeliest by 0.07 px^2 and 1.1, which have no mean.
BIAS_SQUARES, BIAS_FREEDOM = 0.05, 2.5
#: Forgetting factor per frame, a memory of 300 frames.
BIAS_MEMORY = 1.0 - 1.0 / 300.0
#: Residuals of a marker beyond this many times the most likely bias count as so many; in a fit, of bias and noise.
BIAS_OUTLIER = 2.0
#: Fewest markers for the corner bias: the pose absorbs nearly all of the error of fewer.
FEWEST_MARKERS = 3


class CornerBias:
    """Systematic errors of the corners (lens, detector), from the correlation of residuals of successive frames.

    White noise of two frames is independent, so the mean product of a corner's residuals in successive frames is the
    variance of the systematic error, less the part that the pose absorbs: most of an error that is smooth over the
    image, hardly any of errors that each corner has for itself. These the detector claims in the corners' noise
    already; the rest is the bias. Where the image has moved since the last frame, the two have less of the smooth error
    in common, and the pair counts for less. Errors of partially visible markers are correlated for other reasons:
    markers are weighted by their claimed noise.
    """

    def __init__(self) -> None:
        #: standard deviation of the bias [px] by the mean of its variance, which is claimed, and by the mode, which is
        #: what residuals are compared with
        self.px, self.likely_px = _by_mean_and_mode(BIAS_SQUARES, BIAS_FREEDOM)
        # Sums over frames: the weights of their markers, what is known of corners' own errors, and what residuals show.
        self._sums = np.zeros(7)
        #: the last frame, and its corners
        self._last: tuple[CameraPose, _FittedCorners] | None = None

    def _weight(self, fitted: '_FittedCorners', shown: 'ShownErrors') -> float:
        """What a frame counts beside one of an exact map: the variance of a product is the square of the residuals'."""
        corners = fitted.corners
        noise_variance = float(corners.shares**2 @ corners.noise_px**2) / len(corners.shares)
        of_map = not_taken_up(fitted.taken_up, corners.map_draws.reshape(len(fitted.taken_up), -1))
        expected = shown.own * noise_variance + shown.smooth * self.likely_px**2
        return (expected / (expected + float(np.mean(np.square(of_map))))) ** 2

    def add(self, location: Location) -> None:
        """Update with the residuals of a located frame."""
        pose, fitted = location.pose, _FittedCorners.of(_WeightedCorners.of(location, self.likely_px))
        last, self._last = self._last, (pose, fitted)
        if last is None or pose.stamp_ns <= last[0].stamp_ns:
            return
        places = {key: place for place, key in enumerate(last[0].marker_ids)}
        now = [place for place, key in enumerate(pose.marker_ids) if key in places]
        if len(now) < FEWEST_MARKERS:
            return
        fitted, former = fitted.only(now), last[1].only([places[pose.marker_ids[place]] for place in now])
        shares = fitted.corners.shares * former.corners.shares
        # Residuals of moved or mistaken markers are correlated too.
        largest_px = min(INCONSISTENT_PX, BIAS_OUTLIER * self.likely_px)
        bounds = _bounds(_mean_products(fitted.residuals, former.residuals), largest_px)
        shown, common = shown_errors(fitted, former, bounds)
        known = shown.own * float(np.mean(shares * fitted.corners.detector_px**2))
        common *= self._weight(fitted, shown)
        self._sums = BIAS_MEMORY * self._sums + common * np.array((shares.mean(), known, *shown))
        weight, known, *sums_shown = self._sums.tolist()
        variance = max(ShownErrors(*sums_shown).smooth_variance(known), 0.0)
        self.px, self.likely_px = _by_mean_and_mode(BIAS_SQUARES + weight * variance, BIAS_FREEDOM + weight)


def _mean_products(residuals: FloatArray, former: FloatArray) -> FloatArray:
    """Means (N,) [px^2] over the corners of N markers of the products of two residuals (N, 4, 2)."""
    return np.asarray((residuals * former).sum(axis=(1, 2)) / 8.0)


def _bounds(products: FloatArray, largest_px: FloatArray | float) -> FloatArray:
    """(N,) weights of residuals by which no marker's mean product (N,) [px^2] exceeds the square of the largest."""
    return np.asarray(np.sqrt(np.minimum(1.0, largest_px**2 / np.maximum(np.abs(products), TINY))))


def _by_mean_and_mode(squares: float, freedom: float) -> tuple[float, float]:
    """Standard deviations by mean and mode of an inverse gamma distribution of the variance.

    What has such a variance is distributed as Student's t, whose variance is that mean.
    """
    return math.sqrt(squares / (freedom - 2.0)), math.sqrt(squares / (freedom + 2.0))


class ShownErrors(NamedTuple):
    """What residuals of two poses show of the corners' systematic errors: sums per coordinate.

    If each corner has an error of its own, of variance s^2, and all share one that is smooth over the image, of
    variance b^2, ``product`` is expected to be ``s^2 own + b^2 smooth`` and ``smooth_product``
    ``s^2 smooth + b^2 both``
    (minimum norm quadratic estimation of variance components; C. R. Rao, 1971).
    """

    #: product of successive residuals, and the same weighted by the correlations of the smooth error [px^2]
    product: float
    smooth_product: float
    own: float
    smooth: float
    both: float

    def smooth_variance(self, known: float) -> float:
        """Variance b^2 [px^2], without errors of corners of their own as far as they are ``known`` in ``product``.

        Errors of single corners beyond what the detector declares are attributed to the smooth error of the lens: a
        model that is wrong within a marker is worse over the whole image, where the pose hides it.
        """
        if self.smooth == 0.0:
            return 0.0
        own = (self.product * self.both - self.smooth_product * self.smooth) / (self.own * self.both - self.smooth**2)
        return (self.product - min(max(own, 0.0) * self.own, known)) / self.smooth


@dataclass(frozen=True, slots=True)
class _WeightedCorners(Stacked):
    """Corners of the N markers of a frame, with weights of the markers."""

    #: (N,) weights: markers with more noise than the frame's median have less, and mistaken ones
    shares: FloatArray
    #: (N,) standard deviations of a coordinate of their corners, and of the detector's own errors in it [px]
    noise_px: FloatArray
    detector_px: FloatArray
    #: (N, 4, 2) residuals [px] as located, and derivatives of the corners (N, 8, 6) by the pose
    located: FloatArray
    J: FloatArray
    #: with those weights: (N, 4, I) factors of the smooth error, and (N, 8, K) joint draws of the map's errors in them
    modes: FloatArray
    map_draws: FloatArray

    @staticmethod
    def of(location: Location, bias_px: float) -> '_WeightedCorners':
        """All markers of a frame; ``bias_px`` is the standard deviation of the bias, as known by then."""
        sight, fit = location.sight, location.reprojection
        noise = sight.noise_px
        by_noise = np.minimum(1.0, (median(noise.tolist()) / noise) ** 2)
        residuals, _ = _refitted(fit.residuals, fit.J_camera, by_noise)
        shares = by_noise * _bounds(_mean_products(residuals, residuals), BIAS_OUTLIER * np.hypot(noise, bias_px))
        weights = shares[:, None, None]
        map_draws = weights * (fit.J_marker @ sight.draws)
        return _WeightedCorners(
            shares,
            noise,
            sight.observed.detector_px,
            fit.residuals,
            fit.J_camera,
            weights * location.lens.modes,
            map_draws,
        )


class _FittedCorners(NamedTuple):
    """Weighted corners of a frame at the pose that they alone fit best.

    The located pose has odometry in it, and weights by the map, and what that displaces it is no error of the lens.
    """

    corners: _WeightedCorners
    #: (N, 4, 2) [px]
    residuals: FloatArray
    #: (8 N, 6) orthonormal directions, along which the pose takes up weighted errors
    taken_up: FloatArray
    #: (8 N, 2 I) what that leaves of the smooth error, by its factors in either coordinate, and (2 I, 2 I) products
    smooth: FloatArray
    gram: FloatArray

    @staticmethod
    def of(corners: _WeightedCorners) -> '_FittedCorners':
        """The fit of the pose to all ``corners``."""
        residuals, taken_up = _refitted(corners.located, corners.J, corners.shares)
        by_coordinate = corners.modes[:, :, None, :, None] * np.eye(2)[:, None]
        smooth = not_taken_up(taken_up, by_coordinate.reshape(len(taken_up), -1))
        return _FittedCorners(corners, residuals, taken_up, smooth, smooth.T @ smooth)

    def only(self, chosen: list[int]) -> '_FittedCorners':
        """The fit to the markers at the places ``chosen``."""
        if chosen == list(range(len(self.residuals))):
            return self
        return _FittedCorners.of(self.corners.only(np.array(chosen)))


def _refitted(residuals: FloatArray, J: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 4, 2) [px] at the pose that N markers with weights ``shares`` (N,) fit best: J (N, 8, 6).

    And the orthonormal directions (8 N, 6) along which it takes up weighted errors.
    """
    weights = np.repeat(shares, 8)
    taken_up = np.linalg.qr(weights[:, None] * J.reshape(-1, 6))[0]
    left = not_taken_up(taken_up, weights * residuals.ravel()) / weights
    return left.reshape(residuals.shape), taken_up


def shown_errors(now: _FittedCorners, former: _FittedCorners, bounds: FloatArray) -> tuple[ShownErrors, float]:
    """What the residuals of N markers and the ``former`` ones of the same markers show.

    Parameters
    ----------
    bounds : (N,) further weights of the residuals of both

    Returns
    -------
    that, and the share, 0 to 1, of the smooth error in the present residuals that was in the former ones
    """
    r_now, r_former = (np.repeat(bounds * of.corners.shares, 8) * of.residuals.ravel() for of in (now, former))
    count, common = len(r_now), now.taken_up.T @ former.taken_up
    smooth = np.vdot(now.smooth, former.smooth)
    sums = (
        r_now @ r_former,
        (r_now @ now.smooth) @ (r_former @ former.smooth),
        count - 12.0 + np.vdot(common, common),
        smooth,
        np.vdot(now.gram, former.gram),
    )
    share = float(smooth) / max(float(now.gram.trace()), TINY)
    return ShownErrors(*(float(value) / count for value in sums)), min(max(share, 0.0), 1.0)
