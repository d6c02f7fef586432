"""``calibrate``: intrinsics and lag of the thermal camera, camera against IMU, and noise of the IMU."""

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermal_fiducial.calibration.sources import camera_of, clean_frames, imu_track
from thermal_fiducial.cli import calibrate_intrinsics
from thermal_fiducial.cli.arguments import (
    add_calibration,
    add_force,
    add_remap,
    file_to_write,
    refuse_to_overwrite,
    warn,
)
from thermal_fiducial.cli.calibrate_imu import add_imu
from thermal_fiducial.cli.calibrate_intrinsics import LEAST_ORIENTATION_STD, mapped_detector
from thermal_fiducial.cli.calibrate_lag import add_lag
from thermal_fiducial.cli.marker_sizes import add_thickness
from thermal_fiducial.cli.parser import add_command, Parser
from thermal_fiducial.cli.progress import tracked
from thermal_fiducial.cli.ranges import IMU_NOISE, LAG_S
from thermal_fiducial.cli.recorded_corners import has_corners_only, recorded_rows
from thermal_fiducial.config import ArucoDetectorConfig, ImuNoise, PoseEkfConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.error_model import READOUT_AS_DECLARED
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.measurements import corner_covariances, corners_px, Markers
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader, parse_remaps
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.reading import naming
from thermal_fiducial.files.writing import write_text

if TYPE_CHECKING:
    from thermal_fiducial.calibration.camera_imu import CameraImuCalibration
    from thermal_fiducial.calibration.rolling import FrameCorners

#: Least standard deviation of the camera's position [m]: calibrations of one rig differ by 7 mm.
_LEAST_POSITION_STD = 0.002
_REMEDY = 'record a minute with turns about all three axes and motion along them'


def add_arguments(parser: Parser) -> None:
    """Sub-commands of ``calibrate``."""
    commands = parser.add_subparsers(dest='action', metavar='ACTION', required=True)
    what = 'intrinsics (camera_info) from thermal views of a board'
    calibrate_intrinsics.add_arguments(add_command(commands, 'intrinsics', what))
    add_lag(add_command(commands, 'lag', 'time constant of the bolometers'))
    _add_camera_imu(add_command(commands, 'camera-imu', 'pose and clock of the camera relative to the IMU'))
    add_imu(add_command(commands, 'imu', 'noise densities of an IMU at rest'))


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    return int(args.do(args))


# --- camera against IMU -------------------------------------------------------------------------------


def _add_camera_imu(parser: Parser) -> None:
    parser.set_defaults(do=_camera_imu)
    parser.add_argument(
        'bag',
        type=Path,
        metavar='BAG',
        help='bag with thermal/image_raw (or markers, their corners) and imu/data, moving before mapped markers',
    )
    parser.add_argument('--map', type=Path, required=True, metavar='FILE', help='marker map (YAML)')
    add_calibration(parser)
    add_thickness(parser)
    parser.add_argument(
        '--bolometer-lag',
        type=LAG_S,
        metavar='S',
        help='thermal time constant of the bolometers [s], by which corners are late '
        f'(default: {ArucoDetectorConfig.bolometer_lag})',
    )
    parser.add_argument('--out', type=file_to_write, default=Path('extrinsics.yaml'), help='parameters to write')
    add_force(parser)
    noise = ImuNoise()
    for name, unit in (
        ('gyroscope_noise_density', 'rad/s/sqrt(Hz)'),
        ('accelerometer_noise_density', 'm/s^2/sqrt(Hz)'),
        ('gyroscope_random_walk', 'rad/s^2/sqrt(Hz)'),
        ('accelerometer_random_walk', 'm/s^3/sqrt(Hz)'),
        ('gyroscope_instability', 'rad/s'),
        ('accelerometer_instability', 'm/s^2'),
    ):
        default = getattr(noise, name)
        parser.add_argument(
            '--' + name.replace('_', '-'), type=IMU_NOISE, default=default, metavar='X', help=f'[{unit}]'
        )
    add_remap(parser)


def _camera_imu(args: argparse.Namespace) -> int:
    # Takes half a second to import, which the other calibrations do not need.
    from thermal_fiducial.calibration.camera_imu import calibrate_rolling_camera_imu

    refuse_to_overwrite([args.out], args.force)
    noise = ImuNoise(
        args.gyroscope_noise_density,
        args.accelerometer_noise_density,
        args.gyroscope_random_walk,
        args.accelerometer_random_walk,
        args.gyroscope_instability,
        args.accelerometer_instability,
    )
    marker_map = load_map(args.map)
    with BagReader(args.bag, parse_remaps(args.remap)) as bag:
        camera = camera_of(bag, args.calibration)
        imu, start_ns = imu_track(bag)
        lag = ArucoDetectorConfig.bolometer_lag if args.bolometer_lag is None else args.bolometer_lag
        detector = mapped_detector(marker_map, args.map.parent, args.plate_thickness, lag)
        of_images = {'--plate-thickness': args.plate_thickness > 0.0, '--bolometer-lag': args.bolometer_lag is not None}
        for option, given in of_images.items():
            if given and has_corners_only(bag):
                raise InputError(f'{option} has no effect with {args.bag}, which has corners instead of images')
        found = recorded_rows(bag) if has_corners_only(bag) else _detected_rows(bag, detector, camera)
        seen = sorted(_mapped_corners(found, marker_map), key=lambda frame: frame.stamp_ns)
    if not seen:
        raise InputError(f'{args.bag}: no frame shows a marker of {args.map}, which are of {marker_map.dictionary}')
    with naming(args.bag):
        result = calibrate_rolling_camera_imu(seen, camera, imu, start_ns, noise)
    write_text(args.out, _extrinsics_text(result))
    print(_extrinsics_text(result))
    _warn_of_wide(*_extrinsics_std(result))
    return 0


