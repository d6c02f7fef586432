"""Blind search for markers in a frame."""

from dataclasses import dataclass, fields

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.contrast import halved, noise_of, normalise
from thermal_fiducial.core.decoding import Decoder, Reading, shrunk
from thermal_fiducial.core.quads import find_quads
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# Full resolution sees small and smeared markers: smoothing [px], floor [noise], window [px], threshold [levels].
_FINE = (1.5, 3.0, 15, 7.0)
# Half resolution, smoothed more, sees markers of twice the noise.
_FAINT = (1.2, 1.0, 7, 3.0)


@dataclass(frozen=True, slots=True)
class Found:
    """Markers that a search found.

    Parameters
    ----------
    ids : (N,)
    corners_px : (N, 4, 2) clockwise from the marker's top-left, to a pixel or two
    clarity : (N,) contrast over the noise of a pixel, negative where black is warmer than white
    """

    ids: IntArray
    corners_px: FloatArray
    clarity: FloatArray

    @staticmethod
    def none() -> 'Found':
        """No markers."""
        return Found(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros(0))


def blind_search(
    image: Float32Array, scene: Float32Array, decoder: Decoder, allowed: BoolArray, config: ArucoDetectorConfig
) -> Found:
    """Markers with IDs ``allowed`` (M,), each ID once.

    Parameters
    ----------
    image : (height, width) the frame
    scene : the same freed of lag, which costs noise: the finest markers are sought there, the faintest in ``image``
    """
    noise = noise_of(image)
    smoothing, floor, window, threshold = _FINE
    fine = find_quads(normalise(scene, noise, smoothing, floor), window, threshold, config.min_side_px)
    half = halved(image)
    smoothing, floor, window, threshold = _FAINT
    view = normalise(half, noise_of(half), smoothing, floor, 2)
    faint = 2.0 * find_quads(view, window, threshold, 0.5 * config.min_side_px + 2.0) + 0.5
    quads = np.concatenate([fine, faint, shrunk(faint, decoder.cells)])
    if len(quads) == 0:
        return Found.none()
    reading = _joined(decoder.read(scene, fine, allowed), decoder.read(half, 0.5 * (quads[len(fine) :] - 0.5), allowed))
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=-1).min(axis=1)
    good = accepted(reading, noise, config) & (sides >= config.min_side_px)
    best = _once(reading, quads, good, config.duplicates == 'drop')
    turned = (np.arange(4) - reading.turns[best][:, None]) % 4
    corners = np.take_along_axis(quads[best], turned[..., None], axis=1)
    return Found(reading.ids[best], corners, reading.contrast[best] / noise)


def _joined(first: Reading, second: Reading) -> Reading:
    names = [item.name for item in fields(Reading)]
    return Reading(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


def merged(first: Found, second: Found) -> Found:
    """All markers of ``first``, and those of ``second`` that it does not have."""
    new = ~np.isin(second.ids, first.ids)
    return Found(
        np.concatenate([first.ids, second.ids[new]]),
        np.concatenate([first.corners_px, second.corners_px[new]]),
        np.concatenate([first.clarity, second.clarity[new]]),
    )


def accepted(reading: Reading, noise: float, config: ArucoDetectorConfig) -> BoolArray:
    """Which readings are evidence enough for a marker nobody expected."""
    similarity = np.abs(reading.correlation)
    return np.asarray(
        (similarity >= config.min_correlation)
        & (similarity - reading.runner_up >= config.min_margin)
        & (reading.bit_errors <= config.max_bit_errors)
        & (reading.border_errors <= config.max_border_errors)
        & (np.abs(reading.contrast) >= config.min_contrast * noise)
    )


def _once(reading: Reading, quads: FloatArray, good: BoolArray, drop_duplicates: bool) -> IntArray:
    """Places of the best reading of every ID; of an ID at two places neither, when such are to be dropped."""
    order = np.flatnonzero(good)
    order = order[np.argsort(-np.abs(reading.correlation[order]), kind='stable')]
    ids, first = np.unique(reading.ids[order], return_index=True)
    best = order[first]
    if drop_duplicates and len(order) > len(best):
        centre = quads.mean(axis=1)
        extent = np.linalg.norm(quads[:, 2] - quads[:, 0], axis=-1)
        owner = best[np.searchsorted(ids, reading.ids[order])]
        apart = np.linalg.norm(centre[order] - centre[owner], axis=-1) > 0.5 * extent[owner]
        keep = ~np.isin(ids, reading.ids[order][apart])
        best = best[keep]
    return np.asarray(best)
