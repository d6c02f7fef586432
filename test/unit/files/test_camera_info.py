"""Calibration files and lists of bad pixels."""

import numpy as np
import pytest
import yaml

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bad_pixel_list import load_bad_pixels
from thermal_fiducial.files.camera_info import load_camera, save_camera

K = [[529.1, 0.0, 317.2], [0.0, 528.4, 259.9], [0.0, 0.0, 1.0]]
CAMERAS = [
    Camera(640, 512, K, 'plumb_bob', [-0.3, 0.1, 1e-3, -5e-4, 0.01]),
    Camera(640, 512, K, 'rational_polynomial', [0.3, 0.05, 1e-3, -5e-4, 0.01, 0.5, 0.1, 0.02]),
    Camera(324, 256, K, 'equidistant', [-0.125, -0.0158, 0.0055, 1.881602e-05]),
]


@pytest.mark.parametrize('camera', CAMERAS, ids=lambda camera: camera.model)
def test_a_saved_camera_is_read_back_exactly(tmp_path, camera):
    path = tmp_path / 'camera.yaml'
    save_camera(path, camera)
    assert load_camera(path).matches(camera)
    assert set(yaml.safe_load(path.read_text())) >= {'camera_name', 'rectification_matrix', 'projection_matrix'}


def test_a_plain_list_and_the_fisheye_synonym_are_understood(tmp_path):
    path = tmp_path / 'camera.yaml'
    content = {
        'image_width': 640,
        'image_height': 512,
        'camera_matrix': {'data': [*K[0], *K[1], *K[2]]},
    }
    path.write_text(
        yaml.safe_dump(content | {'distortion_model': 'fisheye', 'distortion_coefficients': [0.1, 0, 0, 0]})
    )
    assert load_camera(path).model == 'equidistant'


GOOD = {
    'image_width': 640,
    'image_height': 512,
    'camera_matrix': {'rows': 3, 'cols': 3, 'data': [*K[0], *K[1], *K[2]]},
    'distortion_model': 'plumb_bob',
    'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [0.0] * 5},
}


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'image_width': None}, 'image_width is missing'),
        ({'image_width': 'wide'}, "image_width: 'wide' is not a whole number"),
        ({'image_height': 0}, 'image size 640x0'),
        ({'camera_matrix': {'data': [1.0] * 8}}, 'camera_matrix: data: holds 8 numbers, not 9'),
        ({'camera_matrix': {'data': ['a'] * 9}}, "camera_matrix: data[0]: 'a' is not a number"),
        ({'camera_matrix': {'data': [0.0] * 9}}, 'focal length'),
        ({'camera_matrix': {'data': [0.013, 0, 317, 0, 0.013, 259, 0, 0, 1]}}, 'with fx 0.013 for an image of 640x512'),
        ({'camera_matrix': {'data': [529, 0, 317, 0, 528, 259, 0, 0, 5]}}, 'not of the form'),
        ({'distortion_coefficients': {'data': [-5.0, 0, 0, 0, 0]}}, 'that no lens has'),
        ({'camera_matrix': {'data': [float('nan')] * 9}}, "data[0]: '.nan' is not a number"),
        ({'distortion_coefficients': None}, 'distortion_coefficients is missing'),
        ({'distortion_coefficients': {'data': [0.1] * 9}}, 'takes 5 coefficients, not 9'),
        ({'distortion_model': 'spline'}, "'spline' is not one of"),
        ({'distortion_model': ['plumb_bob']}, 'distortion_model: a list of 1 is not a name'),
    ],
)
def test_a_broken_calibration_is_named(tmp_path, change, words):
    path = tmp_path / 'camera.yaml'
    path.write_text(yaml.safe_dump(GOOD | change))
    with pytest.raises(InputError) as error:
        load_camera(path)
    assert str(path) in str(error.value)
    assert words in str(error.value)
    assert '\n' not in str(error.value)


def test_saving_where_nothing_can_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match='No such file'):
        save_camera(tmp_path / 'none' / 'camera.yaml', CAMERAS[0])


def test_bad_pixels_are_columns_and_rows(tmp_path):
    path = tmp_path / 'bad.txt'
    path.write_text('# column row\n3 4\n639 511\n')
    assert np.array_equal(load_bad_pixels(path), [[3, 4], [639, 511]])


def test_comments_commas_and_empty_lists(tmp_path):
    path = tmp_path / 'bad.txt'
    path.write_text('# dead\n\n 12, 7  # near the border\n')
    assert load_bad_pixels(path).tolist() == [[12, 7]]
    # As editors of Windows write it.
    path.write_bytes(b'\xef\xbb\xbf12 7\r\n3 4\r\n')
    assert load_bad_pixels(path).tolist() == [[12, 7], [3, 4]]
    path.write_text('')
    assert load_bad_pixels(path).shape == (0, 2)


@pytest.mark.parametrize('line', ['1', '1 2 3', '-1 2', '1.5 2', 'a b'])
def test_a_broken_line_is_named(tmp_path, line):
    path = tmp_path / 'bad.txt'
    path.write_text(f'1 2\n{line}\n')
    with pytest.raises(InputError, match='line 2'):
        load_bad_pixels(path)
