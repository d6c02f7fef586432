"""The four stages composed: the node graph offline, for one camera and a map that no service replaces.

Tests, benchmarks and tools run it without ROS. What passes from stage to stage is what the topics carry, in their
precision, so a lock-step replay through the nodes gives the same numbers. The nodes alone fuse a second camera
(``ros/mapper_node/camera_poses.py``), and move the filter with a map that is loaded or reset (``map_correction``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from thermal_fiducial.config import (
    ArucoDetectorConfig,
    check_names,
    from_mapping,
    MarkerMapperConfig,
    PoseEkfConfig,
    Tau2CameraConfig,
)
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.detection.patterns import Dictionary
from thermal_fiducial.core.filter.belief import PoseUpdate
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner
from thermal_fiducial.core.mapping.keyframes import VIEWS
from thermal_fiducial.core.mapping.map_data import MapperResult, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import ImuSample, Markers, Odometry, places_of, whole_ns
from thermal_fiducial.core.motion_prior import MotionPrior, plausible
from thermal_fiducial.core.types import Counts, FloatArray, Gray, IntArray


@dataclass(frozen=True)
class PipelineConfig:
    """The parameters of the four stages."""

    tau2_camera: Tau2CameraConfig = field(default_factory=Tau2CameraConfig)
    aruco_detector: ArucoDetectorConfig = field(default_factory=ArucoDetectorConfig)
    marker_mapper: MarkerMapperConfig = field(default_factory=MarkerMapperConfig)
    pose_ekf: PoseEkfConfig = field(default_factory=PoseEkfConfig)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> 'PipelineConfig':
        """One parameter file for all stages: ROS name to value.

        Raises
        ------
        InputError
            A name that no stage has, or a value of the wrong type or out of range.
        """
        values = dict(values)
        check_names(values)
        return cls(
            from_mapping(Tau2CameraConfig, values),
            from_mapping(ArucoDetectorConfig, values),
            from_mapping(MarkerMapperConfig, values),
            from_mapping(PoseEkfConfig, values),
        )


@dataclass(frozen=True)
class FrameResult:
    """Results of the stages for one thermal frame; None for those that it did not reach."""

    stamp_ns: int
    #: why the frame was withheld; empty for a good one
    withheld: str = ''
    markers: Markers | None = None
    mapping: MapperResult | None = None
    update: PoseUpdate | None = None


def as_published(T: FloatArray) -> FloatArray:
    """A transform after conversion to position and quaternion and back, as in a message."""
    return transform_from_quaternion(T[:3, 3], quaternion_from_rotation(T[:3, :3]))


def as_received(states: Sequence[Odometry]) -> list[Odometry]:
    """The filter's odometry as detector and mapper read it from its messages."""
    return plausible([replace(state, T_map_body=as_published(state.T_map_body)) for state in states])


class Pipeline:
    """Frames and IMU samples in, in the order of their arrival; odometry out.

    Parameters
    ----------
    config : parameters of the stages
    dictionary : ArUco dictionary of the markers
    marker_map : the map to start from; at least one marker with a known pose
    camera : intrinsics; may come later, frames before it give nothing
    bad_pixels : (N, 2) column and row of dead pixels
    """

    def __init__(
        self,
        config: PipelineConfig,
        dictionary: Dictionary,
        marker_map: MarkerMap,
        camera: Camera | None = None,
        bad_pixels: IntArray | None = None,
    ) -> None:
        self.camera = camera
        self.cleaner = FrameCleaner(config.tau2_camera, bad_pixels)
        self.detector = MarkerDetector(config.aruco_detector, dictionary)
        self.mapper = MarkerMapper(config.marker_mapper, marker_map)
        self.filter = PoseEkf(config.pose_ekf)
        self._odometry = MotionPrior(config.aruco_detector.camera_time_offset, as_received)
        self._share_map()

    def add_imu(self, sample: ImuSample) -> Odometry | None:
        """Odometry at the stamp of an IMU sample; None before the filter is initialised."""
        odometry = self.filter.add_imu(sample)
        if odometry is not None:
            self._odometry.add(odometry.stamp_ns, odometry)
        return odometry

    def add_image(self, stamp_ns: int, counts: Counts | Gray) -> FrameResult:
        """Clean, detect, map and correct with one raw thermal frame (H, W) at its stamp.

        Raises
        ------
        InputError
            The calibration is of another image size, the image is none, or its stamp is not an integer.
        """
        stamp_ns = whole_ns(stamp_ns, 'image')
        frame = self.cleaner.process(stamp_ns, counts)
        if frame.counts is None or self.camera is None:
            return FrameResult(stamp_ns, withheld=frame.reason or 'no camera_info')
        markers = self.detector.detect(stamp_ns, frame.counts, self.camera, self._odometry)
        mapping = self.mapper.learn(self.mapper.locate(stamp_ns, markers, self.camera, self._odometry))
        update = None
        if (pose := mapping.pose) is not None:
            update = self.filter.add_pose(replace(pose, T_map_camera=as_published(pose.T_map_camera)))
            if (offset := self.filter.camera_time_offset) is not None:
                self._odometry.set_clock_offset(offset)
        refined = self.mapper.refinement_due(stamp_ns) and self.mapper.refine(VIEWS) is not None
        if refined or mapping.map_changed:
            self._share_map()
        return FrameResult(stamp_ns, markers=markers, mapping=mapping, update=update)

    def finish(self) -> None:
        """Refine the map with the last keyframes, as the mapper does before it saves at the end."""
        if self.mapper.has_unrefined and self.mapper.refine(VIEWS) is not None:
            self._share_map()

    def _share_map(self) -> None:
        """Give the detector the map, as the ``marker_map`` topic does."""
        self.detector.set_map(*places_of(self.mapper.map.rows()))
