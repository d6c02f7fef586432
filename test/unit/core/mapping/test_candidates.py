"""Markers on trial: starts of the fit that cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_bag import CAMERA as STRAIGHT

from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.mapping.candidates import Candidate
from thermal_fiducial.core.mapping.marker_views import MarkerView, Viewpoint

# What lies far beside the axis a lens with distortion throws farthest.
CAMERA = replace(STRAIGHT, D=np.array([-0.3, 0.12, 0.0, 0.0, -0.02]))
SIZE = 0.3
T_MAP_MARKER = transform(np.diag([1.0, -1.0, -1.0]), [0.1, 0.2, 2.0])


def view(stamp_ns, T_map_camera, covariance=1e-3):
    """A marker seen in the middle of the image, from a camera that may not have seen it there."""
    branch = transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 2.0])
    corners = CAMERA.project((branch[:3, :3] @ marker_corners(SIZE).T).T + branch[:3, 3])
    viewpoint = Viewpoint.known(T_map_camera, covariance * np.eye(6), np.zeros((6, 6)))
    return MarkerView(stamp_ns, viewpoint, corners, np.tile(1e-4 * np.eye(2), (4, 1, 1)), np.stack([branch] * 2))


@pytest.mark.parametrize('gap', [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
def test_a_start_through_a_camera_is_no_marker(gap):
    """The camera of one view stands in the corner where another view has the marker: it cannot have seen it."""
    corner = T_MAP_MARKER[:3, :3] @ marker_corners(SIZE)[0] + T_MAP_MARKER[:3, 3]
    turned = so3_exp([0.1, 0.0, 0.0])
    candidate = Candidate(7, SIZE)
    candidate.add(view(0, transform(np.eye(3), [0.1, 0.2, 0.0])))
    candidate.add(view(1, transform(turned, corner - turned @ [1e-3, 2e-3, gap])))
    candidate.add(view(2, transform(so3_exp([-0.1, 0.0, 0.0]), [2.0, 2.0, 0.0])))
    placement = candidate.place(CAMERA)
    assert placement.T_map_marker is None
    assert 'marker 7' in placement.reason
