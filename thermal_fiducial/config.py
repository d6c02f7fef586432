"""Every parameter of the four nodes: default, range, unit, description.

The nodes declare these as ROS parameters, the offline pipeline takes the same objects, and
``config/thermal_fiducial.yaml`` is checked against them, so a default lives in one place.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, Field, field, fields, MISSING
import difflib
import math
from typing import Any, TypeVar

from thermal_fiducial.errors import InputError

Config = TypeVar('Config')
#: By how much the norm of a quaternion that somebody typed may be off.
_NORM_TOLERANCE = 0.01
#: Characters of a value that an error shows.
_LONGEST_SHOWN = 100
#: Parameters that rclpy declares on every node.
_OF_ROS = ('use_sim_time', 'start_type_description_service')


def param(
    default: Any,
    description: str,
    *,
    unit: str = '',
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    length: int | None = None,
    normed: bool = False,
    verify: Callable[[Any], object] | None = None,
    live: bool = False,
) -> Any:
    """One parameter: a dataclass field with what ROS wants to know of it.

    Parameters
    ----------
    default : bool, int, float, str, or a tuple of floats, ints or strings
    description : one sentence for ``ros2 param describe``
    unit : appended to the description in brackets
    minimum, maximum : inclusive range of a number or of each number of a tuple
    choices : the allowed values of a string
    length : number of elements of a tuple of floats
    normed : whether their squares must add up to one, as a rotation's quaternion's do
    verify : called with the value, raises InputError if it cannot be used
    live : whether it may be set while the node runs; otherwise it is declared read-only
    """
    metadata = {
        'description': f'{description} [{unit}]' if unit else description,
        'minimum': minimum,
        'maximum': maximum,
        'choices': choices,
        'length': length,
        'normed': normed,
        'verify': verify,
        'live': live,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class SelfChecked:
    """Base of the configs: values are checked wherever an object is made, also by hand or by ``replace``.

    Raises
    ------
    InputError
        A value of the wrong type, out of range, or not among the choices.
    """

    def __post_init__(self) -> None:
        for item in fields(self):
            if item.default_factory is MISSING:
                object.__setattr__(self, item.name, checked(item.name, item, getattr(self, item.name)))


def group(kind: type) -> Any:
    """Parameters of dataclass ``kind`` under the field's name and a dot."""
    return field(default_factory=kind)


def parameters(config: Any, prefix: str = '') -> Iterator[tuple[str, 'Field[Any]', Any]]:
    """All parameters of a config (class or instance) as (ROS name, field, value or default)."""
    for item in fields(config):
        if item.default_factory is not MISSING:
            nested = item.default_factory() if isinstance(config, type) else getattr(config, item.name)
            yield from parameters(nested, f'{prefix}{item.name}.')
        else:
            value = item.default if isinstance(config, type) else getattr(config, item.name)
            yield prefix + item.name, item, value


def from_mapping(kind: type[Config], values: dict[str, Any]) -> Config:
    """Config of dataclass ``kind`` with ``values`` (ROS name to value) in place of the defaults.

    Names that ``kind`` doesn't have are left alone, as one parameter file serves all nodes; see :func:`check_names`.

    Raises
    ------
    InputError
        A value of the wrong type, out of range, or not among the choices.
    """
    return _build(kind, values, '')


def _build(kind: type[Config], values: dict[str, Any], prefix: str) -> Config:
    arguments: dict[str, Any] = {}
    for item in fields(kind):  # type: ignore[arg-type]
        name = prefix + item.name
        if item.default_factory is not MISSING:
            arguments[item.name] = _build(type(item.default_factory()), values, name + '.')
        elif name in values:
            arguments[item.name] = checked(name, item, values[name])
    return kind(**arguments)


