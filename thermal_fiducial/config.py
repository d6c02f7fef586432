"""Every parameter of the nodes: default, range, unit, description.

The nodes declare them as ROS parameters, the offline pipeline uses the same config objects, and
``config/thermal_fiducial.yaml`` is generated from them, so each default is defined once.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, Field, field, fields, MISSING
import difflib
from itertools import combinations
import math
import os
import re
from typing import Any, get_args, TypeVar
from urllib.parse import unquote

from thermal_fiducial.errors import InputError

Config = TypeVar('Config')
#: Largest deviation from 1 of the norm of a quaternion parameter: typed values are rounded.
_NORM_TOLERANCE = 0.01
#: Longest quotation of a value in an error message [characters].
_LONGEST_SHOWN = 100
#: Parameters with frames: that of the map, those of the robot.
_FRAMES = ('map_frame', 'odom_frame', 'base_frame', 'camera_frame')
#: Parameters that rclpy declares on every node.
_OF_ROS = ('use_sim_time', 'start_type_description_service')
#: Prefix of ROS's parameters for the quality of service, which a file for several packages may have.
QOS_OVERRIDES = 'qos_overrides.'
#: 99.9 % quantile of chi square with six degrees of freedom, of a pose: beyond it two poses contradict each other.
CHI2_OF_POSE = 22.5
#: Range of a marker's side [m].
SMALLEST_SIDE, LARGEST_SIDE = 0.005, 10.0
#: Largest ``keyframe_budget``.
MOST_KEYFRAMES = 20_000


def param(
    default: Any,
    description: str,
    *,
    unit: str = '',
    minimum: float | None = None,
    maximum: float | None = None,
    least: float = 0.0,
    choices: tuple[str, ...] = (),
    length: int | None = None,
    normed: bool = False,
    verify: Callable[[Any], object] | None = None,
    form: Callable[[str], str] | None = None,
    dynamic: bool = False,
    needs: tuple[str, ...] = (),
) -> Any:
    """One parameter: a dataclass field whose metadata fill ROS's parameter descriptor.

    Parameters
    ----------
    default : bool, int, float, str, or a tuple of floats, ints or strings
    description : one sentence for ``ros2 param describe``
    unit : appended to the description in brackets
    minimum, maximum : inclusive range of a number or of each number of a tuple
    least : smallest value beside 0, which stands for none: a rate or a period is divided by
    choices : the allowed values of a string
    length : number of elements of a tuple of floats
    normed : whether the tuple must have unit norm (a quaternion)
    verify : called with the value; raises InputError if it is unusable
    form : makes the value of a string: :func:`local_path` of a path, :func:`frame_name` of the name of a frame
    dynamic : whether it may be set while the node runs; otherwise it is declared read-only
    needs : parameters of the same node without which this one has no effect
    """
    if needs:
        description += f' Needs {" and ".join(needs)}.'
    metadata = {
        'description': f'{description} [{unit}]' if unit else description,
        'unit': unit,
        'minimum': minimum,
        'maximum': maximum,
        'least': least,
        'choices': choices,
        'length': length,
        'normed': normed,
        'verify': verify,
        'form': form,
        'dynamic': dynamic,
        'needs': needs,
    }
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class SelfChecked:
    """Base of the configs: values are checked at every construction, including ``dataclasses.replace``.

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


def without_effect(config: Any) -> list[str]:
    """A line for each parameter that was changed from its default although others that it needs are not set."""
    lines = []
    values = {name: value for name, _, value in parameters(config)}
    for name, item, value in parameters(config):
        missing = [need for need in item.metadata['needs'] if not values[need]]
        if missing and value != item.default:
            lines.append(f'parameter {name}: no effect without {" and ".join(missing)}')
    return lines


def from_mapping(kind: type[Config], values: dict[str, Any]) -> Config:
    """Config of dataclass ``kind`` with ``values`` (ROS name to value) in place of the defaults.

    Names that ``kind`` lacks are ignored, since one parameter file serves all nodes; see :func:`check_names`.

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
        Wrong type, out of range, not among the choices, or not a unit quaternion.
    """
    limits = item.metadata
    result = _typed(name, item, value)
    if limits['form']:
        result = limits['form'](result)
    if limits['choices'] and result not in limits['choices']:
        raise InputError(f'parameter {name}: {_shown(result)} is not one of {", ".join(limits["choices"])}')
    low, high = limits['minimum'], limits['maximum']
    for element in result if isinstance(result, tuple) else (result,):
        if (low is not None and not element >= low) or (high is not None and not element <= high):
            allowed = f'{low} .. {high} {limits["unit"]}'.rstrip()
            raise InputError(f'parameter {name}: {_shown(element)} is outside {allowed}')
        if limits['least'] and 0.0 < element < limits['least']:
            allowed = f'neither 0 nor at least {limits["least"]} {limits["unit"]}'
            raise InputError(f'parameter {name}: {_shown(element)} is {allowed}')
    if limits['normed'] and not abs(math.hypot(*result) - 1.0) < _NORM_TOLERANCE:
        raise InputError(f'parameter {name}: {list(result)} is no unit quaternion')
    if limits['verify']:
        limits['verify'](result)
    return result


