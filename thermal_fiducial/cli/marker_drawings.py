"""``markers make``, ``sheet`` and ``board``: drawings for laser cutters and printers."""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from shlex import quote

import numpy as np

from thermal_fiducial.cli.arguments import add_force, refuse_to_overwrite, warn
from thermal_fiducial.cli.marker_choice import add_choice, chosen, name_look_alikes
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.cli.ranges import BOARD_POINTS, CELLS, LENGTH_MM
from thermal_fiducial.core.detection.patterns import Dictionary
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import base_plate, circle_board, LEAST_MARKERS, marker_grid
from thermal_fiducial.fabrication.drawing import Drawing
from thermal_fiducial.fabrication.paper import check_paper, PAPERS
from thermal_fiducial.fabrication.plate import marker_drawing, MOUNTS, PlateOptions
from thermal_fiducial.fabrication.sheet import nest
from thermal_fiducial.fabrication.strength import strength_of
from thermal_fiducial.fabrication.verification import agree, problems, read_dxf
from thermal_fiducial.fabrication.writers import FORMATS, write
from thermal_fiducial.files.dictionary import copied_beside, load_dictionary
from thermal_fiducial.files.marker_map import save_map
from thermal_fiducial.files.packages import is_installed, remedy
from thermal_fiducial.files.reading import read_text
from thermal_fiducial.files.writing import write_text

_OPTION_HELP = {
    'size': 'side of the black square',
    'thickness': 'thickness of the acrylic',
    'hole_diameter': 'diameter of the mounting holes (4.3: M4)',
    'stand_off': 'length of the spacers between warm surface and plate',
    'kerf': 'width of the cut',
    'corner_radius': 'radius of re-entrant corners',
    'bridge_width': 'width of the webs that hold islands of standard dictionaries',
    'frame_width': 'width of the frame (--mount frame)',
    'tie_width': 'width of the necks of the ears, or of the ties to the frame',
}


def add_make(parser: Parser) -> None:
    """Arguments of ``markers make``."""
    parser.set_defaults(do=_make)
    add_choice(parser)
    add_plate_options(parser)
    _add_output(parser)


def _make(args: argparse.Namespace) -> int:
    dictionary, ids = chosen(args)
    drawings = _markers(dictionary, ids, args)
    _write_all(drawings, args)
    _say_what_is_weak(drawings, args, dictionary.cells)
    name_look_alikes(dictionary, ids)
    _say_parameters(args)
    return 0


def add_sheet(parser: Parser) -> None:
    """Arguments of ``markers sheet``."""
    parser.set_defaults(do=_sheet)
    add_choice(parser)
    add_plate_options(parser)
    parser.add_argument(
        '--sheet', type=LENGTH_MM, nargs=2, default=(1000.0, 600.0), metavar=('WIDTH', 'HEIGHT'), help='its size [mm]'
    )
    parser.add_argument('--spacing', type=LENGTH_MM, default=5.0, metavar='MM', help='between markers')
    parser.add_argument('--margin', type=LENGTH_MM, default=10.0, metavar='MM', help='along the border of the sheet')
    _add_output(parser)


def _sheet(args: argparse.Namespace) -> int:
    width, height = args.sheet
    if args.spacing <= args.kerf:
        raise InputError(f'--spacing {args.spacing:g}: cuts of {args.kerf:g} mm need more between markers (--kerf)')
    dictionary, ids = chosen(args)
    drawings = _markers(dictionary, ids, args)
    _write_all(nest(drawings, width, height, spacing=args.spacing, margin=args.margin), args)
    _say_what_is_weak(drawings, args, dictionary.cells)
    name_look_alikes(dictionary, ids)
    _say_parameters(args)
    return 0


def _say_parameters(args: argparse.Namespace) -> None:
    metres = f'marker_size: {args.size / 1e3:g}, plate_thickness: {args.thickness / 1e3:g}'
    print(f'parameters of the nodes for these markers: dictionary: {args.dictionary}, {metres}')


