import numpy as np
import pytest
import yaml

from thermal_fiducial.cli.main import main
from thermal_fiducial.cli.marker_measurement import camera_and_detector, show
from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.side_fit import too_small_for_sides
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.planning import (
    expect,
    expected_errors,
    load_measurements,
    Measurements,
    save_measurements,
    viewed_at,
)

CAMERA = Camera(640, 512, np.array([[765.0, 0.0, 319.5], [0.0, 765.0, 255.5], [0.0, 0.0, 1.0]]))
SIDES, CONTRASTS, TILTS = np.array([16.0, 64.0]), np.array([1.0, 100.0]), np.array([0.0, 60.0])


def table(found, sigma, distance=0.001, pose_sigma=None):
    shape = (2, 2, 2)
    return Measurements(
        SIDES,
        CONTRASTS,
        TILTS,
        np.broadcast_to(found, shape),
        np.broadcast_to(sigma, shape),
        np.broadcast_to(sigma if pose_sigma is None else pose_sigma, shape),
        np.broadcast_to(distance, shape),
    )


def share_found(measurements, narrow_px, contrast, tilt_deg, bits=4):
    return measurements.found_share(np.array([narrow_px]), contrast, tilt_deg, bits)[0]


def noise(measurements, narrow_px, contrast, tilt_deg):
    return measurements.noise_px(np.array([narrow_px]), contrast, tilt_deg)[0]


def view(measurements, side_px, contrast, tilt_deg):
    """What is expected of a marker whose side in a view from the front is ``side_px``."""
    distance = CAMERA.focal_px * 0.3 / side_px
    return expect(measurements, CAMERA, size=0.3, distance=distance, tilt_deg=tilt_deg, contrast=contrast)


def test_predictions_at_measured_points_are_the_measurements():
    found = np.arange(8.0).reshape(2, 2, 2) / 8.0
    sigma = 0.01 * (1.0 + np.arange(8.0).reshape(2, 2, 2))
    measurements = table(found, sigma)
    for s, side in enumerate(SIDES):
        for c, contrast in enumerate(CONTRASTS):
            for t, tilt in enumerate(TILTS):
                assert share_found(measurements, side, contrast, tilt) == pytest.approx(found[s, c, t])
                assert noise(measurements, side, contrast, tilt) == pytest.approx(sigma[s, c, t])
    # Half-way in the logarithms, where noise is a power of side and contrast.
    assert noise(measurements, 32.0, 1.0, 0.0) == pytest.approx(np.sqrt(sigma[0, 0, 0] * sigma[1, 0, 0]))


def test_nothing_smaller_or_fainter_than_measured_is_found():
    measurements = table(1.0, 0.05)
    assert share_found(measurements, 15.0, 10.0, 0.0) == 0.0
    assert share_found(measurements, 20.0, 0.9, 0.0) == 0.0
    # Cells of 6 x 6 bits are smaller: 8 cells in the place of 6.
    assert share_found(measurements, 21.3, 10.0, 0.0, bits=6) == 0.0
    assert share_found(measurements, 21.4, 10.0, 0.0, bits=6) == 1.0


def test_nothing_is_promised_below_the_shortest_side_that_the_detector_takes():
    smallest = ArucoDetectorConfig().min_side_px
    packaged, any_side = load_measurements(), table(1.0, 0.05)
    for tilt in (0.0, 30.0, 60.0):
        # Tilted about its diagonal, a square keeps this share of all its sides; about any other axis less of two.
        kept = np.sqrt(0.5 * (1.0 + np.cos(np.radians(tilt)) ** 2))
        for measurements in (packaged, any_side):
            assert view(measurements, 0.99 * smallest / kept, 100.0, tilt).found == 0.0
    assert view(packaged, 1.3 * smallest, 200.0, 0.0).found > 0.8


def test_error_of_the_distance_is_that_of_the_measurements():
    measured = np.full((2, 2, 2), 0.001)
    measured[0] = 0.01
    plan = expect(table(1.0, 0.02, measured), CAMERA, size=0.3, distance=8.0, tilt_deg=0.0, contrast=50.0)
    # 28.7 px: not half-way between 16 and 64 in the logarithm, where the error is 0.01 and 0.001 of the distance.
    assert plan.distance == pytest.approx(8.0 * 10.0 ** (-2.0 - np.log(765.0 * 0.3 / 8.0 / 16.0) / np.log(4.0)))
    assert plan.position >= plan.distance


