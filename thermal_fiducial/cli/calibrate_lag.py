"""``calibrate lag``: the time constant of the bolometers, from raw counts of markers that move."""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from thermal_fiducial.calibration.bolometer_lag import calibrate_lag, LagCalibration
from thermal_fiducial.calibration.moving_markers import DetectedFrame, moving_markers
from thermal_fiducial.calibration.sources import camera_of, clean_frames
from thermal_fiducial.cli.arguments import add_calibration, add_force, add_remap, file_to_write, refuse_to_overwrite
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import tracked
from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.files.bags import BagReader, parse_remaps
from thermal_fiducial.files.dictionary import dictionary_of_map, load_dictionary
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.reading import naming
from thermal_fiducial.files.writing import write_text


def add_lag(parser: Parser) -> None:
    """Options of the action."""
    parser.set_defaults(do=_lag)
    parser.add_argument(
        'bag', type=Path, metavar='BAG', help='bag with raw counts (thermal/image_raw), moving before markers'
    )
    parser.add_argument(
        '--map', type=Path, required=True, metavar='FILE', help='marker map (YAML); places do not matter'
    )
    add_calibration(parser)
    parser.add_argument('--out', type=file_to_write, default=Path('lag.yaml'), help='parameter to write')
    add_force(parser)
    add_remap(parser)


def _lag(args: argparse.Namespace) -> int:
    refuse_to_overwrite([args.out], args.force)
    marker_map = load_map(args.map)
    name = dictionary_of_map(marker_map.dictionary, args.map.parent)
    dictionary = load_dictionary(name)
    decoder = Decoder(dictionary.bits, dictionary.correctable)
    # Corners as they are in the images: late by a lag that is not known yet.
    config = ArucoDetectorConfig(dictionary=name, bolometer_lag=0.0)
    with BagReader(args.bag, parse_remaps(args.remap)) as bag:
        camera = camera_of(bag, args.calibration)
        frames = _detected(bag, MarkerDetector(config, dictionary), camera, marker_map)
        with naming(args.bag):
            views = list(moving_markers(frames, camera, decoder.cells))
            result = calibrate_lag(views, decoder, camera, config.blur_px)
    write_text(args.out, lag_text(result))
    print(lag_text(result))
    return 0


def _detected(
    bag: BagReader, detector: MarkerDetector, camera: Camera, marker_map: MarkerMap
) -> Iterator[DetectedFrame]:
    """Frames of a bag with those of its detections that the map has."""
    known = list(marker_map.markers)
    for frame in tracked(clean_frames(bag), 'finding markers', bag.message_count([bag.image_topic])):
        rows = detector.detect(frame.stamp_ns, frame.counts, camera)
        yield DetectedFrame(frame.stamp_ns, frame.counts, rows[np.isin(rows['id'], known)])


def lag_text(result: LagCalibration) -> str:
    """Parameter file of the nodes, with the error of the value as a comment."""
    slowest, fastest = result.speeds
    views = f'# {result.views} views of markers that move by {slowest:.0f} to {fastest:.0f} px/s'
    if result.lag == 0.0:
        views += ' and leave no tail'
        error = f'one of {1e3 * result.std:.1f} ms would show'
    else:
        views += f'; single ones scatter by {1e3 * result.scatter:.2f} ms'
        error = f'+- {1e3 * result.std:.2f} ms'
    return '\n'.join([views, '/**:', '  ros__parameters:', f'    bolometer_lag: {result.lag:.5f}  # {error}', ''])
