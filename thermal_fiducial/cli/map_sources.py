"""``map build`` and ``map refine``: maps from photos and from the detections of a run."""

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import re

import numpy as np

from thermal_fiducial.cli.arguments import file_to_write, warn, whole_number
from thermal_fiducial.cli.map_photos import detect_in_photos, isotropic, photos_in
from thermal_fiducial.cli.marker_sizes import add_thickness
from thermal_fiducial.cli.parser import Parser
from thermal_fiducial.cli.progress import progress_bar
from thermal_fiducial.cli.run_parameters import (
    camera_of_run,
    dictionary_of_run,
    size_std_of_run,
    sizes_of_run,
)
from thermal_fiducial.config import ArucoDetectorConfig, MarkerMapperConfig, size_overrides
from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import CORNER_FIELDS, Markers
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.files.csv_rows import named_rows
from thermal_fiducial.files.dictionary import (
    bring_beside,
    bring_from_map,
    dictionary_of_map,
    not_in_dictionary,
    other_patterns,
)
from thermal_fiducial.files.map_history import digest, save_with_history
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.reading import require_regular
from thermal_fiducial.files.recordings import LARGEST_SIGMA_PX, MOST_IDS
from thermal_fiducial.map_tools.map_building import build_map, Built
from thermal_fiducial.map_tools.map_doubts import Doubt, doubts

# Bound above all stamps [ns] and corners [px].
_LARGEST_VALUE = 9.2e18
# Share of the markers whose centres may lie outside the image: partially visible ones at its border.
_MOST_OUTSIDE = 0.05
# Dictionary of a new map, as the nodes take it.
_DICTIONARY = ArucoDetectorConfig().dictionary


def add_build(parser: Parser) -> None:
    """Arguments of ``map build``."""
    parser.add_argument('images', type=Path, metavar='FOLDER', help='photos of the markers, in any order')
    parser.add_argument(
        '--calibration', type=Path, required=True, metavar='FILE', help='camera_info YAML of the camera'
    )
    parser.add_argument(
        '--dictionary', help=f'dictionary or dictionary file (default: that of --map, with --origin {_DICTIONARY})'
    )
    start = parser.add_mutually_exclusive_group(required=True)
    start.add_argument('--origin', type=whole_number(0), metavar='ID', help='marker that becomes the origin of the map')
    start.add_argument('--map', type=Path, metavar='MAP', help='map with known markers to start from')
    add_thickness(parser)
    parser.add_argument('--out', type=file_to_write, required=True, metavar='MAP', help='the map to write')
    parser.set_defaults(do=_build)


def add_refine(parser: Parser) -> None:
    """Arguments of ``map refine``."""
    parser.add_argument('map', type=Path, metavar='MAP', help='the map to adjust; its fixed markers stay')
    parser.add_argument('run_folder', type=Path, metavar='RUN', help='run folder with detections.csv, or such a file')
    parser.add_argument(
        '--calibration', type=Path, metavar='FILE', help='camera_info YAML of the camera (default: that of the run)'
    )
    parser.add_argument(
        '--max-frames', type=whole_number(1), default=1500, metavar='N', help='frames used, evenly chosen'
    )
    parser.add_argument('--out', type=file_to_write, metavar='FILE', help='default: MAP itself')
    parser.set_defaults(do=_refine)


@dataclass(frozen=True)
class _MapInProgress:
    """The file of a new map; changes to it since the command began are not overwritten."""

    path: Path
    #: ``build`` or ``refine``, and what from
    action: str
    source: Path
    read: str

    @classmethod
    def of(cls, path: Path, action: str, source: Path) -> '_MapInProgress':
        """The file at ``path`` as it is now."""
        return cls(path, action, source, digest(path))

    def save(self, marker_map: MarkerMap) -> None:
        """Write the map. Raises InputError if the file has changed or cannot be written."""
        save_with_history(self.path, marker_map, f'{self.action} from {self.source.name}', self.read)


def _build(args: argparse.Namespace) -> int:
    work = _MapInProgress.of(args.out, 'build', args.images)
    camera = load_camera(args.calibration)
    start = _start(args)
    args.marker_size = args.marker_size or _only_size(start)
    if args.marker_size is None:
        raise InputError(f'{args.map}: its markers have several sizes: give --marker-size for new ones')
    photos = photos_in(args.images)
    frames = detect_in_photos(photos, camera, args)
    if args.origin is not None and not any(args.origin in rows['id'] for rows in frames):
        origin = f'marker {args.origin} of {args.dictionary}'
        raise InputError(f'{args.images}: {origin}, the origin, is in none of the {number_of(len(frames), "photo")}')
    bring_beside(args.dictionary, args.out.parent)
    config = _mapper_config(args, start.dictionary)
    return _grow(frames, camera, start, config, work, [photo.name for photo in photos])


