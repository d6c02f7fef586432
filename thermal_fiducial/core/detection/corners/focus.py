"""Focus of the camera: the blur of optics and pixels, as the sides of markers show it in flight.

A blurred step that is wider than its model leaves residuals that are odd about the edge, as contrast and level are, and
a displacement is not. So a blur that is wrong displaces no step that stands alone; but it displaces those that other
edges are near, and what is fitted of the pattern with them. The blur is one quantity for all markers and frames: it is
declared to some tenths, changes with the temperature of the lens, and one marker of 50 px shows it to two hundredths.
"""

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.corners.corner_errors import OF_LAG
from thermal_fiducial.core.detection.corners.side_fit import OF_CLEAR
from thermal_fiducial.core.detection.corners.sides import blur_of, EdgeModel, free_distance, model, sides_of
from thermal_fiducial.core.detection.prediction.frame import counts_of, Frame, MotionBlur
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.types import Float32Array, FloatArray, SECOND_NS, SIGMA_OF_MEDIAN, TINY

#: Standard deviation of the blur as declared, as a share of it; range of the blur, in declared ones.
FOCUS_STD, BLURS = 0.3, (0.5, 2.0)
# What frames of one focus differ by, as a share of the blur: the point spread is no Gaussian, and edges of plates are
# sharp or not. Rendered frames, markers of 24 to 135 px.
_OF_FRAME = 0.05
# Standard deviation by which it changes in a minute, as a share of it: a germanium lens of 13 mm and f/1.0 that warms
# by 1 K is out of focus by 1.5 um, a tenth of a pixel.
_IN_A_MINUTE = 0.1
# Time between two frames that are looked at [s], as a look takes as long as a fifth of a frame; standard deviation from
# which on each frame is, as a share of the blur.
_PERIOD_S, _UNKNOWN = 0.3, 0.1
# Distance from the edge up to which pixels count [blurs]; farther away they show nothing of it.
_NEAR = 3.0
# Least number of pixels of a segment, three times its unknowns, and of segments; greatest standard deviation of what
# one shows [blurs].
_FEWEST_PIXELS, _FEWEST_SEGMENTS, _UNSURE = 12, 8, 0.4
# Longest step [blurs]: the linearisation holds up to there. Motion blur [blurs of the optics] beyond which a marker
# shows little of it: at 0.7 a wrong time constant of the lag makes it 0.17 blurs wider, and 0.3 is what is declared.
_LONGEST, _MOST_MOTION = 0.3, 0.7
# Blur [declared ones] from which on the lens counts as out of focus: markers of 24 px are then 0.2 % too large or small
# where it is taken for declared.
_OUT_OF_FOCUS = 1.5
# Share of the information's diagonal that keeps segments without an edge solvable.
_RIDGE = 1e-6


class ShownBlur(NamedTuple):
    """What one frame shows."""

    #: how much wider the blur of the optics is than its model, and standard deviation [px]
    wider: float
    std: float


@dataclass(frozen=True, slots=True)
class Focus:
    """Estimate of the blur of optics and pixels [px], a scalar Kalman filter."""

    declared_px: float
    blur_px: float
    #: of the estimate [px^2]
    variance: float
    #: of the last frame that was looked at
    stamp_ns: int | None = None

    @staticmethod
    def as_declared(blur_px: float) -> 'Focus':
        """Before the first frame."""
        return Focus(blur_px, blur_px, (FOCUS_STD * blur_px) ** 2)

    @property
    def doubt(self) -> str:
        """That the lens is out of focus; empty while it is not known to be."""
        if self._is_unknown or self.blur_px < _OUT_OF_FOCUS * self.declared_px:
            return ''
        return (
            f'images blur by {self.blur_px:.1f} px, blur_px is {self.declared_px:.2g}: focus the lens, or set blur_px'
        )

    @property
    def _is_unknown(self) -> bool:
        return self.variance > (_UNKNOWN * self.blur_px) ** 2

    def due(self, stamp_ns: int) -> bool:
        """Whether a frame is to be looked at."""
        if self.stamp_ns is None or self._is_unknown:
            return True
        return not 0 <= stamp_ns - self.stamp_ns < _PERIOD_S * SECOND_NS

    def after(self, stamp_ns: int, shown: ShownBlur | None) -> 'Focus':
        """With one more frame that was looked at."""
        minutes = 0.0 if self.stamp_ns is None else max(stamp_ns - self.stamp_ns, 0) / (60.0 * SECOND_NS)
        now = replace(self, stamp_ns=stamp_ns, variance=self.variance + (_IN_A_MINUTE * self.blur_px) ** 2 * minutes)
        if shown is None:
            return now
        gain = now.variance / (now.variance + shown.std**2 + (_OF_FRAME * self.blur_px) ** 2)
        longest, (least, most) = _LONGEST * self.blur_px, BLURS
        step = gain * min(max(shown.wider, -longest), longest)
        blur_px = min(max(self.blur_px + step, least * self.declared_px), most * self.declared_px)
        # A step that is cut short leaves as much unknown.
        variance = now.variance if abs(shown.wider) > longest else (1.0 - gain) * now.variance
        return replace(now, blur_px=blur_px, variance=variance)


