"""Lenses whose calibration is off by a smooth random function of the place in the image, and flights behind them."""

from dataclasses import replace
from functools import cache

import numpy as np

from support import walls
from support.following_filter import FollowingFilter
from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.se3 import difference, retract
from thermal_fiducial.core.mapping.keyframes import VIEWS
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import corners_px

#: Waves that a function is the sum of: enough for its values to be normally distributed.
_WAVES = 200
_SIGMA_PX = 0.05
_CONFIG = MarkerMapperConfig(marker_size_std=0.0, focal_length_std=0.0, camera_orientation=(0.0, 0.0, 0.0, 1.0))


def drawn_lens(rng, px, width=walls.CAMERA.width, length=0.25):
    """Errors (..., 2) [px] of corners (..., 2), of standard deviation ``px`` over a ``length`` in image widths.

    Sums of cosines have the same covariance as the errors that the package assumes, and nothing else in common with
    its draws (A. Rahimi, B. Recht, "Random Features for Large-Scale Kernel Machines", 2007).
    """
    waves = rng.normal(size=(_WAVES, 2)) / (length * width)
    phases, heights = rng.uniform(0.0, 2.0 * np.pi, (2, _WAVES)), rng.normal(size=(2, _WAVES))

    def errors(corners):
        along = corners @ waves.T
        both = [np.cos(along + phase) @ height for phase, height in zip(phases, heights, strict=True)]
        return px * np.sqrt(2.0 / _WAVES) * np.stack(both, axis=-1)

    return errors


def through(lens, rows, sigma):
    """Rows of markers seen through such a lens."""
    corners = corners_px(rows)
    return walls.rows(rows['id'], corners + lens(corners), sigma)


def _corridor(rng):
    """Fifteen markers along 11 m, of which two or three are in view, and where the camera is in frame k."""
    first = walls.wall(rng, 1)[0]
    poses = {i: retract(first, [0.0, 0.8 * i, *(rng.normal(size=4) * [0.1, 0.05, 0.05, 0.05])]) for i in range(15)}

    def camera(k):
        y = poses[0][1, 3] + 0.3 + 10.6 * k / 600
        eye = np.array([-1.8, y + 0.2 * np.sin(k / 9), 1.0 + 0.3 * np.sin(k / 14)])
        return walls.look(eye, [0.0, y, 1.0 + 0.1 * np.sin(k / 20)])

    return poses, camera


def _nees(off, covariance):
    return float(off @ np.linalg.solve(covariance, off)) / 6.0


def _errors_of(located):
    """Squared errors and claims (n,) of positions [m^2], and NEES per degree of freedom, of true poses and poses."""
    off = [(difference(pose.T_map_camera, T), pose.covariance) for T, pose in located]
    squared = [d[:3] @ d[:3] for d, _ in off]
    return squared, [np.trace(P[:3, :3]) for _, P in off], [_nees(d, P) for d, P in off]


def _flown(seed, lens_px, frames, marker_map=None):
    """The mapper after a flight along a corridor behind a lens that is off by ``lens_px``.

    Parameters
    ----------
    marker_map : of an earlier flight there, on which this one localizes; default: mapping from one marker

    Returns
    -------
    The mapper, true poses of the markers, and of the located frames true poses of the camera and its poses.
    """
    rng = np.random.default_rng(seed)
    lens, (poses, camera) = drawn_lens(rng, lens_px), _corridor(rng)
    config, step = replace(_CONFIG, mode='mapping' if marker_map is None else 'localization'), 2
    if marker_map is not None:
        # The same lens and corridor, other noise.
        rng, step = np.random.default_rng(1000 + seed), 5
    mapper = MarkerMapper(config, marker_map or MarkerMap({0: MapMarker(0, walls.SIZE, True, poses[0])}))
    truth = {walls.stamp(k): camera(k) for k in range(0, frames, step)}
    ekf, located = FollowingFilter(truth, rng), []
    for k, (stamp, T) in enumerate(truth.items()):
        rows = through(lens, walls.see(T, poses, _SIGMA_PX, rng), _SIGMA_PX)
        pose = mapper.process(stamp, rows, walls.CAMERA, ekf.prior(stamp)).pose
        ekf.follow(stamp, pose)
        if pose is not None and k * step > 60:
            located.append((T, pose))
        if mapper.refinement_due(stamp):
            mapper.refine(VIEWS)
    return mapper, poses, located


@cache
def _mapped(seed, lens_px, frames):
    """As :func:`_flown` without a map, and refined in the end; tests that share it change nothing of it."""
    mapper, poses, located = _flown(seed, lens_px, frames)
    mapper.refine(VIEWS)
    return mapper, poses, located


def bent_corridor(seed, lens_px, frames):
    """A map that grows along a corridor from one marker, behind a lens that is off by ``lens_px``.

    Returns
    -------
    Rms error of the markers [m]; NEES per degree of freedom of the map in the end, and of the poses while it grew.
    """
    mapper, poses, located = _mapped(seed, lens_px, frames)
    markers = [marker for key, marker in mapper.map.markers.items() if key]
    of_map = [_nees(difference(m.T_map_marker, poses[m.id]), m.covariance) for m in markers]
    off = [np.linalg.norm(difference(m.T_map_marker, poses[m.id])[:3]) for m in markers]
    return np.sqrt(np.mean(np.square(off))), np.mean(of_map), np.mean(_errors_of(located)[2])


def corridor_again(seed, lens_px, frames):
    """A second flight along such a corridor, on the map of the first.

    Returns
    -------
    Mean squared errors and claims of positions [m^2], and NEES per degree of freedom.
    """
    mapper, _, _ = _mapped(seed, lens_px, frames)
    _, _, located = _flown(seed, lens_px, frames, mapper.map)
    return np.mean(_errors_of(located), axis=1)
