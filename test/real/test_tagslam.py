"""Recorded tag corners: our map explains them as well as an offline solver's."""

import pytest
from support import tagslam


@pytest.mark.parametrize(
    'name', ['test_22', *(pytest.param(name, marks=pytest.mark.nightly) for name in ('test_1', 'test_12', 'test_16'))]
)
def test_reprojection_error_against_the_reference(real_data, name, measured):
    recording = tagslam.load(real_data / 'tagslam' / name)
    markers, refinement = tagslam.solve(recording, 1)
    ours, theirs, views = tagslam.compare(recording, markers, refinement)
    total = sum(len(seen) for seen in recording.views.values())
    placed = len(markers.keys() & recording.T_map_marker.keys())
    measured(
        f'tag corners {name}, first camera ({placed} of {len(recording.T_map_marker)} markers, '
        f'{views} of {total} views): re-projection rms, ours / reference',
        'at most 1.05',
        f'{ours:.3f} / {theirs:.3f} px = {ours / theirs:.3f}',
    )
    # The number to reach: the reference is a batch solution by GTSAM.
    assert ours <= 1.05 * theirs
    assert placed == len(recording.T_map_marker)
