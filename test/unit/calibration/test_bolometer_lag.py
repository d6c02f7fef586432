"""``calibrate lag``: the time constant that the tails of drawn markers have."""

from functools import cache

import cv2
import numpy as np
import pytest
from scipy.signal import lfilter
from support import small_bag
from support.opencv import draw_marker
import yaml

from thermal_fiducial.calibration import bolometer_lag
from thermal_fiducial.calibration.bolometer_lag import calibrate_lag, lag_of_view, LagOfView
from thermal_fiducial.calibration.moving_markers import DetectedFrame, moving_markers, MovingMarker
from thermal_fiducial.cli.main import main
from thermal_fiducial.core.detection.detector import rows_from_corners
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import CAMERA_INFO_TOPIC, IMAGE_TOPIC
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.marker_map import save_map

DICTIONARY, MARKER = 'DICT_4X4_50', 2
WIDTH, HEIGHT = 240, 120
CAMERA = Camera(WIDTH, HEIGHT, np.array([[285.0, 0.0, 119.5], [0.0, 285.0, 59.5], [0.0, 0.0, 1.0]]))
#: Parts of a pixel in drawings; side of a marker [px], its turn [rad], and where its middle is in the first frame [px].
FINE, SIDE, TURN, START = 8, 54.0, 0.35, (60.0, 60.0)
#: Blur of optics and pixels [px]; of a frame to the next [s].
BLUR, PERIOD = 0.66, 1.0 / 30.0
COLD, HOT = 7000.0, 7600.0


@pytest.fixture(scope='module')
def decoder():
    dictionary = load_dictionary(DICTIONARY)
    return Decoder(dictionary.bits, dictionary.correctable)


@cache
def drawing(speed, lag, exposure=0.0, blur=BLUR):
    """Counts at parts of pixels of a marker that moves to the right [px/s], with a lag and an exposure [s]."""
    bits = draw_marker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), MARKER, 6) / 255.0
    part = round(FINE * SIDE / 6)
    sheet = np.kron(np.pad(bits, 2, constant_values=((0, 0),) * 2), np.ones((part, part))).astype(np.float32)
    sheet[part:-part, part:-part] = np.kron(np.pad(bits, 1, constant_values=1.0), np.ones((part, part)))
    c, s = np.cos(TURN), np.sin(TURN)
    turn = np.array([[c, -s], [s, c]])
    middle = FINE * (np.array(START) + 0.5) - 0.5
    M = np.column_stack([turn, middle - turn @ np.full(2, 5.0 * part - 0.5)])
    image = cv2.warpAffine(sheet, M, (WIDTH * FINE, HEIGHT * FINE))
    image = cv2.GaussianBlur(image, (0, 0), FINE * np.sqrt(blur**2 - 1.0 / 12.0))
    width = round(FINE * speed * exposure)
    if width > 1:
        image = cv2.blur(image, (width, 1))
    if lag:
        # What was ahead is behind the marker's edges still.
        kept = np.exp(-1.0 / (FINE * speed * lag))
        image = lfilter([1.0 - kept], [1.0, -kept], image[:, ::-1], axis=1)[:, ::-1]
    return COLD + (HOT - COLD) * image


def counts_at(fine, shift_px):
    """Counts (HEIGHT, WIDTH) of a drawing that has moved on, by whole parts of pixels."""
    moved = np.roll(fine, round(FINE * shift_px), axis=1)
    return moved.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3))


def corners_at(shift_px):
    """Corners (4, 2) of the marker."""
    c, s = np.cos(TURN), np.sin(TURN)
    square = 0.5 * SIDE * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return square @ np.array([[c, s], [-s, c]]) + START + [shift_px, 0.0]


def view_of(fine, speed):
    velocity = np.tile([float(speed), 0.0], (4, 1))
    return MovingMarker(MARKER, counts_at(fine, 0.0), corners_at(0.0), velocity, np.zeros((1, 2, 16)))


