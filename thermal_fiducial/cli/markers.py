"""``markers``: dictionaries, drawings and planning of markers that can be cut."""

import argparse
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from thermal_fiducial.cli import marker_planning
from thermal_fiducial.core.detection.patterns import marker_bits
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.types import FloatArray, Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import base_plate, circle_board, marker_grid
from thermal_fiducial.fabrication.bridges import darkest_white, find_bridges
from thermal_fiducial.fabrication.cuttability import examine
from thermal_fiducial.fabrication.dictionary_search import distances, search
from thermal_fiducial.fabrication.drawing import Drawing
from thermal_fiducial.fabrication.plate import marker_drawing, MOUNTS, PlateOptions
from thermal_fiducial.fabrication.sheet import nest
from thermal_fiducial.fabrication.verification import agree, problems, read_dxf
from thermal_fiducial.fabrication.writers import FORMATS, write
from thermal_fiducial.files.dictionary import load_dictionary, save_dictionary
from thermal_fiducial.files.marker_map import save_map

_OPTION_HELP = {
    'size': 'side of the black square',
    'hole_diameter': 'mounting holes (4.3: M4)',
    'stand_off': 'spacers between warm surface and plate',
    'kerf': 'width of the cut',
    'corner_radius': 'radius of re-entrant corners',
    'bridge_width': 'webs that hold islands of standard dictionaries',
    'frame_width': 'width of the frame (--mount frame)',
    'tie_width': 'necks of the ears, or ties to the frame',
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Sub-commands of ``markers``."""
    commands = parser.add_subparsers(dest='action', metavar='ACTION', required=True)
    _add_check(commands.add_parser('check', help='which markers of a dictionary can be cut in one piece'))
    _add_make(commands.add_parser('make', help='drawings of markers (SVG, DXF, PDF, PNG), one file a marker'))
    _add_sheet(commands.add_parser('sheet', help='many markers nested on sheets of a given size'))
    _add_bridge(commands.add_parser('bridge', help='where bridges go in markers of a standard dictionary'))
    _add_board(commands.add_parser('board', help='drawings of thermal calibration boards'))
    _add_dictionary(commands.add_parser('dictionary', help='search a dictionary of markers that can be cut'))
    marker_planning.add_plan(
        commands.add_parser('plan', help='will it be seen, how good is the pose, how long is it warm')
    )
    marker_planning.add_measure(
        commands.add_parser('measure', help='measure the tables that plan reads, in simulation')
    )


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    return int(args.do(args))


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_check)
    _add_choice(parser)
    parser.add_argument('--size', type=float, default=300.0, metavar='MM', help='side of the black square')
    parser.add_argument('--min-web', type=float, default=3.0, metavar='MM', help='least width of acrylic between holes')


def _check(args: argparse.Namespace) -> int:
    bits, ids = _chosen(args)
    cell = args.size / (bits.shape[1] + 2)
    table = Table('ID', 'one piece', 'islands', 'point contacts', 'narrowest web mm', 'longest arm cells')
    good = 0
    for marker_id in ids:
        found = examine(bits[marker_id])
        web = found.narrowest_web_cells * cell
        fine = found.cuttable and web >= args.min_web
        good += fine
        row = (found.islands, found.point_contacts, f'{web:.1f}', found.longest_arm)
        table.add_row(str(marker_id), 'yes' if fine else 'no', *map(str, row))
    console = Console()
    console.print(table)
    between, own = distances(bits[ids])
    console.print(
        f'{good} of {len(ids)} markers can be cut; distance between markers {between}, to own rotations {own}'
    )
    return 0


def _add_make(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_make)
    _add_choice(parser)
    _add_plate_options(parser)
    _add_output(parser)


def _make(args: argparse.Namespace) -> int:
    for drawing in _markers(args):
        _write_all(drawing, args)
    return 0


def _add_sheet(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_sheet)
    _add_choice(parser)
    _add_plate_options(parser)
    parser.add_argument('--sheet', type=float, nargs=2, default=(1000.0, 600.0), metavar=('WIDTH', 'HEIGHT'), help='mm')
    parser.add_argument('--spacing', type=float, default=5.0, metavar='MM', help='between markers')
    parser.add_argument('--margin', type=float, default=10.0, metavar='MM', help='along the rim of the sheet')
    _add_output(parser)


def _sheet(args: argparse.Namespace) -> int:
    width, height = args.sheet
    for drawing in nest(list(_markers(args)), width, height, spacing=args.spacing, margin=args.margin):
        _write_all(drawing, args)
    return 0


def _add_bridge(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_bridge)
    _add_choice(parser)
    parser.add_argument('--size', type=float, default=300.0, metavar='MM', help='side of the black square')
    parser.add_argument('--bridge-width', type=float, default=4.0, metavar='MM', help='width of a web')


def _bridge(args: argparse.Namespace) -> int:
    bits, ids = _chosen(args)
    cell = args.size / (bits.shape[1] + 2)
    table = Table('ID', 'patches', 'webs', 'longest web cells', 'read part of a white cell covered')
    for marker_id in ids:
        bridges = find_bridges(bits[marker_id])
        longest = max((len(web) - 1 for web in bridges.webs), default=0)
        covered = darkest_white(bits[marker_id], bridges, cell, args.bridge_width)
        row = (marker_id, len(bridges.patches), len(bridges.webs), longest, f'{100 * covered:.0f} %')
        table.add_row(*map(str, row))
    Console().print(table)
    return 0


def _add_board(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_board)
    parser.add_argument('kind', choices=('circles', 'markers'), help='one stencil of holes, or markers on a base plate')
    parser.add_argument('--grid', type=int, nargs=2, metavar=('COLUMNS', 'ROWS'), help='circles: 4 11; markers: 4 3')
    parser.add_argument('--spacing', type=float, metavar='MM', help='circles: between rows (25); markers: gap (40)')
    parser.add_argument('--diameter', type=float, default=20.0, metavar='MM', help='of the circles')
    parser.add_argument('--dictionary', default='STENCIL_4X4_100', help='of the markers')
    _add_plate_options(parser)
    parser.set_defaults(size=80.0)
    _add_output(parser)


def _board(args: argparse.Namespace) -> int:
    options = _plate_options(args)
    columns, rows = args.grid or ((4, 11) if args.kind == 'circles' else (4, 3))
    if args.kind == 'circles':
        _write_all(circle_board(columns, rows, args.spacing or 25.0, args.diameter, options), args)
        return 0
    bits = marker_bits(load_dictionary(args.dictionary))
    if columns < 1 or rows < 1 or columns * rows > len(bits):
        raise InputError(f'a board of {columns} x {rows} markers: {args.dictionary} has {len(bits)}')
    labels = [str(index) for index in range(columns * rows)]
    for label in labels:
        _write_all(marker_drawing(bits[int(label)], label, options), args)
    centres = marker_grid(columns, rows, options.size, args.spacing or 40.0)
    _write_all(base_plate(centres, labels, bits.shape[1] + 2, options), args)
    save_map(args.out / 'board.yaml', _board_map(centres, options, args.dictionary))
    return 0


def _board_map(centres: FloatArray, options: PlateOptions, dictionary: str) -> MarkerMap:
    """Map of a board's markers, the origin in its middle; what ``calibrate intrinsics --board`` takes."""
    metres = 1e-3 * np.column_stack([centres, np.zeros(len(centres))])
    markers = {
        index: MapMarker(index, 1e-3 * options.size, True, se3.transform(np.eye(3), centre))
        for index, centre in enumerate(metres)
    }
    return MarkerMap(markers, dictionary=dictionary)


def _add_dictionary(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(do=_dictionary)
    parser.add_argument('out', type=Path, help="dictionary file to write (YAML); its name becomes the dictionary's")
    parser.add_argument('--bits', type=int, default=4, help='bits along a side')
    parser.add_argument('--distance', type=int, default=4, help='least Hamming distance')
    parser.add_argument('--count', type=int, help='keep this many, the stiffest')
    parser.add_argument('--seed', type=int, default=1, help='the same seed and restarts give the same file')
    parser.add_argument('--restarts', type=int, default=1000, help='codes to try')


def _dictionary(args: argparse.Namespace) -> int:
    with Progress(transient=True) as bar:
        task = bar.add_task('searching', total=args.restarts)
        bits = search(
            args.bits,
            args.distance,
            seed=args.seed,
            restarts=args.restarts,
            progress=lambda done, most: bar.update(task, completed=done, description=f'{most} markers'),
        )
    found = len(bits)
    if args.count is not None and args.count > found:
        raise InputError(f'{found} markers found, not {args.count}; try more restarts')
    kept = bits[: args.count]
    packed = np.concatenate([cv2.aruco.Dictionary.getByteListFromBits(marker) for marker in kept])
    dictionary = cv2.aruco.Dictionary(packed, args.bits, (args.distance - 1) // 2)
    save_dictionary(args.out, args.out.stem, dictionary)
    count = '' if args.count is None else f' --count {args.count}'
    command = f'--bits {args.bits} --distance {args.distance} --seed {args.seed} --restarts {args.restarts}{count}'
    text = args.out.read_text(encoding='utf-8')
    args.out.write_text(f'# thermal-fiducial markers dictionary {args.out.name} {command}\n{text}', encoding='utf-8')
    between, own = distances(kept)
    print(f'{args.out}: {len(kept)} of {found} markers, distance {between}, to own rotations {own}')
    return 0


def _add_choice(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--dictionary', default='STENCIL_4X4_100', help="name of OpenCV's or ours, or a file")
    parser.add_argument('--ids', metavar='LIST', help='markers, e.g. 0-7,12 (default: all)')


def _add_plate_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('plate', 'all lengths in millimetres')
    group.add_argument('--mount', choices=MOUNTS, default='ears', help='what holds the pattern (default: ears)')
    defaults = PlateOptions()
    for name, description in _OPTION_HELP.items():
        default = getattr(defaults, name)
        option = '--' + name.replace('_', '-')
        group.add_argument(
            option, type=float, default=default, metavar='MM', help=f'{description} (default: {default:g})'
        )
    group.add_argument('--quiet-cells', type=float, default=1.0, metavar='CELLS', help='warm ring around the pattern')


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--out', type=Path, default=Path('markers'), metavar='FOLDER', help='where the files go')
    parser.add_argument('--formats', default='svg,dxf,pdf,png', help='of these, separated by commas (default: all)')


def _plate_options(args: argparse.Namespace) -> PlateOptions:
    return PlateOptions(**{item.name: getattr(args, item.name) for item in fields(PlateOptions)})


def _chosen(args: argparse.Namespace) -> tuple[Gray, list[int]]:
    bits = marker_bits(load_dictionary(args.dictionary))
    ids = list(range(len(bits))) if args.ids is None else _id_list(args.ids)
    wrong = [marker_id for marker_id in ids if marker_id >= len(bits)]
    if wrong:
        raise InputError(f'{args.dictionary} has no marker {wrong[0]}: its IDs are 0 to {len(bits) - 1}')
    return bits, ids


def _id_list(text: str) -> list[int]:
    ids: list[int] = []
    for part in text.split(','):
        first, dash, last = part.partition('-')
        try:
            ids += range(int(first), int(last if dash else first) + 1)
        except ValueError:
            raise InputError(f'--ids {text!r} is not a list like 0-7,12') from None
    if not ids:
        raise InputError(f'--ids {text!r} names no marker')
    return ids


def _markers(args: argparse.Namespace) -> Iterable[Drawing]:
    bits, ids = _chosen(args)
    options = _plate_options(args)
    for marker_id in ids:
        yield marker_drawing(bits[marker_id], str(marker_id), options)


def _write_all(drawing: Drawing, args: argparse.Namespace) -> None:
    """Write a drawing in all formats, read the DXF back and compare."""
    formats = args.formats.split(',')
    unknown = set(formats) - set(FORMATS)
    if unknown:
        raise InputError(f'--formats: {", ".join(sorted(unknown))} is not among {", ".join(FORMATS)}')
    wrong = problems(drawing, drawing.parts)
    if wrong:
        raise InputError(f'{drawing.name}: {"; ".join(wrong)}')
    stem = f'marker-{drawing.name}' if drawing.name.isdigit() else drawing.name
    for kind in formats:
        path = args.out / f'{stem}.{kind}'
        write(drawing, path)
        if kind == 'dxf' and not agree(read_dxf(path), drawing):
            raise InputError(f'{path}: what was read back is not what was written')
    notes = '\n  '.join(('', *drawing.notes))
    print(f'{args.out / stem}: {drawing.width:.1f} x {drawing.height:.1f} mm, {drawing.parts} parts{notes}')
