"""A lens from a real recording of a board that is not as it is described."""

from dataclasses import replace
from functools import cache
import os

import numpy as np
import pytest
from support.corner_runs import fly
from support.real_flights import april_board, board_reference, camera_against_imu, lens_and_board, part

from thermal_fiducial.core.geometry import se3

pytestmark = pytest.mark.skipif(not os.environ.get('THERMAL_FIDUCIAL_DATA'), reason='no real data at hand')


@cache
def of_first_half(camera, every, board_std=5e-4):
    """Lens and map of the board by every so many frames of the first 20 s of the recording."""
    return lens_and_board(part(april_board(camera), 0.0, 20.0), every, board_std)


def shape(found):
    """Displacement (P, 3) [m] of the board's points from where they are described, without that of all of them."""
    board = found.board
    return se3.apply(se3.rigid_alignment(board.described, board.places), board.places) - board.described


def test_two_cameras_find_the_same_board():
    """Of the same 20 s, each by its own lens: what both say of the board is no error of a lens."""
    found = [of_first_half(camera, 12)[0] for camera in ('cam0', 'cam1')]
    assert np.array_equal(found[0].board.described, found[1].board.described)
    shapes = np.stack([shape(one) for one in found])
    # 0.40 and 0.30 mm in the plane, 0.47 mm across it; the two differ by 0.15, 0.24, 0.14 mm. If they had nothing in
    # common, the correlation were 0 +- 0.05.
    assert np.corrcoef(*shapes.reshape(2, -1))[0, 1] > 0.8
    assert np.sqrt(np.mean(shapes**2)) > 3e-4
    exact = of_first_half('cam0', 12, board_std=0.0)[0]
    # 0.289 px by the board as described, 0.213 px as found.
    assert found[0].rms_px < 0.8 * exact.rms_px
    # By an independent adjustment that leaves the board open it is 3.1 px beside the published one, here 3.9; by the
    # board as described 8.1 px, at a claim of 0.6.
    published = april_board('cam0').camera.principal_point[0]
    off, off_exact = (one.camera.principal_point[0] - published for one in (found[0], exact))
    assert -5.5 < off < -2.0
    assert off_exact < -7.0


@pytest.mark.nightly
@pytest.mark.parametrize(('camera', 'other'), [('cam0', 'cam1'), ('cam1', 'cam0')])
def test_lens_board_and_mount_of_one_half_fly_the_other_better_than_those_published(camera, other):
    flight = april_board(camera)
    begin, rest = part(flight, 0.0, 20.0), part(flight, 20.0, 20.0)
    lens, board = of_first_half(camera, 5)
    own = {'camera': lens.camera, 'marker_map': board}
    own['T_body_camera'] = camera_against_imu(replace(begin, **own)).T_body_camera
    stamps_ns, reference = board_reference(other)
    judge = {'reference_ns': stamps_ns, 'reference': reference}
    runs = [fly(flown) for flown in (rest, replace(rest, **own))]
    fused, fused_own = (run.updated.score(replace(run.flight, **judge)) for run in runs)
    markers, markers_own = (run.markers.score(replace(run.flight, **judge)) for run in runs)
    # Measured: 6.4 -> 4.9 and 6.2 -> 4.5 mm, markers alone 11.0 -> 5.0 and 9.6 -> 5.1 mm.
    assert fused_own.rms_mm < 0.9 * fused.rms_mm
    assert markers_own.rms_mm < 0.7 * markers.rms_mm
