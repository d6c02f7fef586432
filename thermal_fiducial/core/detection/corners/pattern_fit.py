"""Fit of whole patterns: corners of small markers, and alignment of inaccurate outlines.

No side of a marker whose cells are hardly wider than the blur can be measured by itself: the cells behind it and the
end of the warm surface before it reach into its pixels, the more the camera is out of focus. So the blurred pattern is
fitted to the pixels: Gauss-Newton on corners and blur, and on all that is linear.

The share of the variance that the pattern leaves is the evidence. A square with any other content leaves a share below
r with a probability of the order of r^(v/2), where v is the number of independent values that the fit leaves free, at
most one a bit: -v/2 log r is the log-likelihood ratio of the marker over such a square.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.corners.blurred_patterns import (
    BENDS,
    BLUR,
    cell_weights,
    CORNERS,
    LARGEST_OF_CURVES,
    LARGEST_OF_LEVEL,
    LINEAR,
    pattern_grid,
    PatternGrid,
    PatternView,
    SMALL,
)
from thermal_fiducial.core.detection.corners.corner_errors import (
    CONTRAST_BENDS,
    GRAY_BENDS,
    LEVEL_BENDS,
    OF_DISPLAYED_PATTERN_PX,
    OF_PATTERN_PX,
    RefinedCorners,
    SURFACE_FALLS,
)
from thermal_fiducial.core.detection.corners.focus import BLURS, FOCUS_STD
from thermal_fiducial.core.detection.corners.pattern_residuals import PatternResiduals, residuals_at
from thermal_fiducial.core.detection.corners.side_fit import too_small_for_sides
from thermal_fiducial.core.detection.corners.squares import as_squares
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.prediction.frame import Frame
from thermal_fiducial.core.detection.prediction.known_markers import FoundMarkers
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.reprojection import diagonals, sides_px, squared_sides, widths
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, TINY

# Bound on the number of false markers in a picture, were all of it squares with a black border around random bits.
_FALSE_MARKERS = 0.01
# Distance of samples [px]: 0.85 px gives no better corners; least and largest number of them along a cell. Where cells
# are wider, they are near the lines between cells, at about this distance [blurs].
_APART_PX, _FEWEST, _MOST = 1.0, 3, 6
_APART = 1.3
# Steps of a fit, and length of the step of a corner after which there is no further one [px], in counts and in pictures
# for a display. Size and focus converge slowly together: in counts 0.03 px would leave 0.2 per mille more of the size
# of 22 px. On displays corners are as good with 0.05 as with 0.02 px.
_STEPS, _CONVERGED_PX = 8, (0.02, 0.05)
# A step by a new sample of the image alone that is not shorter than this share of the last one is no further one:
# OpenCV interpolates at thirty-seconds of a pixel, by which such steps may go to and fro by up to 0.03 px.
_SHORTER = 0.5
# Length of a step of the corners [px], and distance of the blur from that of the pattern as it is modelled [blurs of
# the optics], up to which that is still the same: the image is sampled again, and nothing else. After 0.3 px, markers
# out of focus would be off by 0.5 to 1.3 per mille. The pattern of a blur that is a third too small makes them 4 per
# mille too large, and the error is a square.
_SAME_PX, _SAME_BLUR = 0.1, 0.05
# The same where cells are wider than so many blurs of optics and motion: a blur that is wrong displaces no edge there.
# With 0.3, or from 6 blurs on, markers are up to 0.02 px smaller. A blur takes many steps to find, as gray scales that
# are bent bend edges alike.
_ALONE, _SAME_ALONE = 7.5, 0.2
# Steps of an alignment. Damping: share of the information's diagonal that is added to it.
_OF_ALIGNMENT, _DAMPING = 3, 0.1
# Standard deviation of the shape of a predicted outline [cells]: a prediction that is 2 cm and 1 deg off makes a marker
# a metre away 0.06 cells larger or smaller and turns it by 0.05. Its place may be anywhere.
_SHAPE = 0.1
# Blur of the pattern in an alignment, so wide that it reaches an edge half a cell away [cells].
_WIDE = 0.25
# Smoothing of the image for it, in pixels and at most in cells; least width of cells [px].
_SMOOTHING_PX, _SMOOTHING, _LEAST_CELL_PX = 1.0, 0.4, 0.5
# Longest step of a corner [cells] and of the blur [blurs of the optics].
_LONGEST, _LONGEST_BLUR = 0.6, 0.3
# Standard deviation of the corners from where they are looked for [cells].
_START = 0.5
# Standard deviations of amounts that are small, as shares of the contrast: in counts, and in pictures for a display.
_LEVEL_STD, _BENDS_STD = LEVEL_BENDS / LARGEST_OF_LEVEL, np.full(BENDS, GRAY_BENDS)
_SMALL_STD = (
    np.concatenate([_LEVEL_STD, SURFACE_FALLS / LARGEST_OF_CURVES[:1]]),
    np.concatenate([_LEVEL_STD, CONTRAST_BENDS / LARGEST_OF_CURVES, _BENDS_STD]),
)
# Parameters of a fit: corners, blur, contrast, warm surface, level, background. A fit to something that is not there
# makes use of fewer, as outlines bound the corners: with 9 the evidence in textures is alike from 5 to 12 px, with 5 it
# is higher below 8.
_PARAMETERS, _OF_CHANCE = 20, 9
# Least share of the variance that counts as left: no model is better.
_LEAST = 1e-6
# Residuals over the noise of a pixel beyond which they are more than noise.
_MISFIT = 4.0
# Share of the largest information that is added to all, for sums in single precision.
_SINGULAR = 1e-9
# Displacement from where a marker was decoded up to which it was decoded there [cells].
_NEAR = 0.1
_EYE = np.eye(2)
# What all corners (u of all, v of all) have in common, taken out.
_WITHOUT_MEAN = np.kron(_EYE, np.eye(4) - 0.25)


class _Prior(NamedTuple):
    """What is known of Q markers before the fit."""

    #: (Q, 4, 2) [px], and standard deviation (Q,) of each coordinate
    corners_px: FloatArray
    corners_std: FloatArray
    blur_px: float

    def normal_equations(self, residuals: PatternResiduals) -> tuple[FloatArray, FloatArray]:
        """Those of the residuals and the prior together, (Q, K, K) and (Q, K, 1), for samples with a variance of 1."""
        precision, off = self._precision(residuals), np.zeros(residuals.J.shape[:2])
        off[:, CORNERS] = (residuals.corners_px - self.corners_px).swapaxes(1, 2).reshape(-1, 8)
        off[:, BLUR], off[:, LINEAR][:, SMALL] = residuals.blur - self.blur_px, residuals.amounts[:, SMALL]
        information = residuals.information.copy()
        np.einsum('qii->qi', information)[:] += precision
        return _solvable(information), _gradient(residuals) + (precision * off)[..., None]

    def _precision(self, residuals: PatternResiduals) -> FloatArray:
        """Inverse variances (Q, K), for samples with a variance of 1."""
        precision = np.zeros(residuals.J.shape[:2])
        precision[:, CORNERS] = 1.0 / self.corners_std[:, None] ** 2
        precision[:, BLUR] = 1.0 / (FOCUS_STD * self.blur_px) ** 2
        of_contrast = 1.0 / (residuals.contrast * residuals.contrast + TINY)
        small = _SMALL_STD[residuals.unevenness is not None]
        precision[:, LINEAR][:, SMALL] = (1.0 / small) ** 2 * of_contrast[:, None]
        return precision * _variance_of_samples(residuals, self.blur_px)[:, None]


class PatternFit(NamedTuple):
    """Fits of Q markers."""

    #: (Q, 4, 2) [px], and their covariances (Q, 8, 8) [px^2]
    corners_px: FloatArray
    covariance: FloatArray
    #: (Q,) white minus black, and standard deviation of a pixel about the model [counts]
    contrast: FloatArray
    noise: FloatArray
    #: (Q,) length of the last step of a corner [px]
    step_px: FloatArray
    #: at the corners
    residuals: PatternResiduals


def nearness(corners_px: FloatArray, cells: int, blurs_px: FloatArray) -> IntArray:
    """How many times markers (N, 4, 2) are sampled twice as near the lines between cells, by their blurs (N,) [px]."""
    apart = sides_px(corners_px) / (cells * _MOST) / (_APART * blurs_px)
    return np.maximum(np.rint(np.log2(np.maximum(apart, 1.0))), 0.0).astype(np.int64)


def sample_grid(cell_px: FloatArray, cells: int, nearer: int) -> PatternGrid:
    """Samples of markers of m x m ``cells``, which are so wide (N,), as ``nearer`` to the lines between cells."""
    density = max(_FEWEST, math.ceil(float(cell_px.max(initial=0.0)) / _APART_PX))
    return pattern_grid(cells, min(density, _MOST), nearer)


def fitted_patterns(
    frame: Frame,
    found: FoundMarkers,
    start: ImagePoints,
    rolling: FloatArray,
    view: PatternView,
    nearer: int,
    decoder: Decoder,
) -> RefinedCorners:
    """Corners of N markers by their patterns, and of small ones what evidence of the markers these are.

    Parameters
    ----------
    found : (N,)
    start : (N, 4) corners in the image, accurate to half a cell
    rolling : (N, 4, 2) what the rolling shutter displaces them by [px]
    view : the image; of raw counts, without lag tails
    nearer : of :func:`nearness`, the same for all
    """
    fit = fit_patterns(view, start.px, found.ids, decoder, frame.blur_px, nearer)
    # The two constraints of a square in space hold for them, too.
    square = as_squares(start.at_pixels(fit.corners_px - rolling), np.zeros((len(found.ids), 8, 1)), fit.covariance)
    floor = OF_DISPLAYED_PATTERN_PX if frame.displayed else OF_PATTERN_PX
    corners = fit.corners_px + square.moved.reshape(-1, 4, 2)
    doubt = square.doubt * squared_sides(corners).mean(axis=1)
    doubt = np.where(fit.step_px > _CONVERGED_PX[frame.displayed], np.maximum(doubt, fit.step_px**2), doubt)
    off = np.abs(corners - start.px).max(axis=(1, 2)) * decoder.cells / sides_px(start.px)
    covariances = square.corner_covariances + floor**2 * _EYE
    small = too_small_for_sides(start.px, decoder.cells, frame.blur_px)
    evident, refuted = small & found.certain & (off < _NEAR), np.zeros(len(small), dtype=bool)
    others = np.flatnonzero(small & ~evident)
    if len(others):
        evident[others], refuted[others] = _verdicts(fit, found, others, frame, decoder)
    return RefinedCorners(corners, covariances, fit.contrast, fit.noise, doubt, small, evident, refuted)


def fit_patterns(
    view: PatternView, quads: FloatArray, ids: IntArray, decoder: Decoder, blur_px: float, nearer: int = 0
) -> PatternFit:
    """Fits of the markers ``ids`` (Q,), upright in ``quads`` (Q, 4, 2), which are accurate to half a cell."""
    white, blur = decoder.patterns(ids, np.zeros_like(ids)), np.full(len(ids), blur_px)
    cell = sides_px(quads) / decoder.cells
    grid = sample_grid(cell, decoder.cells, nearer)
    prior = _Prior(quads, np.maximum(_START * cell, TINY), blur_px)
    blurs_px = blur_px if view.motion is None else np.hypot(blur_px, np.hypot(*view.motion.T))
    residuals = residuals_at(view, quads.copy(), blur, white, grid)
    # Which samples are known changes with the corners.
    alone = (widths(quads) > _ALONE * blurs_px * decoder.cells) & residuals.known.all(axis=1)
    same_px, same_blur = (np.where(alone, _SAME_ALONE, same) for same in (_SAME_PX, _SAME_BLUR))
    converged_px, last = _CONVERGED_PX[view.displayed], np.full(len(quads), np.inf)
    for left in reversed(range(_STEPS)):
        information, product = prior.normal_equations(residuals)
        move = _step(information, product)
        quads, blur = _moved(residuals, move, blur_px)
        step = np.abs(quads - residuals.corners_px).max(axis=(1, 2))
        far = (step > same_px) | (np.abs(blur - residuals.blur) > same_blur * blur_px)
        anew, again = np.flatnonzero(far), np.flatnonzero(~far & (step > converged_px) & (step < _SHORTER * last))
        last = step
        if left == 0 or not len(anew) + len(again):
            break
        if len(anew):
            residuals.put(anew, residuals_at(view.only(anew), quads[anew], blur[anew], white[anew], grid))
        if len(again):
            residuals.sample_at(view, quads[again], again)
    residuals = residuals.moved(move)
    covariance = _covariance(residuals, information, blur_px)
    return PatternFit(
        quads, covariance, residuals.contrast, np.sqrt(_noise_variance(residuals, blur_px)), step, residuals
    )


def aligned(
    image: Float32Array,
    quads: FloatArray,
    ids: IntArray,
    turns: IntArray,
    decoder: Decoder,
    steps: int = _OF_ALIGNMENT,
    *,
    predicted: bool = False,
) -> FloatArray:
    """Inaccurate outlines (Q, 4, 2), moved to where the patterns of their markers are.

    The outline of a faint marker may have a corner or two wrong by up to a cell.

    Parameters
    ----------
    image : (height, width) counts
    ids, turns : (Q,) markers, and the quarter turns in which the outlines show them
    steps : number of them
    predicted : whether the outlines are in the wrong place rather than of the wrong shape. Something that covers a part
        of a marker then does not draw its corners there.
    """
    white, grid = decoder.patterns(ids, turns), pattern_grid(decoder.cells, _FEWEST, bent=True)
    cell = np.maximum(diagonals(quads) / (math.sqrt(2.0) * decoder.cells), _LEAST_CELL_PX)
    smoothing = min(_SMOOTHING_PX, _SMOOTHING * float(np.median(cell)))
    view = PatternView(np.asarray(cv2.GaussianBlur(image, (0, 0), smoothing), dtype=np.float32))
    start, blur = quads, _WIDE * cell
    wide = blur
    for _ in range(steps):
        residuals = residuals_at(view, quads, blur, white, grid)
        information, gradient = residuals.information, _gradient(residuals)
        if predicted:
            _hold_shape(information, gradient, residuals, start, _SHAPE * cell)
        diagonal = np.einsum('qii->qi', information)
        diagonal *= 1.0 + _DAMPING
        quads, blur = _moved(residuals, _step(_solvable(information), gradient), wide)
    return quads


def _hold_shape(
    information: FloatArray, gradient: FloatArray, residuals: PatternResiduals, start: FloatArray, std_px: FloatArray
) -> None:
    """Add to the normal equations (Q, K, K), (Q, K, 1) that outlines have the shapes of ``start`` (Q, 4, 2).

    Where the model misses a cell, it misses all of its samples. ``std_px`` (Q,): of the shapes.
    """
    variance = _FEWEST**2 * (residuals.rest * residuals.rest).mean(axis=1, dtype=np.float64)
    precision = (variance / std_px**2)[:, None, None] * _WITHOUT_MEAN
    off = (residuals.corners_px - start).swapaxes(1, 2).reshape(-1, 8, 1)
    information[:, CORNERS, CORNERS] += precision
    gradient[:, CORNERS] += precision @ off


def _noise_variance(residuals: PatternResiduals, blur_px: float) -> FloatArray:
    """Variance (Q,) of a pixel about the model.

    Neighbouring pixels that the model misses, it misses together: as many residuals as there are independent values.
    """
    independent = _independent(residuals, blur_px)
    mean_square = (residuals.rest * residuals.weighted).sum(axis=1) / residuals.number
    return np.asarray(mean_square * independent / np.maximum(independent - _PARAMETERS, 1.0))


def _variance_of_samples(residuals: PatternResiduals, blur_px: float) -> FloatArray:
    """Variance (Q,) that samples would have, were they independent and said as much as the pixels."""
    return np.asarray(_noise_variance(residuals, blur_px) / residuals.apart_px**2)


def _independent(residuals: PatternResiduals, blur_px: float) -> FloatArray:
    """Number (Q,) of independent values: pixels over what blur averages over, its noise-equivalent area."""
    return np.asarray(residuals.pixels / (4.0 * math.pi * np.minimum(residuals.blur, blur_px) ** 2))


def _covariance(residuals: PatternResiduals, information: FloatArray, blur_px: float) -> FloatArray:
    """Covariance (Q, 8, 8) of the corners [px^2], by the ``information`` (Q, K, K) of samples with a variance of 1.

    Neighbouring pixels that the model misses, it misses together: within a blur, or within a patch if that is more,
    as behind smoke.
    """
    inverse: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
    variance = np.maximum(_variance_of_samples(residuals, blur_px), _variance_by_patches(residuals, inverse))
    covariance = inverse[:, CORNERS, CORNERS] * variance[:, None, None]
    # From u of all corners and v of all of them to u and v of each.
    return np.asarray(covariance.reshape(-1, 2, 4, 2, 4).transpose(0, 2, 1, 4, 3).reshape(-1, 8, 8))


def _variance_by_patches(residuals: PatternResiduals, inverse: FloatArray) -> FloatArray:
    """Variance (Q,) that samples would have if each patch missed the model as a whole, independently of the others.

    The squares of what the residuals of single patches move the corners by are added (K.-Y. Liang, S. Zeger,
    "Longitudinal data analysis using generalized linear models", 1986). ``inverse`` (Q, K, K): of the information.
    """
    by_patches = (
        residuals.grid.patches(residuals.J).swapaxes(1, 2) @ residuals.grid.patches(residuals.weighted)[..., None]
    )
    moved = inverse[:, CORNERS] @ by_patches[..., 0].swapaxes(1, 2)
    # So much of what patches miss is left by a fit of so many parameters.
    left = 1.0 - (residuals.J.shape[1] - residuals.grid.background.shape[1]) / moved.shape[2]
    claimed = np.maximum(np.trace(inverse[:, CORNERS, CORNERS], axis1=1, axis2=2), TINY)
    return np.asarray((moved * moved).sum(axis=(1, 2)) / (left * claimed), dtype=np.float64)


def _gradient(residuals: PatternResiduals) -> FloatArray:
    """Derivative (Q, K, 1) of half the sum of the squared residuals, which is least over all that is linear."""
    gradient = np.zeros((*residuals.J.shape[:2], 1))
    nonlinear = slice(LINEAR.start)
    np.negative(residuals.J[:, nonlinear] @ residuals.weighted[..., None], out=gradient[:, nonlinear])
    return gradient


def _solvable(information: FloatArray) -> FloatArray:
    """``information`` (Q, K, K), in place, so that it has an inverse where the image has no gradient in a direction."""
    diagonal = np.einsum('qii->qi', information)
    diagonal += _SINGULAR * (1.0 + diagonal.max(axis=1, keepdims=True))
    return information


def _step(information: FloatArray, gradient: FloatArray) -> FloatArray:
    """Gauss-Newton step (Q, K)."""
    return np.asarray(-np.linalg.solve(information, gradient)[..., 0], dtype=np.float64)


def _moved(residuals: PatternResiduals, step: FloatArray, blur_px: float | FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners (Q, 4, 2) and blur (Q,) after a step (Q, K), which is limited."""
    longest = _LONGEST * (residuals.apart_px / residuals.grid.apart)[:, None]
    corners = residuals.corners_px + np.clip(step[:, CORNERS], -longest, longest).reshape(-1, 2, 4).swapaxes(1, 2)
    wider = np.clip(step[:, BLUR], -_LONGEST_BLUR * blur_px, _LONGEST_BLUR * blur_px)
    return corners, np.clip(residuals.blur + wider, BLURS[0] * blur_px, BLURS[1] * blur_px)


