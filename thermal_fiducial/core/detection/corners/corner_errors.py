"""Refined corners of markers, and errors of the detector in them beyond the noise of pixels, fit and motion.

Each error has its unit and source here, and enters where its name is used.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, Stacked, TINY

#: A corner by its four sides, an edge between two cells, and a corner of a partially visible marker by such edges
#: [px]: the blur of the optics is not quite a Gaussian. Behind the diffraction of a perfect lens of f/1.0 to f/1.6,
#: corners of markers of 45 and 80 px are 0.006 to 0.013 px off, without noise.
OF_SIDES_PX = 0.010
#: Part of that error that the four sides of a marker have in common [px].
OF_ALL_SIDES_PX = 0.005
#: A corner by the whole pattern of a small marker [px]: the blur of the optics is not quite a Gaussian. Rendered frames
#: without noise.
OF_PATTERN_PX = 0.006
#: A corner by the whole pattern in a picture for a display [px]: gray levels there are a nonlinear function of the
#: counts, and sheets are bent. Photos of a room and of a carpet, against the same at full resolution.
OF_DISPLAYED_PATTERN_PX = 0.05
#: A side of a partially visible marker in a picture for a display, a nonlinear function of the counts [px]: if its
#: middle gray lies anywhere between a fifth and four fifths of the original step, a step blurred by 0.66 px is
#: displaced by up to 0.55, evenly spread.
OF_BENT_SCALE_PX = 0.3
#: Corners of a marker whose contrast is uneven, by smoke before it or by what it hangs in front of [px over the share
#: by which the contrast changes from cell to cell]. A blurred step whose contrast has a slope, fitted without one in
#: pixels up to a cell away, is displaced by 0.7 of what the contrast changes in a cell; a slope of the level displaces
#: nothing.
OF_UNEVEN_CONTRAST_PX = 0.7
#: Standard deviation of what the warm surface falls by, from the middle of a marker to its corners, as a share of the
#: contrast. Where a heater ends 5 cm inside the edge of its sheet, that edge is 6 to 11 % cooler: 1 - 1 / cosh of 5 cm
#: over sqrt(k t / h), for t = 2 to 1 mm of aluminium, k = 200 W/(m K), h = 20 W/(m2 K) of still air and radiation on
#: both sides (F. Incropera, D. DeWitt, "Fundamentals of Heat and Mass Transfer", on fins).
SURFACE_FALLS = 0.1
#: Standard deviation of what the level in the corners of a marker is off a linear one, as a share of the contrast, by
#: smoke before it. Behind smoke that hides 0.6 of the warmth and changes by a third of that within 20 px, any larger
#: value leaves the same errors of clear markers, and faint ones pay for it without smoke.
LEVEL_BENDS = 0.03
#: Standard deviation of what the contrast is off a linear one at the sides of a marker in a picture for a display, as a
#: share of it, by the shares of the warmth that smoke lets through: 0.1 to 0.4 within 20 px behind dense smoke. With
#: 0.3 and 1 corners there are the same to 5 %.
CONTRAST_BENDS = 0.5
#: Standard deviation of the amounts that bend the gray scale of a picture for a display, as shares of the contrast: by
#: a quadratic of 1, the scale begins or ends with a slope of 0.
GRAY_BENDS = 1.0
#: A side by a gradient of the contrast across it [px^2]: a step with a slope on one side, fitted as a step blurred by
#: 0.75 px in pixels up to four blurs away, is displaced by 1.4 to 2.0 px^2 times the slope over the step. The slope
#: looks like contrast too [px]: a step of nothing has 2 px of the slope. Both grow with the distance of the pixels.
OF_GRADIENT_PX2, GRADIENT_AS_CONTRAST_PX = 2.0, 2.0
#: The time constant of the lag, and the displacement of an edge by a response that is no exponential, both as shares of
#: the motion blur. Rendered frames of a lag in steps, and of one of 14 ms taken for 10: corners with 2 to 8 px of blur
#: are displaced by 0.010 to 0.014 of it, along the motion and across.
OF_LAG, OF_LAG_FORM = 0.35, 0.014
#: The latter in pictures for a display, whose gray scale is known to 1 to 3 % of the contrast: lag tails that are wrong
#: by so much displace corners by about as large a share of the blur.
OF_DISPLAYED_LAG_FORM = 0.03
#: Shape of a marker in a picture for a display by a displacement by lag that is wrong for all its corners alike, as a
#: share of it: motion blur remains, along the motion alone. Rendered frames of markers of 17 to 57 px, without noise,
#: with the true motion but for 0.25 to 1 px: 0.10 to 0.2 of that (rms).
OF_DISPLAYED_LAG = 0.15
#: Displacement of a corner by motion blur that is not modelled [px], over the residuals that it leaves [contrasts], and
#: the residuals beyond which they hardly grow with it. Measured: 0.015 at rest, 0.05 at 1.5 px of blur, 0.08 at 6 px.
BLUR_THAT_SHOWS, BLURRED_OUT = 20.0, 0.055
#: Displacement by motion blur of any marker that can be read, in cells: nine of ten are off by less than 0.65 where no
#: motion is modelled.
READABLE_CELLS = 0.4

_EYE = np.eye(2)


@dataclass(frozen=True, slots=True)
class RefinedCorners(Stacked):
    """Corners of N markers.

    Parameters
    ----------
    corners_px : (N, 4, 2)
    covariances : (N, 4, 2, 2) [px^2]
    contrast : (N,) white minus black [counts]
    noise : (N,) standard deviation of a pixel about the model [counts]
    doubt : (N,) additional variance where the outline is inconsistent with a square, or has not converged, else 0;
        not in covariances [px^2]
    small : (N,) whether their sides are too small to be measured, so that the fit of their pattern is the evidence
    evident : (N,) whether it is enough
    refuted : (N,) whether the image is clear, and something else than the marker fits about as well
    """

    corners_px: FloatArray
    covariances: FloatArray
    contrast: FloatArray
    noise: FloatArray
    doubt: FloatArray
    small: BoolArray
    evident: BoolArray
    refuted: BoolArray

    @property
    def mean_variance(self) -> FloatArray:
        """Mean variance (N,) of the corners' coordinates [px^2]."""
        return np.asarray(self.covariances.diagonal(axis1=-2, axis2=-1).mean(axis=(1, 2)))

    @staticmethod
    def by_edges(
        corners_px: FloatArray,
        covariances: FloatArray,
        contrast: FloatArray,
        noise: FloatArray,
        doubt: FloatArray,
    ) -> 'RefinedCorners':
        """Corners whose edges were fitted, not their pattern."""
        no = np.zeros(len(corners_px), dtype=bool)
        return RefinedCorners(corners_px, covariances, contrast, noise, doubt, no, no, no)

    @staticmethod
    def none() -> 'RefinedCorners':
        """No corners."""
        no = np.zeros(0)
        return RefinedCorners.by_edges(np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2)), no, no, no)


