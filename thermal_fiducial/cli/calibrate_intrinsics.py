"""``calibrate intrinsics``: camera_info from thermal views of a board, or from measured points."""

import argparse
from collections.abc import Sequence
import math
from pathlib import Path

import numpy as np

from thermal_fiducial.calibration.board_shape import BoardShape
from thermal_fiducial.calibration.intrinsics import Calibration
from thermal_fiducial.calibration.lens_check import image_error, ImageError
from thermal_fiducial.calibration.lens_choice import CANDIDATES
from thermal_fiducial.calibration.report import write_refusal, write_report
from thermal_fiducial.calibration.sources import is_folder_of_pictures
from thermal_fiducial.calibration.targets import Chessboard, CircleGrid, MarkerBoard, Target
from thermal_fiducial.cli.arguments import (
    add_force,
    add_remap,
    file_to_write,
    refuse_to_overwrite,
    warn,
    whole_number,
)
from thermal_fiducial.cli.board_views import (
    BoardViews,
    corners_of,
    images_of,
    look_at_bag,
    look_at_pictures,
    look_at_points,
)
from thermal_fiducial.cli.marker_sizes import add_thickness
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.ranges import (
    BOARD_MM,
    BOARD_POINTS,
    BOARD_STD_MM,
    FOCAL_PX,
    IMAGE_PX,
    MORE_POINTS,
    MOTION_PX,
)
from thermal_fiducial.cli.recorded_corners import has_corners_only
from thermal_fiducial.config import ArucoDetectorConfig, MarkerMapperConfig, PoseEkfConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.measurements import places_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader, parse_remaps
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.files.dictionary import bring_from_map, dictionary_of_map, load_dictionary
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.files.plain_yaml import save_plain
from thermal_fiducial.files.reading import naming

_SHADES = ' .:+#'
#: Boards; ``circles`` are OpenCV's asymmetric grid.
TARGETS = ('chessboard', 'circles', 'symmetric-circles', 'markers')
_OF_CIRCLES = ('--longer-rows', '--missing', '--diameter')
#: Least standard deviation of the camera's rotation on the robot by a calibration [rad]: those of one rig differ by
#: 2.6 to 3.7 mrad with one board.
LEAST_ORIENTATION_STD = 0.002


def add_arguments(parser: Parser) -> None:
    """Options of ``calibrate intrinsics``."""
    parser.set_defaults(do=_intrinsics)
    parser.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='folder of pictures (8 or 16 bit), a bag with thermal/image_raw (or markers, the corners of a marker '
        'board), or a CSV file of measured points (columns view, point, u, v [px], x, y [m]; with --size)',
    )
    parser.add_argument('--out', type=file_to_write, default=Path('camera_info.yaml'), help='calibration to write')
    parser.add_argument(
        '--report', type=file_to_write, help='report to write (default: next to the calibration, .html)'
    )
    add_force(parser)
    parser.add_argument(
        '--models', default=','.join(CANDIDATES), metavar='NAMES', help='models to choose among, by held-out error'
    )
    parser.add_argument('--focal-px', type=FOCAL_PX, default=600.0, help='rough focal length to start from [px]')
    parser.add_argument('--most-views', type=whole_number(1), default=80, help='stop looking for views after this many')
    parser.add_argument('--every', type=whole_number(1), default=5, help='look at every n-th frame of a bag')
    parser.add_argument(
        '--most-motion',
        type=MOTION_PX,
        default=0.7,
        metavar='PX',
        help='most motion of the board from a view of a bag to the next frame [px]; more only where all rows of an '
        'image are read at once',
    )
    parser.add_argument(
        '--size', type=IMAGE_PX, nargs=2, metavar=('WIDTH', 'HEIGHT'), help='size of the image, needed with a CSV file'
    )
    add_remap(parser)
    _add_board(parser.add_argument_group('board'))
    add_thickness(parser)
    parser.add_argument(
        '--board-out', type=file_to_write, metavar='MAP', help='map to write, of a marker board as it was found'
    )
    _refuse_what_is_for_others(parser)


def _refuse_what_is_for_others(parser: Parser) -> None:
    """Refuse options that the source, or the board, has no use for."""
    parser.refuse(
        [
            '--target',
            *_OF_CIRCLES,
            '--grid',
            '--spacing',
            '--board',
            '--board-out',
            '--most-views',
            '--every',
            '--most-motion',
            '--remap',
        ],
        'with a CSV file of measured points',
        _has_points,
    )
    parser.refuse(['--size'], 'without a CSV file of measured points', lambda args: not _has_points(args))
    of_bags = ['--every', '--most-motion', '--remap']
    parser.refuse(of_bags, 'with a folder of pictures', lambda args: is_folder_of_pictures(args.source))
    parser.refuse(_OF_CIRCLES, 'without --target circles', lambda args: not args.target.endswith('circles'))
    parser.refuse(['--grid', '--spacing'], 'with --target markers', lambda args: args.target == 'markers')
    parser.refuse(
        ['--board', '--board-out', '--plate-thickness'],
        'without --target markers',
        lambda args: args.target != 'markers',
    )