def _verdicts(
    fit: PatternFit, found: FoundMarkers, which: IntArray, frame: Frame, decoder: Decoder
) -> tuple[BoolArray, BoolArray]:
    """Which fits at places ``which`` are evidence enough, of all markers and places that might be one by chance.

    And which are none although the image is clear: more than noise is left, and something else may be there as well.
    """
    height, width = frame.image.shape
    evidence, lead = evidence_of(fit.residuals, which, found.ids, decoder, frame.blur_px)
    places = height * width / np.maximum(sides_px(fit.corners_px[which]) ** 2, 1.0)
    tried = 4.0 * decoder.count * np.where(found.expected[which], 1.0, places)
    evident = (evidence > np.log(tried / _FALSE_MARKERS)) & (lead > -math.log(_FALSE_MARKERS))
    doubtful = np.minimum(evidence, lead) < -math.log(_FALSE_MARKERS)
    return evident, doubtful & (fit.noise[which] > _MISFIT * frame.noise)


def evidence_of(
    residuals: PatternResiduals, which: IntArray, ids: IntArray, decoder: Decoder, blur_px: float
) -> tuple[FloatArray, FloatArray]:
    """Log-likelihood ratios (W,) over a square with other content, and over the likeliest other marker or turn."""
    free = np.clip(_independent(residuals, blur_px)[which] - _OF_CHANCE, 0.0, (decoder.cells - 2) ** 2)
    left = 1.0 - _explained(residuals, which, decoder)
    mine = np.arange(len(which)), 4 * ids[which]
    own = np.maximum(left[mine], _LEAST)
    left[mine] = 1.0
    other = np.maximum(left.min(axis=1), _LEAST)
    content = np.maximum(_content(residuals, decoder.cells)[which], _LEAST)
    return 0.5 * free * np.log(content / own), 0.5 * free * np.log(other / own)


