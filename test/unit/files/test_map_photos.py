"""Maps from photos, in the dictionary that the map is of."""

import shutil

import cv2
import numpy as np
import pytest
from support.opencv import need_4_7
from support.walls import CAMERA, flight, SIZE, wall

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.reprojection import corners_in_map, reproject
from thermal_fiducial.core.geometry.se3 import difference
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.files.camera_info import save_camera
from thermal_fiducial.files.dictionary import load_dictionary, save_dictionary
from thermal_fiducial.files.marker_map import load_map, save_map

DICTIONARY = 'STENCIL_4X4_100'
CELL_PX = 20


def photo(T_map_camera, poses):
    """A white wall with markers as a camera for visible light shows it."""
    picture = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    bits = load_dictionary(DICTIONARY).bits
    for key, T in poses.items():
        cells = np.pad(np.pad(bits[key], 1), 1, constant_values=1)
        marker = np.kron(255 * cells, np.ones((CELL_PX, CELL_PX), np.uint8))
        side = CELL_PX * (len(cells) - 2)
        square = CELL_PX - 0.5 + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        uv = reproject(CAMERA, T_map_camera, corners_in_map(T[None], np.array([SIZE])))[0]
        H = cv2.getPerspectiveTransform(square.astype(np.float32), uv.astype(np.float32))
        cv2.warpPerspective(marker, H, picture.shape[::-1], picture, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    return cv2.GaussianBlur(picture, (0, 0), 0.7)


@pytest.fixture(scope='module')
def poses():
    return wall(np.random.default_rng(3))


@pytest.fixture(scope='module')
def photographed(tmp_path_factory, poses):
    """Arguments: a folder of photos, and the camera."""
    need_4_7()
    folder = tmp_path_factory.mktemp('photos')
    for k in range(12):
        cv2.imwrite(str(folder / f'{k}.png'), photo(flight(2.0 * k), poses))
    save_camera(folder / 'camera.yaml', CAMERA)
    return [folder, '--calibration', folder / 'camera.yaml']


def build(photographed, *arguments):
    return main(['map', 'build', *(str(argument) for argument in (*photographed, *arguments))])


def test_photos_are_read_in_the_dictionary_of_the_map(photographed, poses, tmp_path):
    start, out = tmp_path / 'start.yaml', tmp_path / 'hall.yaml'
    save_map(start, MarkerMap({2: MapMarker(2, SIZE, True, poses[2])}, dictionary=DICTIONARY))
    assert build(photographed, '--map', start, '--out', out) == 0
    built = load_map(out)
    assert built.dictionary == DICTIONARY
    assert sorted(built.markers) == sorted(poses)
    for key, T in poses.items():
        # Measured: up to 16 mm and 0.01 rad, with corners found to 0.25 px. A wrong one of two poses is off by 0.5 rad.
        d = difference(built.markers[key].T_map_marker, T)
        assert np.linalg.norm(d[:3]) < 0.03
        assert np.linalg.norm(d[3:]) < 0.05


@pytest.mark.parametrize('begins_with', ['origin', 'map'])
def test_a_map_in_a_dictionary_file_finds_it_beside_itself(photographed, poses, tmp_path, capsys, begins_with):
    """It had the path of the file, which the rules of maps refuse."""
    own, start, out = tmp_path / 'own.yaml', tmp_path / 'start.yaml', tmp_path / 'maps' / 'hall.yaml'
    out.parent.mkdir()
    save_dictionary(own, 'own', load_dictionary(DICTIONARY))
    save_map(start, MarkerMap({2: MapMarker(2, SIZE, True, poses[2])}, dictionary=own.name))
    first = ['--origin', 2, '--marker-size', SIZE, '--dictionary', own] if begins_with == 'origin' else ['--map', start]
    assert build(photographed, *first, '--out', out) == 0
    assert load_map(out).dictionary == own.name
    assert f'{out}: sound' in capsys.readouterr().out
    (out.parent / own.name).write_text('other: things')
    assert build(photographed, *first, '--out', out) == 2
    assert f'{out.parent / own.name}: not the dictionary {own}, which a map' in capsys.readouterr().err
    assert (out.parent / own.name).read_text() == 'other: things'


def test_a_photo_that_gave_nothing_is_named_with_its_reason(photographed, poses, tmp_path, capsys):
    start = tmp_path / 'start.yaml'
    save_map(start, MarkerMap({2: MapMarker(2, SIZE, True, poses[2])}, dictionary=DICTIONARY))
    folder = shutil.copytree(photographed[0], tmp_path / 'photos')
    cv2.imwrite(str(folder / 'blank.png'), np.full((CAMERA.height, CAMERA.width), 255, np.uint8))
    assert build([folder, *photographed[1:]], '--map', start, '--out', tmp_path / 'hall.yaml') == 0
    printed = capsys.readouterr().out
    assert '12 of 13 frames used\nblank.png not used: no known marker in view\n' in printed


def test_photos_in_another_dictionary_than_that_of_the_map_are_refused(photographed, poses, tmp_path, capsys):
    start = tmp_path / 'start.yaml'
    save_map(start, MarkerMap({2: MapMarker(2, SIZE, True, poses[2])}, dictionary=DICTIONARY))
    status = build(photographed, '--map', start, '--out', tmp_path / 'out.yaml', '--dictionary', 'DICT_4X4_50')
    assert status == 2
    assert f'{start}: the map has markers of {DICTIONARY}, but dictionary is DICT_4X4_50' in capsys.readouterr().err
    assert not (tmp_path / 'out.yaml').exists()


def test_an_origin_that_is_in_no_photo_is_named_with_its_dictionary(photographed, tmp_path, capsys):
    out = tmp_path / 'out.yaml'
    assert build(photographed, '--origin', 49, '--marker-size', SIZE, '--out', out) == 2
    assert 'marker 49 of DICT_4X4_50, the origin, is in none of the 12 photos' in capsys.readouterr().err


def test_photos_of_temperatures_are_refused(photographed, tmp_path, capsys):
    """They were cut off to eight bits, and their markers said to be in no photo."""
    temperatures = np.full((CAMERA.height, CAMERA.width), 25.5, np.float32)
    cv2.imwrite(str(tmp_path / 'degrees.tiff'), temperatures)
    options = '--origin', 2, '--marker-size', SIZE, '--out', tmp_path / 'a.yaml'
    assert build((tmp_path, *photographed[1:]), *options) == 2
    assert 'degrees.tiff: a picture of float32, not of 8 or 16 bit' in capsys.readouterr().err


def thermal_photos(folder, poses):
    """Twelve pictures of 16 bits."""
    rng = np.random.default_rng(7)
    for k in range(12):
        shown = photo(flight(2.0 * k), poses).astype(float)
        counts = 5000.0 + shown + rng.normal(0.0, 1.5, shown.shape)
        cv2.imwrite(str(folder / f'{k}.png'), np.rint(counts).astype(np.uint16))


def mapped_errors(photographed, folder, poses):
    """Built markers, and the differences of their poses from the true ones; marker 2 is known."""
    start, out = folder / 'start.yaml', folder / 'hall.yaml'
    save_map(start, MarkerMap({2: MapMarker(2, SIZE, True, poses[2])}, dictionary=DICTIONARY))
    out.unlink(missing_ok=True)
    assert build((folder, *photographed[1:]), '--map', start, '--out', out) == 0
    built = load_map(out).markers
    return built, {key: difference(built[key].T_map_marker, poses[key]) for key in sorted(poses.keys() - {2})}


def test_a_map_from_thermal_photos_claims_what_they_show(photographed, poses, tmp_path):
    """A camera that hangs still for each picture has no motion blur that its corners could be displaced by."""
    thermal_photos(tmp_path, poses)
    built, differences = mapped_errors(photographed, tmp_path, poses)
    for key, d in differences.items():
        # Measured: 0.3 to 1.0 a degree of freedom and up to 2.5 mm; it was 0.02 to 0.05 and 13 mm when the camera might
        # have moved. 3.7 is the 99.9 % quantile of chi square with 6 degrees of freedom, over 6.
        assert 0.1 < d @ np.linalg.solve(built[key].covariance, d) / 6.0 < 3.7
        assert np.linalg.norm(d[:3]) < 0.005


def test_a_thickness_of_plates_is_refused_with_photos_of_visible_light(photographed, tmp_path, capsys):
    options = '--origin', 2, '--marker-size', SIZE, '--plate-thickness', 0.003
    assert build(photographed, *options, '--out', tmp_path / 'a.yaml') == 2
    assert '--plate-thickness has no effect with the photos' in capsys.readouterr().err


def test_a_thickness_in_millimetres_is_refused(photographed, tmp_path, capsys):
    with pytest.raises(SystemExit):
        build(photographed, '--origin', 2, '--marker-size', SIZE, '--plate-thickness', 3, '--out', tmp_path / 'a.yaml')
    assert "argument --plate-thickness: '3' is not a number from 0 to 0.05 m" in capsys.readouterr().err
