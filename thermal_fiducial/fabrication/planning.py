"""Predicted detection rate and pose error of a marker, seen by a given camera.

The predictions rest on measurements: ``measured.yaml`` holds results of this package's detector in rendered frames,
over narrowest side in the image, contrast and tilt (``thermal-fiducial markers measure`` measures them again). The
narrowest side says whether the detector finds a marker and how it fits it, so it is the axis, and a view of a given
distance and tilt is a mean over the rotations of the marker, each with a narrowest side of its own. The share of
markers found, the noise of the corners and the error of the distance are read from the tables. The other errors of the
pose come from the pose solver, run on corners with the noise that gives the measured errors of poses, with both planar
branches, since linear propagation fails near front-parallel views. The distance is measured because the corners of
small markers have, besides their noise, a common displacement, which scales the distance.
"""

from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import solve_marker_poses
from thermal_fiducial.core.geometry.reprojection import marker_corners, narrow_sides
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.plain_yaml import load_plain, save_plain
from thermal_fiducial.files.reading import one_line

FORMAT = 'thermal_fiducial/marker_measurements'
#: The measurements in the package.
PACKAGED = Path(__file__).resolve().parent / 'measured.yaml'
#: Share of measured markers found from which a marker counts as detected: four frames of five, 24 a second.
DETECTED = 0.8

# Bounds of the axes, whose logarithms, or that of the cosine, are interpolated.
_AXES = {'narrow_px': (1.0, 1e5), 'contrast': (1e-3, 1e6), 'tilt_deg': (0.0, 89.9)}
_TABLES = (*_AXES, 'found', 'sigma_px', 'pose_sigma_px', 'distance_error')
_SAMPLES = 200
# Bits along a side of the measured markers; other markers are compared by the size of their cells.
_MEASURED_BITS = 4


@dataclass(frozen=True)
class Measurements:
    """Results of the detector.

    Parameters
    ----------
    narrow_px : (S,) narrowest side of the black square in the image
    contrast : (C,) in standard deviations of the camera's temporal noise (NETD)
    tilt_deg : (T,) between the marker's normal and the line of sight
    found : (S, C, T) share of the markers that were found; NaN where a marker does not fit into the image
    sigma_px : (S, C, T) noise of a corner coordinate; NaN where nothing was found
    pose_sigma_px : (S, C, T) noise of independent corners whose poses are as good as those found: the errors of a
        marker's corners are correlated, by common sides or by the fit of the whole pattern, which changes the pose more
        or less than independent ones; NaN where nothing was found
    distance_error : (S, C, T) median relative error of the distance; NaN where nothing was found
    """

    narrow_px: FloatArray
    contrast: FloatArray
    tilt_deg: FloatArray
    found: FloatArray
    sigma_px: FloatArray
    pose_sigma_px: FloatArray
    distance_error: FloatArray

    def found_share(self, narrow_px: FloatArray, contrast: float, tilt_deg: float, bits: int = 4) -> FloatArray:
        """Share of markers found (N,), for narrowest sides (N,), linear over the logarithms of side and contrast.

        Markers that are smaller or fainter than measured, or have a side below the detector's ``min_side_px``, count
        as not found.
        """
        readable = narrow_px * (_MEASURED_BITS + 2) / (bits + 2)
        index, share = self._faint(contrast)
        at_tilt = self._tilted(self.found, tilt_deg)
        found = self._along(_between(at_tilt[:, index], at_tilt[:, index + 1], share), readable)
        refused = (readable < self.narrow_px[0]) | (narrow_px < ArucoDetectorConfig().min_side_px)
        return np.where(refused | (contrast < self.contrast[0]), 0.0, found)

    def noise_px(self, narrow_px: FloatArray, contrast: float, tilt_deg: float) -> FloatArray:
        """``sigma_px`` (N,), for narrowest sides (N,)."""
        return self._noise(self.sigma_px, narrow_px, contrast, tilt_deg)

    def pose_noise_px(self, narrow_px: FloatArray, contrast: float, tilt_deg: float) -> FloatArray:
        """``pose_sigma_px`` (N,), for narrowest sides (N,)."""
        return self._noise(self.pose_sigma_px, narrow_px, contrast, tilt_deg)

    def _noise(self, table: FloatArray, narrow_px: FloatArray, contrast: float, tilt_deg: float) -> FloatArray:
        """Noise (N,) of a ``table`` (S, C, T).

        It is a power of the side in pixels, so its logarithm is linear over those of side and of the tilt's cosine.
        Its square is a floor, from optics and from the fixed pattern, plus a part that falls with the square of the
        contrast. Beyond the measured range the values of its ends hold.
        """
        index, _ = self._faint(contrast)
        inverse = self.contrast[index : index + 2] ** -2.0
        share = float(np.clip((inverse[0] - contrast**-2.0) / (inverse[0] - inverse[1]), 0.0, 1.0))
        at_tilt = self._tilted(np.log(table), tilt_deg)
        fainter, clearer = (np.exp(2.0 * self._along(at_tilt[:, end], narrow_px)) for end in (index, index + 1))
        return np.sqrt(_between(fainter, clearer, share))

    def distance_share(self, narrow_px: FloatArray, contrast: float, tilt_deg: float) -> FloatArray:
        """``distance_error`` (N,), for narrowest sides (N,): its logarithm is linear over those of the axes."""
        index, share = self._faint(contrast)
        at_tilt = self._tilted(np.log(self.distance_error), tilt_deg)
        return np.exp(self._along(_between(at_tilt[:, index], at_tilt[:, index + 1], share), narrow_px))

    def _faint(self, contrast: float) -> tuple[int, float]:
        return _position(np.log(self.contrast), np.log(contrast))

    def _tilted(self, table: FloatArray, tilt_deg: float) -> FloatArray:
        """A ``table`` (..., T) at a tilt."""
        index, share = _position(-np.log(np.cos(np.radians(self.tilt_deg))), -np.log(np.cos(np.radians(tilt_deg))))
        return _between(table[..., index], table[..., index + 1], share)

    def _along(self, values: FloatArray, narrow_px: FloatArray) -> FloatArray:
        """Those of ``values`` (S,) that there are, between the measured sides."""
        known = np.isfinite(values)
        if not np.any(known):
            return np.full(np.shape(narrow_px), np.nan)
        return np.interp(np.log(narrow_px), np.log(self.narrow_px[known]), values[known])