def _content(residuals: PatternResiduals, cells: int) -> FloatArray:
    """Share (Q,) of the variance that a border around a plain square, each of any gray, leaves: that of the bits."""
    inner = np.pad(np.ones((cells - 2, cells - 2)), 1)
    squares = np.stack([np.ones((cells, cells)), inner])
    x, y = _weights(residuals, cells)
    drawn = y[:, None] @ squares @ x.swapaxes(1, 2)[:, None]
    drawn = residuals.grid.by_patches(drawn.reshape(len(residuals.samples), 2, -1).astype(np.float32))
    shown = residuals.grid.without_background(drawn)
    product = shown @ residuals.samples[..., None]
    explained = product.swapaxes(1, 2) @ np.linalg.solve(shown @ shown.swapaxes(1, 2) + TINY * np.eye(2), product)
    return np.asarray(1.0 - explained[:, 0, 0] / np.maximum((residuals.samples * residuals.samples).sum(axis=1), TINY))


def _explained(residuals: PatternResiduals, which: IntArray, decoder: Decoder) -> FloatArray:
    """Shares (W, 4 M) of the variance that each marker's pattern explains in each turn, at the same corners."""
    black = decoder.black
    flat = black.reshape(len(black), -1)
    background = residuals.grid.by_rows(residuals.grid.background.T)
    shares = np.empty((len(which), len(black)))
    residuals = residuals.only(which)
    for row, (samples, x, y) in enumerate(zip(residuals.samples, *_weights(residuals, decoder.cells), strict=True)):
        product = flat @ (y.T @ residuals.grid.by_rows(samples) @ x).ravel()
        size = ((y.T @ y) @ black @ (x.T @ x)).reshape(len(black), -1)
        size = (size * flat).sum(axis=1) - ((flat @ (y.T @ background @ x).reshape(3, -1).T) ** 2).sum(axis=1)
        shares[row] = product * product / np.maximum(size * (samples @ samples), TINY)
    return shares


def _weights(residuals: PatternResiduals, cells: int) -> Float32Array:
    """Weights (2, Q, S, m) of cells at samples along rows and along columns; the form of a lag is left out."""
    return cell_weights(residuals.grid.along, cells, residuals.spread)[:, :, 0]
