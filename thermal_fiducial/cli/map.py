"""``map``: show, check, edit, merge, build, refine and align marker maps."""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import re

import numpy as np

from thermal_fiducial.cli import map_cloud, map_comparison, map_sources
from thermal_fiducial.cli.arguments import file_to_write, require_unit, warn
from thermal_fiducial.cli.marker_sizes import add_sizes, join_sizes
from thermal_fiducial.cli.parser import add_command, Commands, Parser
from thermal_fiducial.cli.ranges import COORDINATE_M, MARKER_ID, QUATERNION, SIGMA_DEG, SIGMA_M
from thermal_fiducial.cli.terminal_tables import show, table_of
from thermal_fiducial.config import size_overrides
from thermal_fiducial.core.geometry.se3 import transform_from_quaternion
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files import map_history
from thermal_fiducial.files.atomic import locked
from thermal_fiducial.files.csv_rows import csv_rows
from thermal_fiducial.files.dictionary import bring_from_map, not_in_dictionary
from thermal_fiducial.files.map_format import read_document, upgraded
from thermal_fiducial.files.marker_map import dump_map, load_map
from thermal_fiducial.files.packages import require_plots
from thermal_fiducial.files.reading import naming
from thermal_fiducial.map_tools import map_editing
from thermal_fiducial.map_tools.anchoring import anchor
from thermal_fiducial.report.map_error import sigmas

#: What the actions that add markers take for the side of one where nothing is said.
_SIZE_WITHOUT = {
    'build': 'the common one of --map',
    'refine': 'that of the run, or the common one of the map',
}


def add_arguments(parser: Parser) -> None:
    """Sub-commands of ``map``."""
    add_sizes(parser)
    commands = parser.add_subparsers(dest='action', metavar='ACTION', required=True)
    shown = _command(commands, 'show', 'table of the markers, and a plot', _show)
    shown.add_argument(
        '--plot',
        type=file_to_write,
        metavar='PNG',
        help='picture of the map from above, from the side and from the front, with uncertainties',
    )
    _command(commands, 'check', 'check a map for implausible entries; exit status 1 if there are any', _check)
    for name, fixed in (('fix', True), ('unfix', False)):
        action = _command(
            commands, name, f'declare markers {"fixed, so that they never move" if fixed else "free to move"}', _fix
        )
        action.add_argument('ids', type=MARKER_ID, nargs='+', metavar='ID', help='markers of the map')
        action.set_defaults(fixed=fixed)
    _add_editing(commands)
    _command(commands, 'history', 'earlier versions of a map', _history)
    _command(commands, 'undo', 'restore the previous version, or an autosaved map', _undo)
    _command(commands, 'upgrade', 'convert a map from before 0.2 to the present format', _upgrade)
    map_sources.add_build(add_command(commands, 'build', 'make a map from a folder of photos in any order'))
    map_sources.add_refine(add_command(commands, 'refine', 'adjust a map to the detections of a run'))
    map_comparison.add_error(add_command(commands, 'error', 'compare a map with the true one'))
    map_cloud.add_align(add_command(commands, 'align', 'align a map to a point cloud of the place'))
    parser.refuse(
        ['--marker-size', '--marker-size-override'],
        'with map history, undo and upgrade',
        lambda args: args.do in (_history, _undo, _upgrade),
    )
    for name, action in commands.choices.items():
        if name not in ('history', 'undo', 'upgrade'):
            add_sizes(action, behind=True, without=_SIZE_WITHOUT.get(name, 'none'))


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    join_sizes(args)
    if getattr(args, 'plot', None) is not None:
        require_plots()
    return int(args.do(args))


def _command(commands: Commands, name: str, text: str, do: Callable[[argparse.Namespace], int]) -> Parser:
    parser = add_command(commands, name, text)
    parser.add_argument('map', type=Path, metavar='MAP', help='map file (YAML)')
    parser.set_defaults(do=do)
    return parser


def _add_editing(commands: Commands) -> None:
    move = _command(commands, 'move', 'set the pose of a marker', _move)
    move.add_argument('id', type=MARKER_ID, metavar='ID', help='marker of the map')
    move.add_argument(
        '--position',
        type=COORDINATE_M,
        nargs=3,
        required=True,
        metavar=('X', 'Y', 'Z'),
        help='position of its centre [m]',
    )
    move.add_argument(
        '--orientation', type=QUATERNION, nargs=4, metavar=('QX', 'QY', 'QZ', 'QW'), help='default: as it is'
    )
    move.add_argument('--sigma', type=SIGMA_M, default=0.005, metavar='M', help='standard deviation of the position')
    move.add_argument(
        '--sigma-deg', type=SIGMA_DEG, default=1.0, metavar='DEG', help='standard deviation of the orientation'
    )
    rename = _command(commands, 'rename', 'give a marker another ID', _rename)
    rename.add_argument('old', type=MARKER_ID, metavar='OLD', help='ID that it has')
    rename.add_argument('new', type=MARKER_ID, metavar='NEW', help='ID that no other marker has')
    delete = _command(commands, 'delete', 'remove markers', _delete)
    delete.add_argument('ids', type=MARKER_ID, nargs='+', metavar='ID', help='markers of the map')
    merge = _command(commands, 'merge', 'add the markers of another map, aligned by the markers in common', _merge)
    merge.add_argument('other', type=Path, metavar='OTHER', help='map file with markers in common')
    merge.add_argument('--out', type=file_to_write, metavar='FILE', help='default: MAP itself')
    anchor = _command(commands, 'anchor', 'move the whole map onto surveyed markers', _anchor)
    anchor.add_argument(
        'survey', type=Path, metavar='CSV', help='lines "id,x,y,z": centres of three markers or more [m]'
    )
    anchor.add_argument('--fix', action='store_true', help='also declare those markers fixed')


