"""Boards in rendered frames: found whatever the polarity, and measured to a few hundredths of a pixel."""

import re

import cv2
import numpy as np
import pytest
from support.boards import chessboard_levels, circle_levels, plate_pose, random_view, render
from support.heated_boards import Heat, picture
import yaml

from thermal_fiducial.calibration.keypoints import without_speckles
from thermal_fiducial.calibration.recognition import BoardNotFound
from thermal_fiducial.calibration.targets import Chessboard, CircleGrid
from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import asymmetric_circles
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.sim.scenario import LENSES

LENS = LENSES['13mm']
GUESS = Camera(640, 512, np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 255.5], [0.0, 0.0, 1.0]]))
CHESSBOARD, SQUARE = Chessboard(8, 6, 0.05), 0.05
CIRCLES = CircleGrid(4, 11, 0.03, 0.024)


def chessboard_view(rng, contrast, seed, lens=LENS):
    return seen_from(random_view(lens, CHESSBOARD.points, rng), contrast, seed, lens)


def seen_from(T, contrast, seed, lens=LENS):
    plate = plate_pose(T, np.array([3.5, 2.5]) * SQUARE)
    counts = render(lens, plate, chessboard_levels(8, 6), 11 * SQUARE, 9 * SQUARE, contrast, seed)
    return counts, lens.project(se3.apply(T, CHESSBOARD.points))


def smallest_error(pixels, truth):
    """A chessboard of even and odd sides looks the same after half a turn."""
    return min((pixels - order for order in (truth, truth[::-1])), key=lambda error: np.abs(error).max())


@pytest.mark.parametrize('views', [1, pytest.param(4, marks=pytest.mark.nightly)])
@pytest.mark.parametrize('contrast', [8.0, -8.0, 2.0])
def test_chessboard_of_either_polarity(contrast, views):
    rng = np.random.default_rng(7)
    errors = []
    for seed in range(views):
        counts, truth = chessboard_view(rng, contrast, seed)
        sighting = CHESSBOARD.find(counts, GUESS)
        errors.append(smallest_error(sighting.pixels, truth))
    rms = np.sqrt(np.mean(np.sum(np.concatenate(errors) ** 2, axis=1)))
    # Measured 0.017 px at 8 K; noise grows as contrast falls.
    assert rms < 0.03 * 8.0 / min(8.0, abs(contrast) * 1.6)


def test_outer_corners_are_as_good_as_inner_ones():
    rng = np.random.default_rng(11)
    views = [random_view(LENS, CHESSBOARD.points, rng) for _ in range(8)]
    for index in (2, 7):
        counts, truth = seen_from(views[index], 8.0 if index % 2 else -8.0, index)
        error = smallest_error(CHESSBOARD.find(counts, GUESS).pixels, truth)
        # 0.010 and 0.015 px at worst. Where what fits badly starts at a prediction that takes the grid for nearly even,
        # an outer corner is 0.14 and 0.25 px off.
        assert np.linalg.norm(error, axis=1).max() < 0.02


def test_chessboard_beside_something_hot():
    counts, truth = chessboard_view(np.random.default_rng(3), 4.0, 1)
    hot = counts.copy()
    hot[:8, :200] = 14000
    sighting = CHESSBOARD.find(hot, GUESS)
    assert np.abs(smallest_error(sighting.pixels, truth)).max() < 0.3


@pytest.mark.parametrize('views', [1, pytest.param(3, marks=pytest.mark.nightly)])
@pytest.mark.parametrize('name', ['13mm', '7.5mm'])
def test_circles(name, views):
    lens = LENSES[name]
    levels, width, height = circle_levels(4, 11, 0.03, 0.024, 0.0005)
    rng = np.random.default_rng(2)
    for seed in range(views):
        T = random_view(lens, CIRCLES.points, rng)
        plate = plate_pose(T, np.array([0.5 * width - 0.03, 0.5 * height - 0.03]))
        sighting = CIRCLES.find(render(lens, plate, levels, width, height, 8.0, seed), GUESS)
        # Without those that the border of the image cuts.
        assert len(sighting.points) >= 38
        # Centroids differ from projected centres by perspective, at these sizes by less than half a pixel.
        truth = lens.project(se3.apply(T, sighting.points))
        assert np.abs(sighting.pixels - truth).max() < 0.6


