"""The camera and the detector of a simulated scenario, and what a filter tells it."""

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.motion_prior import MotionPrior


def camera_of(scenario):
    lens = scenario.lens
    return Camera(lens.width, lens.height, lens.matrix, lens.model, lens.distortion)


def detector_of(scenario, *, with_map):
    """A detector that knows the rig and, ``with_map``, where the markers are."""
    config = ArucoDetectorConfig(
        marker_size=scenario.markers[0].size,
        camera_position=scenario.camera_position,
        camera_orientation=scenario.camera_orientation,
    )
    detector = MarkerDetector(config, scenario.aruco_dictionary)
    if with_map:
        detector.set_map({marker.id: (marker.T_map_marker, marker.size) for marker in scenario.markers})
    return detector


def told(*states):
    """A log of these states of the filter."""
    log = MotionPrior()
    for state in states:
        log.add(state.stamp_ns, lambda state=state: state)
    return log