@pytest.mark.parametrize('speed', [150, 280])
@pytest.mark.parametrize('lag', [0.005, 0.007, 0.010, 0.014])
def test_a_view_without_noise_shows_its_lag(decoder, lag, speed):
    # Six Gaussians stand for an exponential: up to 1.2 % in tails of 0.7 to 6 px.
    assert lag_of_view(view_of(drawing(speed, lag), speed), decoder, BLUR).lag == pytest.approx(lag, rel=0.015)


@pytest.mark.parametrize(('exposure', 'blur'), [(0.010, BLUR), (0.0, 0.46), (0.0, 0.86), (0.005, 1.2)])
def test_blur_that_is_symmetrical_is_no_lag(decoder, exposure, blur):
    """The blur that fits begin with is 0.66 px."""
    view = view_of(drawing(200, 0.010, exposure, blur), 200)
    # As above, and an exposure is a box, for which a Gaussian stands.
    assert lag_of_view(view, decoder, BLUR).lag == pytest.approx(0.010, rel=0.04)


def detected(shifts_px, stamps_s=None):
    """Frames with the marker's true corners, which has moved by so much in each."""
    for number, shift in enumerate(shifts_px):
        stamp = number * PERIOD if stamps_s is None else stamps_s[number]
        corners = corners_at(shift)[None]
        rows = rows_from_corners(np.array([MARKER]), corners, np.full((1, 4, 2, 2), np.eye(2)), np.ones(1), CAMERA)
        yield DetectedFrame(round(1e9 * stamp), np.full((HEIGHT, WIDTH), 7000, np.uint16), rows)


def test_velocities_are_those_of_the_corners_in_the_image():
    views = list(moving_markers(detected(100.0 * PERIOD * np.arange(9)), CAMERA, 6))
    assert len(views) == 5
    for view in views:
        # Single precision of the rows.
        assert view.velocity == pytest.approx(np.tile([100.0, 0.0], (4, 1)), abs=0.01)