def _load(args: argparse.Namespace, path: Path | None = None) -> MarkerMap:
    return load_map(path or args.map, args.marker_size, size_overrides(tuple(args.marker_size_override)))


def _edit(args: argparse.Namespace, action: str, change: Callable[[MarkerMap], MarkerMap]) -> int:
    """Change the map file; if it changes meanwhile, apply the change to its new contents."""
    while True:
        read = map_history.digest(args.map)
        before = _load(args)
        edited = change(before)
        if dump_map(edited) == dump_map(replace(before, revision=edited.revision)):
            # An unchanged version would push a different one out of the history.
            print(f'{args.map}: {action}: nothing to change')
            return 0
        try:
            map_history.save_with_history(args.map, edited, action, read)
            break
        except map_history.ChangedMeanwhileError:
            # The edit is applied to the new contents.
            continue
    print(f'{args.map}: {action}; revision {edited.revision}, {edited.size_in_words}')
    return 0


def _show(args: argparse.Namespace) -> int:
    marker_map = _load(args)
    title = f'{args.map}: {marker_map.dictionary}, frame {marker_map.frame_id}, revision {marker_map.revision}'
    headers = 'ID', 'size m', 'x m', 'y m', 'z m', 'faces', 'sigma mm', 'deg', 'error px', 'seen', 'status'
    table = table_of(title, headers, left=['faces', 'status'])
    table.columns[headers.index('faces')].no_wrap = True
    for key in sorted(marker_map.markers):
        m = marker_map.markers[key]
        x, y, z = m.T_map_marker[:3, 3]
        sigma_mm, sigma_deg = sigmas(m)
        status = 'quarantine' if not m.trusted else 'fixed' if m.fixed else ''
        table.add_row(
            str(key), f'{m.size:g}', f'{x:.4f}', f'{y:.4f}', f'{z:.4f}', _direction(m.T_map_marker[:3, 2]),
            f'{sigma_mm:.2f}', f'{sigma_deg:.3f}', f'{m.reprojection_error_px:.3f}',
            str(m.observations), status,
        )  # fmt: skip
    show(table)
    if args.plot:
        from thermal_fiducial.cli.map_plot import plot_map

        plot_map(marker_map, args.plot)
        print(f'{args.plot} written')
    return 0


def _direction(unit: FloatArray) -> str:
    """Direction of a unit vector: the nearest axis of the map, and the angle to it."""
    axis = int(np.argmax(np.abs(unit)))
    off = np.rad2deg(np.arccos(np.clip(abs(unit[axis]), -1.0, 1.0)))
    return f'{"-" if unit[axis] < 0 else "+"}{"xyz"[axis]}' + (f' {off:.0f}°' if off >= 0.5 else '')


def _check(args: argparse.Namespace) -> int:
    return 1 if map_sources.say_doubts(_load(args), args.map) else 0


def _fix(args: argparse.Namespace) -> int:
    names = ' '.join(str(key) for key in args.ids)
    action = f'{"fix" if args.fixed else "unfix"} {names}'
    return _edit(args, action, lambda marker_map: map_editing.set_fixed(marker_map, args.ids, args.fixed))


def _move(args: argparse.Namespace) -> int:
    if args.orientation:
        require_unit('--orientation', args.orientation)
    covariance = np.diag([args.sigma**2 / 3.0] * 3 + [np.deg2rad(args.sigma_deg) ** 2 / 3.0] * 3)
    return _edit(args, f'move {args.id}', lambda marker_map: _moved(args, marker_map, covariance))


def _moved(args: argparse.Namespace, marker_map: MarkerMap, covariance: FloatArray) -> MarkerMap:
    T = map_editing.marker_of(marker_map, args.id).T_map_marker.copy()
    if args.orientation:
        T = transform_from_quaternion(args.position, args.orientation)
    T[:3, 3] = args.position
    return map_editing.move(marker_map, args.id, T, covariance)


def _rename(args: argparse.Namespace) -> int:
    def renamed(marker_map: MarkerMap) -> MarkerMap:
        if _is_foreign(args.new, marker_map, args.map.parent):
            raise InputError(f'{args.map}: there is no marker {args.new} in {marker_map.dictionary}')
        return map_editing.rename(marker_map, args.old, args.new)

    return _edit(args, f'rename {args.old} to {args.new}', renamed)


