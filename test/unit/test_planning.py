import numpy as np
import pytest

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.planning import (
    expect,
    expected_errors,
    load_measurements,
    Measurements,
    save_measurements,
)

CAMERA = Camera(640, 512, np.array([[765.0, 0.0, 319.5], [0.0, 765.0, 255.5], [0.0, 0.0, 1.0]]))
SIDES, CONTRASTS, TILTS = np.array([10.0, 40.0]), np.array([1.0, 100.0]), np.array([0.0, 60.0])


def table(found, sigma):
    shape = (2, 2, 2)
    return Measurements(
        SIDES,
        CONTRASTS,
        TILTS,
        np.broadcast_to(found, shape),
        np.broadcast_to(sigma, shape),
        np.array([[1.0, 0.5], [1.0, 0.5]]),
    )


def test_looks_up_what_was_measured():
    found = np.arange(8.0).reshape(2, 2, 2) / 8.0
    sigma = 0.01 * (1.0 + np.arange(8.0).reshape(2, 2, 2))
    measurements = table(found, sigma)
    for s, side in enumerate(SIDES):
        for c, contrast in enumerate(CONTRASTS):
            for t, tilt in enumerate(TILTS):
                share, noise = measurements.look_up(side, contrast, tilt)
                assert share == pytest.approx(found[s, c, t])
                assert noise == pytest.approx(sigma[s, c, t])
    # Half-way in the logarithms, where noise is a power of side and contrast.
    assert measurements.look_up(20.0, 1.0, 0.0)[1] == pytest.approx(np.sqrt(sigma[0, 0, 0] * sigma[1, 0, 0]))


def test_nothing_smaller_or_fainter_than_measured_is_found():
    measurements = table(1.0, 0.05)
    assert measurements.look_up(9.0, 10.0, 0.0)[0] == 0.0
    assert measurements.look_up(20.0, 0.9, 0.0)[0] == 0.0
    # Cells of 6 x 6 bits are smaller: 8 cells in the place of 6.
    assert measurements.look_up(13.0, 10.0, 0.0, bits=6)[0] == 0.0
    assert measurements.look_up(13.4, 10.0, 0.0, bits=6)[0] == 1.0


def test_unmeasured_noise_is_left_out():
    sigma = np.full((2, 2, 2), 0.05)
    sigma[0] = np.nan
    measurements = table(1.0, sigma)
    assert measurements.look_up(20.0, 10.0, 0.0)[1] == pytest.approx(0.05)
    assert np.isnan(measurements.look_up(10.0, 1.0, 0.0)[1])


def test_errors_grow_with_distance_squared_and_noise():
    near, far, noisy = (
        expected_errors(CAMERA, 0.3, distance, 40.0, sigma, 1)
        for distance, sigma in ((2.0, 0.02), (4.0, 0.02), (2.0, 0.04))
    )
    # Distance from the size of a square: error of the order of the distance squared; doubled noise, doubled errors.
    assert far[1] / near[1] == pytest.approx(4.0, rel=0.15)
    assert noisy[0] / near[0] == pytest.approx(2.0, rel=0.1)
    assert near[3] == 0.0


def test_noise_is_a_floor_and_a_part_that_falls_with_contrast():
    noise = np.sqrt(0.01**2 + (0.5 / CONTRASTS) ** 2)
    measurements = table(1.0, noise[None, :, None])
    for contrast in (1.5, 5.0, 40.0):
        assert measurements.look_up(20.0, contrast, 30.0)[1] == pytest.approx(np.hypot(0.01, 0.5 / contrast))


def test_branches_that_meet_are_no_flips():
    # So near and so well measured that the other branch is no minimum of its own.
    assert expected_errors(CAMERA, 0.3, 1.0, 30.0, 0.007, 1)[3] == 0.0


def test_pose_factor_scales_the_errors():
    plain = expect(table(1.0, 0.02), CAMERA, size=0.3, distance=3.0, tilt_deg=60.0, contrast=50.0)
    errors = expected_errors(CAMERA, 0.3, 3.0, 60.0, 0.02, 1)
    assert (plain.position, plain.distance, plain.rotation_deg) == pytest.approx(np.multiply(0.5, errors[:3]))
    assert plain.side_px == pytest.approx(76.5)
    assert plain.detected


@pytest.mark.parametrize('view', [{'distance': 0.1}, {'tilt_deg': 88.0}, {'contrast': 0.0}, {'size': -1.0}])
def test_views_that_cannot_be(view):
    with pytest.raises(InputError):
        expect(table(1.0, 0.02), CAMERA, **{'size': 0.3, 'distance': 3.0, 'tilt_deg': 30.0, 'contrast': 50.0, **view})


def test_tables_survive_the_file(tmp_path):
    sigma = np.full((2, 2, 2), 0.05)
    sigma[0, 0, 0] = np.nan
    path = tmp_path / 'measured.yaml'
    save_measurements(path, table(0.5, sigma), {'seed': 1})
    again = load_measurements(path)
    assert np.array_equal(again.sigma_px, sigma, equal_nan=True)
    assert np.array_equal(again.found, np.full((2, 2, 2), 0.5))


@pytest.mark.parametrize('content', ['', 'format: other', 'format: thermal_fiducial/marker_measurements\nside_px: 3'])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / 'measured.yaml'
    path.write_text(content)
    with pytest.raises(InputError):
        load_measurements(path)


def test_command_prints_tables_and_draws(tmp_path, capsys):
    picture = tmp_path / 'plan.png'
    assert main(['markers', 'plan', '--size', '300', '--distances', '2,4', '--plot', str(picture)]) == 0
    said = capsys.readouterr().out
    assert 'Contrast left' in said
    assert 'in contact' in said
    assert picture.stat().st_size > 10_000
    assert main(['markers', 'plan', '--distances', 'far']) == 2
    assert main(['markers', 'plan', '--thickness', '0']) == 2