def _has_points(args: argparse.Namespace) -> bool:
    return bool(args.source.suffix.lower() == '.csv')


def _add_board(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        '--target', choices=TARGETS, default='chessboard', metavar='KIND', help=f'one of {", ".join(TARGETS)}'
    )
    group.add_argument(
        '--grid',
        type=BOARD_POINTS,
        nargs=2,
        metavar=('COLUMNS', 'ROWS'),
        help='inner corners, or circles as OpenCV counts them (default: 8 6; circles 4 11; symmetric-circles 7 5)',
    )
    group.add_argument(
        '--longer-rows',
        type=MORE_POINTS,
        default=0,
        metavar='N',
        help='number of circles by which every other row is longer than COLUMNS',
    )
    group.add_argument(
        '--missing',
        action='append',
        default=[],
        metavar='COLUMN,ROW',
        help='a circle that is not there, counted from 0,0; may be given several times',
    )
    group.add_argument(
        '--spacing',
        type=BOARD_MM,
        metavar='MM',
        help='side of a square, or distance between two rows of circles (default: 50; circles 25)',
    )
    group.add_argument('--diameter', type=BOARD_MM, default=20.0, metavar='MM', help='diameter of the circles')
    group.add_argument('--board', type=Path, metavar='MAP', help='marker map of a marker board')
    group.add_argument(
        '--board-std',
        type=BOARD_STD_MM,
        default=0.5,
        metavar='MM',
        help='standard deviation of each coordinate of its points, which are unknowns as well; 0: exact',
    )


def _intrinsics(args: argparse.Namespace) -> int:
    models = args.models.split(',')
    unknown = set(models) - set(CANDIDATES)
    if unknown:
        raise InputError(f'--models are {", ".join(CANDIDATES)}, not {", ".join(sorted(unknown))}')
    page = args.report or args.out.with_suffix('.html')
    written = [args.out, _covariance_file(args.out), page, *filter(None, [args.board_out])]
    refuse_to_overwrite(written, args.force)
    views = _views(args)
    try:
        result, fits = _solved(views, args, models)
    except InputError as reason:
        refused = page.with_stem(f'{page.stem}_refused')
        write_refusal(refused, str(reason), views.size, views.kept, views.unusable)
        raise InputError(f'{reason}; see {refused}') from None
    error = image_error(result.camera, result.covariance, [views.kept[k].sighting for k in result.views.tolist()])
    save_camera(args.out, result.camera)
    _save_covariance(args.out, result, error)
    if args.board_out is not None:
        assert isinstance(views.target, MarkerBoard)
        found = views.target.as_found(result.board)
        bring_from_map(found.dictionary, args.board.parent, args.board_out.parent)
        save_map(args.board_out, found)
    write_report(page, result, views.kept, fits, error, views.unusable)
    _print_result(args.out, result, fits, views, error)
    _warn_of_focal_length(result)
    _warn_of_principal_point(result)
    _warn_of_board(result.board, 1e-3 * args.board_std)
    return 0


def _solved(
    views: BoardViews, args: argparse.Namespace, models: Sequence[str]
) -> tuple[Calibration, dict[str, Calibration]]:
    """The best calibration, and the best of each lens model. Raises InputError, which names the source."""
    views.require(args.source)
    with naming(args.source):
        result, fits = views.solve(models, args.focal_px, 1e-3 * args.board_std)
        if isinstance(views.target, MarkerBoard) and any(view.counts is not None for view in views.kept):
            # The first search refined the corners without knowledge of the distortion.
            views.look_again(result.camera)
            result, fits = views.solve(models, args.focal_px, 1e-3 * args.board_std)
        return result, fits


def _views(args: argparse.Namespace) -> BoardViews:
    if _has_points(args):
        if args.size is None:
            raise InputError(f'{args.source}: points without pictures need --size WIDTH HEIGHT')
        return look_at_points(args.source, tuple(args.size))
    views = BoardViews(_target(args))
    if is_folder_of_pictures(args.source):
        look_at_pictures(args.source, views, args.focal_px, args.most_views)
        return views
    if not args.source.exists():
        raise InputError(f'{args.source}: no such folder of pictures, bag or CSV file')
    with BagReader(args.source, parse_remaps(args.remap)) as bag:
        by_corners = isinstance(views.target, MarkerBoard) and has_corners_only(bag)
        if by_corners and args.plate_thickness:
            raise InputError(f'--plate-thickness has no effect with {args.source}, which has corners instead of images')
        frames = corners_of(bag, views) if by_corners else images_of(bag, views, args.focal_px)
        look_at_bag(frames, views, args.most_views, args.every, args.most_motion)
    return views


def _target(args: argparse.Namespace) -> Target:
    # The default of ``markers board``.
    millimetres = args.spacing or (25.0 if args.target == 'circles' else 50.0)
    spacing, diameter = 1e-3 * millimetres, 1e-3 * args.diameter
    if args.target == 'chessboard':
        columns, rows = args.grid or (8, 6)
        return Chessboard(columns, rows, spacing)
    if args.target != 'markers':
        asymmetric = args.target == 'circles'
        columns, rows = args.grid or ((4, 11) if asymmetric else (7, 5))
        missing = [_place(text) for text in args.missing]
        longer = args.longer_rows
        return CircleGrid(columns, rows, spacing, diameter, asymmetric=asymmetric, longer=longer, missing=missing)
    if args.board is None:
        raise InputError('--target markers needs --board, the marker map of the board')
    board = load_map(args.board)
    with naming(args.board):
        return MarkerBoard(board, mapped_detector(board, args.board.parent, args.plate_thickness))


