"""Up to where the pixels across the sides of markers count: as far as the model of a side holds.

Where a gradient of temperature displaces sides, near pixels alone count. And where the warm surface ends within the
columns, only those before its end: on a side whose white is darker outward the end shows.
"""

from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.core.detection.corners.segments import Segments
from thermal_fiducial.core.detection.corners.sides import EdgeModel, free_distance, Sides
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Stacked

# Distance from the sides [blurs] beyond which pixels do not count where a gradient of temperature displaces a side: it
# displaces it by as much less as pixels are nearer, and noise by a tenth more.
_WITH_GRADIENT = 4.0
# The white outside a side begins so far from it [blurs]; the model of a blurred step needs that much of it.
_WHITE_BEGINS, _LEAST_WHITE = 1.2, 1.5
# Before its end, as the outer half of the white shows it, the surface is whole: distance from there [blurs].
_END_REACHES = 2.0
# What the outer half of the white is darker by than the inner one at the end of the surface: more than this share of
# the contrast, by which a heater that is weaker by half at the corners of a marker of 26 px fades in a pixel, and so
# many standard deviations more.
_FADES, _SURE = 0.04, 3.0
# Least number of pixels in each half. Of so many columns, and more, every second one is looked at.
_FEWEST, _MANY = 6, 12
# What pixels are off by, in contrasts, where the model of a side does not hold: even markers leave up to 0.013.
_MISFIT = 0.02
# Motion blur beyond which the end of the surface is not looked for: what lags behind a side fades as well [px].
_STILL_PX = 0.3


@dataclass(frozen=True, slots=True)
class Reach(Stacked):
    """Distances from the sides of N markers up to which pixels count [px]; infinite where cells alone limit them."""

    #: (N, 4) each
    inside: FloatArray
    outside: FloatArray

    @staticmethod
    def everywhere(count: int) -> 'Reach':
        """As far as the cells of ``count`` markers allow."""
        return Reach(np.full((count, 4), np.inf), np.full((count, 4), np.inf))

    @property
    def near(self) -> BoolArray:
        """Which markers (N,) are measured by pixels near their sides alone."""
        return np.asarray(np.isfinite(self.inside).any(axis=1))

    def limits(self, sides: Sides, width: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances (E, m) inside and outside the sides up to which pixels count, for blur of ``width`` (E, m) [px]."""
        free = free_distance(sides, width)
        return np.minimum(free, self.inside.reshape(-1, 1)), np.minimum(free, self.outside.reshape(-1, 1))

    def nearer(self, uneven: BoolArray, ending: BoolArray, outward: FloatArray, width: FloatArray) -> 'Reach':
        """The same with near pixels alone for ``uneven`` markers (N,), and less at ``ending`` sides (N, 4).

        Parameters
        ----------
        outward, width : (E, m) distance outside the sides up to which pixels count, and the blur [px]
        """
        outward, width = (part.mean(axis=1).reshape(-1, 4) for part in (outward, width))
        near = np.where(uneven[:, None], _WITH_GRADIENT * width, np.inf)
        before = np.where(ending, np.maximum(outward - _END_REACHES * width, _LEAST_WHITE * width), np.inf)
        return replace(
            self,
            inside=np.minimum(self.inside, near),
            outside=np.minimum(self.outside, np.minimum(near, before)),
        )


def ending_sides(
    counts: Float32Array,
    modelled: EdgeModel,
    sides: Sides,
    segments: Segments,
    outward: FloatArray,
    width: FloatArray,
    motion_px: FloatArray,
) -> BoolArray:
    """Sides (N, 4) within whose columns the warm surface ends.

    Parameters
    ----------
    counts, modelled : as of :func:`thermal_fiducial.core.detection.corners.segments.measure`
    segments : measured with them
    outward, width : (E, m) distance outside the sides up to which pixels count, and the blur [px]
    motion_px : (N,) blur by motion
    """
    contrast, noise = segments.typical[:, 0], segments.noise.min(axis=1)
    looked_at = (noise > (_MISFIT * contrast) ** 2) & (motion_px < _STILL_PX)
    if not looked_at.any():
        return np.zeros((len(contrast), 4), dtype=bool)
    # For each part, not for each side: numpy is slow where it repeats the few numbers of a row.
    begins = _WHITE_BEGINS * width
    limits = np.array(
        [begins, 0.5 * (begins + outward), np.repeat(contrast, width.size // len(contrast)).reshape(width.shape)],
        dtype=np.float32,
    )
    step = 2 if counts.shape[1] >= _MANY else 1
    outside = -sides.distance[:, ::step]
    planes = np.empty((4, *outside.shape), dtype=np.float32)
    np.multiply(modelled.counting[:, ::step], outside > limits[0], out=planes[0])
    np.multiply(planes[0], outside > limits[1], out=planes[1])
    rest = counts[:, ::step] - counts[0, 0, 0, 0]
    rest -= modelled.value[:, ::step] * limits[2]
    np.multiply(planes[:2], rest, out=planes[2:])
    # Of all the white, and of its outer half. A product of matrices adds up three times as fast as a sum.
    moments = np.ones(outside[:, :, 0, 0].size, dtype=np.float32) @ planes.reshape(4, -1, modelled.value[0, 0].size)
    white, outer, white_sum, outer_sum = moments.reshape(4, *modelled.value.shape[2:]).sum(axis=2)
    contrast, noise = np.repeat(contrast, 4), np.repeat(noise, 4)
    number = np.array([outer, white - outer])
    level = np.array([outer_sum, white_sum - outer_sum]) / np.maximum(number, 1)
    variance = noise * (1.0 / np.maximum(number, 1)).sum(axis=0)
    darker = (level[1] - level[0]) * np.sign(contrast) > _FADES * np.abs(contrast) + _SURE * np.sqrt(variance)
    judged = (number >= _FEWEST).all(axis=0) & (outward > _LEAST_WHITE * width).all(axis=1)
    return np.asarray((darker & judged).reshape(-1, 4) & looked_at[:, None])