def _detected_rows(bag: BagReader, detector: MarkerDetector, camera: Camera) -> Iterator[tuple[int, Markers]]:
    """Stamps and detections of the frames of a bag."""
    for frame in tracked(clean_frames(bag), 'finding markers', bag.message_count([bag.image_topic])):
        with naming(bag.path):
            camera.require_size_of(frame.counts)
        yield frame.stamp_ns, detector.detect(frame.stamp_ns, frame.counts, camera)


def _mapped_corners(found: Iterable[tuple[int, Markers]], marker_map: MarkerMap) -> Iterator['FrameCorners']:
    """Detections of mapped markers that are not in quarantine, frames without any left out."""
    from thermal_fiducial.calibration.rolling import FrameCorners

    trusted = [key for key, marker in marker_map.markers.items() if marker.trusted]
    for stamp_ns, rows in found:
        rows = rows[np.isin(rows['id'], trusted)]
        if len(rows) == 0:
            continue
        markers = [marker_map.markers[marker_id] for marker_id in rows['id'].tolist()]
        T_map_marker = np.stack([marker.T_map_marker for marker in markers])
        sizes = np.array([marker.size for marker in markers])
        yield FrameCorners(stamp_ns, corners_px(rows), corner_covariances(rows), T_map_marker, sizes)


def _extrinsics_std(result: 'CameraImuCalibration') -> tuple[float, float]:
    """Standard deviations of position [m] and orientation [rad] for the filter, those of the worst axes.

    At least ``_LEAST_POSITION_STD`` and ``LEAST_ORIENTATION_STD``.
    """
    sigma = np.sqrt(np.diag(result.covariance))
    position = max(float(sigma[3:6].max()), _LEAST_POSITION_STD)
    orientation = max(float(sigma[:3].max()), LEAST_ORIENTATION_STD)
    return position, orientation


def _warn_of_wide(position: float, orientation: float) -> None:
    """Warn of extrinsics that the recording leaves wider [m, rad] than usual."""
    if position <= _LEAST_POSITION_STD and orientation <= LEAST_ORIENTATION_STD:
        return
    known = _in_words(position, orientation)
    usual = _in_words(_LEAST_POSITION_STD, LEAST_ORIENTATION_STD)
    warn(f'extrinsics known to {known} only, {usual} are usual: {_REMEDY}')


def _in_words(position: float, orientation: float) -> str:
    return f'{1e3 * position:.1f} mm and {np.degrees(orientation):.2f} deg'


def _percent(result: 'CameraImuCalibration', places: tuple[int, ...]) -> str:
    return ', '.join(f'{100.0 * result.axes[k]:.2f} +- {100.0 * result.axes_sigma[k]:.2f}' for k in places)


def _extrinsics_text(result: 'CameraImuCalibration') -> str:
    """Parameter file of the nodes, with the errors of the values as comments."""
    q = se3.quaternion_from_rotation(result.T_body_camera[:3, :3])
    p = result.T_body_camera[:3, 3]
    sigma = np.sqrt(np.diag(result.covariance))
    rotation, position = np.degrees(sigma[:3]), 1e3 * sigma[3:6]
    position_std, orientation_std = _extrinsics_std(result)
    left_mm = 1e3 * np.linalg.norm(result.residuals[:, :3], axis=1)
    return '\n'.join(
        [
            # No rms: one pose of a marker that was taken for its mirror image, which has no weight, would make it.
            f'# {result.poses} camera poses, off the motion by {np.median(left_mm):.2f} mm in the median, '
            f'{left_mm.max():.2f} mm at worst; noise {result.scale:.2f} of the expected',
            f'# scale errors of the gyroscope [%]: {_percent(result, (0, 4, 8))}',
            f'# scale errors of the accelerometer [%]: {_percent(result, (9, 11, 14))}',
            f'# accelerometer behind the gyroscope: {1e3 * result.force_delay:.2f} +- '
            f'{1e3 * result.force_delay_sigma:.2f} ms',
            f'# gravity in the map: {np.round(result.gravity_map, 4).tolist()} m/s^2',
            '/**:',
            '  ros__parameters:',
            f'    camera_position: {np.round(p, 6).tolist()}  # +- {np.round(position, 2).tolist()} mm',
            f'    camera_orientation: {np.round(q, 8).tolist()}  # +- {np.round(rotation, 4).tolist()} deg',
            f'    extrinsics_position_std: {position_std:.6f}',
            f'    extrinsics_orientation_std: {orientation_std:.6f}',
            f'    camera_time_offset: {result.time_offset:.6f}  # +- {1e3 * sigma[6]:.3f} ms',
            f'    readout_time: {result.readout_time:.6f}  # +- {1e3 * result.readout_sigma:.3f} ms',
            f'    readout_time_std: {max(result.readout_sigma, READOUT_AS_DECLARED):.6f}',
            f'    stamp_jitter: {max(result.stamp_jitter, PoseEkfConfig().stamp_jitter):.6f}  # found: '
            f'{1e3 * result.stamp_jitter:.3f} ms',
            '',
        ]
    )