def _place(text: str) -> tuple[int, int]:
    try:
        column, row = map(int, text.split(','))
    except ValueError:
        raise InputError(f'--missing {text}: not COLUMN,ROW') from None
    return column, row


def mapped_detector(
    board: MarkerMap, folder: Path, thickness: float = 0.0, lag: float = ArucoDetectorConfig.bolometer_lag
) -> MarkerDetector:
    """Detector with the markers of ``board``, a map in ``folder``, plates of ``thickness`` [m], as its map.

    ``lag`` [s]: of the bolometers.
    """
    dictionary = dictionary_of_map(board.dictionary, folder)
    config = ArucoDetectorConfig(dictionary=dictionary, plate_thickness=thickness, bolometer_lag=lag)
    detector = MarkerDetector(config, load_dictionary(dictionary))
    detector.set_map(*places_of(board.rows()))
    return detector


def _save_covariance(out: Path, result: Calibration, error: ImageError) -> None:
    """Write the covariance beside the calibration, whose format has no field for it."""
    rows = result.parameter_rows()
    document = {
        'parameters': [name for name, _, _ in rows],
        'sigma': [sigma for _, _, sigma in rows],
        'covariance': result.covariance[: len(rows), : len(rows)].tolist(),
        'rms_px': result.rms_px,
        'held_out_rms_px': result.held_out_px[0],
        'held_out_standard_error_px': result.held_out_px[1],
        'covered_share': round(error.covered_share, 4),
        'sigma_covered_px': error.inside_px,
        'sigma_not_covered_px': error.outside_px,
    }
    save_plain(_covariance_file(out), document)


def _covariance_file(out: Path) -> Path:
    return out.with_name(f'{out.stem}_covariance.yaml')


def _warn_of_focal_length(result: Calibration) -> None:
    """Warn of a focal length that the views leave wider than the mapper's default."""
    usual = MarkerMapperConfig().focal_length_std
    share = max(sigma / value for name, value, sigma in result.parameter_rows() if name in ('fx', 'fy'))
    if share > usual:
        known = f'focal length known to {100.0 * share:.2g} % only, {100.0 * usual:.2g} % is usual'
        remedy = f'tilt the board by 20 to 40 degrees, or set focal_length_std: {share:.4f}'
        warn(f'{known}: {remedy}')


def _warn_of_principal_point(result: Calibration) -> None:
    """Warn of a principal point whose error may turn the camera by more than calibrations of a mount differ by.

    Corners that are all displaced alike are, to first order, those of a camera that is turned on the robot.
    """
    claimed = PoseEkfConfig().extrinsics_orientation_std
    point = max(sigma for name, _, sigma in result.parameter_rows() if name in ('cx', 'cy'))
    turn = point / result.camera.focal_px
    if turn > LEAST_ORIENTATION_STD:
        known = f'principal point known to {point:.2g} px only, which may turn the camera by {1e3 * turn:.2g} mrad'
        remedy = f'more views, or set extrinsics_orientation_std: {math.hypot(turn, claimed):.4f}'
        warn(f'{known}: {remedy}')


def _warn_of_board(board: BoardShape, board_std: float) -> None:
    """Warn of a board that is off by more than it is known to [m]."""
    # Of three coordinates. As many times the standard deviation as no board of 20 points or more reaches by chance.
    if board_std and board.rms_m > 1.5 * np.sqrt(3.0) * board_std:
        wider = f'--board-std {1e3 * board.rms_m / np.sqrt(3.0):.1f}'
        warn(f'{board.sentence()}, more than {1e3 * board_std:.2g} mm allow: measure it, or give {wider}')


def _print_result(
    out: Path, result: Calibration, fits: dict[str, Calibration], views: BoardViews, error: ImageError
) -> None:
    cells = views.covered()
    shades = np.minimum(np.ceil(4.0 * cells / max(1, int(np.percentile(cells, 90)))), 4).astype(int)
    print('\n'.join('|' + ''.join(_SHADES[shade] for shade in row) + '|' for row in shades))
    for fit in fits.values():
        print(f'{fit.lens_name()}: held-out rms {fit.held_out_px[0]:.4f} +- {fit.held_out_px[1]:.4f} px')
    for name, value, sigma in result.parameter_rows():
        print(f'{name} = {value:.6g} +- {sigma:.2g}')
    dropped = ', '.join(views.kept[index].name for index in result.dropped) or 'none'
    print(error.sentence())
    print(result.board.sentence())
    seen = f'{len(result.views)} views of {len(views.kept) + len(views.unusable)} frames, dropped by the fit: {dropped}'
    print(f'{out}: {result.lens_name()}, rms {result.rms_px:.4f} px, {seen}')