def add_board(parser: Parser) -> None:
    """Arguments of ``markers board``."""
    parser.set_defaults(do=_board)
    parser.add_argument('kind', choices=('circles', 'markers'), help='one stencil of holes, or markers on a base plate')
    parser.add_argument(
        '--grid', type=BOARD_POINTS, nargs=2, metavar=('COLUMNS', 'ROWS'), help='default: 4 11 circles, 4 3 markers'
    )
    parser.add_argument(
        '--spacing', type=LENGTH_MM, metavar='MM', help='default: 25 between rows of circles, 40 between markers'
    )
    parser.add_argument('--diameter', type=LENGTH_MM, default=20.0, metavar='MM', help='of the circles')
    parser.add_argument('--dictionary', default='STENCIL_4X4_100', help='of the markers')
    add_plate_options(parser, size=130.0)
    _add_output(parser)
    parser.refuse(['--diameter'], 'on a board of markers', lambda args: args.kind == 'markers')
    parser.refuse(
        ['--dictionary', '--mount', '--min-web', *(_option(name) for name in (*_OPTION_HELP, 'quiet_cells'))],
        'on a board of circles',
        lambda args: args.kind == 'circles',
    )


def _board(args: argparse.Namespace) -> int:
    options = plate_options(args)
    columns, rows = args.grid or ((4, 11) if args.kind == 'circles' else (4, 3))
    if args.kind == 'circles':
        spacing = 25.0 if args.spacing is None else args.spacing
        _write_all([circle_board(columns, rows, spacing, args.diameter, options)], args)
        _say_how_to_use(f'circles --grid {columns} {rows} --spacing {spacing:g} --diameter {args.diameter:g}')
        return 0
    dictionary = load_dictionary(args.dictionary)
    count = len(dictionary.bits)
    if not LEAST_MARKERS <= columns * rows <= count:
        possible = f'calibration needs {LEAST_MARKERS} or more, {args.dictionary} has {count}'
        raise InputError(f'a board of {columns} x {rows} markers: {possible}')
    labels = [str(index) for index in range(columns * rows)]
    centres = marker_grid(columns, rows, options.size, 40.0 if args.spacing is None else args.spacing)
    base = base_plate(centres, labels, dictionary.cells, options)
    board = args.out / 'board.yaml'
    markers = _markers(dictionary, range(columns * rows), args)
    copy = copied_beside(args.dictionary, args.out)
    _write_all([*markers, base], args, [board, *filter(None, [copy])])
    _say_what_is_weak(markers, args, dictionary.cells)
    if copy is not None:
        write_text(copy, read_text(args.dictionary))
    save_map(board, _board_map(centres, options, Path(args.dictionary).name))
    _say_how_to_use(f'markers --board {quote(str(board))} --plate-thickness {args.thickness / 1e3:g}')
    return 0


def _say_how_to_use(target: str) -> None:
    print(f'calibrate with it: thermal-fiducial calibrate intrinsics VIEWS --target {target}')


def _board_map(centres: FloatArray, options: PlateOptions, dictionary: str) -> MarkerMap:
    """Map of a board's markers, with its origin in the middle, for ``calibrate intrinsics --board``."""
    metres = 1e-3 * np.column_stack([centres, np.zeros(len(centres))])
    markers = {
        index: MapMarker(index, 1e-3 * options.size, True, se3.transform(np.eye(3), centre))
        for index, centre in enumerate(metres)
    }
    return MarkerMap(markers, dictionary=dictionary)


def _option(name: str) -> str:
    return '--' + name.replace('_', '-')


def add_plate_options(parser: Parser, size: float = PlateOptions.size, without: Sequence[str] = ()) -> None:
    """Options for the dimensions of a plate; ``size`` is the default side of the black square [mm].

    Those of ``without`` are left out, and keep their defaults.
    """
    group = parser.add_argument_group('plate', 'all lengths in millimetres')
    group.add_argument('--mount', choices=MOUNTS, default='ears', help='mount of the pattern')
    for name, description in _OPTION_HELP.items():
        if name in without:
            parser.set_defaults(**{name: getattr(PlateOptions, name)})
            continue
        default = size if name == 'size' else getattr(PlateOptions, name)
        group.add_argument(_option(name), type=LENGTH_MM, default=default, metavar='MM', help=description)
    group.add_argument(
        '--quiet-cells', type=CELLS, default=1.0, metavar='CELLS', help='width of the warm ring around the pattern'
    )
    group.add_argument(
        '--min-web', type=LENGTH_MM, default=3.0, metavar='MM', help='least width of acrylic between holes'
    )
    parser.refuse(['--frame-width'], 'without --mount frame', lambda args: args.mount != 'frame')
    parser.refuse(['--hole-diameter', '--stand-off', '--tie-width'], 'with --mount none', _is_bare)