def _refine(args: argparse.Namespace) -> int:
    require_regular(args.map)
    work = _MapInProgress.of(args.out or args.map, 'refine', args.run_folder)
    file = args.run_folder
    if file.is_dir():
        file /= 'detections.csv'
        require_regular(file)
    camera = camera_of_run(args.run_folder) if args.calibration is None else load_camera(args.calibration)
    size, overrides = sizes_of_run(args.run_folder)
    args.marker_size = args.marker_size or size
    args.marker_size_override = [*overrides, *args.marker_size_override]
    start = load_map(args.map, args.marker_size, size_overrides(tuple(args.marker_size_override)))
    args.marker_size = args.marker_size or _only_size(start)
    _warn_of_other_dictionary(args, start)
    bring_from_map(start.dictionary, args.map.parent, work.path.parent)
    frames = _read_detections(file, start, args, camera)
    if len(frames) > args.max_frames:
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, args.max_frames).astype(int)]
    config = replace(_mapper_config(args, start.dictionary), marker_size_std=size_std_of_run(args.run_folder))
    return _grow(frames, camera, start, config, work)


def _warn_of_other_dictionary(args: argparse.Namespace, start: MarkerMap) -> None:
    of_run = dictionary_of_run(args.run_folder)
    if of_run and (other := other_patterns(start.markers, start.dictionary, of_run, args.map.parent)):
        warn(f'{args.map} and {args.run_folder}: {other}')


def _only_size(marker_map: MarkerMap) -> float | None:
    """Side of all markers of a map [m]; None if they differ."""
    sizes = {marker.size for marker in marker_map.markers.values()}
    return sizes.pop() if len(sizes) == 1 else None


def _grow(
    frames: list[Markers],
    camera: Camera,
    start: MarkerMap,
    config: MarkerMapperConfig,
    work: _MapInProgress,
    names: Sequence[str] = (),
) -> int:
    with progress_bar('mapping') as progress:
        built = build_map(
            frames, camera, start, config, lambda markers, share: progress(share, number_of(markers, 'marker'))
        )
    _print_what_was_used(built, len(frames), names)
    if not built.frames_used:
        raise InputError(f'{work.source}: no frame of it gives a pose in the map; {work.path} is left as it is')
    work.save(built.map)
    print(f'{work.path}: {built.map.size_in_words}')
    if built.contradiction:
        warn(built.contradiction)
    return 2 if any(doubt.spoils for doubt in say_doubts(built.map, work.path)) or built.contradiction else 0


def say_doubts(marker_map: MarkerMap, path: Path) -> list[Doubt]:
    """Print and return the doubts about the map in the file ``path``."""
    found = [*doubts(marker_map), *_doubts_of_dictionary(marker_map, path.parent)]
    for doubt in found:
        print(doubt.text)
    print(f'{path}: {number_of(len(found), "doubt")}' if found else f'{path}: sound')
    return found


def _doubts_of_dictionary(marker_map: MarkerMap, folder: Path) -> list[Doubt]:
    try:
        foreign = not_in_dictionary(marker_map.markers, marker_map.dictionary, folder)
    except InputError as error:
        # The poses may be right all the same: a node reads the patterns from its own parameter.
        return [Doubt(f'whether its dictionary has these markers is unknown: {error}', False)]
    return [Doubt(f'marker {key}: not in {marker_map.dictionary}', True) for key in foreign]


def _print_what_was_used(built: Built, frames: int, names: Sequence[str]) -> None:
    """What the map was built of; ``names`` of the frames, if they have any."""
    print(f'{built.frames_used} of {number_of(frames, "frame")} used')
    _print_what_was_not(built.unused, names)
    if built.map.markers and all(marker.fixed for marker in built.map.markers.values()):
        print('all markers are fixed: none was moved (map unfix)')
    # Medians over each marker's views: the root mean square is dominated by a few outliers, and twenty times as large.
    errors = {marker.id: marker.reprojection_error_px for marker in built.map.markers.values() if marker.observations}
    if errors:
        worst = max(errors, key=lambda key: errors[key])
        middle = float(np.median(list(errors.values())))
        of_worst = f'{errors[worst]:.3f} px (marker {worst})'
        print(f're-projection error, median of the views: {middle:.3f} px, at worst {of_worst}')
    if built.refinement is not None:
        for key, share in built.refinement.inconsistent.items():
            print(f'marker {key}: {100.0 * share:.0f} % of its views disagree with the others; has it been moved?')
    for key, why in sorted(built.unplaced.items()):
        print(f'marker {key} is not in the map: {why}')


