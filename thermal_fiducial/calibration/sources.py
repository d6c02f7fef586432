"""Raw frames, IMU samples and intrinsics from a folder of pictures or a bag."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermal_fiducial.calibration.preintegration import ImuTrack
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner
from thermal_fiducial.core.types import Counts, FloatArray, Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, COMPRESSED_TOPIC, IMU_TOPIC
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.files.csv_rows import named_rows
from thermal_fiducial.files.images import image_to_array, PICTURE_SUFFIXES, pictures_in, stamp_to_ns
from thermal_fiducial.files.reading import naming
from thermal_fiducial.files.recordings import check_units, imu_samples
from thermal_fiducial.files.records import camera

#: Columns of a file of measured points; a header may hold more.
POINT_COLUMNS = ('view', 'point', 'u', 'v', 'x', 'y')
_IMAGE_TYPE, _IMU_TYPE, _INFO_TYPE = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/CameraInfo'
_COMPRESSED_TYPE = 'sensor_msgs/msg/CompressedImage'


@dataclass(frozen=True)
class RawFrame:
    """One raw frame.

    Parameters
    ----------
    name : of its file, or its number in the bag
    stamp_ns : of the bag's frames; pictures get artificial stamps ten seconds apart
    counts : (height, width)
    """

    name: str
    stamp_ns: int
    counts: Counts | Gray


def is_folder_of_pictures(source: Path) -> bool:
    """Whether ``source`` is a folder that holds no bag."""
    return source.is_dir() and not (source / 'metadata.yaml').exists()


def pictures(folder: Path) -> list[Path]:
    """Picture files of a folder in the order of their names.

    Raises
    ------
    InputError
        There are none.
    """
    if paths := pictures_in(folder):
        return paths
    raise InputError(f'{folder}: no pictures ({", ".join(PICTURE_SUFFIXES)}) and no bag')


def measured_points(path: Path, width: int, height: int) -> list[tuple[str, Sighting]]:
    """Views of a flat board from a CSV file with the columns view, point, u, v [px], x, y [m], by their names.

    Raises
    ------
    InputError
        No such file or columns, invalid numbers, points outside the image or twice in a view.
    """
    views: dict[str, dict[str, list[float]]] = {}
    for number, (view, point, *cells) in named_rows(path, POINT_COLUMNS):
        where = f'{path}, line {number}'
        points = views.setdefault(view, {})
        if point in points:
            raise InputError(f'{where}: point {point} of view {view} for the second time')
        points[point] = _measured(cells, where, width, height)
    return [(name, _flat_sighting(np.array(list(points.values())))) for name, points in views.items()]


def _measured(cells: list[str], where: str, width: int, height: int) -> list[float]:
    try:
        u, v, x, y = map(float, cells)
    except ValueError:
        raise InputError(f'{where}: u, v, x and y must be numbers') from None
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5 and np.isfinite(x) and np.isfinite(y)):
        raise InputError(f'{where}: a point that lies outside {width} x {height} pixels, or on no board')
    return [u, v, x, y]


def _flat_sighting(values: FloatArray) -> Sighting:
    return Sighting(np.column_stack([values[:, 2:], np.zeros(len(values))]), values[:, :2])


def clean_frames(bag: BagReader) -> Iterator[RawFrame]:
    """Frames of a bag as the detector receives them, without frozen ones."""
    bag.require({bag.image_topic: _COMPRESSED_TYPE if bag.image_topic == COMPRESSED_TOPIC else _IMAGE_TYPE})
    cleaner = FrameCleaner(Tau2CameraConfig())
    for index, entry in enumerate(bag.messages([bag.image_topic])):
        stamp_ns = stamp_to_ns(entry.message.header.stamp)
        with naming(bag.path):
            frame = cleaner.process(stamp_ns, image_to_array(entry.message))
        if frame.counts is not None:
            yield RawFrame(str(index), stamp_ns, frame.counts)


def recorded_camera(bag: BagReader) -> Camera:
    """Recorded intrinsics of a bag.

    Raises
    ------
    InputError
        There are none, or they are impossible.
    """
    bag.require({CAMERA_INFO_TOPIC: _INFO_TYPE})
    info = next(bag.messages([CAMERA_INFO_TOPIC])).message
    with naming(bag.path):
        return camera(info)


def camera_of(bag: BagReader, calibration: Path | None) -> Camera:
    """Intrinsics of a file, else of the bag.

    Raises
    ------
    InputError
        There are none, or the images of the bag have another size.
    """
    if calibration is None:
        return recorded_camera(bag)
    given = load_camera(calibration)
    if CAMERA_INFO_TOPIC in bag.topics:
        there = recorded_camera(bag)
        if (there.width, there.height) != (given.width, given.height):
            sizes = f'{given.width}x{given.height} pixels, the bag of {there.width}x{there.height}'
            raise InputError(f'{calibration}: a calibration of {sizes}')
    return given


def imu_track(bag: BagReader) -> tuple[ImuTrack, int]:
    """IMU samples in order, in seconds since the returned stamp [ns].

    Raises
    ------
    InputError
        No topic of IMU samples, or samples that are invalid or most likely in other units.
    """
    bag.require({IMU_TOPIC: _IMU_TYPE})
    stamps, values = [], []
    for entry in bag.messages([IMU_TOPIC]):
        message = entry.message
        stamps.append(stamp_to_ns(message.header.stamp))
        rate, force = message.angular_velocity, message.linear_acceleration
        values.append((rate.x, rate.y, rate.z, force.x, force.y, force.z))
    samples = np.array(values, dtype=np.float64)
    track = _in_order(bag.path, stamps, samples)
    check_units(bag.path, np.array(stamps, dtype=np.int64), samples)
    return track


def imu_track_of_csv(path: Path) -> ImuTrack:
    """IMU samples of a CSV file in order, as :func:`imu_track`; see :func:`imu_samples`."""
    samples = imu_samples(path)
    values = np.array([(*sample.angular_velocity, *sample.linear_acceleration) for sample in samples])
    return _in_order(path, [sample.stamp_ns for sample in samples], values)[0]


def _in_order(path: Path, stamps: Sequence[int], values: FloatArray) -> tuple[ImuTrack, int]:
    """Track of samples, turn rates and forces (N, 6), and its first stamp [ns]."""
    order, first = np.unique(np.array(stamps, dtype=np.int64), return_index=True)
    table = values[first]
    if len(order) < 2 or not np.all(np.isfinite(table)):
        raise InputError(f'{path}: the IMU samples are not finite numbers at increasing stamps')
    return ImuTrack((order - order[0]) * 1e-9, table[:, :3], table[:, 3:]), int(order[0])