def _is_foreign(key: int, marker_map: MarkerMap, folder: Path) -> bool:
    try:
        return bool(not_in_dictionary([key], marker_map.dictionary, folder))
    except InputError:
        # The dictionary lies elsewhere, on the robot say: any ID may be in it.
        return False


def _delete(args: argparse.Namespace) -> int:
    names = ' '.join(str(key) for key in args.ids)
    return _edit(args, f'delete {names}', lambda marker_map: map_editing.delete(marker_map, args.ids))


def _merge(args: argparse.Namespace) -> int:
    other = _load(args, args.other)
    merged, alignment = map_editing.merge(_load(args), other)
    for key, residual in alignment.residuals_m.items():
        note = '  left out: it disagrees with the others' if key in alignment.outliers else ''
        print(f'marker {key}: {1e3 * residual:.1f} mm{note}')
    if args.out:
        bring_from_map(merged.dictionary, args.map.parent, args.out.parent)
        map_history.save_with_history(args.out, merged, f'merge {args.map.name} and {args.other.name}')
        print(f'{args.out}: {merged.size_in_words}')
        return 0
    return _edit(args, f'merge {args.other.name}', lambda marker_map: map_editing.merge(marker_map, other)[0])


def _anchor(args: argparse.Namespace) -> int:
    surveyed = _survey(args.survey)
    marker_map = _load(args)
    with naming(args.survey):
        result = anchor(marker_map, surveyed)
    for key, distance in result.distances_m.items():
        axes = result.map.markers[key].T_map_marker[:3, :3]
        sides = f'faces {_direction(axes[:, 2])}, its top points to {_direction(axes[:, 1])}'
        print(f'marker {key}: {1e3 * distance:.1f} mm from its surveyed place; {sides}')
    for key in sorted(surveyed.keys() - result.distances_m.keys()):
        print(f'marker {key}: surveyed, but not in the map')
    key, std = result.least_known
    off = f'{1e3 * std:.1f} mm off by the alignment (1 sigma)'
    print(f'marker {key}: {off}, no other more; no covariance of the map has it')
    for doubt in result.doubts:
        warn(doubt)

    def anchored(marker_map: MarkerMap) -> MarkerMap:
        moved = anchor(marker_map, surveyed)
        return map_editing.set_fixed(moved.map, moved.distances_m, True) if args.fix else moved.map

    return _edit(args, f'anchor to {args.survey.name}', anchored)


def _survey(path: Path) -> dict[int, FloatArray]:
    surveyed: dict[int, FloatArray] = {}
    for number, row in csv_rows(path):
        if row[0].lower() in ('id', '') or row[0].startswith('#'):
            names = [cell.lower() for cell in row]
            if {'x', 'y', 'z'} <= set(names) and names[1:4] != ['x', 'y', 'z']:
                raise InputError(f'{path}: line {number}: columns {", ".join(row)}; they are id, x, y, z')
            continue
        try:
            if not re.fullmatch(r'[0-9]{1,9}', row[0]):
                raise ValueError
            centre = np.array([float(value) for value in row[1:4]]).reshape(3)
        except ValueError:
            raise InputError(f'{path}: line {number} is not "id,x,y,z"') from None
        if not np.all(np.abs(centre) < LARGEST_COORDINATE):
            raise InputError(f'{path}: line {number} is not a place [m]')
        if int(row[0]) in surveyed:
            raise InputError(f'{path}: line {number}: marker {row[0]} for the second time')
        surveyed[int(row[0])] = centre
    return surveyed


def _history(args: argparse.Namespace) -> int:
    for entry in map_history.entries(args.map):
        what = entry.problem or f'{entry.content}, before: {entry.action}'
        print(f'{entry.number:6d}  {what}')
    # Before the map itself, which may be why one looks here: it cannot be read.
    next_up = map_history.autosaved(args.map)
    for entry in map_history.autosaves(args.map):
        fate = ': map undo takes it up' if entry == next_up else ', before the map was written' * entry.outdated
        print(f'autosaved  {entry.problem or f"{entry.content} in {entry.path}"}{fate}')
    current = read_document(str(args.map))
    print(f'   now  revision {current.revision}, {number_of(len(current.markers), "marker")}')
    return 0


def _undo(args: argparse.Namespace) -> int:
    copy = map_history.autosaved(args.map)
    if copy is not None:
        map_history.take_up_autosave(args.map, copy.path)
        print(f'{args.map}: the autosaved map is taken up; {copy.content}')
        return 0
    entry = map_history.undo(args.map)
    print(f'{args.map}: undone: {entry.action}; {entry.content}')
    return 0


def _upgrade(args: argparse.Namespace) -> int:
    with locked(args.map):
        map_history.replace(args.map, upgraded(str(args.map)), 'upgrade')
    print(f'{args.map}: upgraded; revision {read_document(str(args.map)).revision}')
    return 0
