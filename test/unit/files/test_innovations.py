"""The filter's innovations on their way to the report."""

import math

import numpy as np

from thermal_fiducial.core.filter.belief import PoseUpdate
from thermal_fiducial.files.innovations import innovations_of, innovations_text

STAMP = 1_700_000_000_123_456_789


def test_what_is_written_is_read():
    updates = [
        PoseUpdate(STAMP, True, '', 5.4321),
        PoseUpdate(STAMP + 1, False, 'initialising', math.nan),
        PoseUpdate(STAMP + 2, False, 'refused: 1000.0 sigma', 1e6),
        PoseUpdate(STAMP + 3, True, 'reset', 3e-7),
    ]
    innovations = innovations_of(innovations_text(updates))
    np.testing.assert_array_equal(innovations.stamps_ns, [STAMP, STAMP + 2, STAMP + 3])
    # four digits
    np.testing.assert_allclose(innovations.nis, [5.4321, 1e6, 3e-7], rtol=1e-3)
    np.testing.assert_array_equal(innovations.accepted, [True, False, True])


def test_without_poses_there_are_none():
    assert innovations_text([]) == ''
    innovations = innovations_of('')
    assert (len(innovations.stamps_ns), len(innovations.nis), len(innovations.accepted)) == (0, 0, 0)
