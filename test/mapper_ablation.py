"""Prints what each mechanism of the mapper buys, as ``make ablation`` does for the detector.

For each mechanism one row: the lines that exist for it alone, and all figures of the scenes that change by more than a
twentieth without it. A mechanism is switched off by putting what does nothing in its place. Names of mechanisms as
arguments: only these. Recordings are taken where ``THERMAL_FIDUCIAL_DATA`` names their folder, else left out.
"""

from dataclasses import replace
from functools import partial
import sys
from typing import Any

import numpy as np
from support.mapper_scenes import SCENES
from support.taken_out import Mechanism, Study

from thermal_fiducial.core.error_model import DRAWS, SystematicErrors
from thermal_fiducial.core.mapping.localization import locate

MAPPING = 'thermal_fiducial.core.mapping'
#: Change of a figure that is worth printing.
NOTABLE = 0.05


def _ignored(*_: Any, **__: Any) -> None:
    return None


def _independent(gains: Any, draws: Any) -> Any:
    """Draws of a pose's error by markers whose errors have nothing in common."""
    return np.sqrt(len(draws)) * np.concatenate(list(gains @ draws), axis=-1)


def _no_lens(_: Any, gains: Any, group: Any, count: int) -> Any:
    """Draws of what the lenses have no part in."""
    return np.zeros((count, gains.shape[2], DRAWS))


def _placed_together(stamp_ns: int, sight: Any, **given: Any) -> Any:
    """The camera from markers of which none counts as surveyed."""
    return locate(stamp_ns, replace(sight, surveyed=np.zeros_like(sight.surveyed)), **given)


MECHANISMS = {
    'learned bias of corners': Mechanism(
        ('wrong lens', 'board', 'moved markers'), ('corner_bias:CornerBias',), {'corner_bias:CornerBias.add': _ignored}
    ),
    'weights by errors': Mechanism(
        ('moved markers', 'uneven map', 'board', 'carpet'),
        ('joint_fit:marker_weights',),
        {'joint_fit:marker_weights': lambda errors, *_: np.ones(len(errors))},
    ),
    'weights by the map': Mechanism(
        ('uneven map', 'chain'),
        ('joint_fit:JointFit.map_weights',),
        {'joint_fit:JointFit.map_weights': lambda self, *_: np.ones(len(self.sight.sizes))},
    ),
    'joint weights of surveyed markers': Mechanism(
        ('uneven map', 'surveyed board'),
        ('joint_fit:SurveyedFit',),
        {'mapper:locate': _placed_together},
    ),
    'alternative pose': Mechanism(
        ('small markers', 'chain', 'tags test_16'),
        ('joint_fit:JointFit.alternative',),
        {'joint_fit:JointFit.alternative': _ignored},
    ),
    'poses that nearly merge': Mechanism(
        ('from the front', 'small markers'),
        ('localization:_widened',),
        {'localization:_widened': lambda found, _: found},
    ),
    'what corners add to odometry': Mechanism(
        ('from the front', 'small markers'),
        ('localization:_by_odometry',),
        {'localization:_by_odometry': lambda _, found, *__: found},
    ),
    'error of the aspect ratio': Mechanism(
        ('board', 'surveyed board'), (), {'mapper:SystematicErrors': partial(SystematicErrors, aspect=0.0)}
    ),
    'contradiction of odometry': Mechanism(
        ('chain', 'tags test_22'),
        ('located:LocatedFrame.contradicts_odometry.func',),
        {'located:LocatedFrame.contradicts_odometry': False},
    ),
    'odometry of keyframes': Mechanism(
        ('chain', 'tags test_22'),
        (),
        {'keyframes:information_of_followed_map': lambda information, _: 1e-12 * information},
    ),
    'bridging': Mechanism(
        ('chain', 'tags test_22'),
        ('keyframes:KeyframeStore.bridge', 'keyframes:KeyframeStore.bridgeable', 'keyframes:displacement_covariance'),
        {'keyframes:KeyframeStore.bridgeable': lambda *_, **__: False},
    ),
    'two cameras of a candidate': Mechanism(
        ('small markers', 'tags test_16'),
        ('marker_views:MarkerViews._choose',),
        {'mapper:MarkerMapper._without_pose': lambda self, frame, refusal: (False, {})},
    ),
    'markers turned back': Mechanism(
        ('turned markers', 'wall'),
        ('bundle_adjustment:_with_mirrored',),
        {'bundle_adjustment:_with_mirrored': _ignored},
    ),
    'two places': Mechanism(
        ('two sheets', 'tags test_16'),
        ('bundle_adjustment:two_places',),
        {'bundle_adjustment:two_places': lambda *_: False},
    ),
    'shape of markers': Mechanism(
        ('shaped markers', 'wall', 'chain'),
        ('error_sources:ErrorSources._shapes',),
        {'error_sources:ErrorSources._shapes': lambda self: np.zeros(len(self.problem.ids))},
    ),
    'lens in the errors of the map': Mechanism(
        ('bent corridor', 'wall'),
        ('error_sources:LensErrors',),
        {'error_sources:ErrorSources._by_lens': _no_lens},
    ),
    'joint draws of the map': Mechanism(
        ('bent corridor', 'wall', 'uneven map'),
        ('error_sources:ErrorSources._lasting', 'normal_equations:ReducedSystem.drawn'),
        {'joint_fit:drawn_sum': _independent},
    ),
    'priors': Mechanism(
        ('second flight', 'chain'), ('keyframes:prior_poses',), {'keyframes:prior_poses': lambda *_: {}}
    ),
    'quarantine': Mechanism(
        ('moved markers', 'two sheets'),
        ('consistency:Consistency.judge', 'consistency:inconsistent'),
        {'consistency:inconsistent': lambda disagrees, _: np.zeros_like(disagrees)},
    ),
    'misplaced marker alone in view': Mechanism(
        ('second plate',),
        (
            'consistency:Consistency.checked',
            'consistency:Consistency._at_first_sight',
            'consistency:Consistency.add',
            'located:MisplacedMarker',
        ),
        {'consistency:Consistency.checked': lambda self, frame: frame},
    ),
    'three trials a frame': Mechanism(('carpet',), (), {'candidates:TRIALS': 10**9}),
    'best-known proposers': Mechanism(('carpet',), (), {'localization:_PROPOSERS': 10**9}),
}


def main() -> None:
    """Print the table."""
    scenes = {name: lambda _, fly=fly: fly() for name, fly in SCENES.items()}
    Study(MAPPING, MECHANISMS, scenes, NOTABLE).print(sys.argv[1:])


if __name__ == '__main__':
    main()