def _print_what_was_not(unused: dict[int, str], names: Sequence[str]) -> None:
    if names:
        for frame, why in unused.items():
            print(f'{names[frame]} not used: {why}')
        return
    # Of thousands of frames: how many for each reason, without its numbers.
    reasons = Counter(re.sub(r'\d+', 'N', why.partition(',')[0]) for why in unused.values())
    for why, count in reasons.most_common():
        print(f'{count} not used: {why}')


def _mapper_config(args: argparse.Namespace, dictionary: str) -> MarkerMapperConfig:
    defaults = MarkerMapperConfig()
    return MarkerMapperConfig(
        dictionary=dictionary,
        marker_size=args.marker_size or defaults.marker_size,
        marker_size_overrides=tuple(args.marker_size_override),
    )


def _start(args: argparse.Namespace) -> MarkerMap:
    """Map to start from; sets ``args.dictionary`` to its dictionary, of which the map has the name without a path."""
    sizes = size_overrides(tuple(args.marker_size_override))
    if args.map is not None:
        known = load_map(args.map, args.marker_size, sizes)
        args.dictionary = args.dictionary or dictionary_of_map(known.dictionary, args.map.parent)
        if other := other_patterns(known.markers, known.dictionary, args.dictionary, args.map.parent):
            raise InputError(f'{args.map}: {other}')
        return replace(known, dictionary=Path(args.dictionary).name)
    args.dictionary = args.dictionary or _DICTIONARY
    size = sizes.get(args.origin, args.marker_size)
    if size is None:
        raise InputError('map build --origin needs --marker-size')
    origin = MapMarker(args.origin, size, True, np.eye(4))
    return MarkerMap({args.origin: origin}, dictionary=Path(args.dictionary).name)


def _read_detections(path: Path, start: MarkerMap, args: argparse.Namespace, camera: Camera) -> list[Markers]:
    """Rows of each frame of a ``detections.csv``.

    Raises
    ------
    InputError
        Also if the side of a marker is unknown: a guess would displace it.
    """
    table = _detection_table(path)
    if not len(table):
        raise InputError(f'{path}: no detections')
    _require_inside(path, table[:, 3:].reshape(-1, 4, 2), camera)
    table = table[np.argsort(table[:, 0], kind='stable')]
    _, firsts = np.unique(table[:, 0], return_index=True)
    sizes = size_overrides(tuple(args.marker_size_override))
    sizes |= {key: marker.size for key, marker in start.markers.items()}
    unknown = sorted({int(key) for key in table[:, 1]} - sizes.keys())
    if unknown and args.marker_size is None:
        raise InputError(f'{path}: markers {", ".join(map(str, unknown))} have no known side: give --marker-size')
    frames = []
    for rows in np.split(table, firsts[1:]):
        ids = rows[:, 1].astype(np.int64)
        size = np.array([sizes.get(int(key), args.marker_size) for key in ids])
        frames.append(rows_from_corners(ids, rows[:, 3:].reshape(-1, 4, 2), isotropic(rows[:, 2]), size, camera))
    return frames


def _require_inside(path: Path, corners: FloatArray, camera: Camera) -> None:
    """Raise InputError if markers with ``corners`` (N, 4, 2) [px] lie outside the image of the calibration."""
    centres = corners.mean(axis=1)
    outside = np.any((centres < 0.0) | (centres > (camera.width, camera.height)), axis=1)
    if np.mean(outside) > _MOST_OUTSIDE:
        share = f'{100.0 * np.mean(outside):.0f} % of the markers'
        raise InputError(f'{path}: {share} lie outside the {camera.width}x{camera.height} pixels of the calibration')


def _detection_table(path: Path) -> FloatArray:
    """Stamp [ns], ID, sigma and corners [px] of each row of a ``detections.csv``, (N, 11)."""
    names = ('stamp_ns', 'id', 'sigma_px', *CORNER_FIELDS)
    rows = []
    for number, cells in named_rows(path, names):
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            raise InputError(f'{path}: line {number}: not a detection') from None
        finite = all(abs(value) < _LARGEST_VALUE for value in values)
        if not (finite and values[1] in range(MOST_IDS) and 0.0 < values[2] < LARGEST_SIGMA_PX):
            raise InputError(f'{path}: line {number}: not a detection')
        rows.append(values)
    return np.array(rows).reshape(-1, len(names))
