"""``markers plan`` and ``markers measure``: choose side, thickness and stand-off before cutting."""

import argparse
from pathlib import Path

import numpy as np
from rich.table import Table

from thermal_fiducial.cli.arguments import add_force, file_to_write, refuse_to_overwrite, whole_number
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.cli.ranges import (
    AFTER_S,
    BITS,
    CONTRAST_K,
    DISTANCE_M,
    FOG_PER_M,
    GAP_MM,
    LENGTH_MM,
    LENS_MM,
    LOSS,
    NETD_K,
    TILT_DEG,
)
from thermal_fiducial.cli.terminal_tables import show, table_of
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.contrast_decay import Mounting, remaining_contrast
from thermal_fiducial.fabrication.planning import (
    DETECTED,
    expect,
    Expectation,
    load_measurements,
    Measurements,
    PACKAGED,
    save_measurements,
)
from thermal_fiducial.fabrication.plate import PlateOptions
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.files.packages import require_plots
from thermal_fiducial.files.writing import new_file

# Pitch of a Tau 2's pixels.
_PITCH_MM = 0.017
_FADE_SECONDS = (0.0, 30.0, 60.0, 120.0, 300.0, 900.0, 3600.0)
_STAND_OFFS_MM = (0.0, 0.5, 2.0, 5.0, 10.0, 20.0)
# Narrowest sides [px] from the detector's min_side_px to a marker that fills the image, and one on each side of where
# the fit changes (``too_small_for_sides``: 23.8 px), as far from it as inaccurate first corners are; contrasts in NETD.
_NARROW_PX = (12.0, 13.0, 15.0, 17.0, 20.0, 23.4, 24.2, 28.0, 34.0, 45.0, 70.0, 110.0, 160.0)
_CONTRASTS = (1.0, 2.0, 4.0, 8.0, 20.0, 80.0, 300.0)
_TILTS_DEG = (0.0, 30.0, 45.0, 55.0, 65.0, 75.0)


def add_plan(parser: Parser) -> None:
    """Arguments of ``markers plan``."""
    parser.set_defaults(do=_plan)
    camera = parser.add_argument_group('camera')
    camera.add_argument('--calibration', type=Path, help='camera_info YAML (default: the --lens of a Tau 2)')
    camera.add_argument('--lens', type=LENS_MM, default=13.0, metavar='MM', help='focal length, without a calibration')
    camera.add_argument('--netd', type=NETD_K, default=0.05, metavar='K', help='temporal noise of the camera')
    marker = parser.add_argument_group('marker')
    marker.add_argument('--size', type=LENGTH_MM, default=300.0, metavar='MM', help='side of the black square')
    marker.add_argument('--bits', type=BITS, default=4, help='bits along a side of the dictionary')
    marker.add_argument('--thickness', type=LENGTH_MM, default=3.0, metavar='MM', help='thickness of the acrylic')
    marker.add_argument(
        '--stand-off', type=GAP_MM, default=10.0, metavar='MM', help='air gap between warm surface and sheet'
    )
    scene = parser.add_argument_group('scene')
    scene.add_argument(
        '--contrast',
        type=CONTRAST_K,
        default=15.0,
        metavar='K',
        help='temperature of the warm surface above that of the room',
    )
    scene.add_argument(
        '--after', type=AFTER_S, default=300.0, metavar='S', help='time since the surface was switched on'
    )
    scene.add_argument(
        '--loss',
        type=LOSS,
        default=10.0,
        metavar='W/m2/K',
        help='heat transfer to the room: 10 in still air, 25 under rotors',
    )
    scene.add_argument(
        '--fog',
        type=FOG_PER_M,
        default=0.0,
        metavar='1/M',
        help='extinction in the long-wave infrared',
    )
    scene.add_argument(
        '--tilt', type=TILT_DEG, default=30.0, metavar='DEG', help='angle between normal and line of sight'
    )
    scene.add_argument('--distances', default='1,1.5,2,3,4,6,8,12', metavar='LIST', help='distances [m]')
    parser.add_argument('--plot', type=file_to_write, metavar='FILE', help='picture of both tables (PNG, PDF, SVG)')
    parser.add_argument(
        '--tables', type=Path, default=PACKAGED, help='file of ``markers measure`` (default: that of the package)'
    )
    parser.refuse(['--lens'], 'with --calibration', lambda args: args.calibration is not None)


def _plan(args: argparse.Namespace) -> int:
    if args.plot is not None:
        require_plots()
    distances = _numbers(args.distances)
    # The same sizes as are drawn.
    PlateOptions(size=args.size, thickness=args.thickness)
    mounting = Mounting(1e-3 * args.thickness, 1e-3 * args.stand_off, args.loss)
    share = float(remaining_contrast(mounting, args.after))
    contrast = args.contrast * share
    measurements = load_measurements(args.tables)
    views = [_expectation(args, measurements, distance, contrast) for distance in distances]
    print(
        f'{args.contrast:g} K in front of the room; {100 * share:.0f} % of it, {contrast:.2g} K, left after '
        f'{args.after:g} s with {args.thickness:g} mm of acrylic and {args.stand_off:g} mm of stand-off.'
    )
    show(_view_table(distances, views))
    show(_fade_table(args))
    if args.plot is not None:
        _draw(args, measurements, distances, views)
        print(f'{args.plot} written')
    return 0


def _numbers(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(',')]
    except ValueError:
        raise InputError(f'--distances {text!r} is not a list of numbers') from None
    least, most = DISTANCE_M
    if not all(least <= value <= most for value in values):
        raise InputError(f'--distances {text!r}: all must be from {least:g} to {most:g} m')
    return sorted(values)


