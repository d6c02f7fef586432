"""``calibrate intrinsics``: camera_info from thermal views of a board, or from points that were measured elsewhere."""

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from thermal_fiducial.calibration.intrinsics import Calibration, LEAST_VIEWS
from thermal_fiducial.calibration.lens_check import image_error, ImageError
from thermal_fiducial.calibration.lens_choice import CANDIDATES, choose_model
from thermal_fiducial.calibration.plots import coverage
from thermal_fiducial.calibration.report import BoardView, write_report
from thermal_fiducial.calibration.sources import (
    clean_frames,
    is_folder_of_pictures,
    measured_points,
    pictures,
    RawFrame,
    read_picture,
)
from thermal_fiducial.calibration.targets import BoardNotFound, Chessboard, CircleGrid, MarkerBoard, Sighting, Target
from thermal_fiducial.cli.progress import tracked
from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader, parse_remaps
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.writing import write_text

# A view of a bag must have moved by this much since the last one kept, and by less than that to the next frame [px].
_NEW_VIEW_PX, _STILL_PX = 12.0, 0.7
_SHADES = ' .:+#'
#: Boards; ``circles`` are OpenCV's asymmetric grid.
TARGETS = ('chessboard', 'circles', 'symmetric-circles', 'markers')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``calibrate intrinsics``."""
    parser.set_defaults(do=_intrinsics)
    parser.add_argument(
        'source',
        type=Path,
        help='folder of pictures (8 or 16 bit), a bag with thermal/image_raw, or a CSV file of measured points '
        '(columns view, point, u, v [px], x, y [m]; with --size)',
    )
    parser.add_argument('--out', type=Path, default=Path('camera_info.yaml'), help='calibration to write')
    parser.add_argument('--report', type=Path, help='report to write (default: next to the calibration, .html)')
    parser.add_argument('--models', default=','.join(CANDIDATES), help='to choose among, by held-out error')
    parser.add_argument('--focal-px', type=float, default=600.0, help='rough focal length to start from [px]')
    parser.add_argument('--most-views', type=int, default=80, help='stop looking for views after this many')
    parser.add_argument('--every', type=int, default=5, help='look at every n-th frame of a bag')
    parser.add_argument('--size', type=int, nargs=2, metavar=('WIDTH', 'HEIGHT'), help='of the image, with a CSV file')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO', help='another name in the bag')
    _add_board(parser.add_argument_group('board'))


def _add_board(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        '--target', choices=TARGETS, default='chessboard', metavar='KIND', help=f'one of {", ".join(TARGETS)}'
    )
    group.add_argument(
        '--grid',
        type=int,
        nargs=2,
        metavar=('COLUMNS', 'ROWS'),
        help='inner corners, or circles as OpenCV counts them (default: 8 6; circles 4 11; symmetric-circles 7 5)',
    )
    group.add_argument(
        '--longer-rows', type=int, default=0, metavar='N', help='circles that every other row has more than COLUMNS'
    )
    group.add_argument(
        '--missing', action='append', default=[], metavar='COLUMN,ROW', help='a circle, from 0,0, that is not there'
    )
    group.add_argument(
        '--spacing', type=float, default=50.0, metavar='MM', help='square, or between two rows of circles'
    )
    group.add_argument('--diameter', type=float, default=20.0, metavar='MM', help='of the circles')
    group.add_argument('--board', type=Path, metavar='MAP', help='marker map of a marker board')


def _intrinsics(args: argparse.Namespace) -> int:
    models = args.models.split(',')
    unknown = set(models) - set(CANDIDATES)
    if unknown or not args.focal_px > 0.0 or args.every < 1:
        raise InputError(f'--models are {", ".join(CANDIDATES)}; --focal-px and --every must be positive')
    views = _views(args)
    views.require(args.source)
    result, fits = views.solve(models, args.focal_px)
    if isinstance(views.target, MarkerBoard):
        # The first search refined its corners without the lens.
        views.look_again(result.camera)
        result, fits = views.solve(models, args.focal_px)
    error = image_error(result.camera, result.covariance, [views.kept[k].sighting for k in result.views.tolist()])
    save_camera(args.out, result.camera)
    _save_covariance(args.out, result, error)
    write_report(args.report or args.out.with_suffix('.html'), result, views.kept, fits, error, views.unusable)
    _print_result(args.out, result, fits, views, error)
    return 0


@dataclass
class _Views:
    """Views of the board as they come in.

    Parameters
    ----------
    target : the board; None where its points were measured elsewhere
    kept, unusable : views, and name and reason of frames that are none
    size : width and height of the image [px]
    """

    target: Target | None = None
    kept: list[BoardView] = field(default_factory=list)
    unusable: list[tuple[str, str]] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)

    def find(self, frame: RawFrame, camera: Camera) -> Sighting | None:
        """The board in a frame; None, with the reason noted, where there is none."""
        height, width = frame.counts.shape
        if self.kept and self.size != (width, height):
            reason = f'{width}x{height} pixels, the views before it have {self.size[0]}x{self.size[1]}'
            self.unusable.append((frame.name, reason))
            return None
        self.size = (width, height)
        assert self.target is not None
        try:
            return self.target.find(frame.counts, camera)
        except BoardNotFound as reason:
            self.unusable.append((frame.name, str(reason)))
            return None

    def keep(self, frame: RawFrame, sighting: Sighting) -> None:
        """Use a view, and say how much of the image is covered by now."""
        self.kept.append(BoardView(frame.name, sighting, frame.counts))
        cells = self.covered()
        print(f'{frame.name}: {len(sighting.pixels)} points; {np.sum(cells > 0)} of {cells.size} cells covered')

    def covered(self) -> np.ndarray:
        """Points in each cell of the image."""
        return coverage(np.concatenate([view.sighting.pixels for view in self.kept]), *self.size)

    def require(self, source: Path) -> None:
        """Refuse too few views, with the reasons of those that are none.

        Raises
        ------
        InputError
            Fewer than a calibration needs.
        """
        if len(self.kept) >= LEAST_VIEWS:
            return
        total = len(self.kept) + len(self.unusable)
        reasons = Counter(reason for _, reason in self.unusable)
        named = [f'{name}: {reason}' for name, reason in self.unusable] if len(self.unusable) <= 20 else []
        named = named or [f'{count} frames: {reason}' for reason, count in reasons.most_common(5)]
        text = f'{source}: {len(self.kept)} of {total} frames are usable views, a calibration needs {LEAST_VIEWS}'
        raise InputError('; '.join([text, *named]))

    def look_again(self, camera: Camera) -> None:
        """Find the board once more in all frames, now that the camera is known."""
        assert self.target is not None
        for index, view in enumerate(self.kept):
            if view.counts is None:
                continue
            try:
                self.kept[index] = BoardView(view.name, self.target.find(view.counts, camera), view.counts)
            except BoardNotFound:
                continue

    def solve(self, models: Sequence[str], focal_px: float) -> tuple[Calibration, dict[str, Calibration]]:
        """The best lens, and the best of every model."""
        radius = 0.0 if self.target is None else self.target.radius
        sightings = [view.sighting for view in self.kept]
        return choose_model(sightings, *self.size, models, radius=radius, focal_px=focal_px)


def _views(args: argparse.Namespace) -> _Views:
    if args.source.suffix.lower() == '.csv':
        if args.size is None or min(args.size) < 32:
            raise InputError(f'{args.source}: points without pictures need --size WIDTH HEIGHT')
        named = [BoardView(name, sighting) for name, sighting in measured_points(args.source, *args.size)]
        return _Views(None, named, size=tuple(args.size))
    views = _Views(_target(args))
    if is_folder_of_pictures(args.source):
        _look_at_pictures(args, views)
    else:
        _look_at_bag(args, views)
    return views


def _target(args: argparse.Namespace) -> Target:
    spacing, diameter = 1e-3 * args.spacing, 1e-3 * args.diameter
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
    return MarkerBoard(board, mapped_detector(board))


def _place(text: str) -> tuple[int, int]:
    try:
        column, row = map(int, text.split(','))
    except ValueError:
        raise InputError(f'--missing {text}: not COLUMN,ROW') from None
    return column, row


def mapped_detector(board: MarkerMap) -> MarkerDetector:
    """Detector of the markers of a map."""
    detector = MarkerDetector(ArucoDetectorConfig(dictionary=board.dictionary), load_dictionary(board.dictionary))
    detector.set_map(board.geometry())
    return detector


def _guess(frame: RawFrame, focal_px: float) -> Camera:
    height, width = frame.counts.shape
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return Camera(width, height, K)


def _look_at_pictures(args: argparse.Namespace, views: _Views) -> None:
    for index, path in enumerate(pictures(args.source)):
        if len(views.kept) == args.most_views:
            return
        try:
            counts = read_picture(path)
        except InputError as reason:
            views.unusable.append((path.name, str(reason).removeprefix(f'{path}: ')))
            print(f'{path.name}: not used: {views.unusable[-1][1]}')
            continue
        frame = RawFrame(path.name, index * 10_000_000_000, counts)
        sighting = views.find(frame, _guess(frame, args.focal_px))
        if sighting is None:
            print(f'{frame.name}: not used: {views.unusable[-1][1]}')
        else:
            views.keep(frame, sighting)


def _look_at_bag(args: argparse.Namespace, views: _Views) -> None:
    """Every n-th frame where the board stands still and elsewhere than before."""
    if not args.source.exists():
        raise InputError(f'{args.source}: no such folder of pictures, bag or CSV file')
    with BagReader(args.source, parse_remaps(args.remap)) as bag:
        pending: tuple[RawFrame, Sighting] | None = None
        frames = tracked(clean_frames(bag), 'looking for the board', bag.message_count([bag.image_topic]))
        for index, frame in enumerate(frames):
            if pending is None and index % args.every:
                continue
            sighting = views.find(frame, _guess(frame, args.focal_px))
            if pending is not None and sighting is not None:
                if _distance(pending[1], sighting) < _STILL_PX:
                    views.keep(*pending)
                else:
                    views.unusable.append((pending[0].name, 'the board moves'))
            pending = None
            if sighting is not None and _is_new(sighting, views.kept):
                pending = (frame, sighting)
            if len(views.kept) >= args.most_views:
                return


def _is_new(sighting: Sighting, kept: Sequence[BoardView]) -> bool:
    return all(_distance(sighting, view.sighting) > _NEW_VIEW_PX for view in kept)


def _distance(a: Sighting, b: Sighting) -> float:
    """Mean distance of the points that both show [px]; infinite when they share none."""
    there = {tuple(point): pixel for point, pixel in zip(a.points.tolist(), a.pixels, strict=True)}
    both = [
        (there[tuple(point)], pixel)
        for point, pixel in zip(b.points.tolist(), b.pixels, strict=True)
        if tuple(point) in there
    ]
    return float(np.mean([np.linalg.norm(p - q) for p, q in both])) if both else np.inf


def _save_covariance(out: Path, result: Calibration, error: ImageError) -> None:
    """Next to the calibration, which has no place for it."""
    path = out.with_name(f'{out.stem}_covariance.yaml')
    rows = result.parameter_rows()
    document = {
        'parameters': [name for name, _, _ in rows],
        'sigma': [sigma for _, _, sigma in rows],
        'covariance': result.covariance.tolist(),
        'rms_px': result.rms_px,
        'held_out_rms_px': result.held_out_px[0],
        'held_out_standard_error_px': result.held_out_px[1],
        'covered_share': round(error.covered_share, 4),
        'sigma_covered_px': error.inside_px,
        'sigma_not_covered_px': error.outside_px,
    }
    write_text(path, yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120))


def _print_result(
    out: Path, result: Calibration, fits: dict[str, Calibration], views: _Views, error: ImageError
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
    print(f'{out}: {result.lens_name()}, rms {result.rms_px:.4f} px, {len(result.views)} views, dropped: {dropped}')
