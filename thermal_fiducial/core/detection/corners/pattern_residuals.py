"""How pixels differ from the blurred patterns of markers, and what would change that.

Smoke in front of a marker makes level and contrast uneven in no way that a formula foresees, and a gain control makes
more of it. In pictures for a display they may differ from linear ones around each node of the pattern, where cells
meet, by what the marker itself shows.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.detection.corners.blurred_patterns import (
    BLUR,
    blurred,
    cells_by_pixels,
    CORNERS,
    LINEAR,
    linear_terms,
    local_contrast,
    PatternGrid,
    PatternView,
)
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, Stacked, TINY

# Least local contrast, as a share of that of the whole marker: gray levels rise with counts. Without it, fits of
# markers behind dense smoke end up to 2 px off.
_LEAST_CONTRAST = 0.1


@dataclass(frozen=True, slots=True)
class Unevenness(Stacked):
    """Level and contrast of Q markers that differ from patch to patch of a grid, beside what is linear.

    They differ independently, with variances that the residuals show (analysis of variance with random effects: S.
    Searle, G. Casella, C. McCulloch, "Variance Components", 1992). So residuals have a covariance of noise and of these
    differences, whose inverse, for noise with a variance of 1, is I - F F^T in each patch: generalised least squares.
    """

    #: (Q, n * n, P / (n * n), 2) F: a constant and the pattern without its mean, the longer the more these differ
    differing: Float32Array
    #: (Q, n * n) what the contrast of each patch is more than the linear one
    more_contrast: Float32Array

    @staticmethod
    def estimated(pattern: Float32Array, rest: Float32Array, known: Float32Array, apart_px: FloatArray) -> 'Unevenness':
        """What the residuals show of them.

        Parameters
        ----------
        pattern, rest : (Q, n * n, P / (n * n)) the blurred pattern, and residuals, 0 where they are not known
        known : of the same shape, 1 for samples that are known, else 0
        apart_px : (Q,) distance of the samples: closer ones than a pixel are not independent
        """
        number = np.asarray(_sums(known), dtype=np.float64)
        some = np.maximum(number, 1.0)
        means = np.asarray(_sums(pattern * known) / some, dtype=np.float32)
        centred = (pattern - means[..., None]) * known
        strength = np.asarray(_sums(centred * centred), dtype=np.float64)
        length = np.sqrt(strength + TINY)
        level = np.asarray(_sums(rest) / np.sqrt(some), dtype=np.float64)
        contrast = np.asarray(_sums(rest * centred), dtype=np.float64) / length
        inside = _sums(rest * rest).sum(axis=1) - (level * level + contrast * contrast).sum(axis=1)
        free = np.maximum(np.maximum(number - 2.0, 0.0).sum(axis=1), 1.0)
        noise = np.maximum(inside, 0.0) / free / np.minimum(apart_px, 1.0) ** 2 + TINY
        noise = noise[:, None]
        of_level = _beyond(level, noise, number) * number
        of_contrast = _beyond(contrast, noise, strength) * strength
        of_level, of_contrast = of_level / (noise + of_level), of_contrast / (noise + of_contrast)
        differing = np.empty((*rest.shape, 2), dtype=np.float32)
        np.multiply(known, np.sqrt(of_level / some).astype(np.float32)[..., None], out=differing[..., 0])
        np.multiply(centred, (np.sqrt(of_contrast) / length).astype(np.float32)[..., None], out=differing[..., 1])
        return Unevenness(differing, (of_contrast * contrast / length).astype(np.float32))

    def weighted(self, rest: Float32Array) -> Float32Array:
        """Residuals (Q, n * n, P / (n * n)) times their inverse covariance: less what is uneven in each patch."""
        shown = self.differing @ (rest[:, :, None] @ self.differing).swapaxes(2, 3)
        return np.asarray(rest - shown[..., 0])

    def information(self, J: Float32Array) -> Float32Array:
        """Information (Q, K, K) that uneven levels and contrasts take from K parameters with derivatives (Q, K, P)."""
        count, patches, size = self.differing.shape[:3]
        by_patches = J.reshape(count, -1, patches, size).swapaxes(1, 2) @ self.differing
        together = by_patches.swapaxes(1, 2).reshape(count, J.shape[1], -1)
        return np.asarray(together @ together.swapaxes(1, 2))


def _sums(patches: Float32Array) -> Float32Array:
    """Sums (Q, N) over the samples of patches (Q, N, M)."""
    return np.asarray(patches @ np.ones(patches.shape[2], dtype=np.float32))


def _beyond(amounts: FloatArray, noise: FloatArray, strength: FloatArray) -> FloatArray:
    """Estimate v (Q, 1) from amounts (Q, N) with variances of ``noise + v * strength``, by their second moments."""
    excess = (strength * (amounts * amounts - noise)).sum(axis=1, keepdims=True)
    return np.asarray(np.maximum(excess, 0.0) / (strength * strength).sum(axis=1, keepdims=True))


@dataclass(frozen=True, slots=True)
class PatternResiduals(Stacked):
    """Residuals of Q markers at their corners, and their derivatives."""

    corners_px: FloatArray
    #: (Q,) [px]
    blur: FloatArray
    #: (Q, 2, 2) derivatives of places in the marker [cells] by pixels
    to_cells: FloatArray
    #: (Q, 2, 2) covariance of all blur [cells^2]
    spread: FloatArray
    #: (Q, P) gray levels, no background in them
    samples: Float32Array
    #: (Q, P) which of them are known: the others, and derivatives there, are 0; and their number (Q,), at least 1
    known: BoolArray
    number: IntArray
    #: (Q,) distance of samples [px]
    apart_px: FloatArray
    #: (Q, P) these without the pattern, and times their inverse covariance, for noise with a variance of 1
    rest: Float32Array
    weighted: Float32Array
    #: (Q, L) amounts of the linear terms, the first of them the contrast
    amounts: FloatArray
    #: (Q, 9 + L, P) derivatives of the pattern by the corners' u and v, by blur, and by the L linear terms
    J: Float32Array
    #: (Q, 9 + L, 9 + L) of samples with a variance of 1
    information: FloatArray
    grid: PatternGrid
    #: None: nothing is uneven
    unevenness: Unevenness | None

    def moved(self, step: FloatArray) -> 'PatternResiduals':
        """The residuals after a step (Q, 9 + L) of all parameters that is so short that it changes them linearly."""
        rest = self.rest - (self.J.swapaxes(1, 2) @ step[..., None].astype(np.float32))[..., 0]
        return replace(self, rest=rest, weighted=_weighted(rest, self.unevenness))

    def sample_at(self, view: PatternView, quads: FloatArray, which: IntArray) -> None:
        """Sample the image again at corners ``quads`` (W, 4, 2) of ``which`` (W,), so near that the patterns stay."""
        view = view.only(which)
        samples = _samples(view.values(*view.places(quads, self.grid)), self.grid, self.known[which])
        uneven = self.unevenness and self.unevenness.only(which)
        # Not copied: markers have millions of derivatives.
        terms, products = [self.J[index, LINEAR] for index in which], self.information[which, LINEAR, LINEAR]
        self.corners_px[which], self.samples[which] = quads, samples
        self.amounts[which], self.rest[which], self.weighted[which] = fitted(terms, products, samples, uneven)

    @property
    def contrast(self) -> FloatArray:
        """White minus black (Q,), in the middle of the marker."""
        return self.amounts[:, 0]

    @property
    def pixels(self) -> FloatArray:
        """Pixels (Q,) that the samples cover."""
        return np.asarray(self.number * self.apart_px**2)


def residuals_at(
    view: PatternView,
    quads: FloatArray,
    blur: FloatArray,
    white: FloatArray,
    grid: PatternGrid,
) -> PatternResiduals:
    """The fit of ``white`` cells (Q, m, m), seen with ``blur`` (Q,) [px], at corners ``quads`` (Q, 4, 2)."""
    to_cells = cells_by_pixels(quads, white.shape[1])
    model, spread = blurred(view, to_cells, blur, white, grid)
    places = view.places(quads, grid)
    known = view.known(*places)
    number, apart_px = np.maximum(np.count_nonzero(known, axis=1), 1), grid.apart_px(to_cells)
    samples = _samples(view.values(*places), grid, known)
    J = linear_terms(model, spread, grid, white.shape[1], displayed=view.displayed)
    nonlinear, terms = J[:, : LINEAR.start], J[:, LINEAR]
    blank(terms, known)
    products = products_of(terms)
    amounts, rest, weighted = fitted(terms, products, samples, None)
    contrast = local_contrast(amounts.astype(np.float32), model, grid, displayed=view.displayed)
    uneven = None
    if view.displayed:
        pattern, left, counting = (grid.patches(values) for values in (model.value, rest, known.astype(np.float32)))
        uneven = Unevenness.estimated(pattern, left, counting, apart_px)
        contrast = (grid.patches(contrast) + uneven.more_contrast[..., None]).reshape(rest.shape)
        whole, sign = np.abs(amounts[:, :1]), np.sign(amounts[:, :1])
        contrast = (sign * np.maximum(sign * contrast, _LEAST_CONTRAST * whole)).astype(np.float32)
    # Steps of an alignment are long: what of the slopes looks like background is not trusted.
    slopes = model.slopes if grid.graded else grid.without_background(model.slopes)
    by_px = to_cells.swapaxes(1, 2).astype(np.float32) @ (slopes * -contrast).swapaxes(0, 1)
    np.multiply(by_px[:, :, None], grid.weights, out=J[:, CORNERS].reshape(len(quads), 2, 4, -1))
    np.multiply(contrast, model.wider, out=J[:, BLUR])
    if not grid.graded:
        nonlinear[:] = grid.without_background(nonlinear)
    blank(nonlinear, known)
    information = np.empty((len(J), J.shape[1], J.shape[1]))
    information[:, LINEAR, LINEAR] = products
    information[:, : LINEAR.start] = nonlinear @ J.swapaxes(1, 2)
    information[:, LINEAR, : LINEAR.start] = information[:, : LINEAR.start, LINEAR].swapaxes(1, 2)
    if uneven is not None:
        information -= uneven.information(J)
        amounts, rest, weighted = fitted(terms, information[:, LINEAR, LINEAR], samples, uneven)
    fit = rest, weighted, amounts, J, information
    return PatternResiduals(quads, blur, to_cells, spread, samples, known, number, apart_px, *fit, grid, uneven)


def _samples(values: Float32Array, grid: PatternGrid, known: BoolArray) -> Float32Array:
    """The ``values`` (Q, P) at samples without background; 0 where not ``known``."""
    # Small numbers for sums in single precision.
    samples = grid.without_background(values - values[:, :1])
    blank(samples[:, None], known)
    return samples


def blank(rows: Float32Array, known: BoolArray) -> None:
    """Set rows (Q, K, P) to 0 at samples that are not ``known`` (Q, P)."""
    if not known.all():
        rows *= known[:, None]


def products_of(rows: Float32Array) -> FloatArray:
    """Sums of products (Q, K, K) of rows (Q, K, P)."""
    return np.asarray(rows @ rows.swapaxes(1, 2), dtype=np.float64)


def _weighted(rest: Float32Array, uneven: Unevenness | None) -> Float32Array:
    """Residuals (Q, P) times their inverse covariance, for noise with a variance of 1."""
    if uneven is None:
        return rest
    return uneven.weighted(rest.reshape(uneven.differing.shape[:3])).reshape(rest.shape)


def fitted(
    terms: Iterable[Float32Array], products: FloatArray, samples: Float32Array, uneven: Unevenness | None
) -> tuple[FloatArray, Float32Array, Float32Array]:
    """Amounts (Q, L) of linear terms (Q, L, P) with ``products`` (Q, L, L) in gray levels (Q, P).

    And what they leave (Q, P) of these, as it is and weighted.
    """
    shown = np.array([rows @ row for rows, row in zip(terms, _weighted(samples, uneven), strict=True)])
    amounts = np.linalg.solve(products + TINY * np.eye(products.shape[1]), shown[..., None])[..., 0]
    modelled = [row @ rows for rows, row in zip(terms, amounts.astype(np.float32), strict=True)]
    rest = samples - np.array(modelled)
    return np.asarray(amounts), np.asarray(rest), _weighted(rest, uneven)