@pytest.mark.parametrize(
    ('shifts_px', 'stamps_s'),
    [
        # At rest; faster by 30 px/s from frame to frame; to and fro.
        (np.zeros(9), None),
        (0.5 * 30.0 * PERIOD * np.arange(9) ** 2, None),
        (10.0 * np.sin(2.0 * np.arange(9)), None),
        # A shutter event after every fourth frame.
        (100.0 * PERIOD * np.arange(9), PERIOD * (np.arange(9) + 3 * (np.arange(9) // 4))),
    ],
)
def test_motion_that_is_not_known_is_left_out(shifts_px, stamps_s):
    assert list(moving_markers(detected(shifts_px, stamps_s), CAMERA, 6)) == []


def test_markers_where_the_image_ends_are_left_out():
    views = list(moving_markers(detected(200.0 * PERIOD * np.arange(30)), CAMERA, 6))
    # To the right of the image; only the fifth and later frames have all corners before them.
    assert 0 < len(views) < 26
    assert all(min(view.counts.shape) > 60 for view in views)


def result_of(lags, speeds, decoder, monkeypatch):
    """The calibration by views that show ``lags`` (N,) [s]."""
    nothing = np.zeros((1, 1), np.uint16), corners_at(0.0)
    views = [MovingMarker(n, *nothing, np.tile([v, 0.0], (4, 1)), np.zeros((1, 2, 16))) for n, v in enumerate(speeds)]
    monkeypatch.setattr(bolometer_lag, 'lag_of_view', lambda view, *_: LagOfView(lags[view.marker_id], 1e-4))
    return calibrate_lag(views, decoder, CAMERA, BLUR)


def test_the_standard_deviation_is_what_answers_scatter_by(decoder, monkeypatch):
    rng, errors = np.random.default_rng(5), []
    for _ in range(100):
        # Strokes of twelve views each err alike, by 1 ms; 5 % are far off.
        lags = 0.010 + np.repeat(rng.normal(0.0, 1e-3, 8), 12) + rng.normal(0.0, 3e-4, 96)
        lags[rng.random(96) < 0.05] = 0.03
        found = result_of(lags, np.full(96, 200.0), decoder, monkeypatch)
        errors.append((found.lag - 0.010) / found.std)
    # Of eight groups it is known to a quarter, and of what the form leaves nothing is in these views.
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.3


@pytest.mark.parametrize(
    ('lag', 'speed', 'words'),
    [
        (0.010, 65.0, 'rows do not move fast enough to show the lag: markers that move evenly by 70 px/s and more'),
        # Half of the usual lag needs twice the speed; what is slower might look like none.
        (0.005, 100.0, 'by 140 px/s and more, as in turns of 28 deg/s, are in 0 frames, and 24'),
    ],
)
def test_slow_motion_is_refused(decoder, monkeypatch, lag, speed, words):
    with pytest.raises(InputError, match=words):
        result_of(np.full(96, lag), np.full(96, speed), decoder, monkeypatch)


def test_views_that_do_not_agree_are_refused(decoder, monkeypatch):
    lags = np.repeat([0.002, 0.02, 0.03, 0.001, 0.015, 0.04, 0.005, 0.025], 12)
    with pytest.raises(InputError, match='views do not agree on the lag'):
        result_of(lags, np.full(96, 150.0), decoder, monkeypatch)


def test_no_lag_is_found_where_one_would_have_shown(decoder, monkeypatch):
    found = result_of(np.full(96, 2e-4), np.linspace(100.0, 500.0, 96), decoder, monkeypatch)
    assert found.lag == 0.0
    # 0.7 px at the speed of the 24th fastest.
    assert found.std == pytest.approx(0.7 / 403.0, rel=0.01)


def recorded(folder, speed, lag, frames, bits=16, seed=0):
    """A bag of a marker that crosses the image to the right again and again, and its map."""
    fine, rng = drawing(speed, lag), np.random.default_rng(seed)
    step, events = round(FINE * speed * PERIOD) / FINE, []
    across = int(120.0 // step)
    for number in range(frames):
        stamp = small_bag.START_NS + round(1e9 * PERIOD * number)
        noisy = counts_at(fine, step * (number % across)) + rng.normal(0.0, 2.0, (HEIGHT, WIDTH))
        message = small_bag.image(stamp, np.rint(noisy).astype(np.uint16))
        if bits == 8:
            gray = np.clip((noisy - COLD) / 3.0 + 20.0, 0.0, 255.0).astype(np.uint8)
            message = small_bag.replaced(message, encoding='mono8', step=WIDTH, data=gray.ravel())
        events += [(stamp, CAMERA_INFO_TOPIC, small_bag.camera_info(stamp, CAMERA)), (stamp, IMAGE_TOPIC, message)]
    save_map(folder / 'map.yaml', small_bag.map_of([MARKER]))
    small_bag.Recording(events).write(folder / 'bag')
    return [
        'calibrate',
        'lag',
        str(folder / 'bag'),
        '--map',
        str(folder / 'map.yaml'),
        '--out',
        str(folder / 'lag.yaml'),
    ]


def test_the_command_writes_the_parameter(tmp_path, capsys):
    # 4.125 px a frame: nine parts of pixels, in which the marker is by turns.
    command = recorded(tmp_path, 33.0 / 8.0 / PERIOD, 0.012, 44)
    assert main(command) == 0
    found = yaml.safe_load((tmp_path / 'lag.yaml').read_text())['/**']['ros__parameters']
    # Three of its standard deviations, of which the form of the blur has most.
    assert found == {'bolometer_lag': pytest.approx(0.012, rel=0.06)}
    assert '+- 0.2' in capsys.readouterr().out
    assert main(command) == 2


@pytest.mark.parametrize(
    ('speed', 'bits', 'words'),
    [(15.0, 16, 'rows do not move fast enough to show the lag'), (120.0, 8, 'pictures of 8 bits')],
)
def test_the_command_refuses(tmp_path, capsys, speed, bits, words):
    assert main(recorded(tmp_path, speed, 0.010, 12, bits)) == 2
    said = capsys.readouterr().err
    assert f'{tmp_path}/bag: {words}' in said
    assert len(said.strip().splitlines()) == 1
    assert not (tmp_path / 'lag.yaml').exists()
