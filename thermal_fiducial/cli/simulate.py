"""``simulate OUT``: a synthetic thermal bag with ground truth."""

import argparse
from dataclasses import replace
import os
from pathlib import Path
from shlex import quote
import textwrap

from thermal_fiducial.cli.arguments import whole_number
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import counted, progress_bar
from thermal_fiducial.cli.ranges import CONTRAST_K, FLIGHT_S, FOG_PER_M, FRAME_HZ, LAG_S, OFFSET_S, PROCESSES, READOUT_S
from thermal_fiducial.cli.simulate_corners import write_corner_flight
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bag_writer import STORAGES
from thermal_fiducial.sim.recorded import RecordedFlight
from thermal_fiducial.sim.render import Quality
from thermal_fiducial.sim.scenario import LENSES, named, Scenario, SCENARIOS, with_contrast, with_lens
from thermal_fiducial.sim.sensor import FFC_BEHAVIOURS, Sensor
from thermal_fiducial.sim.thermal_camera import FlightPlan, plan, sees_markers
from thermal_fiducial.sim.writer import write_flight

_OWN = "the scenario's"


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.epilog = (
        f'scenarios:\n{_scenarios()}\n\nOUT becomes a rosbag2 with ground_truth.tum, map_true.yaml, map_one.yaml (one\n'
        'fixed marker) and params.yaml (the rig) in it. The same options and seed give\nthe same bytes.'
    )
    parser.add_argument('out', type=Path, metavar='OUT', help='folder to create')
    parser.add_argument('--scenario', default='fog', metavar='NAME', help='see below')
    parser.add_argument('--seconds', type=FLIGHT_S, help=f'length of the flight [s] (default: {_OWN})')
    parser.add_argument('--seed', type=whole_number(0), default=0, help='seed of path and noise')
    parser.add_argument('--storage', choices=sorted(STORAGES), default='mcap', help='storage of the bag')
    parser.add_argument('--lens', help=f'lens: one of {", ".join(LENSES)} (default: {_OWN})')
    parser.add_argument(
        '--contrast',
        type=CONTRAST_K,
        metavar='K',
        help=f'temperature of warm plates above cold acrylic [K] (default: {_OWN})',
    )
    parser.add_argument('--inverted', action='store_true', help='warm code on a cold background')
    parser.add_argument(
        '--fog', type=FOG_PER_M, metavar='E', help=f'extinction in the long-wave infrared [1/m] (default: {_OWN})'
    )
    parser.add_argument(
        '--lag', type=LAG_S, metavar='S', help=f'thermal time constant of the bolometers [s] (default: {_OWN})'
    )
    parser.add_argument(
        '--readout',
        type=READOUT_S,
        metavar='S',
        help=f'rolling shutter: time from the first row to the last [s] (default: {_OWN})',
    )
    parser.add_argument('--frame-rate', type=FRAME_HZ, metavar='HZ', help=f'of the camera (default: {_OWN})')
    parser.add_argument(
        '--ffc', choices=(*FFC_BEHAVIOURS, 'never'), help=f'output during shutter events (default: {_OWN})'
    )
    parser.add_argument(
        '--time-offset',
        type=OFFSET_S,
        metavar='S',
        help=f'clock offset of the camera: t_imu = t_camera + S [s] (default: {_OWN})',
    )
    parser.add_argument(
        '--trajectory', type=Path, metavar='TUM', help=f'fly these poses of base_link in map (default: {_OWN})'
    )
    parser.add_argument('--workers', type=PROCESSES, default=_cores(), help='number of processes (default: one a core)')
    parser.refuse(
        ['--contrast', '--inverted', '--fog', '--lag', '--readout', '--ffc', '--workers'],
        'with a --scenario without pictures',
        lambda args: named(args.scenario).corner_noise is not None,
    )


def _scenarios() -> str:
    """Name, length and description of each scenario, on lines of at most 80 characters."""
    return '\n'.join(
        textwrap.fill(
            item.description, 80, initial_indent=f'  {name:13}{item.seconds:3g} s  ', subsequent_indent=22 * ' '
        )
        for name, item in SCENARIOS.items()
    )


def run(args: argparse.Namespace) -> int:
    """Simulate the flight, print how to replay it."""
    scenario = _scenario(args)
    flight = plan(scenario, args.seconds, args.seed, quality=_quality(scenario.sensor.frame_rate))
    if args.trajectory is not None and not sees_markers(flight):
        why = 'poses must be of base_link in the map of the scenario, in metres, quaternions x y z w'
        raise InputError(f'{args.trajectory}: no frame shows a marker of {scenario.name}: {why}')
    with progress_bar(f'{scenario.name}, {flight.seconds:g} s') as show:
        advance = counted(show, flight.frame_count)
        if scenario.corner_noise is None:
            write_flight(args.out, flight, args.storage, args.workers, advance)
        else:
            write_corner_flight(args.out, flight, scenario.corner_noise, args.storage, advance)
    print(_summary(args.out, flight))
    return 0


def _scenario(args: argparse.Namespace) -> Scenario:
    scenario = named(args.scenario)
    if args.lens is not None:
        scenario = with_lens(scenario, args.lens)
    if args.contrast is not None:
        scenario = with_contrast(scenario, args.contrast)
    if args.inverted:
        scenario = replace(scenario, acrylic=replace(scenario.acrylic, inverted=True))
    if args.fog is not None:
        scenario = replace(scenario, fog=replace(scenario.fog, extinction=args.fog))
    if args.time_offset is not None:
        scenario = replace(scenario, camera_time_offset=args.time_offset)
    if args.trajectory is not None:
        recorded = RecordedFlight.load(args.trajectory)
        scenario = replace(scenario, flight=recorded, seconds=recorded.seconds)
    return replace(scenario, sensor=_sensor(scenario.sensor, args))


def _quality(frame_rate: float) -> Quality:
    """Sub-frames as short as the usual ones of the usual rate, so that motion is sampled as finely."""
    usual = Quality()
    return replace(usual, sub_frames=max(1, round(usual.sub_frames * Sensor().frame_rate / frame_rate)))


def _sensor(sensor: Sensor, args: argparse.Namespace) -> Sensor:
    if args.frame_rate is not None:
        sensor = replace(sensor, frame_rate=args.frame_rate)
    if args.lag is not None:
        sensor = replace(sensor, lag=args.lag)
    if args.readout is not None:
        sensor = replace(sensor, readout=args.readout)
    if args.ffc == 'never':
        return replace(sensor, ffc_period=0.0)
    return sensor if args.ffc is None else replace(sensor, ffc_behaviour=args.ffc)


def _summary(out: Path, flight: FlightPlan) -> str:
    # Of a board all markers are known, a room is to be mapped.
    of_board = flight.scenario.corner_noise is not None
    start, mode = ('map_true.yaml', ' --mode localization') if of_board else ('map_one.yaml', '')
    bag, params, known = (quote(str(path)) for path in (out, out / 'params.yaml', out / start))
    return (
        f'{out}: {flight.scenario.name}, {flight.seconds:g} s, seed {flight.seed}\n'
        f'replay it with: thermal-fiducial replay {bag} --params {params} --map {known}{mode} --out RUN'
    )


def _cores() -> int:
    return len(os.sched_getaffinity(0))