def test_no_board_in_noise():
    noise = np.random.default_rng(1).normal(3600.0, 3.0, (512, 640)).astype(np.uint16)
    for board in (CHESSBOARD, CIRCLES):
        with pytest.raises(BoardNotFound):
            board.find(noise, GUESS)


def test_speckles_go_and_corners_stay():
    counts, _ = chessboard_view(np.random.default_rng(9), 8.0, 2)
    image = without_speckles(counts)
    assert image.max() < counts.max()
    kept = np.mean(image == counts)
    # A twentieth of a percent of the pixels is bad.
    assert 0.998 < kept < 1.0


@pytest.mark.parametrize('size', [(2, 6, 0.05), (8, 6, 0.0)])
def test_unusable_boards(size):
    with pytest.raises(InputError):
        Chessboard(*size)


def test_command_calibrates_a_folder(tmp_path, capsys):
    rng = np.random.default_rng(11)
    for index in range(8):
        counts, _ = chessboard_view(rng, 8.0 if index % 2 else -8.0, index)
        cv2.imwrite(str(tmp_path / f'{index:02}.png'), counts)
    cv2.imwrite(str(tmp_path / '08.png'), np.full((512, 640), 7000, np.uint16))
    out = tmp_path / 'camera.yaml'
    assert main(['calibrate', 'intrinsics', str(tmp_path), '--out', str(out), '--models', 'plumb_bob,equidistant']) == 0
    camera = load_camera(out)
    assert camera.model == 'plumb_bob'
    # Eight views in place of forty: twice the errors that forty may have.
    assert camera.K[0, 0] == pytest.approx(LENS.focal[0], rel=1e-3)
    assert camera.K[:2, 2] == pytest.approx(LENS.centre, abs=0.6)
    printed = capsys.readouterr().out
    assert 'cells covered' in printed
    assert '% of the image' in printed
    assert '08.png: not used: no board found: out of view' in printed
    page = out.with_suffix('.html').read_text()
    # Every view with its points and residuals under its name, and the one that gave nothing with the reason.
    drawn, rest = page.split('<h2>Not used</h2>')
    unused, seen = rest.split('<h2>Views</h2>')
    assert unused.count('<figure>') == 1
    assert '08.png: no board found' in unused
    assert seen.count('<figure>') == 8
    assert seen.count('<circle') == seen.count('<path') >= 8 * 24
    # Drawings stand side by side, none in another, in the colour of the page's text: dark pages are read too.
    assert drawn.count('<svg') == drawn.count('<figure') == 6
    assert 'currentColor' in drawn
    assert not re.search(r'fill: (black|#000000)', drawn)
    # The length of the arrows is written below them, clear of the title.
    title, key = (
        float(re.search(rf' y="([\d.]+)"[^>]*>{words}', drawn)[1]) for words in ('mean residual', r'[\d.]+ px<')
    )
    assert key > title + 100
    bars = drawn[drawn.index('rms of each view') :]
    assert all(f'>{index:02}.png</text>' in bars for index in range(8))
    assert all(f'{index:02}.png:' in seen for index in range(8))
    assert re.search(r'<td>08.png</td><td>no board found: out of view', page)
    # Words begin at the left, and a phone shows a table whole.
    assert page.index('<table class="words"><tr><th>frame</th><th>reason</th>') > page.index(
        '.words td,.words th{text-align:left}'
    )
    assert '@media (max-width:32em)' in page
    covariance = yaml.safe_load((tmp_path / 'camera_covariance.yaml').read_text())
    assert 0.3 < covariance['covered_share'] < 1.0
    assert covariance['sigma_covered_px'] < covariance['sigma_not_covered_px']