def checked(name: str, item: 'Field[Any]', value: Any) -> Any:
    """``value`` as the type of the parameter's default.

    Raises
    ------
    InputError
        Wrong type, out of range, not among the choices, or no unit quaternion.
    """
    limits = item.metadata
    result = _typed(name, item.default, limits['length'], value)
    if limits['choices'] and result not in limits['choices']:
        raise InputError(f'parameter {name}: {_shown(result)} is not one of {", ".join(limits["choices"])}')
    low, high = limits['minimum'], limits['maximum']
    for element in result if isinstance(result, tuple) else (result,):
        if (low is not None and not element >= low) or (high is not None and not element <= high):
            raise InputError(f'parameter {name}: {_shown(element)} is outside {low} .. {high}')
    if limits['normed'] and not abs(math.hypot(*result) - 1.0) < _NORM_TOLERANCE:
        raise InputError(f'parameter {name}: {list(result)} is no unit quaternion')
    if limits['verify']:
        limits['verify'](result)
    return result


def _shown(value: object) -> str:
    """A value as an error shows it: in a line, whatever it is."""
    text = repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f'{text[:_LONGEST_SHOWN]}...'


def _typed(name: str, default: Any, length: int | None, value: Any) -> Any:
    if isinstance(default, tuple):
        if isinstance(value, str) or not hasattr(value, '__iter__'):
            raise InputError(f'parameter {name}: {_shown(value)} is not a list')
        elements = tuple(value)
        if length is not None and len(elements) != length:
            raise InputError(f'parameter {name}: {len(elements)} values, not {length}')
        return elements if length is None else tuple(_number(name, element) for element in elements)
    if isinstance(default, float):
        return _number(name, value)
    if not isinstance(value, type(default)) or (isinstance(value, bool) and not isinstance(default, bool)):
        raise InputError(f'parameter {name}: {_shown(value)} is not of type {type(default).__name__}')
    return value


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f'parameter {name}: {_shown(value)} is not a number')
    return float(value)


# --- parameters that several nodes share --------------------------------------------------------------


def _dictionary() -> Any:
    return param('DICT_4X4_50', 'ArUco dictionary: a name of OpenCV, or the path of a dictionary file of ours.')


def _marker_size() -> Any:
    return param(0.30, 'Side of the black square of a marker.', unit='m', minimum=0.005, maximum=10.0)


def _marker_size_overrides() -> Any:
    text = 'Sides of single markers, strings "ID:SIZE", e.g. ["7:0.50"].'
    return param((), text, unit='m', verify=size_overrides)


def _map_file() -> Any:
    return param('', 'Marker map (YAML). Empty: no map.')


def _mode() -> Any:
    return param(
        'mapping',
        'mapping: new markers enter the map; localization: the map never changes.',
        choices=('mapping', 'localization'),
    )


def _camera_position() -> Any:
    return param(
        (0.0, 0.0, 0.0),
        'Position of the camera in base_link (the IMU frame).',
        unit='m',
        length=3,
        minimum=-10.0,
        maximum=10.0,
    )


def _camera_orientation() -> Any:
    return param(
        (-0.5, 0.5, -0.5, 0.5),
        'Orientation of thermal_camera_optical in base_link, quaternion x y z w. Default: looks forward.',
        length=4,
        normed=True,
    )


def _base_frame() -> Any:
    return param('base_link', 'Frame of the robot: that of the IMU, unless TF or a URDF say otherwise.')


def _camera_frame() -> Any:
    return param('thermal_camera_optical', 'Optical frame of the camera in TF and URDF.')


def _extrinsics() -> Any:
    return param(
        'auto',
        'auto: camera_position and camera_orientation from /tf_static (needs tf2_msgs) or robot_description, where '
        'they connect camera_frame with the robot; parameters: always as set.',
        choices=('auto', 'parameters'),
    )


def _prefix_frames() -> Any:
    return param(False, "Put the node's namespace before the frames of the robot, not before that of the map.")


def _camera_time_offset() -> Any:
    return param(0.0, 'Clock offset of the camera, t_imu = t_camera + offset.', unit='s', minimum=-1.0, maximum=1.0)


def _time_offset_std() -> Any:
    return param(
        0.03,
        'How far camera_time_offset may be wrong (standard deviation); when it is not estimated, what is allowed for.',
        unit='s',
        minimum=0.0,
        maximum=0.2,
    )


def _image_rate() -> Any:
    text = 'Rate of the images, by which the diagnostics judge them; 0: that of the first seconds.'
    return param(0.0, text, unit='Hz', minimum=0.0, maximum=1000.0)