def test_the_narrowest_side_counts_in_each_rotation():
    """Turned by 60 deg, a marker of 60 px has a narrowest side of 30 to 47 px."""
    found, sigma = np.zeros((2, 2, 2)), np.full((2, 2, 2), 0.01)
    found[1], sigma[0] = 1.0, 0.1
    measurements = table(found, sigma)
    widest, narrowest = 60.0 * np.sqrt(0.5 + 0.5 * 0.25), 60.0 * 0.5
    plan = view(measurements, 60.0, 50.0, 60.0)
    assert share_found(measurements, narrowest, 50.0, 60.0) < plan.found < share_found(measurements, widest, 50.0, 60.0)
    assert noise(measurements, widest, 50.0, 60.0) < plan.sigma_px < noise(measurements, narrowest, 50.0, 60.0)


def test_the_tables_have_a_side_on_each_side_of_where_the_fit_changes():
    """Half a pixel from it: between the two the mean of both fits holds."""
    config = ArucoDetectorConfig()
    square = 0.5 * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    small = [
        bool(too_small_for_sides(side * square[None], 6, config.blur_px)[0]) for side in load_measurements().narrow_px
    ]
    last, first = load_measurements().narrow_px[np.sum(small) - 1 : np.sum(small) + 1]
    assert small == sorted(small, reverse=True)
    assert first - last < 1.0


@pytest.mark.parametrize('side', [15.3, 19.1])
def test_predicted_error_of_the_distance_is_that_of_rendered_markers(side):
    """Rendered markers of 0.3 m at 15 and 12 m, other ones than those of the tables."""
    camera, detector = camera_and_detector()
    shown = show(detector, camera, side, 11.0, 30.0, 24, [99, int(side)])
    promised = view(load_measurements(), side, 11.0 / 0.05, 30.0)
    # Medians of 24 errors between those of the tables, each of 24: 0.5 is two and a half standard deviations.
    assert shown.distance_error == pytest.approx(promised.distance * side / (CAMERA.focal_px * 0.3), rel=0.5)


def test_clear_markers_at_12_m_are_not_measured_too_far_away():
    """With the edges of neighbouring cells in the model they were, by 0.3 %, as the optics are not quite Gaussian."""
    camera, detector = camera_and_detector()
    # Median of 48 when written: 0.06 %; before, 0.29 %.
    assert show(detector, camera, 19.1, 11.0, 30.0, 48, [99, 19]).distance_error < 0.0012


@pytest.mark.parametrize(('side', 'promised'), [(350.0, (1.0, 1.0)), (450.0, (0.1, 0.5)), (520.0, (0.0, 0.0))])
def test_markers_that_reach_out_of_the_image_are_not_found(side, promised):
    """In an image of 512 rows a square of 450 px fits in some rotations only, one of 350 px in all."""
    assert promised[0] <= view(table(1.0, 0.02), side, 50.0, 0.0).found <= promised[1]


def test_a_marker_as_large_and_bright_as_this_is_always_found():
    """One of twelve was lost where a plate's border, read inside out as another marker, stood for the place."""
    camera, detector = camera_and_detector()
    promised = view(load_measurements(), 33.0, 11.0 / 0.05, 30.0).found
    assert show(detector, camera, 33.0, 11.0, 30.0, 30, [8, 28]).found == promised == 1.0


def test_unmeasured_noise_is_left_out():
    found, sigma = np.ones((2, 2, 2)), np.full((2, 2, 2), 0.05)
    found[0], sigma[0] = 0.0, np.nan
    measurements = table(found, sigma)
    assert noise(measurements, 20.0, 10.0, 0.0) == pytest.approx(0.05)
    assert np.isnan(view(measurements, 15.9, 1.0, 0.0).sigma_px)
    assert np.isnan(view(table(1.0, np.nan), 40.0, 10.0, 0.0).position)


def seen_from(distance, tilt_deg, sigma_px):
    """Errors of poses from corners with independent noise."""
    rng = np.random.default_rng(1)
    T = viewed_at(distance, np.radians(tilt_deg), rng.uniform(0.0, 2.0 * np.pi, 200), CAMERA)
    return expected_errors(CAMERA, 0.3, T, np.full(200, sigma_px), rng)


