"""Inputs of the pipeline from a bag, without ROS: calibration, IMU samples and raw frames."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.types import Counts, Gray
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMU_TOPIC
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.files.records import camera, imu_sample, stamp_ns


@dataclass(frozen=True, slots=True)
class ThermalFrame:
    """One raw frame of the camera driver."""

    stamp_ns: int
    #: (H, W), uint16 counts or uint8
    counts: Counts | Gray


def read_bag(path: str | Path, remap: Mapping[str, str] | None = None) -> Iterator[Camera | ImuSample | ThermalFrame]:
    """Calibrations, IMU samples and raw frames of a bag, in recorded order.

    Parameters
    ----------
    path : rosbag2 folder, ``.mcap``, ``.db3`` or ROS 1 ``.bag``, with the topics ``thermal/image_raw`` or
        ``thermal/image_raw/compressed`` (PNG), ``thermal/camera_info``, ``imu/data``; missing ones are skipped
    remap : topic of the bag to one of these names

    Yields
    ------
    Camera
        The calibration, as often as the bag has it.
    ImuSample
        Angular velocity and specific force.
    ThermalFrame
        All else: ``stamp_ns``, and ``counts``, an (H, W) array of uint16, or of uint8 in an 8-bit bag.

    Raises
    ------
    InputError
        An unusable bag or message.
    """
    with BagReader(path, remap) as bag:
        convert: dict[str, Callable[[Any], Camera | ImuSample | ThermalFrame]] = {
            CAMERA_INFO_TOPIC: camera,
            IMU_TOPIC: imu_sample,
            bag.image_topic: _frame,
        }
        for recorded in bag.messages(convert):
            yield convert[recorded.topic](recorded.message)


def _frame(message: Any) -> ThermalFrame:
    return ThermalFrame(stamp_ns(message.header.stamp), image_to_array(message))
