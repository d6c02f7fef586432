"""Rolling read-out: the rows of a bolometer array are sampled one after the other.

The stamp is that of the middle row. Row v is seen d later, and what moves is carried on as far by then. Under constant
motion that is an affine map of the image: straight sides stay straight, and shifts of the corners say it all.
"""

import numpy as np

from thermal_fiducial.core.detection.frame import Frame, Places
from thermal_fiducial.core.detection.twist import interaction, Twist
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.types import FloatArray


def delays(rows: FloatArray, frame: Frame) -> FloatArray:
    """How long after the stamp ``rows`` (...) are seen [s]."""
    return frame.readout * (rows / (frame.camera.height - 1) - 0.5)


def stretch(places: Places, twist: Twist, frame: Frame) -> FloatArray:
    """How much longer (N, 4) ways in the image are for what runs with the read-out, or shorter against it."""
    return np.asarray(1.0 / (1.0 - frame.readout / (frame.camera.height - 1) * places.velocity(twist)[..., 1]))


def lag_tail(places: Places, twist: Twist, frame: Frame) -> FloatArray:
    """:meth:`Places.lag_tail` (N, 4, 2) [px] in an image whose rows are seen one after the other."""
    still = places.lag_tail(twist, frame.lag)
    return still * stretch(places, twist, frame)[..., None] if frame.readout > 0.0 else still


def displacement(places: Places, twist: Twist, frame: Frame, seconds: FloatArray) -> FloatArray:
    """By how much (N, 4, 2) corners appear farther on [px] when they are seen ``seconds`` (N, 4) after the stamp.

    What lag holds back has the velocity of one time constant earlier.
    """
    later = seconds[..., None]
    middle = places.at.x + 0.5 * later * (interaction(places.at.x, places.depth) @ twist.value)
    flow = Places.of(ImagePoints.seen_at(middle, frame.camera), places.depth).flow
    return np.asarray(later * (flow @ twist.value - (frame.lag - 0.5 * later) * (flow @ twist.acceleration)))


def expected_displacement(places: Places, twist: Twist | None, frame: Frame) -> FloatArray:
    """The same (N, 4, 2) [px] for the rows in which corners will be seen, lag included."""
    if frame.readout == 0.0 or twist is None:
        return np.zeros_like(places.at.px)
    rows = places.at.px[..., 1] + places.lag_blur(twist, frame.lag)[..., 1]
    return displacement(places, twist, frame, delays(rows, frame) * stretch(places, twist, frame))


def seen_displacement(places: Places, twist: Twist | None, frame: Frame, rows: FloatArray) -> FloatArray:
    """The same (N, 4, 2) [px] for the ``rows`` (N, 4) in which corners are seen."""
    if frame.readout == 0.0 or twist is None:
        return np.zeros_like(places.at.px)
    return displacement(places, twist, frame, delays(rows, frame))
