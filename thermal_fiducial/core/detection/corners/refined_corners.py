"""Refined corners of markers."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, Stacked


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