def _realtime_priority() -> Any:
    text = (
        'Priority of the camera under SCHED_FIFO, where the user may (rtprio in limits.conf); detector, mapper and '
        'filter have one, two and three more; 0: ordinary processes.'
    )
    return param(1, text, minimum=0, maximum=96)


def size_overrides(entries: tuple[str, ...]) -> dict[int, float]:
    """Marker ID to side [m] from strings "ID:SIZE".

    Raises
    ------
    InputError
        An entry that is not of this form, or a side that is not positive.
    """
    sizes: dict[int, float] = {}
    for entry in entries:
        marker_id, _, size = entry.partition(':')
        try:
            sizes[int(marker_id)] = float(size)
        except ValueError:
            raise InputError(f'parameter marker_size_overrides: {_shown(entry)} is not "ID:SIZE"') from None
        if not 0.0 < sizes[int(marker_id)] < 100.0:
            raise InputError(f'parameter marker_size_overrides: {_shown(entry)} has no usable size')
    return sizes


# --- the four nodes -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tau2CameraConfig(SelfChecked):
    """Ingestion of raw thermal frames."""

    calibration_file: str = param('', 'Camera calibration (camera_info YAML) to publish; empty: from the topic.')
    image_transport: str = param(
        'raw',
        'raw: thermal/image_raw; compressed: thermal/image_raw/compressed, PNG of 16 bits as image_transport makes it.',
        choices=('raw', 'compressed'),
    )
    bad_pixel_file: str = param('', 'List of dead pixels: a text file, "column row" a line. Empty: none.')
    find_bad_pixels: bool = param(True, 'Find dead and stuck pixels while running.', live=True)
    bits: int = param(
        14,
        'Significant bits of a 16-bit pixel; flags above them are masked, counts that are shifted up are shifted back.',
        minimum=8,
        maximum=16,
    )
    settle_frames: int = param(
        1,
        'Frames withheld after a shutter event, while they may still hold old counts.',
        minimum=0,
        maximum=30,
        live=True,
    )
    view_tail_percent: float = param(
        0.5,
        '8-bit view: share of the pixels beyond either end of the scale.',
        unit='%',
        minimum=0.0,
        maximum=25.0,
        live=True,
    )
    view_smoothing: float = param(
        0.05,
        '8-bit view: share of a new frame in the scale; small values follow slowly.',
        minimum=0.001,
        maximum=1.0,
        live=True,
    )
    view_minimum_span: float = param(
        40.0,
        '8-bit view: narrowest scale, so that noise alone does not fill it.',
        unit='counts',
        minimum=1.0,
        live=True,
    )
    frame_id: str = param('thermal_camera_optical', 'Frame of the published images.')
    prefix_frames: bool = _prefix_frames()
    image_rate: float = _image_rate()
    realtime_priority: int = _realtime_priority()