def test_errors_grow_with_distance_squared_and_noise():
    near, far, noisy = (seen_from(distance, 40.0, sigma) for distance, sigma in ((2.0, 0.02), (4.0, 0.02), (2.0, 0.04)))
    # Distance from the size of a square: error of the order of the distance squared; doubled noise, doubled errors.
    assert far[1] / near[1] == pytest.approx(4.0, rel=0.15)
    assert noisy[0] / near[0] == pytest.approx(2.0, rel=0.1)
    assert near[3] == 0.0


def test_noise_is_a_floor_and_a_part_that_falls_with_contrast():
    measurements = table(1.0, np.sqrt(0.01**2 + (0.5 / CONTRASTS) ** 2)[None, :, None])
    for contrast in (1.5, 5.0, 40.0):
        assert noise(measurements, 20.0, contrast, 30.0) == pytest.approx(np.hypot(0.01, 0.5 / contrast))


def test_branches_that_meet_are_no_flips():
    # So near and so well measured that the other branch is no minimum of its own.
    assert seen_from(1.0, 30.0, 0.007)[3] == 0.0


def test_poses_have_a_noise_of_their_own():
    """Errors of corners that are correlated move a pose more or less than independent ones."""
    halved, plain = (
        expect(measurements, CAMERA, size=0.3, distance=3.0, tilt_deg=60.0, contrast=50.0)
        for measurements in (table(1.0, 0.02, 1e-6, 0.01), table(1.0, 0.02, 1e-6))
    )
    # All but linear in the noise.
    assert (halved.position, halved.rotation_deg) == pytest.approx(
        (0.5 * plain.position, 0.5 * plain.rotation_deg), rel=0.01
    )
    assert halved.sigma_px == plain.sigma_px == pytest.approx(0.02)
    assert plain.side_px == pytest.approx(76.5)
    assert plain.detected


@pytest.mark.parametrize('changed', [{'distance': 0.1}, {'tilt_deg': 88.0}, {'contrast': 0.0}, {'size': -1.0}])
def test_views_that_cannot_be(changed):
    with pytest.raises(InputError, match='the distance must be more than the side, the tilt below 85 deg'):
        expect(
            table(1.0, 0.02), CAMERA, **{'size': 0.3, 'distance': 3.0, 'tilt_deg': 30.0, 'contrast': 50.0, **changed}
        )


def test_tables_survive_the_file(tmp_path):
    sigma = np.full((2, 2, 2), 0.05)
    sigma[0, 0, 0] = np.nan
    path = tmp_path / 'measured.yaml'
    save_measurements(path, table(0.5, sigma), {'seed': 1})
    again = load_measurements(path)
    assert np.array_equal(again.sigma_px, sigma, equal_nan=True)
    assert np.array_equal(again.found, np.full((2, 2, 2), 0.5))


@pytest.mark.parametrize('content', ['', 'format: other', 'format: thermal_fiducial/marker_measurements\nnarrow_px: 3'])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / 'measured.yaml'
    path.write_text(content)
    with pytest.raises(InputError):
        load_measurements(path)


@pytest.mark.parametrize('axis', [5.0, [64.0, 16.0], [16.0, float('nan')], [[16.0], [64.0]], [0.0, 64.0], [16.0]])
def test_axes_that_do_not_rise_are_refused(tmp_path, axis):
    path = tmp_path / 'measured.yaml'
    save_measurements(path, table(0.5, 0.05), {})
    document = yaml.safe_load(path.read_text())
    assert document['narrow_px'] == [16.0, 64.0]
    path.write_text(yaml.safe_dump({**document, 'narrow_px': axis}))
    with pytest.raises(InputError, match='narrow_px is not two or more rising numbers'):
        load_measurements(path)


def test_command_prints_tables_and_draws(tmp_path, capsys):
    picture = tmp_path / 'plan.png'
    assert main(['markers', 'plan', '--size', '300', '--distances', '2,4', '--plot', str(picture)]) == 0
    said = capsys.readouterr().out
    assert 'Contrast left' in said
    assert 'in contact' in said
    assert 'a warm surface that ends one cell outside it' in ' '.join(said.split())
    assert picture.stat().st_size > 10_000
    assert main(['markers', 'plan', '--distances', 'far']) == 2
    assert main(['markers', 'plan', '--thickness', '0']) == 2


@pytest.mark.parametrize('words', [('--size', '0.3'), ('--thickness', '0.003')])
def test_lengths_in_metres_are_refused(capsys, words):
    assert main(['markers', 'plan', *words]) == 2
    assert f'{words[1]} mm' in capsys.readouterr().err