def _position(axis: FloatArray, value: float) -> tuple[int, float]:
    """Interval of a grid axis that ``value`` falls into, and where in it (0 to 1)."""
    index = int(np.clip(np.searchsorted(axis, value) - 1, 0, len(axis) - 2))
    return index, float(np.clip((value - axis[index]) / (axis[index + 1] - axis[index]), 0.0, 1.0))


def _between(one: FloatArray, other: FloatArray, share: float) -> FloatArray:
    """Interpolate linearly; where one has no value, that of the other holds."""
    mixed = (1.0 - share) * one + share * other
    return np.where(np.isfinite(mixed), mixed, np.where(np.isfinite(one), one, other))


def load_measurements(path: str | os.PathLike[str] = PACKAGED) -> Measurements:
    """Measurements from a file.

    Raises
    ------
    InputError
        Not a file of measurements.
    """
    document: Any = load_plain(os.fspath(path))
    if not isinstance(document, dict) or document.get('format') != FORMAT:
        raise InputError(f'{path}: not of format {FORMAT}')
    try:
        tables = [np.array(document[name], dtype=np.float64) for name in _TABLES]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f'{path}: {one_line(error)} is missing or no table') from None
    for (name, (least, most)), axis in zip(_AXES.items(), tables, strict=False):
        rises = axis.ndim == 1 and len(axis) > 1 and bool(np.all(np.diff(axis) > 0.0))
        if not (rises and least <= axis[0] and axis[-1] <= most):
            raise InputError(f'{path}: {name} is not two or more rising numbers from {least:g} to {most:g}')
    shape, shapes = tuple(map(len, tables[: len(_AXES)])), [table.shape for table in tables[len(_AXES) :]]
    if set(shapes) != {shape}:
        raise InputError(f'{path}: tables of {shapes} do not fit axes of {shape}')
    return Measurements(*tables)


def save_measurements(path: str | os.PathLike[str], measurements: Measurements, notes: dict[str, Any]) -> None:
    """Write ``measurements``, with ``notes`` on how they were made. Raises InputError."""
    document: dict[str, Any] = {'format': FORMAT, **notes}
    for name in _TABLES:
        document[name] = np.round(getattr(measurements, name), 6).tolist()
    save_plain(path, document)


@dataclass(frozen=True)
class Expectation:
    """Prediction for one marker in one view.

    Parameters
    ----------
    side_px : side of the black square in a view from the front
    found : share of frames in which it is found
    sigma_px : noise of a corner coordinate
    position : median error of the camera's position in the marker's frame [m]
    distance : median error of the distance [m]
    rotation_deg : median error of the rotation
    wrong_branch : share of poses on the wrong branch of the planar ambiguity; the errors leave these out
    """

    side_px: float
    found: float
    sigma_px: float = np.nan
    position: float = np.nan
    distance: float = np.nan
    rotation_deg: float = np.nan
    wrong_branch: float = np.nan

    @property
    def detected(self) -> bool:
        """Whether the marker counts as detected."""
        return self.found >= DETECTED


