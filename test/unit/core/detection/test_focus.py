"""Blur of the optics, estimated by the sides of markers."""

import numpy as np
import pytest
from support.small_pictures import counts_with_markers, FOCAL_PX, HEIGHT, WIDTH

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.focus import BLURS, Focus, FOCUS_STD, ShownBlur
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import corner_covariances, corners_px
from thermal_fiducial.files.dictionary import load_dictionary

CAMERA = Camera(WIDTH, HEIGHT, [[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]])
DICTIONARY = load_dictionary('STENCIL_4X4_100')
#: Standard deviation of the area of a pixel [px].
PIXEL_PX = 1.0 / np.sqrt(12.0)
FRAME_NS = 33_333_333


def flown(optics_px, declared_px, *, contrast=330.0, frames=4):
    """A detector at rest before twelve markers of 44 px, and corners' errors and covariances in the last frame."""
    detector = MarkerDetector(ArucoDetectorConfig(blur_px=declared_px, bolometer_lag=0.0), DICTIONARY)
    for number in range(frames):
        # The same scene with other noise.
        noiseless, corners = counts_with_markers(
            np.random.default_rng(3), DICTIONARY.bits, 44.0, 20.0, optics_px=optics_px, contrast=contrast, noise=0.0
        )
        counts = np.rint(noiseless + np.random.default_rng(number).normal(0.0, 1.5, noiseless.shape)).astype(np.uint16)
        rows = detector.detect((1 + number) * FRAME_NS, counts, CAMERA)
    errors = corners_px(rows) - np.array([corners[key] for key in rows['id'].tolist()])
    return detector, errors, corner_covariances(rows)


@pytest.mark.parametrize('optics_px', [0.5, 0.66, 0.9])
@pytest.mark.parametrize('declared_px', [0.5, 0.8])
def test_the_blur_of_the_optics_is_found(optics_px, declared_px):
    """Whatever is declared, within the 5 % by which frames of one focus may differ."""
    detector, _, _ = flown(optics_px, declared_px)
    assert detector.focus.blur_px == pytest.approx(np.hypot(optics_px, PIXEL_PX), rel=0.05)


def test_out_of_focus_corners_are_as_good_as_with_the_blur_declared():
    """Declared too small by a half they were 0.09 px off, at a NEES of 8; with the right blur they are by 0.010 px."""
    optics_px = 0.9
    _, right, _ = flown(optics_px, float(np.hypot(optics_px, PIXEL_PX)))
    _, errors, covariances = flown(optics_px, 0.5, frames=12)
    rms = np.sqrt(np.mean(errors**2))
    # By a blur that is 5 % off, as the estimate may be, they differ by up to a tenth (measured).
    assert rms < 1.1 * np.sqrt(np.mean(right**2))
    squared = np.einsum('nki,nki->nk', errors, np.linalg.solve(covariances, errors[..., None])[..., 0])
    assert np.mean(squared) / 2.0 < 1.0


def test_faint_markers_do_not_show_a_blur_that_is_not_there():
    """Eight noises of a pixel: the blur stays within three of its standard deviations."""
    detector, _, _ = flown(0.6, 0.66, contrast=12.0, frames=8)
    focus = detector.focus
    assert abs(focus.blur_px - np.hypot(0.6, PIXEL_PX)) < 3.0 * np.sqrt(focus.variance)


def test_pictures_for_a_display_and_a_first_frame_show_none():
    detector, _, _ = flown(0.9, 0.5, frames=1)
    assert detector.focus == Focus.as_declared(0.5)


def test_a_lens_out_of_focus_is_named():
    detector, _, _ = flown(1.1, 0.66)
    assert detector.focus.doubt.startswith('images blur by 1.1 px, blur_px is 0.66: focus the lens')
    detector, _, _ = flown(0.66, 0.66)
    assert detector.focus.doubt == ''
    assert Focus.as_declared(0.66).doubt == ''


def test_the_estimate_is_a_kalman_filter_within_limits():
    focus = Focus.as_declared(0.6)
    assert focus.variance == pytest.approx((FOCUS_STD * 0.6) ** 2)
    assert focus.due(0)
    exact = focus.after(0, ShownBlur(0.06, 0.0))
    # By one frame it is known to what frames differ by.
    assert np.sqrt(exact.variance) == pytest.approx(0.05 * 0.6, rel=0.05)
    assert 0.65 < exact.blur_px < 0.66
    assert not exact.due(FRAME_NS)
    assert exact.due(10 * FRAME_NS)
    assert exact.due(-FRAME_NS)
    # What shows nothing leaves it as it is, but for what focus changes with time.
    later = exact.after(60_000_000_000, None)
    assert later.blur_px == exact.blur_px
    assert later.variance > exact.variance
    # A step that is cut short leaves the variance.
    far = focus.after(0, ShownBlur(3.0, 0.0))
    assert far.blur_px < 1.3 * 0.6
    assert far.variance == focus.variance
    for step in (3.0, -3.0):
        extreme = focus
        for number in range(50):
            extreme = extreme.after(number * FRAME_NS, ShownBlur(step, 0.0))
        assert extreme.blur_px == pytest.approx(0.6 * BLURS[int(step > 0.0)])
