"""A map that most of its markers contradict gives no pose, and says which factor its distances are off by."""

import numpy as np
import pytest
from support.scenes import motion_prior
from support.walls import CAMERA, flight, see, SIZE, stamp, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.se3 import transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.measurements import Odometry

#: Frames until a marker counts: 1 - 0.95^n exceeds 0.7 with the 24th; a few allow two poses, and count for nothing.
EVIDENCE = 30


def mapper_of(poses):
    config = MarkerMapperConfig(mode='localization', camera_orientation=(0.0, 0.0, 0.0, 1.0))
    return MarkerMapper(config, MarkerMap({key: MapMarker(key, SIZE, True, T) for key, T in poses.items()}))


def shifted(poses, ids, shift):
    """The poses, those of some markers displaced along the wall [m]."""
    return poses | {key: transform(poses[key][:3, :3], poses[key][:3, 3] + [0.0, shift, 0.0]) for key in ids}


def seen(mapper, poses, frames, odometry=None):
    """Results of frames with the markers that hang at ``poses``; ``odometry`` of a frame."""
    rng = np.random.default_rng(5)
    return [
        mapper.process(stamp(k), see(flight(k / 30), poses, 0.05, rng), CAMERA, odometry and motion_prior(odometry(k)))
        for k in frames
    ]


def at_frame(k):
    """The filter's odometry at frame ``k``: 15 mm and 0.2 deg."""
    return Odometry(
        stamp(k), flight(k / 30), np.zeros(3), np.zeros(3), np.diag([15e-3] * 3 + [3.5e-3] * 3) ** 2, 4e-4 * np.eye(6)
    )


@pytest.mark.parametrize(
    ('unit', 'factor'),
    [(1.0, None), (1.0 / 0.3048, '3.28'), (0.3048, '0.305'), (1.0 / 0.0254, '39.4'), (1000.0, '1000')],
)
def test_a_map_in_another_unit_gives_no_pose_and_the_factor_is_named(unit, factor):
    """One marker of it fits as well as another: in feet 1975 poses went out in 12 s, 7.7 m off."""
    poses = wall(np.random.default_rng(3))
    mapper = mapper_of({key: transform(T[:3, :3], unit * T[:3, 3]) for key, T in poses.items()})
    results = seen(mapper, poses, range(150))
    assert any(result.pose for result in results[EVIDENCE:]) == (factor is None)
    assert (results[-1].reason == 'most markers contradict the map') == (factor is not None)
    expected = f'distances in the map are {factor} times those seen: is it in metres? marker_size?'
    assert mapper.doubt_of_map == (expected if factor else '')


def test_markers_moved_by_different_amounts_have_no_factor():
    poses = wall(np.random.default_rng(3))
    mapper = mapper_of(shifted(shifted(poses, (0, 1, 4), 1.3), (2, 6, 7), -0.7))
    seen(mapper, poses, range(60))
    assert (
        mapper.doubt_of_map
        == 'most markers are not where the map has them: is it of this place, in metres? calibration?'
    )


def test_where_most_have_agreed_before_a_corner_of_moved_markers_takes_no_pose_away():
    """Two of the three in view have moved, five that are out of view have not: odometry shows which is in its place."""
    poses = wall(np.random.default_rng(3))
    mapper = mapper_of(poses)
    results = seen(mapper, poses, range(60), at_frame)
    corner = shifted(shifted({key: poses[key] for key in (1, 2, 5)}, (1,), 0.4), (2,), -0.3)
    results += seen(mapper, corner, range(60, 150), at_frame)
    assert all(result.pose for result in results)
    assert results[-1].quarantined == (1, 2)


def test_markers_that_are_put_back_give_poses_again():
    poses = wall(np.random.default_rng(3))
    mapper = mapper_of(poses)
    contradicted = seen(mapper, shifted(shifted(poses, (0, 1, 4), 1.3), (2, 6, 7), -0.7), range(60))
    assert contradicted[-1].pose is None
    back = seen(mapper, poses, range(60, 60 + 3 * EVIDENCE))
    assert back[-1].pose is not None
    assert mapper.doubt_of_map == ''


def test_a_second_camera_takes_no_pose_from_the_first():
    """Its lens may be another one than its calibration says."""
    poses = wall(np.random.default_rng(3))
    first, second = mapper_of(poses), mapper_of(poses)
    second.use_map_of(first)
    seen(second, shifted(shifted(poses, (0, 1, 4), 1.3), (2, 6, 7), -0.7), range(60))
    assert all(result.pose for result in seen(first, poses, range(60)))
