"""Alignment of a marker map to the surveyed centres of some of its markers."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry.se3 import apply, lever_arm, rigid_alignment
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.map_tools.map_editing import transformed

# Distance of a surveyed marker from its place, as a share of the surveyed part's radius, beyond which the survey
# contradicts the map: maps by one marker are off by a per cent, an exchanged ID or another unit by much more.
_CONTRADICTS = 0.1
# How many times closer one of the survey and its mirror image must fit to be the right one. Of four markers in a plane
# either fits three times closer by chance, where survey and map are off by as much, once in a thousand times.
_CLEARLY = 3.0
# Distances from their places that are rounding, as a share of the surveyed part's radius.
_EXACT = 1e-6
# Turn of the map's z axis that is not levelling [deg]: a map by one marker that was hung by eye leans by a few degrees.
_NOT_LEVELLED_DEG = 10.0
# Axes that a survey may have.
_AS_AXES = 'as east, north, up are'
# Reflects through the plane x y.
_MIRROR = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class AnchoredMap:
    """A map in the frame of a survey."""

    map: MarkerMap
    #: distance [m] of each surveyed centre from its place
    distances_m: dict[int, float]
    #: the marker that an error of the alignment moves most, and the standard deviation [m] of its place by that alone
    least_known: tuple[int, float]
    #: what may be wrong with the axes of the survey
    doubts: tuple[str, ...]


def anchor(marker_map: MarkerMap, surveyed: Mapping[int, FloatArray]) -> AnchoredMap:
    """Align the map to surveyed positions (3,) [m] of the centres of at least three markers.

    Raises
    ------
    InputError
        Fewer than three surveyed markers in the map, or all collinear, or in places that contradict the map or are its
        mirror image.
    """
    common = sorted(marker_map.markers.keys() & surveyed.keys())
    if len(common) < 3:
        raise InputError(f'{number_of(len(common), "surveyed marker")} in the map: three are needed')
    target = np.stack([surveyed[key] for key in common])
    source = np.stack([marker_map.markers[key].T_map_marker[:3, 3] for key in common])
    extents = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    if extents[1] <= 0.02 * extents[0]:
        raise InputError('the surveyed markers lie on a line, or in one place: they leave a rotation open')
    T, mirror_image = rigid_alignment(target, source), _MIRROR * source
    distances = _distances(T, source, target)
    mirrored = _distances(rigid_alignment(target, mirror_image), mirror_image, target)
    radius = float(np.linalg.norm(source - source.mean(axis=0), axis=-1).max())
    if mirrored.max() <= _CONTRADICTS * radius and _is_clearly_closer(mirrored, distances, radius):
        raise InputError(f'the survey is a mirror image of the map: its axes must be right-handed, {_AS_AXES}')
    worst = int(np.argmax(distances))
    if distances[worst] > _CONTRADICTS * radius:
        raise InputError(
            f'the survey contradicts the map: marker {common[worst]} would be {distances[worst]:.3g} m from its place '
            'there: are its numbers metres, its IDs right?'
        )
    doubts = _doubts_of_axes(T, _is_clearly_closer(distances, mirrored, radius))
    anchored = transformed(marker_map, T)
    ids, places = list(anchored.markers), [marker.T_map_marker[:3, 3] for marker in anchored.markers.values()]
    stds = _stds_of_alignment(target, distances, np.stack(places))
    least_known = ids[int(np.argmax(stds))], float(stds.max())
    return AnchoredMap(anchored, dict(zip(common, distances.tolist(), strict=True)), least_known, tuple(doubts))


def _stds_of_alignment(target: FloatArray, distances: FloatArray, places: FloatArray) -> FloatArray:
    """Standard deviations (M,) [m] of ``places`` (M, 3) by an alignment to ``target`` (N, 3), off by ``distances``."""
    centre = target.mean(axis=0)
    variance = distances @ distances / (3 * len(target) - 6)
    of_target, of_places = (lever_arm(points - centre)[:, :3] for points in (target, places))
    covariance = variance * np.linalg.inv((of_target.swapaxes(1, 2) @ of_target).sum(axis=0))
    return np.asarray(np.sqrt((of_places @ covariance @ of_places.swapaxes(1, 2)).trace(axis1=1, axis2=2)))


def _distances(T: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(apply(T, source) - target, axis=-1))


def _is_clearly_closer(distances: FloatArray, others: FloatArray, radius: float) -> bool:
    """Whether a fit is so much closer than another one that only its handedness can be right."""
    ours, theirs = (float(np.linalg.norm(d)) for d in (distances, others))
    return theirs > _CLEARLY * max(ours, _EXACT * radius)


def _doubts_of_axes(T_new_old: FloatArray, right_handed: bool) -> Iterator[str]:
    if not right_handed:
        yield (
            'the surveyed centres lie in a plane, where left-handed axes fit as well: do the markers face the sides '
            f'above? x y z must be {_AS_AXES}'
        )
    turned_deg = np.rad2deg(np.arccos(np.clip(T_new_old[2, 2], -1.0, 1.0)))
    if turned_deg > _NOT_LEVELLED_DEG:
        yield (
            f'z of the map is turned by {turned_deg:.0f} deg: if it was up before, poses will contradict gravity; '
            'z of the survey must be up'
        )