def _camera(args: argparse.Namespace) -> Camera:
    if args.calibration is not None:
        return load_camera(args.calibration)
    focal = args.lens / _PITCH_MM
    return Camera(640, 512, np.array([[focal, 0.0, 319.5], [0.0, focal, 255.5], [0.0, 0.0, 1.0]]))


def _expectation(args: argparse.Namespace, measurements: Measurements, distance: float, contrast: float) -> Expectation:
    # Behind enough fog it is smaller than any number.
    seen = max(contrast * float(np.exp(-args.fog * distance)) / args.netd, float(np.finfo(float).tiny))
    return expect(
        measurements,
        _camera(args),
        size=1e-3 * args.size,
        distance=distance,
        tilt_deg=args.tilt,
        contrast=seen,
        bits=args.bits,
    )


def _view_table(distances: list[float], views: list[Expectation]) -> Table:
    headers = 'at m', 'side px', 'found', 'corner px', 'position mm', 'distance mm', 'rotation deg', 'flips'
    title = (
        'One view of one marker before a warm surface that ends one cell outside it: median errors, position of the '
        'camera in the frame of the marker; flips: how often the wrong one of the two planar poses fits better'
    )
    table = table_of(title, headers)
    for distance, view in zip(distances, views, strict=True):
        verdict = f'{100 * view.found:.0f} %{"" if view.detected else ", too few"}'
        numbers = ['-'] * 5
        if view.found > 0.0 and np.isfinite(view.position):
            errors = _two_digits(1e3 * view.position), _two_digits(1e3 * view.distance), f'{view.rotation_deg:.2g}'
            numbers = [f'{view.sigma_px:.3f}', *errors, f'{100 * view.wrong_branch:.0f} %']
        table.add_row(f'{distance:g}', f'{view.side_px:.0f}', verdict, *numbers)
    return table


def _two_digits(value: float) -> str:
    return f'{value:.0f}' if value >= 10.0 else f'{value:.2g}'


def _fade(args: argparse.Namespace, stand_off_mm: float, seconds: FloatArray) -> FloatArray:
    return remaining_contrast(Mounting(1e-3 * args.thickness, 1e-3 * stand_off_mm, args.loss), seconds)


def _fade_table(args: argparse.Namespace) -> Table:
    headers = 'stand-off mm', *(f'{seconds:g} s' for seconds in _FADE_SECONDS)
    table = table_of(f'Contrast left with {args.thickness:g} mm of acrylic', headers)
    for stand_off in sorted({*_STAND_OFFS_MM, args.stand_off}):
        shares = _fade(args, stand_off, np.array(_FADE_SECONDS))
        label = 'in contact' if stand_off == 0.0 else f'{stand_off:g}'
        table.add_row(label, *(f'{100 * share:.0f} %' for share in shares))
    return table


def _draw(
    args: argparse.Namespace, measurements: Measurements, distances: list[float], views: list[Expectation]
) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout='constrained')
    FigureCanvasAgg(figure)
    fade, pose = figure.subplots(1, 2)
    seconds = np.linspace(0.0, 900.0, 181)
    for stand_off in sorted({*_STAND_OFFS_MM, args.stand_off}):
        label = 'in contact' if stand_off == 0.0 else f'{stand_off:g} mm stand-off'
        fade.plot(seconds, 100.0 * _fade(args, stand_off, seconds), label=label)
    fade.set(xlabel='time [s]', ylabel='contrast left [%]', ylim=(0, 100), title=f'{args.thickness:g} mm of acrylic')
    fade.legend(fontsize='small')
    pose.semilogy(distances, [1e3 * view.position for view in views], 'o-', label='camera position [mm]')
    pose.semilogy(distances, [1e3 * view.distance for view in views], '^-', label='distance [mm]')
    pose.semilogy(distances, [view.rotation_deg for view in views], 's-', label='rotation [deg]')
    pose.set(xlabel='distance [m]', title=f'marker of {args.size:g} mm, tilted {args.tilt:g} deg: median error')
    found = pose.twinx()
    share = found.fill_between(distances, [100.0 * view.found for view in views], alpha=0.15, label='found [%]')
    found.set(ylabel='found [%]', ylim=(0, 100))
    found.legend(handles=[*pose.get_lines(), share], loc='upper left', fontsize='small')
    with new_file(args.plot) as new:
        try:
            figure.savefig(new, dpi=130)
        except ValueError as error:
            raise InputError(f'{args.plot}: {error}') from None


def add_measure(parser: Parser) -> None:
    """Arguments of ``markers measure``."""
    parser.set_defaults(do=_measure)
    parser.add_argument('out', type=file_to_write, help='file to write (YAML)')
    parser.add_argument(
        '--markers', type=whole_number(1), default=16, help='number of markers for each side, contrast and tilt'
    )
    parser.add_argument('--seed', type=whole_number(0), default=1, help='seed of the rendering')
    add_force(parser)


def _measure(args: argparse.Namespace) -> int:
    from thermal_fiducial.cli.marker_measurement import DICTIONARY, LENS, measure

    refuse_to_overwrite([args.out], args.force)
    axes = np.array(_NARROW_PX), np.array(_CONTRASTS), np.array(_TILTS_DEG)
    with progress_bar('showing markers') as progress:
        measurements = measure(*axes, markers=args.markers, seed=args.seed, progress=progress)
    notes = {'dictionary': DICTIONARY, 'lens': LENS, 'markers': args.markers, 'seed': args.seed}
    save_measurements(args.out, measurements, notes)
    detected, shown = np.sum(measurements.found >= DETECTED), np.sum(np.isfinite(measurements.found))
    print(f'{args.out}: {detected} of {shown} kinds of view detected')
    return 0
