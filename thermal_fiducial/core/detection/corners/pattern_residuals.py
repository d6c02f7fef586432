"""How pixels differ from the blurred patterns of markers, and what would change that.

Smoke in front of a marker makes level and contrast uneven in no way that a formula foresees, and a gain control makes
more of it. In pictures for a display they may differ from linear ones around each node of the pattern, where cells
meet, by what the marker itself shows.
"""

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
from thermal_fiducial.core.types import changed, Float32Array, FloatArray, IntArray, Stacked, TINY

# Least local contrast, as a share of that of the whole marker: gray levels rise with counts. Without it, fits of
# markers behind dense smoke end up to 2 px off.
_LEAST_CONTRAST = 0.1


@dataclass(frozen=True, slots=True)
class Unevenness(Stacked):
    """Level and contrast of Q markers that differ from patch to patch of a grid, beside what is linear.

    They differ independently, with variances that the residuals show (analysis of variance with random effects: S.
    Searle, G. Casella, C. McCulloch, "Variance Components", 1992). Residuals have the covariance of noise and of these
    differences. Whitened values have that of noise alone: their least squares are generalised ones.
    """

    #: (Q, n * n, P / (n * n)) the pattern without its mean in each patch, of length 1 there
    pattern: Float32Array
    #: (Q, 1) and (Q, n * n) shares of the mean and of the pattern in each patch that are taken out
    of_level: Float32Array
    of_contrast: Float32Array
    #: (Q, n * n) what the contrast of each patch is more than the linear one
    more_contrast: Float32Array

    @staticmethod
    def shown(pattern: Float32Array, rest: Float32Array, apart_px: FloatArray) -> 'Unevenness':
        """What residuals show.

        Parameters
        ----------
        pattern, rest : (Q, n * n, P / (n * n)) the blurred pattern, and residuals
        apart_px : (Q,) distance of the samples: closer ones than a pixel are not independent
        """
        _, patches, size = rest.shape
        centred = pattern - pattern.mean(axis=2, keepdims=True)
        strength = np.asarray((centred * centred).sum(axis=2), dtype=np.float64)
        length = np.sqrt(strength + TINY)
        unit = np.asarray(centred / length[..., None], dtype=np.float32)
        level = np.asarray(rest.sum(axis=2) / np.sqrt(size), dtype=np.float64)
        contrast = np.asarray((rest * unit).sum(axis=2), dtype=np.float64)
        inside = (rest * rest).sum(axis=(1, 2)) - (level * level + contrast * contrast).sum(axis=1)
        noise = np.maximum(inside, 0.0) / (patches * (size - 2)) / np.minimum(apart_px, 1.0) ** 2 + TINY
        noise = noise[:, None]
        of_level = _beyond(level, noise, np.ones_like(strength))
        of_contrast = _beyond(contrast, noise, strength) * strength
        more = of_contrast / (noise + of_contrast) * contrast / length
        shares = (1.0 - np.sqrt(noise / (noise + part)) for part in (of_level, of_contrast))
        return Unevenness(unit, *(part.astype(np.float32) for part in (*shares, more)))

    def left(self, rest: Float32Array) -> Float32Array:
        """What the differences that residuals (Q, n * n, P / (n * n)) show leave of these."""
        level, contrast = (1.0 - (1.0 - share) ** 2 for share in (self.of_level, self.of_contrast))
        of_pattern = contrast * (rest * self.pattern).sum(axis=2)
        shown = (level * rest.mean(axis=2))[..., None] + of_pattern[..., None] * self.pattern
        return np.asarray(rest - shown, dtype=np.float32)

    def whitened(self, values: Float32Array) -> Float32Array:
        """Values (Q, K, P) at the samples, whitened."""
        count, patches, size = self.pattern.shape
        by_patches, pattern = values.reshape(count, -1, patches, size), self.pattern[:, None]
        together = np.ones((size, 1), dtype=np.float32)
        level = (by_patches @ together) * (self.of_level / np.float32(size))[:, None, :, None]
        contrast = (by_patches * pattern) @ together * self.of_contrast[:, None, :, None]
        return np.asarray((by_patches - level - pattern * contrast).reshape(values.shape), dtype=np.float32)


