"""Recordings other than bags: folders of CSV files and pictures of this package, EuRoC and Kalibr.

This package: ``imu.csv`` (``stamp_ns,wx,wy,wz,ax,ay,az``), ``rig.yaml``, and either ``detections.csv`` (or
``CAMERA.csv``: ``stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3[,sigma_px]``) or ``camera_pose.csv``
(``stamp_ns,x,y,z,qx,qy,qz,qw`` and the 36 numbers of the covariance); optionally the ground truth ``reference.tum``.
EuRoC (ASL): ``[mav0/]imu0/data.csv``, ``CAMERA/data.csv`` with pictures, a ``sensor.yaml`` in each.
Kalibr: ``imu0.csv`` and pictures ``CAMERA/STAMP.png``, with a camchain and an IMU file.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
import math
from pathlib import Path

import numpy as np

from thermal_fiducial.core.geometry.plausibility import checked_covariance
from thermal_fiducial.core.geometry.se3 import inverse, transform_from_quaternion
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.measurements import CameraPose, CORNER_FIELDS, ImuSample
from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS
from thermal_fiducial.core.wording import listed
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.csv_rows import csv_rows
from thermal_fiducial.files.images import pictures_in
from thermal_fiducial.files.reading import require_folder
from thermal_fiducial.files.records import is_imu_reading
from thermal_fiducial.files.rig_files import (
    body_sensor,
    densities,
    LARGEST_OFFSET_S,
    of_camchain,
    of_rig,
    of_sensor,
    Rig,
)
from thermal_fiducial.files.trajectory_file import load_tum

#: Columns of our files, in this order whether a header names them or not.
_IMU = ('stamp_ns', 'wx', 'wy', 'wz', 'ax', 'ay', 'az')
_CORNERS = ('stamp_ns', 'id', *CORNER_FIELDS, 'sigma_px')
_POSES = ('stamp_ns', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
#: Limit of the marker IDs of detections, above any dictionary, and of their corners' standard deviations [px].
MOST_IDS, LARGEST_SIGMA_PX = 100_000, 100.0
#: Deviation of a quaternion's norm from 1, as in maps.
_NORM_TOLERANCE = 0.01
#: Limit of stamps: messages have 32-bit seconds.
_LATEST_NS = 2**31 * SECOND_NS
#: Limit of corners [px]: they may lie outside the picture, but within this range.
_FARTHEST_CORNER = 1e5
#: Plausible IMU samples: period [s], median of the specific force [m/s^2], largest turn rate [rad/s]. No flight takes
#: half of gravity away for most of the time, or shakes by ten times as much.
_STEPS_S, _FORCES, _FAST = (2e-5, 1.0), (4.9, 98.0), 35.0


@dataclass(frozen=True)
class Corners:
    """Markers of one frame: IDs (N,), corners (N, 4, 2) [px], and their standard deviations (N,) [px], NaN: unknown."""

    stamp_ns: int
    ids: IntArray
    corners_px: FloatArray
    sigma_px: FloatArray


@dataclass(frozen=True)
class Picture:
    """A frame on disk."""

    stamp_ns: int
    path: Path


@dataclass(frozen=True)
class Recording:
    """A flight from a folder; the frames are pictures, corners or camera poses."""

    rig: Rig
    samples: list[ImuSample]
    pictures: list[Picture] = field(default_factory=list)
    corners: list[Corners] = field(default_factory=list)
    poses: list[CameraPose] = field(default_factory=list)
    #: stamps (N,) [ns] and T_map_body (N, 4, 4)
    truth: tuple[IntArray, FloatArray] | None = None


def read_recording(
    folder: Path, camera: str = 'cam0', camchain: Path | None = None, imu: Path | None = None
) -> Recording:
    """The flight in ``folder``, in any of the three layouts.

    Parameters
    ----------
    camera : name of the camera
    camchain, imu : Kalibr's files of the rig; default: those in the folder

    Raises
    ------
    InputError
        None of the layouts, a missing file, invalid content, or frames and IMU of different times; the message names
        file and line.
    """
    recording = _read(folder, camera, camchain, imu)
    _require_common_time(folder, recording)
    return recording


def _require_common_time(folder: Path, recording: Recording) -> None:
    """Raise InputError unless frames and IMU samples overlap: those of two clocks, or two units, give no pose."""
    frames = [
        *(picture.stamp_ns for picture in recording.pictures),
        *(frame.stamp_ns for frame in recording.corners),
        *(pose.stamp_ns for pose in recording.poses),
    ]
    samples = [sample.stamp_ns for sample in recording.samples]
    apart = max(min(frames) - max(samples), min(samples) - max(frames)) / SECOND_NS
    if apart > LARGEST_OFFSET_S:
        remark = f'frames and IMU samples are {apart:.3g} s apart'
        raise InputError(f'{folder}: {remark}: are all stamps nanoseconds of one clock?')


def _read(folder: Path, camera: str, camchain: Path | None, imu: Path | None) -> Recording:
    require_folder(folder)
    is_kalibr = (folder / 'imu0.csv').exists()
    if (camchain or imu) and not is_kalibr:
        raise InputError(f"{folder}: no imu0.csv: --camchain and --imu are for Kalibr's layout")
    if (folder / 'imu.csv').exists():
        return _ours(folder, camera)
    asl = next((place for place in (folder, folder / 'mav0') if (place / 'imu0' / 'data.csv').exists()), None)
    if asl is not None:
        return _asl(asl, camera)
    if is_kalibr:
        return _kalibr(folder, camera, camchain, imu)
    raise InputError(f'{folder}: no imu.csv (ours), imu0/data.csv (EuRoC) or imu0.csv (Kalibr)')


def _ours(folder: Path, camera: str) -> Recording:
    rig = of_rig(folder / 'rig.yaml', camera)
    reference = folder / 'reference.tum'
    truth = None
    if reference.exists():
        stamps, positions, quaternions = load_tum(reference)
        truth = stamps, transform_from_quaternion(positions, quaternions)
    samples = imu_samples(folder / 'imu.csv')
    poses = folder / 'camera_pose.csv'
    if poses.exists():
        return Recording(rig, samples, poses=_poses(poses), truth=truth)
    files = [folder / name for name in (f'{camera}.csv', 'detections.csv')]
    detections = next((path for path in files if path.exists()), None)
    if detections is None:
        raise InputError(f'{folder}: no {camera}.csv, detections.csv or camera_pose.csv')
    return Recording(rig, samples, corners=list(_corners(detections)), truth=truth)


def _asl(folder: Path, camera: str) -> Recording:
    rig = of_sensor(folder / camera / 'sensor.yaml', folder / 'imu0' / 'sensor.yaml')
    pictures = [
        Picture(_stamp(f'{folder / camera / "data.csv"} line {number}', words[0]), folder / camera / 'data' / words[1])
        for number, words in _lines(folder / camera / 'data.csv', 2)
    ]
    samples = imu_samples(folder / 'imu0' / 'data.csv')
    reference = folder / 'state_groundtruth_estimate0'
    truth = _asl_truth(reference, folder / 'imu0') if (reference / 'data.csv').exists() else None
    return Recording(rig, samples, pictures=pictures, truth=truth)


def _asl_truth(reference: Path, imu: Path) -> tuple[IntArray, FloatArray]:
    """Stamps [ns] and poses (N, 4, 4) of the IMU, from those of a sensor in the folder ``reference``."""
    # Position, then the quaternion with w first.
    stamps, values = _table(reference / 'data.csv', 8, _is_pose)
    T_map_sensor = transform_from_quaternion(values[:, :3], values[:, [4, 5, 6, 3]])
    place = reference / 'sensor.yaml'
    T_body_sensor = body_sensor(place) if place.exists() else np.eye(4)
    return stamps, T_map_sensor @ inverse(T_body_sensor) @ body_sensor(imu / 'sensor.yaml')


def _kalibr(folder: Path, camera: str, camchain: Path | None, imu: Path | None) -> Recording:
    chains = sorted(folder.glob('*camchain*.yaml'))
    chain = camchain or _only(folder, chains)
    known = densities(imu) if imu else _densities_in(folder, [chain, *chains])
    place = folder / camera
    require_folder(place)
    pictures = [Picture(_stamp(str(path), path.stem), path) for path in pictures_in(place)]
    if not pictures:
        raise InputError(f'{place}: no pictures')
    pictures.sort(key=lambda picture: picture.stamp_ns)
    return Recording(of_camchain(chain, camera, known), imu_samples(folder / 'imu0.csv'), pictures=pictures)


def _only(folder: Path, chains: list[Path]) -> Path:
    """The camchain with the IMU, which Kalibr leaves beside that of the cameras alone; InputError for several."""
    found = [path for path in chains if 'imucam' in path.name] or chains
    if len(found) != 1:
        there = listed([path.name for path in found]) if found else 'no camchain file beside the pictures'
        raise InputError(f'{folder}: {there}: name one with --camchain')
    return found[0]


def _densities_in(folder: Path, chains: list[Path]) -> dict[str, float]:
    """Those of the IMU files in the folder, which Kalibr leaves twice; raises InputError for different ones."""
    given = {path.name: densities(path) for path in sorted(folder.glob('*imu*.yaml')) if path not in chains}
    known = {name: noise for name, noise in given.items() if noise}
    first = next(iter(known.values()), {})
    if any(noise != first for noise in known.values()):
        raise InputError(f'{folder}: {listed(known)}: different noise densities: name one with --imu')
    return first


# --- tables -------------------------------------------------------------------------------------------


def _lines(path: Path, least: int, names: Sequence[str] = ()) -> Iterator[tuple[int, list[str]]]:
    """Number and cells of each line, without comments and header.

    Raises
    ------
    InputError
        Unreadable, no lines, a line with fewer cells than ``least``, or a header with ``names`` of columns elsewhere.
    """
    head, empty = True, True
    for number, words in csv_rows(path):
        if words[0].lstrip('# ') in names[:1]:
            _require_order(f'{path} line {number}', words, names)
        if words[0].startswith('#'):
            continue
        names_columns, head = head and not words[0][:1].isdigit(), False
        if names_columns:
            continue
        if len(words) < least:
            raise InputError(f'{path} line {number}: {len(words)} values, at least {least} are needed')
        empty = False
        yield number, words
    if empty:
        raise InputError(f'{path}: no lines of numbers')


def _require_order(where: str, head: Sequence[str], names: Sequence[str]) -> None:
    """Raise InputError for a header with one of ``names`` in another column: values are known by their places."""
    for column, name in enumerate(head):
        if name in names and names.index(name) != column:
            raise InputError(f'{where}: column {column + 1} is {name}; they are {", ".join(names)}')


def _table(
    path: Path, columns: int, possible: Callable[[list[float]], bool], names: Sequence[str] = ()
) -> tuple[IntArray, FloatArray]:
    """Stamps (N,) [ns] and values (N, M) of at least ``columns`` columns, stamp included; each row is ``possible``."""
    stamps, rows = [], []
    for number, words in _lines(path, columns, names):
        where = f'{path} line {number}'
        stamps.append(_stamp(where, words[0]))
        rows.append(_numbers(where, words[1:]))
        if not possible(rows[-1]):
            raise InputError(f'{where}: numbers, but none that were measured')
    if len({len(row) for row in rows}) > 1:
        raise InputError(f'{path}: lines of different lengths')
    return np.array(stamps, dtype=np.int64), np.array(rows)


def _stamp(where: str, word: str) -> int:
    # At most the digits of int64; the length is checked first, since int() of thousands of digits raises.
    if not (word.isascii() and word.isdigit() and len(word) <= 19 and int(word) < _LATEST_NS):
        raise InputError(f'{where}: {word[:40]!r} is no stamp in nanoseconds')
    return int(word)


def _numbers(where: str, words: list[str]) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f'{where}: not numbers') from None
    if not np.isfinite(values).all():
        raise InputError(f'{where}: not finite')
    return values


def imu_samples(path: Path) -> list[ImuSample]:
    """Samples of a CSV file of ours, EuRoC or Kalibr: stamp [ns], turn rates [rad/s], specific forces [m/s^2].

    Raises
    ------
    InputError
        Unreadable, no such columns, or most likely in other units; the message names file and line.
    """
    stamps, values = _table(path, 7, lambda row: is_imu_reading(row[:3], row[3:6]), _IMU)
    check_units(path, stamps, values)
    return [ImuSample(int(stamp), row[:3], row[3:6]) for stamp, row in zip(stamps, values, strict=True)]


def check_units(path: Path, stamps: IntArray, values: FloatArray) -> None:
    """Raise InputError for stamps (N,), turn rates and forces (N, 6) most likely in another unit or without gravity."""
    step = float(np.median(np.diff(np.sort(stamps)))) / SECOND_NS if len(stamps) > 1 else _STEPS_S[1]
    if not _STEPS_S[0] <= step <= _STEPS_S[1]:
        raise InputError(f'{path}: samples {step:.3g} s apart: are the stamps in nanoseconds?')
    if not _FORCES[0] < (force := float(np.median(np.linalg.norm(values[:, 3:6], axis=1)))) < _FORCES[1]:
        mean = f'accelerations of {force:.2f} m/s^2 on average, gravity makes them 9.8'
        raise InputError(f'{path}: {mean}: are they in g, or without gravity?')
    if (turn := float(np.percentile(np.linalg.norm(values[:, :3], axis=1), 90))) > _FAST:
        raise InputError(f'{path}: a tenth of the turn rates above {turn:.0f} rad/s: are they in degrees a second?')


def _is_detection(row: list[float]) -> bool:
    """Whether a row has an ID, eight coordinates and optionally a standard deviation."""
    corners, sigma = row[1:9], row[9:10]
    return (
        row[0] in range(MOST_IDS)
        and max(map(abs, corners)) < _FARTHEST_CORNER
        and all(0 < s < LARGEST_SIGMA_PX for s in sigma)
    )


def _corners(path: Path) -> Iterator[Corners]:
    stamps, values = _table(path, 10, _is_detection, _CORNERS)
    order = np.argsort(stamps, kind='stable')
    stamps, values = stamps[order], values[order]
    for rows in np.split(np.arange(len(stamps)), np.flatnonzero(np.diff(stamps)) + 1):
        frame = values[rows]
        sigma = frame[:, 9] if values.shape[1] > 9 else np.full(len(rows), np.nan)
        yield Corners(int(stamps[rows[0]]), frame[:, 0].astype(np.int64), frame[:, 1:9].reshape(-1, 4, 2), sigma)


def _is_pose(row: list[float]) -> bool:
    return max(map(abs, row[:3])) < LARGEST_COORDINATE and abs(math.hypot(*row[3:7]) - 1.0) < _NORM_TOLERANCE


def _poses(path: Path) -> list[CameraPose]:
    stamps, values = _table(path, 44, _is_pose, _POSES)
    T_map_camera = transform_from_quaternion(values[:, :3], values[:, 3:7])
    covariances = checked_covariance(values[:, 7:43].reshape(-1, 6, 6), f'{path}: pose with a covariance')
    rows = zip(stamps, T_map_camera, covariances, strict=True)
    return [CameraPose(int(stamp), T, covariance) for stamp, T, covariance in rows]
