"""Where a drone is in smoke and fog: acrylic markers seen by a thermal camera, and an IMU.

What stands in ``__all__`` is stable: it changes only with a line in the changelog and a new minor version. Each name is
imported when it is first used, so that a node loads no more than it needs.

The layers, each importing only from those below it (checked by import-linter)::

    cli                               commands
    replay                            recorded bags through the real nodes
    nodes  report                     thin ROS 2 nodes; plots and HTML
    ros                               messages to records, parameters, QoS, run loop
    sim  calibration  map_tools       simulator, calibration, maps off the robot
    fabrication  cameras              drawings of markers, drivers of cameras
    files                             bags, maps, calibrations, trajectories
    core                              the algorithms: no ROS, no files, no clock, no printing
    config  errors                    every parameter once; the one error for unusable input
"""

from importlib import import_module
import os
from typing import Any, TYPE_CHECKING

# Read by OpenCV when it is loaded: a picture whose header promises more (100 times the Tau 2's) is refused before any
# memory is taken for it.
os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(1 << 25))

if TYPE_CHECKING:
    from thermal_fiducial.core.detection.detector import MarkerDetector
    from thermal_fiducial.core.filter.ekf import PoseEkf
    from thermal_fiducial.core.geometry.camera import Camera
    from thermal_fiducial.core.mapping.map_data import MarkerMap
    from thermal_fiducial.core.mapping.mapper import MarkerMapper
    from thermal_fiducial.core.measurements import CameraPose, ImuSample, Odometry
    from thermal_fiducial.core.pipeline import Pipeline
    from thermal_fiducial.errors import InputError
    from thermal_fiducial.files.camera_info import load_camera
    from thermal_fiducial.files.dictionary import load_dictionary
    from thermal_fiducial.files.marker_map import load_map, save_map
    from thermal_fiducial.files.sensor_bag import read_bag
    from thermal_fiducial.replay.settings import load_config
    from thermal_fiducial.sim.writer import simulate

__version__ = '0.2.0'

__all__ = [
    'Camera',
    'CameraPose',
    'ImuSample',
    'InputError',
    'MarkerDetector',
    'MarkerMap',
    'MarkerMapper',
    'Odometry',
    'Pipeline',
    'PoseEkf',
    'load_camera',
    'load_config',
    'load_dictionary',
    'load_map',
    'read_bag',
    'save_map',
    'simulate',
]

_MODULES = {
    'core.detection.detector': ('MarkerDetector',),
    'core.filter.ekf': ('PoseEkf',),
    'core.geometry.camera': ('Camera',),
    'core.mapping.map_data': ('MarkerMap',),
    'core.mapping.mapper': ('MarkerMapper',),
    'core.measurements': ('CameraPose', 'ImuSample', 'Odometry'),
    'core.pipeline': ('Pipeline',),
    'errors': ('InputError',),
    'files.camera_info': ('load_camera',),
    'files.dictionary': ('load_dictionary',),
    'files.marker_map': ('load_map', 'save_map'),
    'files.sensor_bag': ('read_bag',),
    'replay.settings': ('load_config',),
    'sim.writer': ('simulate',),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _MODULE_OF:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = globals()[name] = getattr(import_module(f'{__name__}.{_MODULE_OF[name]}'), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
