"""What the algorithms take from a bag: calibration, IMU samples and raw frames. No ROS is needed for it."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.types import Counts, Gray
from thermal_fiducial.files.bags import BagReader, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.files.images import image_to_array
from thermal_fiducial.files.records import camera, imu_sample, stamp_ns


@dataclass(frozen=True, slots=True)
class ThermalFrame:
    """One raw frame, as the camera's driver published it."""

    stamp_ns: int
    #: (H, W), uint16 counts or uint8
    counts: Counts | Gray


def read_bag(path: str | Path, remap: Mapping[str, str] | None = None) -> Iterator[Camera | ImuSample | ThermalFrame]:
    """Calibrations, IMU samples and raw frames of a bag, in the order of their arrival.

    Parameters
    ----------
    path : rosbag2 folder, ``.mcap``, ``.db3`` or ROS 1 ``.bag``, with the topics ``thermal/image_raw``,
        ``thermal/camera_info`` and ``imu/data``; those that are missing give nothing
    remap : topic of the bag to one of these names

    Raises
    ------
    InputError
        A bag or a message that cannot be used.
    """
    convert: dict[str, Callable[[Any], Camera | ImuSample | ThermalFrame]] = {
        CAMERA_INFO_TOPIC: camera,
        IMU_TOPIC: imu_sample,
        IMAGE_TOPIC: _frame,
    }
    with BagReader(path, remap) as bag:
        for recorded in bag.messages(convert):
            yield convert[recorded.topic](recorded.message)


def _frame(message: Any) -> ThermalFrame:
    return ThermalFrame(stamp_ns(message.header.stamp), image_to_array(message))
