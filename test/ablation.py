"""Prints what each mechanism of the detector buys: ``make ablation``.

For each mechanism one row: the lines that exist for it alone; on the scene that it is for, with and without it, the
corners' error, the share of the markers that should be found, NEES, how many are false and how many turned to the wrong
branch, and time; and the same over the acceptance scenes: geometric means of error and time without it over those with
it, and the change of the mean share. A mechanism is switched off by putting what does nothing in its place. Names of
mechanisms as arguments: only these. Mechanisms that only tests of their own show are not among them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
import sys
import time
from typing import Any

import cv2
import numpy as np
from support import approach
from support.detector_scores import DetectorScore, odometry_before
from support.scenes import camera_of
from support.taken_out import lines_of, Mechanism, place, replaced

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.sim.scenario import named, Scenario, with_contrast
from thermal_fiducial.sim.thermal_camera import render_frames

DETECTION = 'thermal_fiducial.core.detection'
SEED = 21
#: Frames of a stretch that only settle the detector.
SETTLING = 3


@dataclass(frozen=True)
class Scene:
    """Stretches of a flight, and how they are looked at.

    Parameters
    ----------
    stretches : first and last frame of each
    guided : whether map and odometry are known
    changes : parameters of the detector that are not those of the scenario
    """

    scenario: Scenario
    guided: bool = False
    changes: Mapping[str, Any] = field(default_factory=dict)
    stretches: tuple[tuple[int, int], ...] = ((120, 138), (300, 318))
    seconds: float = 20.0


def _clear(name: str, contrast: float) -> Scenario:
    """A scenario of constant contrast, without dead pixels."""
    scenario = named(name)
    acrylic = replace(scenario.acrylic, contrast=contrast, steady=0.0)
    return replace(scenario, acrylic=acrylic, sensor=replace(scenario.sensor, bad_pixel_share=0.0))


def _lagging(seconds: float) -> Scenario:
    """The fast one, whose bolometers have a time constant of so many ``seconds``."""
    scenario = _clear('fast', 8.0)
    return replace(scenario, sensor=replace(scenario.sensor, lag=seconds))


#: The scenes on which the detector is accepted.
ACCEPTANCE = {
    f'{flight}, {contrast:g} K, {"guided" if guided else "blind"}': Scene(_clear(scenario, contrast), guided)
    for flight, scenario, contrasts in (('slow', 'wall', (8.0, 0.5, 0.1)), ('fast', 'fast', (8.0, 0.5)))
    for contrast in contrasts
    for guided in (False, True)
}
SCENES = ACCEPTANCE | {
    'rolling shutter': Scene(_clear('rough', 8.0), guided=True),
    'lag of 14 ms for 10, guided': Scene(_lagging(0.014), guided=True, changes={'bolometer_lag': 0.01}),
    'landing': Scene(with_contrast(approach.scenario(), 8.0), guided=True, stretches=((90, 150),), seconds=8.0),
}


@cache
def rendered(scenario: Scenario, stretches: tuple[tuple[int, int], ...], seconds: float) -> list[list[Any]]:
    """The frames of each stretch."""
    return [list(render_frames(scenario, seconds, SEED, start=first, stop=last)) for first, last in stretches]


@cache
def inputs(name: str) -> list[list[tuple[Any, Any]]]:
    """Frames of each stretch with their odometry."""
    scene, rng = SCENES[name], np.random.default_rng(1)
    motion_at = scene.scenario.trajectory(scene.seconds, SEED)
    return [
        [(frame, odometry_before(frame, motion_at, rng) if scene.guided else None) for frame in frames]
        for frames in rendered(scene.scenario, scene.stretches, scene.seconds)
    ]


def detector_for(scene: Scene, changes: dict[str, Any]) -> MarkerDetector:
    """A detector with the scene's rig, sensor and, where it is guided, map."""
    scenario = scene.scenario
    parameters = {
        'marker_size': scenario.markers[0].size,
        'camera_position': scenario.camera_position,
        'camera_orientation': scenario.camera_orientation,
        'bolometer_lag': scenario.sensor.lag,
        'readout_time': scenario.sensor.readout,
    }
    detector = MarkerDetector(
        ArucoDetectorConfig(**(parameters | scene.changes | changes)), load_dictionary(scenario.dictionary)
    )
    if scene.guided:
        detector.set_map({marker.id: (marker.T_map_marker, marker.size) for marker in scenario.markers})
    return detector


def run(name: str, changes: dict[str, Any]) -> tuple[DetectorScore, float]:
    """Score of a scene, and mean time of a frame [s]."""
    scene, score, seconds, frames = SCENES[name], DetectorScore(), 0.0, 0
    camera = camera_of(scene.scenario)
    for stretch in inputs(name):
        detector = detector_for(scene, changes)
        for index, (frame, prior) in enumerate(stretch):
            begin = time.thread_time()
            rows = detector.detect(frame.stamp_ns, frame.counts, camera, prior)
            if index < SETTLING:
                continue
            seconds, frames = seconds + time.thread_time() - begin, frames + 1
            T_camera_map = se3.inverse(frame.T_map_camera)
            score.add(frame, rows, {m.id: T_camera_map @ m.T_map_marker for m in scene.scenario.markers})
    return score, seconds / frames


def _place(path: str) -> Any:
    return place(DETECTION, path)


def _nothing_found(*_: Any) -> Any:
    return _place('prediction.known_markers:FoundMarkers').none()