def expect(
    measurements: Measurements,
    camera: Camera,
    *,
    size: float,
    distance: float,
    tilt_deg: float,
    contrast: float,
    bits: int = 4,
    seed: int = 1,
) -> Expectation:
    """Prediction for a marker in the middle of the image of ``camera``, which counts as found with all corners in view.

    Parameters
    ----------
    size : side of the black square [m]
    distance : [m]
    tilt_deg : between the marker's normal and the line of sight
    contrast : in standard deviations of the camera's temporal noise
    bits : along a side of the marker
    """
    if not (size > 0.0 and distance > size and 0.0 <= tilt_deg < 85.0 and contrast > 0.0):
        given = f'side {size:g} m, distance {distance:g} m, tilt {tilt_deg:g} deg'
        raise InputError(f'{given} cannot be planned: the distance must be more than the side, the tilt below 85 deg')
    side_px = camera.focal_px * size / distance
    rng = np.random.default_rng(seed)
    T = viewed_at(distance, np.radians(tilt_deg), rng.uniform(0.0, 2.0 * np.pi, _SAMPLES), camera)
    corners = camera.project(se3.apply(T, marker_corners(size)))
    narrow_px = narrow_sides(corners)
    in_image = camera.contains(corners).all(axis=1)
    found = np.where(in_image, measurements.found_share(narrow_px, contrast, tilt_deg, bits), 0.0)
    share = float(found.mean())
    if share == 0.0:
        return Expectation(side_px, share)
    seen = rng.choice(_SAMPLES, _SAMPLES, p=found / found.sum())
    view = narrow_px[seen], contrast, tilt_deg
    pose_sigma = measurements.pose_noise_px(*view)
    if not np.all(np.isfinite(pose_sigma)):
        return Expectation(side_px, share)
    position, _, rotation_deg, wrong = expected_errors(camera, size, T[seen], pose_sigma, rng)
    # The mean of logarithms: the median over markers of different errors is between those of each.
    along = distance * float(np.exp(np.mean(np.log(measurements.distance_share(*view)))))
    noise = float(np.sqrt(np.mean(measurements.noise_px(*view) ** 2)))
    return Expectation(side_px, share, noise, max(position, along), along, rotation_deg, wrong)


def expected_errors(
    camera: Camera, size: float, T: FloatArray, sigma_px: FloatArray, rng: np.random.Generator
) -> tuple[float, float, float, float]:
    """Errors as of :func:`pose_errors`, for corners with independent noise.

    Parameters
    ----------
    T : (N, 4, 4) T_camera_marker
    sigma_px : (N,) noise of a coordinate
    """
    corners = camera.project(se3.apply(T, marker_corners(size)))
    noisy = corners + sigma_px[:, None, None] * rng.standard_normal(corners.shape)
    covariances = np.broadcast_to((sigma_px**2)[:, None, None, None] * np.eye(2), (*corners.shape, 2))
    poses = solve_marker_poses(noisy, covariances, np.full(len(T), size), camera)
    return pose_errors(poses.T_camera_marker[:, 0], poses.T_camera_marker[:, 1], T)


def viewed_at(distance: float, tilt: float, turned: npt.ArrayLike, camera: Camera) -> FloatArray:
    """T_camera_marker (N, 4, 4) of a marker in the middle of the image.

    Parameters
    ----------
    tilt : of its normal against the line of sight [rad]
    turned : (N,) direction of the tilt axis, and of the marker about its own normal [rad]
    """
    turned = np.asarray(turned, dtype=np.float64)
    middle = camera.rays(np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]))
    zero = np.zeros_like(turned)
    axis = np.stack([np.cos(turned), np.sin(turned), zero], axis=-1)
    own = se3.so3_exp(np.stack([zero, zero, 2.3 * turned], axis=-1))
    R = se3.so3_exp(tilt * axis) @ np.diag([1.0, -1.0, -1.0]) @ own
    return se3.transform(R, distance * middle)


def pose_errors(best: FloatArray, other: FloatArray, T_true: FloatArray) -> tuple[float, float, float, float]:
    """Median errors of position [m], distance [m] and rotation [deg], and the share on the wrong branch.

    Parameters
    ----------
    best, other : (N, 4, 4) T_camera_marker of both branches, the chosen one first
    T_true : (N, 4, 4)
    """
    R_true = np.swapaxes(T_true[:, :3, :3], 1, 2)
    angle, other_angle = (se3.rotation_angle(T[:, :3, :3] @ R_true) for T in (best, other))
    # Where the branches meet they differ only by rounding, and neither is wrong.
    right = angle <= 1.01 * other_angle
    if not np.any(right):
        return np.nan, np.nan, np.nan, 1.0
    seen_from = se3.inverse(best)[:, :3, 3] - se3.inverse(T_true)[:, :3, 3]
    along = np.linalg.norm(best[:, :3, 3], axis=1) - np.linalg.norm(T_true[:, :3, 3], axis=1)
    return (
        float(np.median(np.linalg.norm(seen_from, axis=1)[right])),
        float(np.median(np.abs(along)[right])),
        float(np.degrees(np.median(angle[right]))),
        float(np.mean(~right)),
    )
