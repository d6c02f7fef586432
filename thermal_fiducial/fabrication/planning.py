"""Predicted detection rate and pose error of a marker, seen by a given camera.

The predictions rest on measurements: ``measured.yaml`` holds results of this package's detector in rendered frames,
over marker side in pixels, contrast and tilt (``thermal-fiducial markers measure`` measures them again). The share of
markers found, the noise of the corners and the error of the distance are read from it. The other errors of the pose
come from the pose solver, run on corners with that noise, with both planar branches, since linear propagation fails
near front-parallel views. The distance is measured because the corners of small markers have, besides their noise, a
common displacement, which scales the distance.
"""

from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import solve_marker_poses
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.plain_yaml import load_plain
from thermal_fiducial.files.reading import one_line
from thermal_fiducial.files.writing import write_text

FORMAT = 'thermal_fiducial/marker_measurements'
#: The measurements in the package.
PACKAGED = Path(__file__).resolve().parent / 'measured.yaml'
#: Share of measured markers found from which a marker counts as detected: four frames of five, 24 a second.
DETECTED = 0.8

_TABLES = ('side_px', 'contrast', 'tilt_deg', 'found', 'sigma_px', 'distance_error', 'pose_factor')
_SAMPLES = 200
# Bits along a side of the measured markers; other markers are compared by the size of their cells.
_MEASURED_BITS = 4


@dataclass(frozen=True)
class Measurements:
    """Results of the detector.

    Parameters
    ----------
    side_px : (S,) side of the black square in a view from the front
    contrast : (C,) in standard deviations of the camera's temporal noise (NETD)
    tilt_deg : (T,) between the marker's normal and the line of sight
    found : (S, C, T) share of the markers that were found
    sigma_px : (S, C, T) noise of a corner coordinate; NaN where nothing was found
    distance_error : (S, C, T) median relative error of the distance; NaN where nothing was found
    pose_factor : (C, T) ratio of the median error of the poses to that of poses from corners with independent noise:
        the corners of a marker lie on common sides, so their errors are correlated, most in faint markers
    """

    side_px: FloatArray
    contrast: FloatArray
    tilt_deg: FloatArray
    found: FloatArray
    sigma_px: FloatArray
    distance_error: FloatArray
    pose_factor: FloatArray

    def look_up(self, side_px: float, contrast: float, tilt_deg: float, bits: int = 4) -> tuple[float, float]:
        """Share found and corner noise [px], interpolated.

        The share is linear over the logarithms of side and contrast. The noise is a power of the side in pixels as the
        camera sees it, so its logarithm is linear over those of side and of the tilt's cosine. Its square is a floor,
        from optics and from the fixed pattern, plus a part that falls with the square of the contrast. Beyond the
        measured range the values of its ends hold, but markers that are smaller or fainter than measured, or have a
        side below the detector's ``min_side_px`` in some rotation, count as not found.
        """
        shortest = side_px * np.sqrt(0.5 + 0.5 * np.cos(np.radians(tilt_deg)) ** 2)
        if contrast < self.contrast[0] or shortest < ArucoDetectorConfig().min_side_px:
            return 0.0, np.nan
        faint, tilted = _position(np.log(self.contrast), np.log(contrast)), self._tilted(tilt_deg)
        readable = side_px * (_MEASURED_BITS + 2) / (bits + 2)
        found = 0.0
        if readable >= self.side_px[0]:
            found = _interpolate(self.found, (_position(np.log(self.side_px), np.log(readable)), faint, tilted))
        large = _position(np.log(self.side_px), np.log(max(side_px, self.side_px[0])))
        index, _ = faint
        inverse = self.contrast[index : index + 2] ** -2.0
        share = float(np.clip((inverse[0] - contrast**-2.0) / (inverse[0] - inverse[1]), 0.0, 1.0))
        ends = [_interpolate(np.log(self.sigma_px), (large, (index, end), tilted)) for end in (0.0, 1.0)]
        if not np.all(np.isfinite(ends)):
            return found, float(np.exp(_interpolate(np.log(self.sigma_px), (large, faint, tilted))))
        variances = np.exp(2.0 * np.array(ends))
        return found, float(np.sqrt((1.0 - share) * variances[0] + share * variances[1]))

    def distance_share(self, side_px: float, contrast: float, tilt_deg: float) -> float:
        """``distance_error``, interpolated: its logarithm is linear over those of the axes."""
        large = _position(np.log(self.side_px), np.log(side_px))
        faint = _position(np.log(self.contrast), np.log(contrast))
        return float(np.exp(_interpolate(np.log(self.distance_error), (large, faint, self._tilted(tilt_deg)))))

    def factor(self, contrast: float, tilt_deg: float) -> float:
        """``pose_factor``, interpolated."""
        faint = _position(np.log(self.contrast), np.log(contrast))
        return _interpolate(self.pose_factor[None].repeat(2, axis=0), ((0, 0.0), faint, self._tilted(tilt_deg)))

    def _tilted(self, tilt_deg: float) -> tuple[int, float]:
        return _position(-np.log(np.cos(np.radians(self.tilt_deg))), -np.log(np.cos(np.radians(tilt_deg))))