def _by_optics_alone(corners_px: Any, cells: int, blur_px: float, *_: Any, **__: Any) -> Any:
    return _place('corners.side_fit:too_small_for_sides')(corners_px, cells, blur_px)


def _as_seen(_: Any, seen: Any, covariance: Any) -> Any:
    none = np.zeros(len(seen))
    return _place('corners.squares:Squared')(seen, covariance, none, none, none)


_READOUT = 'prediction.frame:delays', 'prediction.frame:rolling_displacement'
_SCALES = _place('finding.search:SearchScales')
_ALL_IN_THE_SEARCH = {'finding.finder:_next_scales': lambda *_, **__: _SCALES.ALL}

MECHANISMS = {
    'corners of squares': Mechanism(
        ('slow, 0.5 K, blind',), ('corners.squares',), {'corners.side_fit:as_squares': _as_seen}
    ),
    'other tilt of a square': Mechanism(('slow, 0.1 K, blind',), (), {'corners.squares:_INCONSISTENT': np.inf}),
    'passes until settled': Mechanism(('fast, 8 K, blind',), (), {'corners.refining:PASSES': 1}),
    'second round': Mechanism(('fast, 8 K, blind',), (), {'corners.refining:_ROUNDS': 1}),
    'lag tails taken out': Mechanism(('fast, 8 K, blind',), (), {'prediction.frame:_HARDLY_PX': np.inf}),
    'whole patterns in motion blur': Mechanism(
        ('fast, 8 K, guided',), (), {'corners.refining:too_blurred_for_sides': _by_optics_alone}
    ),
    'rolling shutter': Mechanism(('rolling shutter',), _READOUT, {}, {'readout_time': 0.0}),
    'error of the lag model': Mechanism(
        ('lag of 14 ms for 10, guided',),
        (),
        {'corners.corner_errors:OF_LAG': 0.0, 'corners.corner_errors:OF_LAG_FORM': 0.0},
    ),
    'partially visible markers': Mechanism(
        ('landing',),
        ('partial.partial_markers', 'partial.visible_cells', 'partial.grid'),
        {'detector:_ENOUGH_WHOLE': 0},
    ),
    'polarity': Mechanism(('slow, 8 K, blind',), ('finding.finder:FrameHistory.polarities',), {}, {'polarity': 'any'}),
    'half resolution': Mechanism(
        ('slow, 0.5 K, blind',), (), {'finding.finder:_next_scales': lambda *_, **__: _SCALES.FINE}
    ),
    'one resolution in turn': Mechanism(('slow, 8 K, blind',), (), _ALL_IN_THE_SEARCH),
    'outlines pulled onto patterns': Mechanism(
        ('slow, 0.1 K, blind',),
        ('corners.pattern_fit:aligned',),
        {'finding.search:_rough': lambda *_: np.zeros(0, dtype=np.intp)},
    ),
    'large markers halved': Mechanism(('landing',), ('confirmation:_read',), {'confirmation:_WIDE_CELL_PX': np.inf}),
    'columns of the frame': Mechanism(
        ('slow, 0.1 K, guided',), (), {'prediction.frame:with_columns_corrected': lambda counts, _: counts}
    ),
    'following': Mechanism(
        ('landing',),
        ('finding.finder:followed',),
        {'finding.finder:followed': _nothing_found},
    ),
    'search near predictions': Mechanism(
        ('fast, 0.5 K, guided',),
        ('finding.finder:near_prediction', 'finding.finder:_shifted'),
        {'finding.finder:near_prediction': _nothing_found},
    ),
    'branches by the map': Mechanism(
        ('slow, 0.1 K, guided',), (), {'detector:choose_branches': lambda poses, *_: poses}
    ),
}


def _figures(score: DetectorScore, seconds: float) -> str:
    return (
        f'{score.rms_px:.3f} px, {100 * score.rate:.1f} %, NEES {score.nees:.2f}, {score.false} false, '
        f'{score.flipped} turned, {score.seen} seen, {1e3 * seconds:.1f} ms'
    )


def _row(key: str, mechanism: Mechanism, base: dict[str, tuple[DetectorScore, float]]) -> str:
    (own,) = mechanism.scenes
    with replaced(DETECTION, mechanism.off):
        scenes = {name: run(name, mechanism.changes) for name in {*ACCEPTANCE, own}}
    both = [(base[name], scenes[name]) for name in ACCEPTANCE]
    seen = [(old[0].rms_px, new[0].rms_px) for old, new in both if new[0].seen]
    error = np.exp(np.mean([np.log(new / old) for old, new in seen]))
    slower = np.exp(np.mean([np.log(new[1] / old[1]) for old, new in both]))
    rate = 100 * np.mean([new[0].rate - old[0].rate for old, new in both])
    false = sum(new[0].false - old[0].false for old, new in both)
    cells = [key, str(lines_of(DETECTION, mechanism.parts)), own, _figures(*base[own]), _figures(*scenes[own])]
    cells.append(f'x {error:.2f}, {rate:+.1f} %, {false:+d} false, time x {slower:.2f}')
    return f'| {" | ".join(cells)} |'


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    chosen = {key: MECHANISMS[key] for key in sys.argv[1:] or MECHANISMS}
    base = {name: run(name, {}) for name in {*ACCEPTANCE, *(mechanism.scenes[0] for mechanism in chosen.values())}}
    print('| mechanism | lines | its scene | with | without | acceptance scenes without |')
    print('| --- | --- | --- | --- | --- | --- |')
    for key, mechanism in chosen.items():
        print(_row(key, mechanism, base), flush=True)


if __name__ == '__main__':
    main()
