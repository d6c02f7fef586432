"""Markers of photos, for ``map build``."""

import argparse
from pathlib import Path

import cv2
import numpy as np

from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector, rows_from_corners
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import MARKER_DTYPE, Markers
from thermal_fiducial.core.types import FloatArray, Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.images import PICTURE_SUFFIXES, pictures_in, read_gray
from thermal_fiducial.files.reading import naming, require_folder

#: Noise of OpenCV's sub-pixel corners in photos [px]; the mapper takes the actual noise from the pictures.
PHOTO_SIGMA_PX = 0.2
# Time between unordered pictures, so long that the detector assumes no continuous motion.
_APART_NS = 100_000_000_000


def photos_in(folder: Path) -> list[Path]:
    """Pictures of a folder, sorted by name. Raises InputError if it has none."""
    require_folder(folder)
    if photos := pictures_in(folder):
        return photos
    raise InputError(f'{folder}: no photos ({", ".join(PICTURE_SUFFIXES)})')


def detect_in_photos(photos: list[Path], camera: Camera, args: argparse.Namespace) -> list[Markers]:
    """Markers of each photo.

    Raises
    ------
    InputError
        A file is no picture, or its size is not that of the ``camera``; a thickness of plates without thermal pictures.
    """
    detector, photo_detector = _detector(args), _photo_detector(args)
    frames, thermal = [], False
    with progress_bar('detecting') as progress:
        for k, photo in enumerate(photos):
            progress(k / len(photos))
            counts = read_gray(photo)
            with naming(photo):
                camera.require_size_of(counts)
            if counts.dtype == np.uint16:
                thermal = True
                frames.append(detector.detect(k * _APART_NS, counts, camera))
            else:
                frames.append(_detect_in_photo(photo_detector, counts.astype(np.uint8), camera, detector))
    if args.plate_thickness and not thermal:
        raise InputError(f'--plate-thickness has no effect with the photos of {photos[0].parent}, all of 8 bit')
    return frames


def _detect_in_photo(
    photo_detector: 'cv2.aruco.ArucoDetector', gray: Gray, camera: Camera, sizes: MarkerDetector
) -> Markers:
    """Markers of an 8-bit photo.

    Cameras for visible light sharpen their pictures and have a nonlinear grey scale. This displaces the edges of our
    detector, which expects counts linear in radiance; OpenCV's corners depend on the gradient alone.
    """
    corners, ids, _ = photo_detector.detectMarkers(gray)
    if not len(corners):
        return np.zeros(0, MARKER_DTYPE)
    ids = ids.ravel()
    once = np.array([np.count_nonzero(ids == key) == 1 for key in ids])
    ids, uv = ids[once].astype(np.int64), np.array(corners, dtype=np.float64).reshape(-1, 4, 2)[once]
    side = np.array([sizes.size(int(key)) for key in ids])
    return rows_from_corners(ids, uv, isotropic(np.full(len(ids), PHOTO_SIGMA_PX)), side, camera)


def _photo_detector(args: argparse.Namespace) -> 'cv2.aruco.ArucoDetector':
    """OpenCV's detector. Raises InputError if this version of OpenCV does not have it."""
    if not hasattr(cv2.aruco, 'ArucoDetector'):
        raise InputError(f"OpenCV {cv2.__version__}: photos need 4.7 or newer, as pip's opencv-python-headless is")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    ours = load_dictionary(args.dictionary)
    packed = np.concatenate([cv2.aruco.Dictionary.getByteListFromBits(bits) for bits in ours.bits])
    theirs = cv2.aruco.Dictionary(packed, ours.bits.shape[1], ours.correctable)
    return cv2.aruco.ArucoDetector(theirs, parameters)


def _detector(args: argparse.Namespace) -> MarkerDetector:
    defaults = ArucoDetectorConfig()
    config = ArucoDetectorConfig(
        # The camera is held still for each photo; from an unknown motion lag would displace corners by pixels.
        bolometer_lag=0.0,
        plate_thickness=args.plate_thickness,
        dictionary=args.dictionary,
        marker_size=args.marker_size or defaults.marker_size,
        marker_size_overrides=tuple(args.marker_size_override),
    )
    return MarkerDetector(config, load_dictionary(args.dictionary))


def isotropic(sigma_px: FloatArray) -> FloatArray:
    """Covariances (N, 4, 2, 2) [px^2] of the corners of N markers from their standard deviations (N,) [px]."""
    return np.asarray(np.maximum(sigma_px, 1e-3)[:, None, None, None] ** 2 * np.tile(np.eye(2), (4, 1, 1)))
