"""Real raw long-wave infrared frames and a real calibration."""

import cv2
import numpy as np
import pytest

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.eight_bit_view import EightBitView
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner
from thermal_fiducial.files.camera_info import load_camera

PERIOD_NS = 33_333_333


def read(folder, name):
    image = cv2.imread(str(folder / 'lwir_raw' / name), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def test_a_driving_sequence_passes_untouched(real_data):
    cleaner = FrameCleaner(Tau2CameraConfig())
    for index, number in enumerate(('0000', '0020', '0045', '0046', '0080')):
        frame = read(real_data, f'fieldscale_{number}.png')
        result = cleaner.process(index * PERIOD_NS, frame)
        assert result.reason == ''
        assert np.array_equal(result.counts, frame)


@pytest.mark.parametrize('core', ['XT2', 'XTR'])
def test_a_real_scene_holds_no_bad_pixels(real_data, core):
    """Roofs, roads and people at noise of the camera's order, standing still: nothing in it is one pixel sharp."""
    frame = read(real_data, f'DJI_{core}_raw16.png')
    cleaner, rng = FrameCleaner(Tau2CameraConfig()), np.random.default_rng(0)
    for index in range(60):
        noisy = (frame + rng.normal(0.0, 1.3, frame.shape)).round().astype(np.uint16)
        assert cleaner.process(index * PERIOD_NS, noisy).reason == ''
    assert len(cleaner.bad_pixels) == 0


@pytest.mark.parametrize('core', ['XT2', 'XTR'])
def test_the_8_bit_view_is_like_the_camera_s_own(real_data, core):
    """The camera equalises its histogram, the view is linear: alike, not the same (0.985 and 0.996 when written)."""
    view = EightBitView(Tau2CameraConfig())(read(real_data, f'DJI_{core}_raw16.png'))
    own = cv2.cvtColor(read(real_data, f'DJI_{core}_camera_8bit.jpg'), cv2.COLOR_BGR2GRAY)
    assert np.corrcoef(view.ravel(), own.ravel())[0, 1] > 0.97


def test_the_calibration_of_a_real_tau_2(real_data):
    camera = load_camera(real_data / 'tau2_calibration' / 'charlie_tau2.yaml')
    assert (camera.width, camera.height, camera.model) == (640, 512, 'equidistant')
    assert camera.K[0, 0] == 440.381678762
    points = np.array([[0.3, -0.2, 1.0], [-0.6, 0.4, 0.9]])
    expected = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.K, camera.D)[0][:, 0]
    assert np.allclose(camera.project(points), expected, atol=1e-9)
