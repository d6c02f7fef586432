"""``map align``: a marker map against a point cloud of the place."""

import argparse
from pathlib import Path

import numpy as np

from thermal_fiducial.cli.arguments import file_to_write, require_unit
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.ranges import COORDINATE_M, REACH_M
from thermal_fiducial.cli.terminal_tables import show, table_of
from thermal_fiducial.config import size_overrides
from thermal_fiducial.core.geometry.se3 import apply, inverse, quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.packages import remedy
from thermal_fiducial.files.point_cloud import load_cloud, save_alignment, thinned
from thermal_fiducial.map_tools.cloud_alignment import align_to_cloud, CloudAlignment
from thermal_fiducial.report.metrics import rms

# Largest number of points in the picture; more would not be visible.
_DRAWN = 200_000


def add_align(parser: Parser) -> None:
    """Arguments of ``map align``."""
    parser.add_argument('map', type=Path, metavar='MAP', help='map file (YAML)')
    parser.add_argument('--cloud', type=Path, required=True, metavar='FILE', help='point cloud, .ply or .pcd')
    parser.add_argument(
        '--initial',
        type=COORDINATE_M,
        nargs=7,
        default=[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        metavar=('X', 'Y', 'Z', 'QX', 'QY', 'QZ', 'QW'),
        help='rough pose of the map in the cloud (default: the same frame)',
    )
    parser.add_argument('--reach', type=REACH_M, default=0.5, metavar='M', help='how rough that may be')
    parser.add_argument('--out', type=file_to_write, metavar='YAML', help='file for the transform')
    parser.add_argument('--plot', type=file_to_write, metavar='PNG', help='draw map and cloud into a picture')
    parser.set_defaults(do=_align)


def _align(args: argparse.Namespace) -> int:
    require_unit('the orientation of --initial', args.initial[3:])
    if args.out and args.out.resolve() in (args.map.resolve(), args.cloud.resolve()):
        raise InputError(f'--out {args.out}: the transform would replace that file; the map is not changed by align')
    marker_map = load_map(args.map, args.marker_size, size_overrides(tuple(args.marker_size_override)))
    if not marker_map.markers:
        raise InputError(f'{args.map}: the map has no marker')
    cloud = load_cloud(args.cloud)
    initial = transform_from_quaternion(args.initial[:3], args.initial[3:])
    try:
        alignment = align_to_cloud(marker_map.markers.values(), cloud, initial, args.reach)
    except ImportError as error:
        raise InputError(f'map align needs the extra "cloud": {remedy("cloud")}') from error
    _print_result(alignment)
    if args.out:
        save_alignment(args.out, alignment.T, args.cloud.name, marker_map.frame_id)
        print(f'{args.out} written')
    if args.plot:
        from thermal_fiducial.cli.map_plot import plot_map

        plot_map(marker_map, args.plot, apply(inverse(alignment.T), thinned(cloud, _DRAWN)))
        print(f'{args.plot} written')
    return 0


def _print_result(alignment: CloudAlignment) -> None:
    table = table_of('surface under each marker', ('ID', 'distance mm', 'angle deg', 'points'))
    for fit in sorted(alignment.fits, key=lambda fit: fit.id):
        table.add_row(str(fit.id), f'{1e3 * fit.distance_m:.1f}', f'{np.rad2deg(fit.angle):.2f}', str(fit.points))
    show(table)
    distances = np.array([fit.distance_m for fit in alignment.fits])
    print(f'{number_of(len(distances), "marker")}, {1e3 * rms(distances):.1f} mm rms from their surfaces')
    if alignment.without_surface:
        print(f'no surface near markers {", ".join(map(str, alignment.without_surface))}')
    if alignment.open_directions:
        print(f'the surfaces leave {alignment.open_directions} of 6 directions open: in these the initial pose is kept')
    position, q = alignment.T[:3, 3], quaternion_from_rotation(alignment.T[:3, :3])
    print('map in cloud: position', *(f'{v:.4f}' for v in position), 'orientation', *(f'{v:.6f}' for v in q))
