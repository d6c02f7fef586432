"""``import FOLDER``: a bag from a recording of CSV files, in our layout, EuRoC's or Kalibr's."""

import argparse
from dataclasses import replace
from pathlib import Path
from shlex import quote

import numpy as np

from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import counted, progress_bar
from thermal_fiducial.cli.ranges import CORNER_PX, LATE_S, SIDE_M
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bag_writer import STORAGES
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.recording_to_bag import frame_count, write_recording
from thermal_fiducial.files.recordings import read_recording
from thermal_fiducial.files.work_folders import made_whole

#: Usual error of corners in pictures of visible light [px].
_SIGMA_PX = 0.3


def add_arguments(parser: Parser) -> None:
    """Options of the command."""
    parser.epilog = (
        'layouts:\n'
        '  ours    imu.csv, rig.yaml, and detections.csv or CAMERA.csv (corners) or\n'
        '          camera_pose.csv\n'
        '  EuRoC   [mav0/]imu0/data.csv, CAMERA/data.csv and pictures, a sensor.yaml in\n'
        '          each\n'
        '  Kalibr  imu0.csv, CAMERA/STAMP.png, a camchain and an IMU file\n\n'
        'The bag has params.yaml (the rig) in its folder, for replay --params.'
    )
    parser.add_argument('folder', type=Path, metavar='FOLDER', help='the recording')
    parser.add_argument('--out', type=Path, required=True, metavar='BAG', help='folder to create')
    parser.add_argument('--camera', default='cam0', help='name of the camera')
    parser.add_argument('--camchain', type=Path, metavar='YAML', help="Kalibr's camchain (default: in the folder)")
    parser.add_argument('--imu', type=Path, metavar='YAML', help="Kalibr's IMU file (default: in the folder)")
    parser.add_argument(
        '--marker-size', type=SIDE_M, metavar='M', help='side of the markers, for corners [m] (default: of rig.yaml)'
    )
    parser.add_argument('--dictionary', metavar='NAME', help='dictionary of the markers (default: of rig.yaml)')
    parser.add_argument(
        '--sigma-px',
        type=CORNER_PX,
        help=f'standard deviation of corners without one of their own [px] (default: {_SIGMA_PX:g})',
    )
    parser.add_argument(
        '--late', type=LATE_S, default=0.0, metavar='S', help='time from the stamp of a frame until it comes [s]'
    )
    parser.add_argument('--storage', choices=sorted(STORAGES), default='mcap', help='storage of the bag')


def run(args: argparse.Namespace) -> int:
    """Read the recording, write the bag, print how to replay it."""
    recording = read_recording(args.folder, args.camera, args.camchain, args.imu)
    rig = recording.rig
    if args.marker_size is not None:
        rig = replace(rig, marker_size=args.marker_size)
    if args.dictionary is not None:
        rig = replace(rig, dictionary=args.dictionary)
    if rig.dictionary:
        load_dictionary(rig.dictionary)
    recording = replace(recording, rig=rig)
    if args.sigma_px is not None and all(np.all(np.isfinite(frame.sigma_px)) for frame in recording.corners):
        raise InputError(f'--sigma-px has no effect with {args.folder}: no corners without a standard deviation')
    frames = frame_count(recording)
    with made_whole(args.out) as folder, progress_bar(f'import {args.folder.name}') as share:
        advance = counted(share, max(frames, 1))
        write_recording(folder, recording, args.sigma_px or _SIGMA_PX, args.late, args.storage, advance)
    bag, params = (quote(str(path)) for path in (args.out, args.out / 'params.yaml'))
    print(
        f'{args.out}: {number_of(len(recording.samples), "IMU sample")}, {number_of(frames, "frame")}\n'
        f'replay it with: thermal-fiducial replay {bag} --params {params} --map MAP --out RUN'
    )
    return 0
