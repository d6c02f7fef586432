"""Converts a recording to a bag for ``replay``, with a parameter file of its rig."""

from collections.abc import Callable, Iterator
import heapq
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation
from thermal_fiducial.core.measurements import Markers
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files import bag_messages
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.bags import (
    CAMERA_INFO_TOPIC,
    CAMERA_POSE_TOPIC,
    IMAGE_TOPIC,
    IMU_TOPIC,
    MARKERS_TOPIC,
    TRUTH_TOPIC,
)
from thermal_fiducial.files.images import read_gray
from thermal_fiducial.files.plain_yaml import save_plain
from thermal_fiducial.files.recordings import Corners, Recording
from thermal_fiducial.files.rig_files import Rig

_Recorded = tuple[int, str, Any]


def write_recording(
    out: Path,
    recording: Recording,
    sigma_px: float,
    late: float = 0.0,
    storage: str = 'mcap',
    progress: Callable[[int], None] = lambda frames: None,
) -> None:
    """Write the bag ``out``, with ``params.yaml`` in its folder.

    Parameters
    ----------
    sigma_px : standard deviation of corners whose file has none [px]
    late : delay of the frames between stamp and recording [s]
    progress : called with the number of frames written since the last call

    Raises
    ------
    InputError
        ``out`` exists or cannot be written, an unreadable picture, or corners without a marker size.
    """
    if recording.corners and recording.rig.marker_size <= 0.0:
        raise InputError('the recording does not say how large its markers are: give --marker-size')
    late_ns = round((late + recording.rig.time_offset) * SECOND_NS)
    parts = [_imu(recording), _frames(recording, sigma_px, late_ns), _truth(recording)]
    parameters = {'/**': {'ros__parameters': _parameters(recording.rig)}}
    with BagWriter(out, storage) as bag:
        for stamp_ns, topic, message in heapq.merge(*parts, key=lambda event: event[0]):
            # Stamps may begin at 0, with frames from before the IMU's; bags have no earlier times.
            bag.write(topic, max(stamp_ns, 0), message)
            if topic in (IMAGE_TOPIC, MARKERS_TOPIC, CAMERA_POSE_TOPIC):
                progress(1)
        save_plain(out / 'params.yaml', parameters)


def frame_count(recording: Recording) -> int:
    """Number of frames: pictures, corners or camera poses."""
    return len(recording.pictures) + len(recording.corners) + len(recording.poses)


def _imu(recording: Recording) -> Iterator[_Recorded]:
    """IMU samples in recorded order; the recording time of a backward stamp is that of the sample before."""
    arrival_ns = 0
    for sample in recording.samples:
        arrival_ns = max(arrival_ns, sample.stamp_ns)
        yield arrival_ns, IMU_TOPIC, bag_messages.imu(sample)


def _frames(recording: Recording, sigma_px: float, late_ns: int) -> Iterator[_Recorded]:
    camera = recording.rig.camera
    for picture in recording.pictures:
        arrival = picture.stamp_ns + late_ns
        yield arrival, CAMERA_INFO_TOPIC, bag_messages.camera_info(picture.stamp_ns, camera)
        yield arrival, IMAGE_TOPIC, bag_messages.image(picture.stamp_ns, read_gray(picture.path))
    for frame in recording.corners:
        arrival = frame.stamp_ns + late_ns
        yield arrival, CAMERA_INFO_TOPIC, bag_messages.camera_info(frame.stamp_ns, camera)
        yield arrival, MARKERS_TOPIC, bag_messages.markers(frame.stamp_ns, _rows(frame, recording.rig, sigma_px))
    for pose in recording.poses:
        yield pose.stamp_ns + late_ns, CAMERA_POSE_TOPIC, bag_messages.camera_pose(pose)


def _rows(frame: Corners, rig: Rig, sigma_px: float) -> Markers:
    sigma = np.where(np.isfinite(frame.sigma_px), frame.sigma_px, sigma_px)
    covariances = (sigma**2)[:, None, None, None] * np.broadcast_to(np.eye(2), (len(sigma), 4, 2, 2))
    sizes = np.full(len(sigma), rig.marker_size)
    return rows_from_corners(frame.ids, frame.corners_px, covariances, sizes, rig.camera)


def _truth(recording: Recording) -> Iterator[_Recorded]:
    if recording.truth is not None:
        for stamp_ns, T_map_body in zip(*recording.truth, strict=True):
            yield int(stamp_ns), TRUTH_TOPIC, bag_messages.truth(int(stamp_ns), T_map_body)


def _parameters(rig: Rig) -> dict[str, Any]:
    """Parameters of the nodes for the rig; not a thermal camera, so without bolometer lag."""
    return {
        **({'dictionary': rig.dictionary} if rig.dictionary else {}),
        **({'marker_size': rig.marker_size} if rig.marker_size > 0.0 else {}),
        'camera_position': rig.T_body_camera[:3, 3].tolist(),
        'camera_orientation': quaternion_from_rotation(rig.T_body_camera[:3, :3]).tolist(),
        'camera_time_offset': rig.time_offset,
        'bolometer_lag': 0.0,
        **({'imu': rig.imu_noise} if rig.imu_noise else {}),
    }
