"""``calibrate``: intrinsics of the thermal camera, and camera against IMU."""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import track
import yaml

from thermal_fiducial.calibration.camera_imu import calibrate_rolling_camera_imu, CameraImuCalibration
from thermal_fiducial.calibration.intrinsics import Calibration, CANDIDATES, choose_model
from thermal_fiducial.calibration.report import coverage, parameter_rows, write_report
from thermal_fiducial.calibration.rolling import FrameCorners
from thermal_fiducial.calibration.sources import (
    clean_frames,
    Frame,
    imu_track,
    is_folder_of_pictures,
    pictures,
    read_picture,
    recorded_camera,
)
from thermal_fiducial.calibration.targets import Chessboard, CircleGrid, MarkerBoard, Sighting, Target
from thermal_fiducial.config import ArucoDetectorConfig, ImuNoise, PoseEkfConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.measurements import corner_covariances, corners_px
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader, parse_remaps
from thermal_fiducial.files.camera_info import load_camera, save_camera
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.marker_map import load_map

# A view of a bag must have moved by this much since the last one kept, and by less than that to the next frame [px].
_NEW_VIEW_PX, _STILL_PX = 12.0, 0.7
_SHADES = ' .:+#'
#: Boards; ``circles`` are OpenCV's asymmetric grid.
TARGETS = ('chessboard', 'circles', 'symmetric-circles', 'markers')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Sub-commands of ``calibrate``."""
    commands = parser.add_subparsers(dest='action', metavar='ACTION', required=True)
    _add_intrinsics(commands.add_parser('intrinsics', help='camera_info from thermal views of a board'))
    _add_camera_imu(commands.add_parser('camera-imu', help='pose and clock of the camera relative to the IMU'))


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    return int(args.do(args))


# --- intrinsics ---------------------------------------------------------------------------------------


def _add_intrinsics(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_intrinsics)
    parser.add_argument('source', type=Path, help='folder of pictures (8 or 16 bit), or a bag with thermal/image_raw')
    parser.add_argument('--out', type=Path, default=Path('camera_info.yaml'), help='calibration to write')
    parser.add_argument('--report', type=Path, help='report to write (default: next to the calibration, .html)')
    parser.add_argument('--target', choices=TARGETS, default='chessboard')
    parser.add_argument(
        '--grid',
        type=int,
        nargs=2,
        metavar=('COLUMNS', 'ROWS'),
        help='inner corners (8 6), or circles as OpenCV counts them (circles: 4 11; symmetric-circles: 7 5)',
    )
    parser.add_argument(
        '--spacing', type=float, default=50.0, metavar='MM', help='square, or between two rows of circles'
    )
    parser.add_argument('--diameter', type=float, default=20.0, metavar='MM', help='of the circles')
    parser.add_argument('--board', type=Path, metavar='MAP', help='marker map of a marker board')
    parser.add_argument('--models', default=','.join(CANDIDATES), help='to choose among, by held-out error')
    parser.add_argument('--focal-px', type=float, default=600.0, help='rough focal length to start from')
    parser.add_argument('--most-views', type=int, default=80, help='stop looking for views after this many')
    parser.add_argument('--every', type=int, default=5, help='look at every n-th frame of a bag')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO', help='another name in the bag')


def _intrinsics(args: argparse.Namespace) -> int:
    models = args.models.split(',')
    unknown = set(models) - set(CANDIDATES)
    if unknown or not args.focal_px > 0.0 or args.every < 1:
        raise InputError(f'--models are {", ".join(CANDIDATES)}; --focal-px and --every must be positive')
    target = _target(args)
    views = _Views(target)
    if is_folder_of_pictures(args.source):
        _look_at_pictures(args, views)
    else:
        _look_at_bag(args, views)
    if not views.sightings:
        raise InputError(f'{args.source}: the board was found in none of the frames')
    result, errors = views.solve(models, args.focal_px)
    if isinstance(target, MarkerBoard):
        # The first search refined its corners without the lens.
        views.look_again(result.camera)
        result, errors = views.solve(models, args.focal_px)
    save_camera(args.out, result.camera)
    _save_covariance(args.out, result)
    report = args.report or args.out.with_suffix('.html')
    write_report(report, result, views.sightings, views.names, errors)
    _print_result(args, result, errors, views)
    return 0


def _target(args: argparse.Namespace) -> Target:
    spacing, diameter = 1e-3 * args.spacing, 1e-3 * args.diameter
    if args.target == 'chessboard':
        columns, rows = args.grid or (8, 6)
        return Chessboard(columns, rows, spacing)
    if args.target != 'markers':
        asymmetric = args.target == 'circles'
        columns, rows = args.grid or ((4, 11) if asymmetric else (7, 5))
        return CircleGrid(columns, rows, spacing, diameter, asymmetric=asymmetric)
    if args.board is None:
        raise InputError('--target markers needs --board, the marker map of the board')
    board = load_map(args.board)
    return MarkerBoard(board, _detector(board))


def _detector(board: MarkerMap) -> MarkerDetector:
    detector = MarkerDetector(ArucoDetectorConfig(dictionary=board.dictionary), load_dictionary(board.dictionary))
    detector.set_map(board.geometry())
    return detector


@dataclass
class _Views:
    """Views of the board as they come in."""

    target: Target
    sightings: list[Sighting] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)

    def find(self, frame: Frame, camera: Camera) -> Sighting | None:
        """The board in a frame.

        Raises
        ------
        InputError
            A frame of another size than those before.
        """
        height, width = frame.counts.shape
        if self.sightings and self.size != (width, height):
            raise InputError(f'{frame.name}: {width}x{height} pixels, others have {self.size[0]}x{self.size[1]}')
        self.size = (width, height)
        return self.target.find(frame.counts, camera)

    def keep(self, frame: Frame, sighting: Sighting) -> None:
        """Use a view, and say how much of the image is covered by now."""
        self.sightings.append(sighting)
        self.names.append(frame.name)
        self.frames.append(frame)
        cells = self.covered()
        print(f'{frame.name}: {len(sighting.pixels)} points; {np.sum(cells > 0)} of {cells.size} cells covered')

    def covered(self) -> np.ndarray:
        """Points in each cell of the image."""
        return coverage(np.concatenate([sighting.pixels for sighting in self.sightings]), *self.size)

    def look_again(self, camera: Camera) -> None:
        """Find the board once more in all frames, now that the camera is known."""
        found = [self.target.find(frame.counts, camera) for frame in self.frames]
        self.sightings = [new or old for new, old in zip(found, self.sightings, strict=True)]

    def solve(self, models: Sequence[str], focal_px: float) -> tuple[Calibration, dict[str, float]]:
        """The best model, and the held-out errors of all."""
        return choose_model(self.sightings, *self.size, models, radius=self.target.radius, focal_px=focal_px)


def _guess(frame: Frame, focal_px: float) -> Camera:
    height, width = frame.counts.shape
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return Camera(width, height, K)


def _look_at_pictures(args: argparse.Namespace, views: _Views) -> None:
    for index, path in enumerate(pictures(args.source)):
        frame = Frame(path.name, index * 10_000_000_000, read_picture(path))
        sighting = views.find(frame, _guess(frame, args.focal_px))
        if sighting is None:
            print(f'{frame.name}: no board')
        elif len(views.sightings) < args.most_views:
            views.keep(frame, sighting)


def _look_at_bag(args: argparse.Namespace, views: _Views) -> None:
    """Every n-th frame where the board stands still and elsewhere than before."""
    with BagReader(args.source, parse_remaps(args.remap)) as bag:
        pending: tuple[Frame, Sighting] | None = None
        for index, frame in enumerate(clean_frames(bag)):
            if pending is None and index % args.every:
                continue
            sighting = views.find(frame, _guess(frame, args.focal_px))
            if pending is not None and sighting is not None and _distance(pending[1], sighting) < _STILL_PX:
                views.keep(*pending)
            pending = None
            if sighting is not None and _is_new(sighting, views.sightings):
                pending = (frame, sighting)
            if len(views.sightings) >= args.most_views:
                return


def _is_new(sighting: Sighting, kept: Sequence[Sighting]) -> bool:
    return all(_distance(sighting, other) > _NEW_VIEW_PX for other in kept)


def _distance(a: Sighting, b: Sighting) -> float:
    """Mean distance of the points that both show [px]; infinite when they share none."""
    there = {tuple(point): pixel for point, pixel in zip(a.points.tolist(), a.pixels, strict=True)}
    both = [
        (there[tuple(point)], pixel)
        for point, pixel in zip(b.points.tolist(), b.pixels, strict=True)
        if tuple(point) in there
    ]
    return float(np.mean([np.linalg.norm(p - q) for p, q in both])) if both else np.inf


def _save_covariance(out: Path, result: Calibration) -> None:
    """Next to the calibration, which has no place for it."""
    path = out.with_name(f'{out.stem}_covariance.yaml')
    rows = parameter_rows(result)
    document = {
        'parameters': [name for name, _, _ in rows],
        'sigma': [sigma for _, _, sigma in rows],
        'covariance': result.covariance.tolist(),
        'rms_px': result.rms_px,
        'held_out_rms_px': result.held_out_px,
    }
    path.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120), encoding='utf-8')


def _print_result(args: argparse.Namespace, result: Calibration, errors: dict[str, float], views: _Views) -> None:
    cells = views.covered()
    shades = np.minimum(np.ceil(4.0 * cells / max(1, int(np.percentile(cells, 90)))), 4).astype(int)
    print('\n'.join('|' + ''.join(_SHADES[shade] for shade in row) + '|' for row in shades))
    for model, error in errors.items():
        print(f'{model}: held-out rms {error:.4f} px')
    for name, value, sigma in parameter_rows(result):
        print(f'{name} = {value:.6g} +- {sigma:.2g}')
    dropped = ', '.join(views.names[index] for index in result.dropped) or 'none'
    print(
        f'{args.out}: {result.camera.model}, rms {result.rms_px:.4f} px, {len(result.views)} views, dropped: {dropped}'
    )


# --- camera against IMU -------------------------------------------------------------------------------


def _add_camera_imu(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_camera_imu)
    parser.add_argument('bag', type=Path, help='bag with thermal/image_raw and imu/data, moving before mapped markers')
    parser.add_argument('--map', type=Path, required=True, help='marker map')
    parser.add_argument('--calibration', type=Path, help='camera_info YAML (default: the camera_info of the bag)')
    parser.add_argument('--out', type=Path, default=Path('extrinsics.yaml'), help='parameters to write')
    noise = ImuNoise()
    for name in (
        'gyroscope_noise_density',
        'accelerometer_noise_density',
        'gyroscope_random_walk',
        'accelerometer_random_walk',
    ):
        default = getattr(noise, name)
        parser.add_argument('--' + name.replace('_', '-'), type=float, default=default, help=f'(default: {default:g})')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO', help='another name in the bag')


def _camera_imu(args: argparse.Namespace) -> int:
    noise = ImuNoise(
        args.gyroscope_noise_density,
        args.accelerometer_noise_density,
        args.gyroscope_random_walk,
        args.accelerometer_random_walk,
    )
    marker_map = load_map(args.map)
    with BagReader(args.bag, parse_remaps(args.remap)) as bag:
        camera = recorded_camera(bag) if args.calibration is None else load_camera(args.calibration)
        imu, start_ns = imu_track(bag)
        frames = track(clean_frames(bag), 'finding markers', bag.message_count([bag.image_topic]), transient=True)
        seen = sorted(_mapped_corners(frames, marker_map, camera), key=lambda frame: frame.stamp_ns)
    result = calibrate_rolling_camera_imu(seen, camera, imu, start_ns, noise)
    args.out.write_text(_extrinsics_text(result), encoding='utf-8')
    print(_extrinsics_text(result))
    return 0


def _mapped_corners(frames: Iterable[Frame], marker_map: MarkerMap, camera: Camera) -> Iterator[FrameCorners]:
    """Markers of the map in each frame that shows any."""
    detector = _detector(marker_map)
    for frame in frames:
        rows = detector.detect(frame.stamp_ns, frame.counts, camera)
        rows = rows[np.isin(rows['id'], list(marker_map.markers))]
        if len(rows) == 0:
            continue
        markers = [marker_map.markers[marker_id] for marker_id in rows['id'].tolist()]
        T_map_marker = np.stack([marker.T_map_marker for marker in markers])
        sizes = np.array([marker.size for marker in markers])
        yield FrameCorners(frame.stamp_ns, corners_px(rows), corner_covariances(rows), T_map_marker, sizes)


def _extrinsics_text(result: CameraImuCalibration) -> str:
    """Parameter file of the nodes, with what is known of the errors as comments."""
    q = se3.quaternion_from_rotation(result.T_body_camera[:3, :3])
    p = result.T_body_camera[:3, 3]
    sigma = np.sqrt(np.diag(result.covariance))
    rotation, position = np.degrees(sigma[:3]), 1e3 * sigma[3:6]
    rms = np.sqrt(np.mean(np.sum(result.residuals[:, :3] ** 2, axis=1)))
    return '\n'.join(
        [
            f'# {result.poses} camera poses; position rms {1e3 * rms:.2f} mm; noise {result.scale:.2f} of the expected',
            f'# gravity in the map: {np.round(result.gravity_map, 4).tolist()} m/s^2',
            '/**:',
            '  ros__parameters:',
            f'    camera_position: {np.round(p, 6).tolist()}  # +- {np.round(position, 2).tolist()} mm',
            f'    camera_orientation: {np.round(q, 8).tolist()}  # +- {np.round(rotation, 4).tolist()} deg',
            f'    camera_time_offset: {result.time_offset:.6f}  # +- {1e3 * sigma[6]:.3f} ms',
            f'    readout_time: {result.readout_time:.6f}  # +- {1e3 * result.readout_sigma:.3f} ms',
            f'    stamp_jitter: {max(result.stamp_jitter, PoseEkfConfig().stamp_jitter):.6f}  # found: '
            f'{1e3 * result.stamp_jitter:.3f} ms',
            '',
        ]
    )