def local_path(path: str) -> str:
    """``path`` of a file: of a URL, as the ``camera_info_url`` of ROS is one, and with the home for a leading ~.

    No shell replaces ~ in a parameter file. An unknown user's stays, and so does an empty path.
    """
    if url := re.fullmatch(r'file:(?://(?:localhost)?)?(/[^/].*)', path, re.DOTALL):
        return unquote(url[1])
    return os.path.expanduser(path)  # noqa: PTH111 - pathlib makes '.' of '' and fails for an unknown user


def frame_name(name: str) -> str:
    """``name`` without the slash that names of frames begin with in ROS 1; tf2 refuses it in messages."""
    return name.lstrip('/')


def _shown(value: object) -> str:
    """``repr`` of a value for an error message, truncated to one line."""
    return _shortened(repr(value))


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST_SHOWN else f'{text[:_LONGEST_SHOWN]}...'


def _typed(name: str, item: 'Field[Any]', value: Any) -> Any:
    if not isinstance(item.default, tuple):
        return _of_kind(name, type(item.default), value)
    if isinstance(value, str) or not hasattr(value, '__iter__'):
        raise InputError(f'parameter {name}: {_shown(value)} is not a list')
    elements, length = tuple(value), item.metadata['length']
    if length is not None and len(elements) != length:
        raise InputError(f'parameter {name}: {len(elements)} values, not {length}')
    return tuple(_of_kind(name, get_args(item.type)[0], element) for element in elements)


def _of_kind(name: str, kind: type, value: Any) -> Any:
    if kind is float:
        return _number(name, value)
    # In Python a bool is an int.
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise InputError(f'parameter {name}: {_shown(value)} is not of type {kind.__name__}')
    return value


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f'parameter {name}: {_shown(value)} is not a number')
    if math.isinf(value):
        raise InputError(f'parameter {name}: {_shown(value)} is not finite')
    return float(value)


def for_whole_numbers(value: Any, default: Any) -> str:
    """What to do about whole numbers in the value of a parameter, where ROS refuses them; empty if it does not."""
    several = isinstance(default, tuple)
    if isinstance(value, list) != several:
        return ''
    given, due = (value, default[:1]) if several else ([value], (default,))
    if {type(number) for number in due} != {float} or not any(type(number) is int for number in given):
        return ''
    written = ', '.join(str(float(number)) if type(number) is int else str(number) for number in given)
    return f'ROS refuses whole numbers here, write {f"[{written}]" if several else written}'


def size_overrides(entries: tuple[str, ...]) -> dict[int, float]:
    """Marker ID to side [m] from strings "ID:SIZE".

    Raises
    ------
    InputError
        An entry of another form, or a side that no marker has.
    """
    sizes: dict[int, float] = {}
    for entry in entries:
        marker_id, _, size = entry.partition(':')
        try:
            key, side = int(marker_id), float(size)
        except ValueError:
            raise InputError(f'parameter marker_size_overrides: {_shown(entry)} is not "ID:SIZE"') from None
        if not SMALLEST_SIDE <= side <= LARGEST_SIDE:
            allowed = f'{SMALLEST_SIDE} .. {LARGEST_SIDE} m'
            raise InputError(f'parameter marker_size_overrides: the side of {_shown(entry)} is outside {allowed}')
        sizes[key] = side
    return sizes


def _refuse_two_sides(entries: tuple[str, ...]) -> None:
    """Raise InputError for a marker with two sides, and as :func:`size_overrides`, where the last of two counts."""
    ids = [marker_id for entry in entries for marker_id in size_overrides((entry,))]
    if twice := sorted({marker_id for marker_id in ids if ids.count(marker_id) > 1}):
        raise InputError(f'parameter marker_size_overrides: marker {twice[0]} is there twice')


def _refuse_no_namespace(name: str) -> None:
    """Raise InputError for what no ROS namespace can be; empty: none."""
    if name and not re.fullmatch(r'[A-Za-z_]\w*(/[A-Za-z_]\w*)*', name, re.ASCII):
        raise InputError(f'parameter second_camera: {_shown(name)} is not the name of a namespace')