def _is_bare(args: argparse.Namespace) -> bool:
    return bool(args.mount == 'none')


def plate_options(args: argparse.Namespace) -> PlateOptions:
    """Values of the options of :func:`add_plate_options`."""
    return PlateOptions(**{item.name: getattr(args, item.name) for item in fields(PlateOptions)})


def _add_output(parser: Parser) -> None:
    parser.add_argument('--out', type=Path, default=Path('markers'), metavar='FOLDER', help='folder of the files')
    parser.add_argument('--formats', default='svg,dxf,pdf,png', help='formats, separated by commas')
    parser.add_argument(
        '--paper', metavar='PAPER', help=f'PDF in tiles for a printer: {", ".join(PAPERS)} (default: one page)'
    )
    add_force(parser)
    parser.refuse(['--paper'], 'without pdf among --formats', lambda args: 'pdf' not in args.formats.split(','))


def _say_what_is_weak(drawings: Sequence[Drawing], args: argparse.Namespace, cells: int) -> None:
    """Print the narrowest web of each marker of ``cells`` a side, and warnings about its strength and its warm ring."""
    options = plate_options(args)
    if options.quiet_cells < 1.0:
        # doc/accuracy.md: the detector takes the warm surface for one that ends a cell outside the marker.
        ring = f'a warm ring of {options.quiet_cells:g} cells is too narrow'
        warn(f'{ring}: markers are measured too small, by 1 % at 0.7; 1 or more')
    with progress_bar('measuring webs') as progress:
        for done, drawing in enumerate(drawings, 1):
            strength = strength_of(drawing, options, cells, args.min_web)
            print(f'marker {drawing.name}: narrowest web {strength.web_mm:.1f} mm ({strength.kind})')
            for complaint in strength.complaints:
                warn(f'marker {drawing.name}: {complaint}')
            progress(done / len(drawings))


def _markers(dictionary: Dictionary, ids: Sequence[int], args: argparse.Namespace) -> list[Drawing]:
    """Drawings of the markers ``ids``."""
    options = plate_options(args)
    return [marker_drawing(dictionary.bits[marker_id], str(marker_id), options) for marker_id in ids]


def _write_all(drawings: Sequence[Drawing], args: argparse.Namespace, others: Sequence[Path] = ()) -> None:
    """Write drawings in all formats; ``others`` will be written besides."""
    formats = _formats(args)
    stems = [f'marker-{drawing.name}' if drawing.name.isdigit() else drawing.name for drawing in drawings]
    refuse_to_overwrite([*(args.out / f'{stem}.{kind}' for stem in stems for kind in formats), *others], args.force)
    for stem, drawing in zip(stems, drawings, strict=True):
        _write_checked(drawing, [args.out / f'{stem}.{kind}' for kind in formats], args.paper)
        notes = '\n  '.join(('', *drawing.notes))
        size = f'{drawing.width:.1f} x {drawing.height:.1f} mm'
        print(f'{args.out / stem}: {size}, {number_of(drawing.parts, "part")}{notes}')


def _formats(args: argparse.Namespace) -> list[str]:
    """The formats of ``--formats``, each of which must be known and have its library installed."""
    formats: list[str] = args.formats.split(',')
    unknown = set(formats) - set(FORMATS)
    if unknown:
        raise InputError(f'--formats: {", ".join(sorted(unknown))} is not among {", ".join(FORMATS)}')
    if args.paper is not None:
        check_paper(args.paper)
    missing = [kind for kind in formats if not is_installed(FORMATS[kind])]
    if missing:
        libraries = ', '.join(FORMATS[kind] for kind in missing)
        raise InputError(f'{libraries} missing: {remedy("tools")}, or leave {", ".join(missing)} out of --formats')
    return formats


def _write_checked(drawing: Drawing, paths: Iterable[Path], paper: str | None) -> None:
    """Check a drawing, write it to ``paths``, and compare each DXF file, read back, with the drawing."""
    if wrong := problems(drawing, drawing.parts):
        raise InputError(f'{drawing.name}: {"; ".join(wrong)}')
    for path in paths:
        write(drawing, path, paper)
        if path.suffix == '.dxf' and not agree(read_dxf(path), drawing):
            raise InputError(f'{path}: the file differs from the drawing')
