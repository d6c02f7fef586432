"""What is planned against what the detector does with frames that the tables were not made from."""

from itertools import product

import numpy as np
import pytest

from thermal_fiducial.cli.marker_measurement import camera_and_detector, show
from thermal_fiducial.fabrication.planning import expect, load_measurements, pose_errors

NETD = 0.05
SIZE = 0.30
SEEDS = (901, 902, 903)


def ratios_of_errors(views, seeds):
    """Planned over measured errors (views, 2) of position and rotation, of views (side, tilt, kelvin)."""
    camera, detector = camera_and_detector()
    tables = load_measurements()
    ratios = []
    for side, tilt, kelvin in views:
        tallies = [show(detector, camera, side, kelvin, tilt, 72, [seed, int(side), int(tilt)]) for seed in seeds]
        measured = np.mean([pose_errors(tally.best, tally.other, tally.T_true) for tally in tallies], axis=0)
        planned = expect(
            tables, camera, size=SIZE, distance=camera.focal_px * SIZE / side, tilt_deg=tilt, contrast=kelvin / NETD
        )
        assert planned.detected
        # 72 markers: a share of 0.8 scatters by 0.05.
        assert min(tally.found for tally in tallies) >= 0.65
        ratios.append((planned.position / measured[0], planned.rotation_deg / measured[2]))
    return np.array(ratios)


def test_planned_pose_errors_are_the_measured_ones():
    ratios = ratios_of_errors([(34.0, 20.0, 1.0), (50.0, 58.0, 6.0)], SEEDS[:1])
    # As below: of one median each, an eighth, beside the tables' tenth.
    assert np.all(np.abs(np.log(ratios)) < np.log(1.5))


@pytest.mark.nightly
def test_planned_pose_errors_are_the_measured_ones_in_all_views():
    ratios = ratios_of_errors(product((34.0, 50.0, 80.0), (20.0, 40.0, 58.0), (1.0, 6.0)), SEEDS)
    assert len(ratios) == 18
    # Medians of 72 errors scatter by an eighth, three of them together by a fourteenth; the tables scatter by a tenth.
    # The goal holds for each view.
    assert np.all(np.abs(np.log(ratios)) < np.log(1.5))
    # Over all views scatter averages out.
    assert np.all(np.abs(np.log(np.median(ratios, axis=0))) < np.log(1.25))


def test_a_larger_marker_that_is_turned_away_is_no_worse():
    """Its narrow side decides how it is fitted: with the mean side 34 px had two and a half times the errors of 30."""
    camera, detector = camera_and_detector()
    errors = []
    for side in (30.0, 34.0):
        tally = show(detector, camera, side, 6.0, 61.0, 72, [904, int(side)])
        errors.append(pose_errors(tally.best, tally.other, tally.T_true))
    smaller, larger = np.array(errors)[:, [0, 2]]
    # Medians of 72 errors scatter by an eighth: two of them, two standard deviations of their ratio.
    assert np.all(larger < 1.35 * smaller)


@pytest.mark.slow
def test_faint_small_marker_is_found_as_planned():
    camera, detector = camera_and_detector()
    distance = camera.focal_px * SIZE / 40.0
    planned = expect(load_measurements(), camera, size=SIZE, distance=distance, tilt_deg=15.0, contrast=0.2 / NETD)
    tally = show(detector, camera, 40.0, 0.2, 15.0, 48, [902])
    assert planned.detected
    # 48 markers: a share of 0.8 scatters by 0.06.
    assert tally.found >= 0.65