def unknown_markers(config: 'ArucoDetectorConfig', count: int) -> list[str]:
    """A line for each parameter that names markers beyond the ``count`` of the dictionary."""
    lines = []
    named = {'whitelist': config.whitelist, 'marker_size_overrides': size_overrides(config.marker_size_overrides)}
    for name, ids in named.items():
        unknown = [str(marker_id) for marker_id in ids if not 0 <= marker_id < count]
        if unknown:
            lines.append(_shortened(f'parameter {name}: {config.dictionary} has no marker {", ".join(unknown)}'))
    return lines


# --- parameters that several nodes share: bases of their configs, the last of which comes first ---------


def _camera_position(camera: str = 'the camera', needs: tuple[str, ...] = ()) -> Any:
    return param(
        (0.0, 0.0, 0.0),
        f'Position of {camera} in base_link (the IMU frame).',
        unit='m',
        length=3,
        minimum=-10.0,
        maximum=10.0,
        needs=needs,
    )


def _clock_random_walk(needs: tuple[str, ...]) -> Any:
    return param(
        3.0e-4,
        "Random walk of the camera's clock, against the IMU's and a second camera's; the default allows for 50 ppm.",
        unit='s/sqrt(s)',
        minimum=0.0,
        maximum=0.1,
        needs=needs,
    )


def _camera_orientation(frame: str = 'thermal_camera_optical', needs: tuple[str, ...] = ()) -> Any:
    return param(
        (-0.5, 0.5, -0.5, 0.5),
        f'Orientation of {frame} in base_link, quaternion x y z w. Default: looks forward.',
        length=4,
        normed=True,
        needs=needs,
    )


def _calibration_file(if_empty: str) -> Any:
    return param(
        '', f'Camera calibration (camera_info YAML), published with each image. Empty: {if_empty}.', form=local_path
    )


@dataclass(frozen=True)
class MarkerParameters(SelfChecked):
    """What the markers are."""

    dictionary: str = param(
        'DICT_4X4_50',
        'Dictionary of the markers: a name of OpenCV or of this package (STENCIL_4X4_100 is the default of '
        '"markers make"), or the path of a dictionary file.',
        form=local_path,
    )
    marker_size: float = param(
        0.30, 'Side of the black square of a marker.', unit='m', minimum=SMALLEST_SIDE, maximum=LARGEST_SIDE
    )
    marker_size_overrides: tuple[str, ...] = param(
        (), 'Sides of single markers, strings "ID:SIZE", e.g. ["7:0.50"].', unit='m', verify=_refuse_two_sides
    )


@dataclass(frozen=True)
class FrameParameters(SelfChecked):
    """How the robot's frames are named.

    Raises
    ------
    InputError
        Two frames of one name, besides what :class:`SelfChecked` refuses: a tree of TF has each but once.
    """

    prefix_frames: bool = param(False, "Prefix the robot's frames, but not the map frame, with the node's namespace.")

    def __post_init__(self) -> None:
        super().__post_init__()
        names = {name: getattr(self, name, '') for name in _FRAMES}
        for name, other in combinations(filter(names.get, names), 2):
            if names[name] == names[other]:
                shown = _shown(names[name])
                raise InputError(f'parameters {name} and {other}: both are {shown}, and must be two frames')


@dataclass(frozen=True)
class ImageParameters(SelfChecked):
    """What is published with the images of a camera."""

    calibration_file: str = _calibration_file('that of the driver, thermal/camera_info')
    frame_id: str = param('thermal_camera_optical', 'Frame of the published images.', form=frame_name)


@dataclass(frozen=True)
class MountParameters(SelfChecked):
    """Where the camera is on the robot."""

    camera_position: tuple[float, ...] = _camera_position()
    camera_orientation: tuple[float, ...] = _camera_orientation()
    extrinsics: str = param(
        'auto',
        'Source of camera_position and camera_orientation. auto: /tf_static (needs tf2_msgs) or robot_description, if '
        'they connect camera_frame with the robot, else the parameters; parameters: always the parameters.',
        choices=('auto', 'parameters'),
    )
    base_frame: str = param(
        'base_link',
        'Frame of the robot; identical to the IMU frame unless TF or a URDF says otherwise.',
        form=frame_name,
    )
    camera_frame: str = param('thermal_camera_optical', 'Optical frame of the camera in TF and URDF.', form=frame_name)


