"""``calibrate imu``: noise densities of an IMU at rest, in Kalibr's names."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermal_fiducial.calibration.sources import imu_track, imu_track_of_csv
from thermal_fiducial.cli.arguments import add_force, add_remap, file_to_write, refuse_to_overwrite
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.config import ImuNoise
from thermal_fiducial.files.bags import BagReader, parse_remaps
from thermal_fiducial.files.reading import naming
from thermal_fiducial.files.writing import write_text
from thermal_fiducial.report.metrics import rms

if TYPE_CHECKING:
    from thermal_fiducial.calibration.allan_deviation import AllanFit, ImuNoiseFit

#: Shortest recording at rest [s] in which a random walk exceeds the white noise.
_LONG_S = 600.0
#: Averaging times whose deviation is printed [s].
_SHOWN = (0.01, 0.1, 1.0, 10.0, 100.0, 1000.0)


def add_imu(parser: Parser) -> None:
    """Options of the action."""
    parser.set_defaults(do=calibrate_imu)
    parser.add_argument(
        'source',
        type=Path,
        metavar='SOURCE',
        help='the robot at rest (minutes, better hours): a bag with imu/data, or a CSV file of samples '
        '(stamp [ns], turn rates x y z [rad/s], accelerations x y z [m/s^2])',
    )
    parser.add_argument('--out', type=file_to_write, default=Path('imu.yaml'), help='parameters to write')
    add_force(parser)
    add_remap(parser)
    parser.refuse(['--remap'], 'with a CSV file of samples', _is_csv)


def _is_csv(args: argparse.Namespace) -> bool:
    return bool(args.source.suffix.lower() == '.csv')


def calibrate_imu(args: argparse.Namespace) -> int:
    """Fit noise densities to a recording, write and print them."""
    # allantools takes a second to import, which the other calibrations do not need.
    from thermal_fiducial.calibration.allan_deviation import fit_noise

    refuse_to_overwrite([args.out], args.force)
    if _is_csv(args):
        track = imu_track_of_csv(args.source)
    else:
        with BagReader(args.source, parse_remaps(args.remap)) as bag:
            track, _ = imu_track(bag)
    with naming(args.source):
        fit = fit_noise(track)
    text = noise_text(fit)
    write_text(args.out, text)
    for name, sensor, unit in (('gyroscope', fit.gyroscope, 'rad/s'), ('accelerometer', fit.accelerometer, 'm/s^2')):
        print(_deviations(name, sensor, unit))
    print(text)
    return 0


def noise_text(fit: 'ImuNoiseFit') -> str:
    """Parameter file of the nodes: the rms of the three axes, with each axis as a comment.

    Bias instabilities are at least the default ones: those of flight do not show at rest.
    """
    usual = ImuNoise()
    lines = [
        f'# Allan deviation of {fit.seconds:.0f} s at rest, {fit.rate_hz:.1f} Hz; in brackets x, y, z',
        *([] if fit.seconds >= _LONG_S else [f'# random walks need more than {_LONG_S:.0f} s: take these for bounds']),
        '/**:',
        '  ros__parameters:',
        '    imu:',
    ]
    for name, values, least in (
        ('gyroscope_noise_density', fit.gyroscope.white, 0.0),
        ('accelerometer_noise_density', fit.accelerometer.white, 0.0),
        ('gyroscope_random_walk', fit.gyroscope.walk, 0.0),
        ('accelerometer_random_walk', fit.accelerometer.walk, 0.0),
        ('gyroscope_instability', fit.gyroscope.instability, usual.gyroscope_instability),
        ('accelerometer_instability', fit.accelerometer.instability, usual.accelerometer_instability),
    ):
        axes, found = ', '.join(f'{value:.2e}' for value in values), rms(values)
        remark = '' if found >= least else f'in flight; at rest {found:.1e} '
        lines.append(f'      {name}: {max(found, least):.4e}  # {remark}({axes})')
    return '\n'.join(lines) + '\n'


def _deviations(name: str, sensor: 'AllanFit', unit: str) -> str:
    nearest = [int(np.argmin(np.abs(np.log(sensor.tau / tau)))) for tau in _SHOWN if tau <= 1.5 * sensor.tau[-1]]
    parts = [f'{sensor.tau[k]:.3g} s: {rms(sensor.deviation[k]):.2e}' for k in nearest]
    return f'{name}, Allan deviation [{unit}]: ' + ', '.join(parts)