def shown_blur(frame: Frame, corners: ImagePoints, motion: MotionBlur, cells: int) -> ShownBlur | None:
    """The blur that the sides of N markers show; None if they show none.

    Parameters
    ----------
    frame : whose blur is the model
    corners : (N, 4) in its image, refined
    motion : their blur by motion
    cells : m along a side
    """
    still = motion.spread_px < _MOST_MOTION * frame.blur_px
    if not still.any():
        return None
    corners, motion = corners.only(still), motion.only(still)
    motion_px = motion.spread_px
    widest = math.hypot(frame.blur_px, motion_px.max())
    image = frame.pixels if motion.to_tails is None else frame.image
    sides = sides_of(corners.x, frame.camera, image.shape, cells, OF_CLEAR, widest)
    blur = blur_of(sides, frame.blur_px, motion.spread)
    near = np.minimum(free_distance(sides, blur.across), _NEAR * blur.across)
    counts = counts_of(sides.pixel, image, motion.to_tails)
    wider, std = _of_segments(counts, model(sides, blur, near, near), sides.distance / blur.across)
    # Of optics and motion together to that of the optics: the squares add up.
    share = (blur.across / frame.blur_px).ravel()
    wider, std = share * wider, share * std
    shown = std < _UNSURE * frame.blur_px
    number = int(np.count_nonzero(shown))
    if number < _FEWEST_SEGMENTS:
        return None
    middle = float(np.median(wider[shown]))
    # By their noise, and by what they differ in besides. A median has a quarter more error than a mean.
    own = float(np.median(std[shown]))
    scatter = SIGMA_OF_MEDIAN * float(np.median(np.abs(wider[shown] - middle)))
    of_median = 1.25 * math.hypot(own, scatter) / math.sqrt(number)
    return ShownBlur(middle, math.hypot(of_median, OF_LAG * float(motion_px.max()) ** 2 / frame.blur_px))


def _of_segments(counts: Float32Array, modelled: EdgeModel, blurs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """By how much the edges of S segments are wider (S,) than their model [px], and its standard deviation.

    Least squares over level, contrast, displacement and width.

    Parameters
    ----------
    counts : (M, C, E, m) of the pixels
    blurs : (M, C, E, m) distance from the edge
    """
    counting = modelled.counting
    by_width = -blurs * modelled.slope
    terms = np.stack([np.ones_like(by_width), modelled.value, modelled.slope, by_width]) * counting
    values = (counts - counts[len(counts) // 2, 0]) * counting
    # (S, 4, pixels) and (S, pixels): each segment by itself.
    A = terms.reshape(4, counts.shape[0] * counts.shape[1], -1).transpose(2, 0, 1)
    y = values.reshape(A.shape[2], -1).T
    information = A @ A.swapaxes(1, 2) + _RIDGE * np.eye(4)
    covariance = np.linalg.inv(information)
    amounts = (covariance @ (A @ y[..., None]))[..., 0]
    left = y - (amounts[:, None] @ A)[:, 0]
    number = counting.reshape(A.shape[2], -1).sum(axis=0)
    variance = (left * left).sum(axis=1) / np.maximum(number - 4, 1)
    usable = number >= _FEWEST_PIXELS
    # Of the typical segment: noise that makes a segment's own contrast larger makes its edge wider, too.
    contrast = float(np.median(amounts[usable, 1])) if usable.any() else 0.0
    if abs(contrast) < TINY:
        return np.zeros(len(number)), np.full(len(number), np.inf)
    std = np.where(usable, np.sqrt(variance * covariance[:, 3, 3]) / abs(contrast), np.inf)
    return np.asarray(amounts[:, 3] / contrast), std
