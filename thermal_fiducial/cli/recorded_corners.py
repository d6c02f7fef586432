"""Bags that have the corners of markers instead of images, as those of ``import`` do."""

from collections.abc import Iterator

from thermal_fiducial.core.measurements import Markers
from thermal_fiducial.files.bags import BagReader, MARKERS_TOPIC
from thermal_fiducial.files.images import stamp_to_ns


def has_corners_only(bag: BagReader) -> bool:
    """Whether the bag has the corners of markers instead of images."""
    return bag.image_topic not in bag.topics and MARKERS_TOPIC in bag.topics


def recorded_rows(bag: BagReader) -> Iterator[tuple[int, Markers]]:
    """Stamps and detections that a bag holds."""
    # Needs ROS, which calibration by images does without.
    from thermal_fiducial.ros.messages.clouds import markers

    bag.require({MARKERS_TOPIC: 'sensor_msgs/msg/PointCloud2'})
    for entry in bag.messages([MARKERS_TOPIC]):
        yield stamp_to_ns(entry.message.header.stamp), markers(entry.message)