def _beyond(amounts: FloatArray, noise: FloatArray, strength: FloatArray) -> FloatArray:
    """Variance (Q, 1) v of amounts (Q, N) whose variances are that of the ``noise`` and v times ``strength``."""
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
    #: (Q, P) these without the pattern, whitened
    rest: Float32Array
    #: (Q, L) amounts of the linear terms, the first of them the contrast
    amounts: FloatArray
    #: (Q, 9 + L, P) derivatives of ``rest`` by the corners' u and v, by blur, and by the L linear terms
    J: Float32Array
    grid: PatternGrid
    #: None: nothing is uneven
    unevenness: Unevenness | None

    def sampled_at(self, view: PatternView, quads: FloatArray, which: IntArray) -> 'PatternResiduals':
        """The same with ``which`` (W,) at corners ``quads`` (W, 4, 2) so near that the patterns on them stay."""
        samples = _samples(view.only(which), quads, self.grid)
        whitened = samples
        if self.unevenness is not None:
            whitened = self.unevenness.only(which).whitened(samples[:, None])[:, 0]
        amounts, rest = fitted(-self.J[which, LINEAR], whitened)
        return replace(
            self,
            corners_px=changed(self.corners_px, which, quads),
            samples=changed(self.samples, which, samples),
            rest=changed(self.rest, which, rest),
            amounts=changed(self.amounts, which, amounts),
        )

    def information(self) -> FloatArray:
        """Information (Q, 9 + L, 9 + L) of samples with a variance of 1."""
        return np.asarray(self.J @ self.J.swapaxes(1, 2), dtype=np.float64)

    @property
    def contrast(self) -> FloatArray:
        """White minus black (Q,), in the middle of the marker."""
        return self.amounts[:, 0]

    @property
    def pixels(self) -> FloatArray:
        """Pixels (Q,) that the samples cover."""
        return np.asarray(self.samples.shape[1] * self.grid.apart_px(self.to_cells) ** 2)


def linearised(
    view: PatternView,
    quads: FloatArray,
    blur: FloatArray,
    white: FloatArray,
    grid: PatternGrid,
) -> PatternResiduals:
    """The fit of ``white`` cells (Q, m, m), seen with ``blur`` (Q,) [px], at corners ``quads`` (Q, 4, 2)."""
    to_cells = cells_by_pixels(quads, white.shape[1])
    model, spread = blurred(view, to_cells, blur, white, grid)
    samples = _samples(view, quads, grid)
    terms = linear_terms(model, spread, grid, white.shape[1], displayed=view.displayed)
    terms = grid.without_background(terms)
    amounts, rest = fitted(terms, samples)
    contrast = local_contrast(amounts.astype(np.float32), model, grid, displayed=view.displayed)
    uneven = None
    if view.displayed:
        uneven = Unevenness.shown(grid.patches(model.value), grid.patches(rest), grid.apart_px(to_cells))
        contrast = (grid.patches(contrast) + uneven.more_contrast[..., None]).reshape(rest.shape)
        whole, sign = np.abs(amounts[:, :1]), np.sign(amounts[:, :1])
        contrast = (sign * np.maximum(sign * contrast, _LEAST_CONTRAST * whole)).astype(np.float32)
    # Steps of an alignment are long: what of the slopes looks like background is not trusted.
    slopes = model.slopes if grid.graded else grid.without_background(model.slopes)
    by_px = to_cells.swapaxes(1, 2).astype(np.float32) @ (slopes * contrast).swapaxes(0, 1)
    J = np.empty((len(quads), LINEAR.start + terms.shape[1], samples.shape[1]), dtype=np.float32)
    np.multiply(by_px[:, :, None], grid.weights, out=J[:, CORNERS].reshape(len(quads), 2, 4, -1))
    J[:, BLUR] = -contrast * model.wider
    J[:, : LINEAR.start] = grid.without_background(J[:, : LINEAR.start])
    J[:, LINEAR] = -terms
    if uneven is not None:
        J = uneven.whitened(J)
        amounts, rest = fitted(-J[:, LINEAR], uneven.whitened(samples[:, None])[:, 0])
    return PatternResiduals(quads, blur, to_cells, spread, samples, rest, amounts, J, grid, uneven)


def _samples(view: PatternView, quads: FloatArray, grid: PatternGrid) -> Float32Array:
    """Values (Q, P) at the samples of markers in ``quads`` (Q, 4, 2), without their background."""
    values = view.values(quads, grid)
    # Small numbers for sums in single precision.
    return grid.without_background(values - values[:, :1])


def fitted(terms: Float32Array, samples: Float32Array) -> tuple[FloatArray, Float32Array]:
    """Amounts (Q, L) of linear terms (Q, L, P) in gray levels (Q, P), and what they leave of these."""
    products = np.asarray(terms @ terms.swapaxes(1, 2), dtype=np.float64) + TINY * np.eye(terms.shape[1])
    amounts = np.linalg.solve(products, terms @ samples[..., None])
    rest = samples - (terms.swapaxes(1, 2) @ amounts.astype(np.float32))[..., 0]
    return np.asarray(amounts[..., 0]), np.asarray(rest)