@dataclass(frozen=True)
class ArucoDetectorConfig(SelfChecked):
    """Detection of markers and the pose of each."""

    dictionary: str = _dictionary()
    marker_size: float = _marker_size()
    marker_size_overrides: tuple[str, ...] = _marker_size_overrides()
    camera_position: tuple[float, ...] = _camera_position()
    camera_orientation: tuple[float, ...] = _camera_orientation()
    extrinsics: str = _extrinsics()
    base_frame: str = _base_frame()
    camera_frame: str = _camera_frame()
    prefix_frames: bool = _prefix_frames()
    camera_time_offset: float = _camera_time_offset()
    bolometer_lag: float = param(
        0.010,
        'Thermal time constant of the bolometers; 0: none, or a camera of another kind.',
        unit='s',
        minimum=0.0,
        maximum=0.05,
    )
    readout_time: float = param(
        0.0,
        'From the sampling of the first row to that of the last; the stamp is that of the middle row. '
        '0: all rows at once.',
        unit='s',
        minimum=0.0,
        maximum=0.05,
    )
    blur_px: float = param(
        0.66, 'Standard deviation of the blur by optics and pixel.', unit='px', minimum=0.3, maximum=3.0
    )
    refinement: str = param(
        'auto',
        'Corners from the lines of the sides (auto and edges are the same), or each locally as OpenCV does.',
        choices=('auto', 'edges', 'subpix'),
        live=True,
    )
    whitelist: tuple[int, ...] = param((), 'IDs that may be found. Empty: all of the dictionary.')
    whitelist_from_map: bool = param(False, 'Find only the markers of the map, where there is one.')
    polarity: str = param(
        'alike',
        'Which markers a blind search may find: dark ones (colder than their background), bright ones, any, or those '
        'that are like the ones seen in the last seconds.',
        choices=('alike', 'any', 'dark', 'bright'),
        live=True,
    )
    min_side_px: float = param(12.0, 'Shortest side of a marker.', unit='px', minimum=8.0, maximum=400.0, live=True)
    min_contrast: float = param(
        0.7,
        'Smallest contrast of white over black, in standard deviations of the noise of a pixel.',
        minimum=0.0,
        maximum=1000.0,
        live=True,
    )
    min_correlation: float = param(
        0.65, 'Smallest correlation of the cells with the pattern of a marker.', minimum=0.5, maximum=1.0, live=True
    )
    min_margin: float = param(
        0.07,
        'By how much the pattern must correlate better than that of any other marker.',
        minimum=0.0,
        maximum=0.5,
        live=True,
    )
    min_surround: float = param(
        0.3,
        'Smallest step from the border to its white surroundings, as a share of the contrast, on three sides.',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    max_bit_errors: int = param(
        -1,
        'Bits on the wrong side of the middle between black and white. -1: as many as the dictionary can correct.',
        minimum=-1,
        maximum=20,
        live=True,
    )
    max_border_errors: int = param(2, 'The same for the cells of the black border.', minimum=0, maximum=20, live=True)
    guided: bool = param(True, 'With a map and odometry: look for known markers where they should be.', live=True)
    blind_interval: int = param(
        10,
        'A blind search follows every so many frames, and sooner without a map or where most of its markers are not '
        'seen. Where all are clear, small markers (at full resolution) and faint ones (at half) take turns.',
        minimum=1,
        maximum=1000,
        live=True,
    )
    max_odometry_age: float = param(
        0.1, 'Oldest odometry that predicts where markers are.', unit='s', minimum=0.0, maximum=1.0, live=True
    )
    guided_min_contrast: float = param(
        0.35, 'min_contrast of an expected marker.', minimum=0.0, maximum=1000.0, live=True
    )
    guided_min_correlation: float = param(
        0.6, 'min_correlation of an expected marker.', minimum=0.3, maximum=1.0, live=True
    )
    guided_min_margin: float = param(0.05, 'min_margin of an expected marker.', minimum=0.0, maximum=0.5, live=True)
    detections: str = param(
        '',
        'Publish `detections` in the message of another package too, where it is installed: aruco_opencv_msgs, '
        'apriltag_msgs or vision_msgs. Empty: none.',
        choices=('', 'aruco_opencv', 'apriltag', 'vision'),
    )
    image_annotations: bool = param(
        False, 'Publish thermal/image_annotations for Foxglove (needs foxglove_msgs) while someone subscribes.'
    )
    publish_marker_tf: bool = param(False, 'Publish each marker as marker_ID on /tf (needs tf2_ros).')
    duplicates: str = param(
        'drop',
        'An ID at two places of a frame, as in a reflection. drop: neither counts; best: the clearer one does.',
        choices=('drop', 'best'),
        live=True,
    )
    image_rate: float = _image_rate()
    realtime_priority: int = _realtime_priority()


@dataclass(frozen=True)
class MarkerMapperConfig(SelfChecked):
    """The incremental marker map."""

    dictionary: str = _dictionary()
    marker_size: float = _marker_size()
    marker_size_overrides: tuple[str, ...] = _marker_size_overrides()
    map_file: str = _map_file()
    mode: str = _mode()
    map_frame: str = param('map', 'Frame of the map.')
    second_camera: str = param(
        '',
        'Name of a second camera, which makes poses better and stands in: NAME/markers and NAME/thermal/camera_info '
        'are read. Empty: none.',
    )
    second_camera_position: tuple[float, ...] = _camera_position()
    second_camera_orientation: tuple[float, ...] = _camera_orientation()
    cloud_file: str = param('', 'Point cloud of the place (.ply or .pcd) to show beside the markers. Empty: none.')
    cloud_alignment_file: str = param(
        '', 'Where the map lies in cloud_file, as map align writes it. Empty: both are in the same frame.'
    )
    camera_position: tuple[float, ...] = _camera_position()
    camera_orientation: tuple[float, ...] = _camera_orientation()
    extrinsics: str = _extrinsics()
    base_frame: str = _base_frame()
    camera_frame: str = _camera_frame()
    prefix_frames: bool = _prefix_frames()
    camera_time_offset: float = _camera_time_offset()
    time_offset_std: float = _time_offset_std()
    marker_size_std: float = param(
        0.003,
        'Common relative error of all marker sizes and of the focal length: part of the covariance of map and poses.',
        minimum=0.0,
        maximum=0.1,
        live=True,
    )
    bridge_duration: float = param(
        3.0,
        'How long after the last known marker new ones may still be placed from the odometry.',
        unit='s',
        minimum=0.0,
        maximum=60.0,
        live=True,
    )
    keyframe_budget: int = param(800, 'Frames kept for the joint refinement.', minimum=10, maximum=20000)
    autosave_period: float = param(
        30.0,
        'A map that has learned something is written to <map_file>.autosave this often; 0: never.',
        unit='s',
        minimum=0.0,
        maximum=3600.0,
    )
    refinement_period: float = param(
        2.0, 'Shortest time between two joint refinements; 0: never.', unit='s', minimum=0.0, maximum=3600.0, live=True
    )
    image_rate: float = _image_rate()
    realtime_priority: int = _realtime_priority()


@dataclass(frozen=True)
class ImuNoise(SelfChecked):
    """Continuous noise densities of the IMU, under Kalibr's names and units."""

    gyroscope_noise_density: float = param(1.7e-4, 'Gyroscope white noise.', unit='rad/s/sqrt(Hz)', minimum=0.0)
    accelerometer_noise_density: float = param(2.0e-3, 'Accelerometer white noise.', unit='m/s^2/sqrt(Hz)', minimum=0.0)
    gyroscope_random_walk: float = param(2.0e-5, 'Gyroscope bias random walk.', unit='rad/s^2/sqrt(Hz)', minimum=0.0)
    accelerometer_random_walk: float = param(
        3.0e-4, 'Accelerometer bias random walk.', unit='m/s^3/sqrt(Hz)', minimum=0.0
    )
    gyroscope_scale_std: float = param(
        0.005,
        'Scale and cross-axis errors of the gyroscope (standard deviation of each: half the tolerance of the data '
        'sheet), which are estimated while running; 0: none.',
        minimum=0.0,
        maximum=0.1,
    )
    accelerometer_scale_std: float = param(
        0.005,
        'Scale and cross-axis errors of the accelerometer, likewise; 0: none.',
        minimum=0.0,
        maximum=0.1,
    )
    gyroscope_nonlinearity: float = param(
        0.001,
        'What is left of the errors of the gyroscope in motion (nonlinearity, bandwidth), as a share of the rate.',
        minimum=0.0,
        maximum=0.1,
    )
    accelerometer_nonlinearity: float = param(
        0.004,
        'The same of the accelerometer (size effect too), as a share of the specific force beside gravity.',
        minimum=0.0,
        maximum=0.1,
    )
    gyroscope_range: float = param(34.9, 'Readings beyond this are saturated.', unit='rad/s', minimum=0.1)
    accelerometer_range: float = param(156.0, 'Readings beyond this are saturated.', unit='m/s^2', minimum=10.0)
    vibration: float = param(
        1.0,
        'Share of the vibration that may count as white noise where it exceeds the densities: the floor of its '
        'spectrum between the tones of the rotors; 0: none.',
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class PoseEkfConfig(SelfChecked):
    """The filter."""

    camera_position: tuple[float, ...] = _camera_position()
    camera_orientation: tuple[float, ...] = _camera_orientation()
    extrinsics: str = _extrinsics()
    base_frame: str = _base_frame()
    camera_frame: str = _camera_frame()
    prefix_frames: bool = _prefix_frames()
    camera_time_offset: float = _camera_time_offset()
    estimate_time_offset: bool = param(True, 'Estimate what is left of the time offset while running.')
    time_offset_std: float = _time_offset_std()
    time_offset_random_walk: float = param(
        5.0e-5, 'Drift of the two clocks against each other.', unit='s/sqrt(s)', minimum=0.0
    )
    stamp_jitter: float = param(
        0.0005,
        'Jitter of the camera stamps to begin with; it is learned from the poses. 0: exact, nothing is learned.',
        unit='s',
        minimum=0.0,
        maximum=0.05,
    )
    estimate_extrinsics: bool = param(False, 'Refine camera_position and camera_orientation while running.')
    extrinsics_position_std: float = param(0.02, 'Standard deviation of camera_position.', unit='m', minimum=0.0)
    extrinsics_orientation_std: float = param(
        0.02, 'Standard deviation of camera_orientation.', unit='rad', minimum=0.0
    )
    imu: ImuNoise = group(ImuNoise)  # noqa: RUF009
    gravity: float = param(9.80665, 'Local gravity.', unit='m/s^2', minimum=9.7, maximum=9.9)
    map_tilt_std: float = param(
        0.005,
        'How far z of the map may be off the vertical; the tilt is estimated. 0: exactly vertical.',
        unit='rad',
        minimum=0.0,
        maximum=0.2,
    )
    initial_velocity_std: float = param(3.0, 'Speed at the first pose.', unit='m/s', minimum=0.01)
    initial_gyroscope_bias_std: float = param(0.02, 'Gyroscope bias at the start.', unit='rad/s', minimum=0.0)
    initial_accelerometer_bias_std: float = param(0.2, 'Accelerometer bias at the start.', unit='m/s^2', minimum=0.0)
    initial_poses: int = param(3, 'Poses that must agree before the filter starts.', minimum=1, maximum=100)
    pose_noise_scale: float = param(
        1.0,
        'Factor on the standard deviation of the camera poses; where they scatter more, that is learned.',
        minimum=0.1,
        live=True,
    )
    systematic_pose_std: float = param(
        1.0,
        'Error of camera poses that lasts as long as the view (lens, corners), in their own standard deviations.',
        minimum=0.01,
        maximum=100.0,
    )
    systematic_angle: float = param(
        0.3, 'Change of the view after which that error is another.', unit='rad', minimum=0.001, maximum=10.0
    )
    gate: float = param(
        22.5,
        'A pose is refused beyond this squared Mahalanobis distance (22.5: 99.9 % of chi-square, 6 d.o.f.).',
        minimum=1.0,
        live=True,
    )
    reset_after: float = param(
        1.0,
        'Reset when refused poses have agreed with each other for so long; a metre off all of a sudden, only '
        'when they are as many as had borne out the estimate (at most 300), or that is lost.',
        unit='s',
        minimum=0.0,
        live=True,
    )
    max_delay: float = param(1.0, 'Poses that arrive later than this are refused.', unit='s', minimum=0.0, maximum=10.0)
    max_imu_gap: float = param(1.0, 'Reset after an IMU gap or clock jump beyond this.', unit='s', minimum=0.01)
    lost_position_std: float = param(
        0.3,
        'The pose counts as lost when its position is known no better than this.',
        unit='m',
        minimum=0.001,
        live=True,
    )
    reinitialise_after: float = param(
        60.0, 'Reset after so long without an accepted pose.', unit='s', minimum=1.0, live=True
    )
    smoothing_time: float = param(
        0.0, 'Spread corrections of the smooth output over this time; 0: no smooth output.', unit='s', minimum=0.0
    )
    imu_rate: float = param(
        0.0,
        'Rate of imu/data, by which the diagnostics judge it; 0: that of the first seconds.',
        unit='Hz',
        minimum=0.0,
        maximum=10000.0,
    )
    map_frame: str = param('map', 'Frame of the pose.')
    odom_frame: str = param(
        '',
        'With publish_tf and smoothing_time, as REP-105: the smooth output from here to base_frame, the rest from '
        'map_frame to here. Empty: map_frame to base_frame.',
    )
    resume: bool = param(
        True,
        'After a crash in flight: the last pose and clock offset of before, which are kept in ~/.ros (ROS_HOME), are a '
        'hint to the first poses.',
    )
    publish_lost: bool = param(False, 'Publish `pose` also while it counts as lost; `odometry` is always published.')
    publish_tf: bool = param(False, 'Publish map to base_frame and base_frame to camera_frame on /tf (needs tf2_ros).')
    bridge_rate: float = param(
        0.0,
        'Rate of bridge/odometry and bridge/pose for a flight controller, silent while lost, smooth with '
        'smoothing_time; 0: none.',
        unit='Hz',
        minimum=0.0,
        maximum=1000.0,
    )
    px4: bool = param(False, 'Publish fmu/in/vehicle_visual_odometry at bridge_rate too (needs px4_msgs).')
    realtime_priority: int = _realtime_priority()


@dataclass(frozen=True)
class ThermalSourceConfig(SelfChecked):
    """The camera's driver, where no other one is used."""

    camera: str = param(
        '',
        'Where frames come from: a V4L2 device (/dev/video0), a TeAx ThermalGrabber ("teax", or "teax:SERIAL" where '
        'there are several), or a folder or video of 16-bit pictures.',
    )
    image_width: int = param(0, 'Width to ask the camera for; 0: as it is set.', unit='px', minimum=0, maximum=4096)
    image_height: int = param(0, 'Height to ask the camera for; 0: as it is set.', unit='px', minimum=0, maximum=4096)
    frame_rate: float = param(
        0.0,
        'Rate to ask a V4L2 device for, or to show pictures at; 0: as the device is set, pictures at 30.',
        unit='Hz',
        minimum=0.0,
        maximum=1000.0,
    )
    repeat: bool = param(True, 'Show a folder or video again when it ends.')
    calibration_file: str = param('', 'Camera calibration (camera_info YAML) to publish; empty: from the topic.')
    frame_id: str = param('thermal_camera_optical', 'Frame of the published images.')
    prefix_frames: bool = _prefix_frames()


@dataclass(frozen=True)
class LandingTargetConfig(SelfChecked):
    """The landing pad, for an autopilot behind mavros."""

    landing_pad: tuple[int, ...] = param(
        (), 'Markers of the landing pad. Its place is the middle between them, its axes are those of the first.'
    )
    landing_target_frame: str = param(
        'body',
        'body: relative to the robot (ArduPilot; mavros with mav_frame BODY_FRD); map: in the map (PX4; LOCAL_NED).',
        choices=('body', 'map'),
    )
    camera_position: tuple[float, ...] = _camera_position()
    camera_orientation: tuple[float, ...] = _camera_orientation()
    extrinsics: str = _extrinsics()
    base_frame: str = _base_frame()
    camera_frame: str = _camera_frame()
    prefix_frames: bool = _prefix_frames()
    map_frame: str = param('map', 'Frame of the map.')


#: Node to its parameters: the pipeline.
NODES: dict[str, type] = {
    'tau2_camera': Tau2CameraConfig,
    'aruco_detector': ArucoDetectorConfig,
    'marker_mapper': MarkerMapperConfig,
    'pose_ekf': PoseEkfConfig,
}

#: Nodes beside them, which run only where they are asked for.
OPTIONAL_NODES: dict[str, type] = {'thermal_source': ThermalSourceConfig, 'landing_target': LandingTargetConfig}


def check_names(names: Iterable[str]) -> None:
    """Refuse a parameter that no node has: most likely a name that was mistyped.

    Raises
    ------
    InputError
        With the name that comes closest.
    """
    known = {name for kind in (NODES | OPTIONAL_NODES).values() for name, _, _ in parameters(kind)}
    for name in sorted(set(names) - known - set(_OF_ROS)):
        if name.startswith('qos_overrides.'):
            continue
        close = difflib.get_close_matches(name, known, 1)
        shown = _shown(name).strip('\'"')
        raise InputError(f'parameter {shown}: no node has it' + (f'; did you mean {close[0]}?' if close else ''))