def _position(axis: FloatArray, value: float) -> tuple[int, float]:
    """Interval of a grid axis that ``value`` falls into, and where in it (0 to 1)."""
    index = int(np.clip(np.searchsorted(axis, value) - 1, 0, len(axis) - 2))
    return index, float(np.clip((value - axis[index]) / (axis[index + 1] - axis[index]), 0.0, 1.0))


def _interpolate(table: FloatArray, positions: tuple[tuple[int, float], ...]) -> float:
    """Interpolate linearly between the corners of a cell; corners without a value are left out."""
    total, weights = 0.0, 0.0
    for corner in np.ndindex(2, 2, 2):
        weight = float(
            np.prod([share if side else 1.0 - share for side, (_, share) in zip(corner, positions, strict=True)])
        )
        value = table[tuple(index + side for side, (index, _) in zip(corner, positions, strict=True))]
        if weight > 0.0 and np.isfinite(value):
            total, weights = total + weight * float(value), weights + weight
    return total / weights if weights > 0.0 else np.nan


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
    measurements = Measurements(*tables)
    shape = len(measurements.side_px), len(measurements.contrast), len(measurements.tilt_deg)
    sized = (measurements.found, measurements.sigma_px, measurements.distance_error)
    if any(table.shape != shape for table in sized) or tables[-1].shape != shape[1:] or min(shape) < 2:
        raise InputError(f'{path}: tables of {[table.shape for table in tables[3:]]} do not fit axes of {shape}')
    return measurements


def save_measurements(path: str | os.PathLike[str], measurements: Measurements, notes: dict[str, Any]) -> None:
    """Write ``measurements``, with ``notes`` on how they were made. Raises InputError."""
    document: dict[str, Any] = {'format': FORMAT, **notes}
    for name in _TABLES:
        document[name] = np.round(getattr(measurements, name), 6).tolist()
    write_text(path, yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120))


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
    sigma_px: float
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
    """Prediction for a marker in the middle of the image of ``camera``.

    Parameters
    ----------
    size : side of the black square [m]
    distance : [m]
    tilt_deg : between the marker's normal and the line of sight
    contrast : in standard deviations of the camera's temporal noise
    bits : along a side of the marker
    """
    if not (size > 0.0 and distance > size and 0.0 <= tilt_deg < 85.0 and contrast > 0.0):
        raise InputError(f'side {size:g} m, distance {distance:g} m, tilt {tilt_deg:g} deg cannot be planned')
    side_px = camera.focal_px * size / distance
    found, sigma = measurements.look_up(side_px, contrast, tilt_deg, bits)
    if not np.isfinite(sigma):
        return Expectation(side_px, found, sigma)
    errors = expected_errors(camera, size, distance, tilt_deg, sigma, seed)
    factor = measurements.factor(contrast, tilt_deg)
    along = distance * measurements.distance_share(side_px, contrast, tilt_deg)
    position, rotation = factor * errors[0], factor * errors[2]
    return Expectation(side_px, found, sigma, max(position, along), along, rotation, errors[3])


def expected_errors(
    camera: Camera, size: float, distance: float, tilt_deg: float, sigma_px: float, seed: int
) -> tuple[float, float, float, float]:
    """Errors as of :func:`pose_errors`, for corners with independent noise of ``sigma_px``."""
    rng = np.random.default_rng(seed)
    turned = rng.uniform(0.0, 2.0 * np.pi, _SAMPLES)
    T = viewed_at(distance, np.radians(tilt_deg), turned, camera)
    corners = camera.project(se3.apply(T, marker_corners(size)))
    noisy = corners + rng.normal(0.0, sigma_px, corners.shape)
    covariances = np.broadcast_to(sigma_px**2 * np.eye(2), (*corners.shape, 2))
    poses = solve_marker_poses(noisy, covariances, np.full(_SAMPLES, size), camera)
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