def test_a_board_of_circles_is_calibrated_with_as_it_was_drawn(tmp_path, capsys):
    assert main(['markers', 'board', 'circles', '--formats', 'svg', '--out', str(tmp_path / 'board')]) == 0
    said = capsys.readouterr().out.splitlines()[-1].partition(' VIEWS ')[2].split()
    assert said == ['--target', 'circles', '--grid', '4', '11', '--spacing', '25', '--diameter', '20']
    views = tmp_path / 'views'
    views.mkdir()
    counts, _ = picture(asymmetric_circles(4, 11, 1.0), Heat(), np.random.default_rng(1), radius=0.4, fill=0.8)
    cv2.imwrite(str(views / '0.png'), counts)
    for options in (said, said[:2]):
        assert main(['calibrate', 'intrinsics', str(views), '--out', str(tmp_path / 'no.yaml'), *options]) == 2
        assert '0.png: 44 points' in capsys.readouterr().out


def test_points_that_were_measured_elsewhere(tmp_path, capsys):
    rng, out = np.random.default_rng(4), tmp_path / 'camera.yaml'
    lines = ['view,point,u,v,x,y']
    for view in range(10):
        pixels = LENS.project(se3.apply(random_view(LENS, CHESSBOARD.points, rng), CHESSBOARD.points))
        # The last view was measured badly.
        noise = rng.normal(0.0, 0.02 if view < 9 else 4.0, pixels.shape)
        for point, (uv, xyz) in enumerate(zip(pixels + noise, CHESSBOARD.points, strict=True)):
            lines.append(f'v{view},{point},{uv[0]:.4f},{uv[1]:.4f},{xyz[0]:.4f},{xyz[1]:.4f}')
    table = tmp_path / 'points.csv'
    table.write_text('\n'.join(lines))
    command = ['calibrate', 'intrinsics', str(table), '--out', str(out), '--models', 'plumb_bob']
    assert main([*command, '--size', '640', '512']) == 0
    # Nine views in place of forty.
    assert load_camera(out).K[0, 0] == pytest.approx(LENS.focal[0], rel=1e-3)
    page = out.with_suffix('.html').read_text()
    assert 'v8: 48 points, rms' in page
    # A view that was dropped is drawn too, without residuals.
    assert 'v9: 48 points, not used' in page
    seen = page[page.index('class="views"') :]
    assert seen.count('<circle') == seen.count('<path') + 48 == 480
    capsys.readouterr()
    command.append('--force')
    for broken, words in (('v0,0,1,1,0,0', 'second time'), ('v0,99,x,1,0,0', 'numbers'), ('v0,99,-9,1,0,0', 'outside')):
        table.write_text('\n'.join([*lines, broken]))
        assert main([*command, '--size', '640', '512']) == 2
        assert words in capsys.readouterr().err
    assert main(command) == 2
    assert '--size' in capsys.readouterr().err


def test_too_few_views_are_counted_and_the_others_named(tmp_path, capsys):
    rng = np.random.default_rng(12)
    for index in range(2):
        cv2.imwrite(str(tmp_path / f'good{index}.png'), chessboard_view(rng, 8.0, index)[0])
    cv2.imwrite(str(tmp_path / 'blank.png'), np.full((512, 640), 7000, np.uint16))
    assert main(['calibrate', 'intrinsics', str(tmp_path), '--out', str(tmp_path / 'c.yaml')]) == 2
    error = capsys.readouterr().err
    assert '2 of 3 frames are usable views' in error
    assert 'blank.png: no board found: out of view' in error
    assert not (tmp_path / 'c.yaml').exists()


@pytest.mark.parametrize('content', [None, b'no picture', 'blank'])
def test_unusable_folders(tmp_path, content, capsys):
    if content == 'blank':
        cv2.imwrite(str(tmp_path / 'a.png'), np.full((256, 320), 7000, np.uint16))
    elif content is not None:
        (tmp_path / 'a.png').write_bytes(content)
    assert main(['calibrate', 'intrinsics', str(tmp_path), '--out', str(tmp_path / 'c.yaml')]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