def of_motion_blur(
    by_twist: FloatArray, twist_covariance: FloatArray, lag_blur_px: FloatArray, *, displayed: bool
) -> FloatArray:
    """Covariances (N, 4, 2, 2) [px^2] of corners that are freed of their motion blur.

    A wrong twist displaces them, and a wrong time constant along their blur. What they have in common no marker shows,
    and covariances of single corners cannot say; of the time constant it is a delay, and belongs to the filter's time
    offset. The differences change the marker's shape. So does a response that is not exponential, and on displays the
    blur that a wrong twist leaves.

    Parameters
    ----------
    by_twist : (N, 4, 2, 6) derivative of the blur by the twist [px]
    twist_covariance : (6, 6)
    lag_blur_px : (N, 4, 2)
    displayed : whether in a picture for a display
    """
    of_all = by_twist.mean(axis=1, keepdims=True)
    of_shape = by_twist - of_all
    unknown = of_shape @ twist_covariance @ of_shape.swapaxes(-1, -2)
    common = lag_blur_px.mean(axis=1, keepdims=True)
    change = OF_LAG * (lag_blur_px - common)
    of_form, of_wrong = (OF_DISPLAYED_LAG_FORM, OF_DISPLAYED_LAG) if displayed else (OF_LAG_FORM, 0.0)
    wrong = np.trace(of_all @ twist_covariance @ of_all.swapaxes(-1, -2), axis1=-2, axis2=-1)
    form = (of_form**2 * (common * common).sum(axis=-1) + of_wrong**2 * wrong)[..., None, None] * _EYE
    return np.asarray(unknown + change[..., :, None] * change[..., None, :] + form)


def unknown_motion(
    displacement: FloatArray, twist_covariance: FloatArray, unsharpness: FloatArray, cell_px: FloatArray
) -> FloatArray:
    """Covariances (N, 4, 2, 2) [px^2] of corners by the displacement of a nearly unknown motion.

    Sharp edges and readable cells bound it. All corners of a frame are displaced alike, which covariances of single
    corners cannot express: their mean is less accurate than these suggest.

    Parameters
    ----------
    displacement : (N, 4, 2, 6) derivative of the displacement by the twist [px]
    twist_covariance : (6, 6)
    unsharpness : (N,) residuals of pixels across the sides, in contrasts
    cell_px : (N,) width of a cell
    """
    covariance = displacement @ twist_covariance @ np.swapaxes(displacement, -1, -2)
    variance = 0.5 * np.trace(covariance, axis1=-2, axis2=-1)
    sharp = np.where(unsharpness < BLURRED_OUT, BLUR_THAT_SHOWS * unsharpness, np.inf)
    shown = np.minimum(sharp, READABLE_CELLS * cell_px)[:, None] ** 2
    return np.asarray(covariance * np.minimum(shown / np.maximum(variance, TINY), 1.0)[..., None, None])