@dataclass(frozen=True)
class MountErrorParameters(MountParameters):
    """Where the camera is on the robot, and how well that is known."""

    extrinsics_position_std: float = param(
        0.002,
        'Standard deviation of camera_position, and of that of a second camera: what its calibration leaves. 0: exact.',
        unit='m',
        minimum=0.0,
        maximum=1.0,
    )
    extrinsics_orientation_std: float = param(
        0.003,
        'Standard deviation of camera_orientation, and of that of a second camera, about each axis: what its '
        'calibration leaves; the default is what calibrations of one rig differ by. 0: exact.',
        unit='rad',
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class ClockParameters(SelfChecked):
    """The camera's clock against the IMU's, and how well it is known."""

    camera_time_offset: float = param(
        0.0, 'Clock offset of the camera, t_imu = t_camera + offset.', unit='s', minimum=-1.0, maximum=1.0
    )
    time_offset_std: float = param(
        0.03,
        'Standard deviation of camera_time_offset: prior if it is estimated, else noise of each pose.',
        unit='s',
        minimum=0.0,
        maximum=0.2,
    )


@dataclass(frozen=True)
class ScheduleParameters(SelfChecked):
    """How the operating system schedules a node."""

    realtime_priority: int = param(
        1,
        'SCHED_RR priority of tau2_camera, if the user may set one (rtprio in limits.conf); detector, mapper and '
        'filter get 1, 2 and 3 more. 0: ordinary scheduling.',
        minimum=0,
        maximum=96,
    )


@dataclass(frozen=True)
class ImageRateParameters(ScheduleParameters):
    """How the operating system schedules a node that works once a frame, and how many frames there are."""

    image_rate: float = param(
        0.0,
        'Expected image rate for the diagnostics; 0: the rate of the first seconds.',
        unit='Hz',
        minimum=0.0,
        least=0.01,
        maximum=1000.0,
    )


# --- the four nodes -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tau2CameraConfig(ImageRateParameters, FrameParameters, ImageParameters):
    """Ingestion of raw thermal frames."""

    image_transport: str = param(
        'raw',
        'raw: thermal/image_raw; compressed: thermal/image_raw/compressed, 16-bit PNG of image_transport.',
        choices=('raw', 'compressed'),
    )
    bad_pixel_file: str = param(
        '', 'List of dead pixels: a text file, "column row" a line. Empty: none.', form=local_path
    )
    find_bad_pixels: bool = param(True, 'Find dead and stuck pixels while running.', dynamic=True)
    bits: int = param(
        14,
        'Significant bits of a 16-bit pixel; flag bits above them are masked unless counts carry into them, '
        'left-aligned counts are shifted right.',
        minimum=8,
        maximum=16,
    )
    settle_frames: int = param(
        1,
        'Frames dropped after a shutter event, since they may still contain counts from before it.',
        minimum=0,
        maximum=30,
        dynamic=True,
    )
    view_tail_percent: float = param(
        0.5,
        '8-bit view: share of the pixels clipped at either end of the scale.',
        unit='%',
        minimum=0.0,
        maximum=25.0,
        dynamic=True,
    )
    view_smoothing: float = param(
        0.05,
        '8-bit view: weight of a new frame in the exponential average of the scale.',
        minimum=0.001,
        maximum=1.0,
        dynamic=True,
    )
    view_minimum_span: float = param(
        40.0,
        '8-bit view: smallest range of the scale, so that noise alone does not fill it.',
        unit='counts',
        minimum=1.0,
        maximum=65535.0,
        dynamic=True,
    )


@dataclass(frozen=True)
class ArucoDetectorConfig(ImageRateParameters, ClockParameters, FrameParameters, MountParameters, MarkerParameters):
    """Detection and pose estimation of markers."""

    bolometer_lag: float = param(
        0.010,
        'Thermal time constant of the bolometers; 0: no lag (a cooled detector, say).',
        unit='s',
        minimum=0.0,
        maximum=0.05,
    )
    readout_time: float = param(
        0.0,
        'Rolling-shutter readout time from first to last row; the stamp refers to the middle row. 0: global shutter; '
        'negative: last row first, as where the driver turns pictures upside down.',
        unit='s',
        minimum=-0.05,
        maximum=0.05,
    )
    blur_px: float = param(
        0.66,
        'Standard deviation of the blur of optics and pixels, to a third. On raw counts it is estimated in flight, '
        'from half to twice of it.',
        unit='px',
        minimum=0.3,
        maximum=3.0,
    )
    plate_thickness: float = param(
        0.0,
        'Thickness of the plates of the markers, whose sides are as cold as their faces; 0: printed, or cut from foil.',
        unit='m',
        minimum=0.0,
        maximum=0.05,
    )
    whitelist: tuple[int, ...] = param((), 'IDs that may be found. Empty: all of the dictionary.')
    whitelist_from_map: bool = param(False, 'Find only the markers of the map, where there is one.')
    polarity: str = param(
        'alike',
        'Polarity that a blind search accepts: dark (colder than the background), bright, any, or alike: the polarity '
        'of the markers seen in the last half minute.',
        choices=('alike', 'any', 'dark', 'bright'),
        dynamic=True,
    )
    min_side_px: float = param(12.0, 'Shortest side of a marker.', unit='px', minimum=8.0, maximum=400.0, dynamic=True)
    min_contrast: float = param(
        0.7,
        'Smallest contrast-to-noise ratio: white minus black over the noise standard deviation of a pixel.',
        minimum=0.0,
        maximum=1000.0,
        dynamic=True,
    )
    min_correlation: float = param(
        0.65, 'Smallest correlation of the cells with the bit pattern.', minimum=0.5, maximum=1.0, dynamic=True
    )
    min_margin: float = param(
        0.07,
        'Smallest lead of the correlation over that of every other marker.',
        minimum=0.0,
        maximum=0.5,
        dynamic=True,
    )
    min_surround: float = param(
        0.3,
        'Smallest step from the border to its white surroundings, as a share of the contrast, on three sides.',
        minimum=0.0,
        maximum=1.0,
        dynamic=True,
    )
    guided: bool = param(True, 'Search for mapped markers where map and odometry predict them.', dynamic=True)
    blind_period: float = param(
        0.32,
        'Shortest time between blind searches; at most 0.06 s without a map or when most of the expected markers are '
        'not seen. When all are seen, the searches alternate between full resolution (small markers) and half (faint '
        'ones). 0: every frame is searched.',
        unit='s',
        minimum=0.0,
        maximum=60.0,
        dynamic=True,
    )
    guided_min_contrast: float = param(
        0.35,
        'min_contrast of an expected marker.',
        minimum=0.0,
        maximum=1000.0,
        dynamic=True,
        needs=('guided',),
    )
    guided_min_correlation: float = param(
        0.6,
        'min_correlation of an expected marker.',
        minimum=0.3,
        maximum=1.0,
        dynamic=True,
        needs=('guided',),
    )
    guided_min_margin: float = param(
        0.05, 'min_margin of an expected marker.', minimum=0.0, maximum=0.5, dynamic=True, needs=('guided',)
    )
    detections: str = param(
        '',
        'Also publish `detections` as a message of aruco_opencv_msgs, apriltag_msgs or vision_msgs, which must be '
        'installed. Empty: none.',
        choices=('', 'aruco_opencv', 'apriltag', 'vision'),
    )
    image_annotations: bool = param(
        False, 'Publish thermal/image_annotations for Foxglove (needs foxglove_msgs) while someone subscribes.'
    )
    publish_marker_tf: bool = param(False, 'Publish each marker as marker_ID on /tf (needs tf2_ros).')
    duplicates: str = param(
        'drop',
        'An ID that a blind search sees twice (a reflection, say). drop: discard both; best: keep the better '
        'correlated one. One that is followed stays where it is.',
        choices=('drop', 'best'),
        dynamic=True,
    )


@dataclass(frozen=True)
class MarkerMapperConfig(ImageRateParameters, ClockParameters, FrameParameters, MountErrorParameters, MarkerParameters):
    """The incremental marker map."""

    map_file: str = param('', 'Marker map (YAML). Empty: no map.', form=local_path)
    mode: str = param(
        'mapping',
        'mapping: new markers enter the map; localization: the map never changes.',
        choices=('mapping', 'localization'),
    )
    map_frame: str = param('map', 'Frame of the map.', form=frame_name)
    second_camera: str = param(
        '',
        'Name of a second camera, whose poses are fused with those of the first or replace them: subscribes to '
        'NAME/markers and NAME/thermal/camera_info. Empty: none.',
        verify=_refuse_no_namespace,
    )
    second_camera_position: tuple[float, ...] = _camera_position('the second camera', ('second_camera',))
    second_camera_orientation: tuple[float, ...] = _camera_orientation(
        "the second camera's optical frame", ('second_camera',)
    )
    # Without a second camera it still concerns the filter, and may stand in the file of parameters of all nodes.
    time_offset_random_walk: float = _clock_random_walk(())
    cloud_file: str = param(
        '', 'Point cloud of the site (.ply or .pcd) to publish for RViz. Empty: none.', form=local_path
    )
    cloud_alignment_file: str = param(
        '',
        'Transform from the map to the frame of cloud_file, written by map align. Empty: the frames are the same.',
        form=local_path,
        needs=('cloud_file',),
    )
    marker_size_std: float = param(
        0.003,
        'Scale error common to all marker sizes (relative standard deviation); enters the covariances of map and '
        'poses.',
        minimum=0.0,
        maximum=0.1,
        dynamic=True,
    )
    focal_length_std: float = param(
        0.002,
        'Error of the calibrated focal length (relative standard deviation); enters the covariances of poses.',
        minimum=0.0,
        maximum=0.1,
        dynamic=True,
    )
    readout_time_std: float = param(
        0.015,
        'Prior standard deviation of what readout_time is wrong by, which is estimated and enters the covariances of '
        'poses. calibrate camera-imu writes a smaller one; 0: it is exactly as declared.',
        unit='s',
        minimum=0.0,
        maximum=0.05,
    )
    bridge_duration: float = param(
        3.0,
        'Time since the last mapped marker during which new markers may be placed by odometry alone.',
        unit='s',
        minimum=0.0,
        maximum=60.0,
        dynamic=True,
    )
    keyframe_budget: int = param(800, 'Most keyframes of the bundle adjustment.', minimum=10, maximum=MOST_KEYFRAMES)
    autosave_period: float = param(
        30.0,
        'Period at which a changed map is written to <map_file>.autosave; 0: never.',
        unit='s',
        minimum=0.0,
        least=0.05,
        maximum=3600.0,
        needs=('map_file',),
    )
    refinement_period: float = param(
        1.0,
        'Shortest time between two bundle adjustments; 0: none.',
        unit='s',
        minimum=0.0,
        maximum=3600.0,
        dynamic=True,
    )


@dataclass(frozen=True)
class ImuNoise(SelfChecked):
    """Continuous noise densities of the IMU, under Kalibr's names and units."""

    # Upper bounds: below a thousand times the defaults, and 2, 5, 25 and 5 times the largest of a few configurations of
    # visual-inertial odometry that were looked at (VINS, D2SLAM, OpenVINS): 0.05, 0.2, 4e-4 and 0.02.
    gyroscope_noise_density: float = param(
        1.7e-4, 'Gyroscope white noise.', unit='rad/s/sqrt(Hz)', minimum=0.0, maximum=0.1
    )
    accelerometer_noise_density: float = param(
        2.0e-3, 'Accelerometer white noise.', unit='m/s^2/sqrt(Hz)', minimum=0.0, maximum=1.0
    )
    gyroscope_random_walk: float = param(
        2.0e-5, 'Gyroscope bias random walk.', unit='rad/s^2/sqrt(Hz)', minimum=0.0, maximum=0.01
    )
    accelerometer_random_walk: float = param(
        3.0e-4, 'Accelerometer bias random walk.', unit='m/s^3/sqrt(Hz)', minimum=0.0, maximum=0.1
    )
    gyroscope_instability: float = param(
        2.0e-4,
        'Gyroscope bias instability (flicker noise) in flight: more than at rest, by temperature and vibration.',
        unit='rad/s',
        minimum=0.0,
        maximum=0.01,
    )
    accelerometer_instability: float = param(
        0.01,
        'Accelerometer bias instability (flicker noise) in flight: more than at rest, by temperature and vibration.',
        unit='m/s^2',
        minimum=0.0,
        maximum=0.1,
    )
    gyroscope_scale_std: float = param(
        0.005,
        'Prior standard deviation of the scale and cross-axis errors of the gyroscope, which are estimated: half the '
        'tolerance of the data sheet. 0: none.',
        minimum=0.0,
        maximum=0.1,
    )
    accelerometer_scale_std: float = param(
        0.005,
        'Prior standard deviation of the scale and cross-axis errors of the accelerometer, which are estimated: half '
        'the tolerance of the data sheet. 0: none.',
        minimum=0.0,
        maximum=0.1,
    )
    accelerometer_delay_std: float = param(
        0.01,
        'Prior standard deviation of the delay of the accelerometer behind the gyroscope, by the low-pass filters of '
        'either, which is estimated. 0: none.',
        unit='s',
        minimum=0.0,
        maximum=0.1,
    )
    gyroscope_nonlinearity: float = param(
        0.001,
        'Residual error of the gyroscope in motion (nonlinearity, bandwidth), relative to the rate.',
        minimum=0.0,
        maximum=0.1,
    )
    accelerometer_nonlinearity: float = param(
        0.004,
        'Residual error of the accelerometer (also size effect), relative to the specific force without gravity.',
        minimum=0.0,
        maximum=0.1,
    )
    gyroscope_range: float = param(
        34.9, 'Readings beyond this are saturated.', unit='rad/s', minimum=0.1, maximum=100.0
    )
    accelerometer_range: float = param(
        156.0, 'Readings beyond this are saturated.', unit='m/s^2', minimum=10.0, maximum=10000.0
    )
    vibration: float = param(
        1.0,
        'Factor on the noise density measured under vibration (the spectral floor between the rotor tones), which '
        'replaces the white noise of the data sheet where it is larger. 0: ignore vibration.',
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class PoseEkfConfig(ScheduleParameters, ClockParameters, FrameParameters, MountErrorParameters):
    """The filter."""

    estimate_time_offset: bool = param(True, 'Estimate the error of camera_time_offset.')
    time_offset_random_walk: float = _clock_random_walk(('estimate_time_offset',))
    stamp_jitter: float = param(
        0.005,
        'Initial standard deviation of the jitter of the camera stamps, estimated from the poses, 0.1 to 20 ms. '
        '0: no jitter.',
        unit='s',
        minimum=0.0,
        maximum=0.02,
    )
    mount_vibration: float = param(
        5.0e-4,
        'Initial standard deviation of the vibration of the camera against the IMU, estimated from the poses. 0: none.',
        unit='rad',
        minimum=0.0,
        maximum=0.01,
    )
    imu: ImuNoise = group(ImuNoise)  # noqa: RUF009
    gravity: float = param(9.80665, 'Local gravity.', unit='m/s^2', minimum=9.7, maximum=9.9)
    map_tilt_std: float = param(
        0.010,
        'Prior standard deviation of the tilt of the map against gravity, which is estimated. 0: z is vertical.',
        unit='rad',
        minimum=0.0,
        maximum=0.2,
    )
    initial_velocity_std: float = param(
        3.0, 'Initial standard deviation of the velocity.', unit='m/s', minimum=0.01, maximum=100.0
    )
    # 2.9 deg/s: zero-rate offsets in data sheets are 1 to 20 deg/s, a recorded ADIS16448 has 4.4; PX4 begins with 5.7.
    initial_gyroscope_bias_std: float = param(
        0.05, 'Initial standard deviation of the gyroscope bias.', unit='rad/s', minimum=0.0, maximum=1.0
    )
    initial_accelerometer_bias_std: float = param(
        0.2, 'Initial standard deviation of the accelerometer bias.', unit='m/s^2', minimum=0.0, maximum=10.0
    )
    initial_poses: int = param(3, 'Consistent poses needed to initialise the filter.', minimum=1, maximum=100)
    pose_noise_scale: float = param(
        1.0,
        'Factor on the standard deviation of the camera poses; larger scatter is estimated on top of it.',
        minimum=0.1,
        maximum=1000.0,
        dynamic=True,
    )
    systematic_pose_std: float = param(
        1.0,
        'Systematic error of camera poses in a constant view (lens, corners), in their standard deviations.',
        minimum=0.01,
        maximum=100.0,
    )
    systematic_angle: float = param(
        0.3, 'Change of the view that decorrelates the systematic error.', unit='rad', minimum=0.001, maximum=10.0
    )
    gate: float = param(
        CHI2_OF_POSE,
        f'Gate: a pose with a larger NIS is refused ({CHI2_OF_POSE}: 99.9 % quantile of chi-square, '
        '6 degrees of freedom).',
        minimum=1.0,
        dynamic=True,
    )
    reset_after: float = param(
        1.0,
        'Reset when refused poses have been consistent with each other for this long. If they are far from the '
        'estimate, as many are needed as the estimate has accepted (at most 300), unless it is lost.',
        unit='s',
        minimum=0.0,
        dynamic=True,
    )
    max_delay: float = param(
        1.0, 'Largest delay of a pose; later ones are refused.', unit='s', minimum=0.0, maximum=10.0
    )
    max_imu_gap: float = param(
        1.0, 'Longest IMU gap or clock jump without a reset.', unit='s', minimum=0.01, maximum=10.0
    )
    lost_position_std: float = param(
        0.3,
        'The pose is lost when the standard deviation of the position exceeds this.',
        unit='m',
        minimum=0.001,
        maximum=10.0,
        dynamic=True,
    )
    reinitialise_after: float = param(
        60.0, 'Reset after this time without an accepted pose.', unit='s', minimum=1.0, dynamic=True
    )
    smoothing_time: float = param(
        0.0,
        'Time over which the smooth output spreads corrections; 0: no smooth output.',
        unit='s',
        minimum=0.0,
        maximum=60.0,
    )
    imu_rate: float = param(
        0.0,
        'Expected rate of imu/data for the diagnostics; 0: the rate of the first seconds.',
        unit='Hz',
        minimum=0.0,
        least=0.01,
        maximum=10000.0,
    )
    map_frame: str = param('map', 'Frame of the pose.', form=frame_name)
    odom_frame: str = param(
        '',
        'REP-105 odom frame: /tf gets odom_frame to base_frame (smooth output) and map_frame to odom_frame (the '
        'difference). Empty: map_frame to base_frame.',
        form=frame_name,
        needs=('publish_tf', 'smoothing_time'),
    )
    resume: bool = param(
        True,
        'After a crash in flight, start from the last clock offset, which is stored in ~/.ros (ROS_HOME).',
    )
    publish_lost: bool = param(False, 'Publish `pose` also while it is lost; `odometry` is always published.')
    publish_tf: bool = param(False, 'Publish map to base_frame and base_frame to camera_frame on /tf (needs tf2_ros).')
    bridge_rate: float = param(
        0.0,
        'Rate of bridge/odometry and bridge/pose for a flight controller; nothing is sent while the pose is lost, and '
        'the smooth output with smoothing_time. 0: none.',
        unit='Hz',
        minimum=0.0,
        least=0.1,
        maximum=1000.0,
    )
    px4: bool = param(
        False,
        'Also publish fmu/in/vehicle_visual_odometry at that rate, with the package px4_msgs.',
        needs=('bridge_rate',),
    )


@dataclass(frozen=True)
class ThermalSourceConfig(FrameParameters, ImageParameters):
    """A camera driver, for cameras without one of their own."""

    calibration_file: str = _calibration_file('none')

    camera: str = param(
        '',
        'Source of the frames: a V4L2 device (/dev/video0), a TeAx ThermalGrabber ("teax", or "teax:SERIAL" if there '
        'are several), or a folder, picture or video of 16 bits.',
        form=local_path,
    )
    image_width: int = param(0, 'Requested width; 0: as the camera is set.', unit='px', minimum=0, maximum=4096)
    image_height: int = param(0, 'Requested height; 0: as the camera is set.', unit='px', minimum=0, maximum=4096)
    frame_rate: float = param(
        0.0,
        'Rate requested of a V4L2 device, or at which pictures are published; 0: as the device is set, pictures at 30.',
        unit='Hz',
        minimum=0.0,
        least=0.01,
        maximum=1000.0,
    )
    repeat: bool = param(True, 'Restart a folder, picture or video at its end.')


@dataclass(frozen=True)
class LandingTargetConfig(FrameParameters, MountParameters):
    """The landing pad, for an autopilot behind mavros."""

    landing_pad: tuple[int, ...] = param(
        (), 'IDs of the markers of the landing pad: its origin is their centroid, its axes are those of the first.'
    )
    landing_target_frame: str = param(
        'body',
        'body: relative to the robot (ArduPilot; mavros with mav_frame BODY_FRD); map: in the map (PX4; LOCAL_NED).',
        choices=('body', 'map'),
    )
    map_frame: str = param('map', 'Frame of the map.', form=frame_name)


#: Node to its parameters: the pipeline.
NODES: dict[str, type] = {
    'tau2_camera': Tau2CameraConfig,
    'aruco_detector': ArucoDetectorConfig,
    'marker_mapper': MarkerMapperConfig,
    'pose_ekf': PoseEkfConfig,
}

#: The nodes that each camera has.
OF_CAMERA = ('tau2_camera', 'aruco_detector')
#: Topics of the first camera's nodes that those of a second camera, in a namespace of its own, use as well.
SHARED_WITH_SECOND_CAMERA = ('marker_map', 'odometry', 'camera_clock')

#: Optional nodes beside the pipeline.
OPTIONAL_NODES: dict[str, type] = {'thermal_source': ThermalSourceConfig, 'landing_target': LandingTargetConfig}


def meant_node(section: str, names: Iterable[str]) -> str:
    """The node that a section of a parameter file is meant for, if its name is mistyped; empty if it is not.

    Sections for nodes of other packages may have any names: one is meant for a node of ours if its name is similar
    and all its parameters are that node's.

    Parameters
    ----------
    section : its name, as ``/drone/pose_ekf``
    names : its parameters
    """
    nodes = NODES | OPTIONAL_NODES
    name = section.rpartition('/')[2]
    close = [] if name in nodes else difflib.get_close_matches(name.lower(), nodes, 1)
    if not close:
        return ''
    own = {name for name, _, _ in parameters(nodes[close[0]])}
    return close[0] if own.intersection(names) and set(names) <= own.union(_OF_ROS) else ''


def check_names(names: Iterable[str]) -> None:
    """Refuse a parameter that no node has, most likely a mistyped name.

    Raises
    ------
    InputError
        An unknown name; the message suggests the closest known one.
    """
    known = {name for kind in (NODES | OPTIONAL_NODES).values() for name, _, _ in parameters(kind)}
    for name in sorted(set(names) - known - set(_OF_ROS)):
        if name.startswith(QOS_OVERRIDES):
            continue
        close = difflib.get_close_matches(name, known, 1)
        shown = _shown(name).strip('\'"')
        raise InputError(f'parameter {shown}: no node has it' + (f'; did you mean {close[0]}?' if close else ''))
