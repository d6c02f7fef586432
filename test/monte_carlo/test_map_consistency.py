"""Simulated maps, fifty at night: the errors of the markers are what their covariances say."""

import numpy as np
import pytest
from scipy.stats import chi2
from support.walls import CAMERA, flight, NO_SYSTEMATIC_ERRORS, see, SIZE, wall

from thermal_fiducial.core.geometry.se3 import difference, retract
from thermal_fiducial.core.mapping.bundle_adjustment import refine
from thermal_fiducial.core.mapping.keyframes import Keyframe, snapshot_of
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.measurements import corner_covariances, corners_px


def one_map(seed):
    """NEES of each of the seven free markers of one simulated map."""
    rng = np.random.default_rng(seed)
    poses = wall(rng)
    sigma, phase = rng.choice([0.02, 0.1]), rng.uniform(0.0, 20.0)
    frames = []
    for k in range(25):
        T = flight(phase + 0.8 * k)
        rows = see(T, poses, sigma, rng)
        ids = rows['id'].astype(np.int64)
        start = retract(T, 0.01 * rng.normal(size=6))
        frames.append(Keyframe(k, start, ids, corners_px(rows), corner_covariances(rows)))
    markers = {
        i: MapMarker(i, SIZE, i == 0, T if i == 0 else retract(T, 0.01 * rng.normal(size=6)), (i > 0) * np.eye(6))
        for i, T in poses.items()
    }
    refinement = refine(snapshot_of(markers, frames, CAMERA, {}, 0, NO_SYSTEMATIC_ERRORS))
    nees = []
    for i in range(1, 8):
        d = difference(poses[i], refinement.markers[i].T_map_marker)
        nees.append(d @ np.linalg.solve(refinement.markers[i].covariance, d))
    return nees


@pytest.mark.parametrize('runs', [16, pytest.param(50, marks=pytest.mark.nightly)])
def test_nees_of_marker_poses_is_inside_the_95_percent_band(runs):
    nees = np.array([one_map(seed) for seed in range(runs)])
    # Means of chi squares of six degrees of freedom (C. Bar-Shalom et al., 2001, section 5.4). The seven markers of a
    # map share most of their error, so they are judged as one.
    low, high = chi2.ppf([0.025, 0.975], 6 * runs) / runs
    assert low < nees.mean() < high
    # And each marker by itself at 99.9 %.
    low, high = chi2.ppf([0.0005, 0.9995], 6 * runs) / runs
    assert np.all((nees.mean(axis=0) > low) & (nees.mean(axis=0) < high))
