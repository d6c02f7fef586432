"""The camera and the detector of a simulated scenario, and what a filter knows."""

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.files.dictionary import load_dictionary


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
    detector = MarkerDetector(config, load_dictionary(scenario.dictionary))
    if with_map:
        detector.set_map({marker.id: (marker.T_map_marker, marker.size) for marker in scenario.markers})
    return detector


def motion_prior(*states, clock_offset=0.0):
    """What these states of the filter say [s]; None: it doesn't know the offset of the clocks yet."""
    prior = MotionPrior()
    if clock_offset is not None:
        prior.set_clock_offset(clock_offset)
    for state in states:
        prior.add(state.stamp_ns, state)
    return prior
