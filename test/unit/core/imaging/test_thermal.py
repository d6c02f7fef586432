"""Cleaning of raw frames: rows, flags, bad pixels, frozen and shutter frames, the 8-bit view."""

import cv2
import numpy as np
import pytest
from support.opencv import draw_marker

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.eight_bit_view import EightBitView
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner, FROZEN, REPEATED_STAMP, SETTLING, SHUTTER
from thermal_fiducial.errors import InputError

PERIOD_NS = 33_333_333
NOISE = 1.3  # counts: NETD 50 mK at 0.04 K a count


def soft_step(x):
    """An edge at 0 through a lens with a point spread of 0.6 px."""
    return 0.5 * (1.0 + np.tanh(0.85 * x / 0.6))


def scene(shift=0.0, contrast=150.0, shape=(512, 640)):
    """Warm squares on a colder wall, edges as soft as a lens makes them, moved to the right by ``shift`` px."""
    rows, columns = np.arange(shape[0], dtype=float)[:, None], np.arange(shape[1], dtype=float)

    def box(u0, v0, side):
        across = soft_step(columns - shift - u0) - soft_step(columns - shift - u0 - side)
        return across * (soft_step(rows - v0) - soft_step(rows - v0 - side))

    return (
        7000.0 + 0.05 * rows + contrast * (box(150.3, 120.6, 60.0) + box(330.7, 260.2, 45.0) + box(60.4, 350.1, 30.0))
    )


def noisy(image, rng, sigma=NOISE):
    # In single precision, which takes a third of the time.
    noise = np.float32(sigma) * rng.standard_normal(image.shape, dtype=np.float32)
    return (image + noise).round().clip(0, 16383).astype(np.uint16)


class Camera:
    """Feeds a cleaner with frames, a period apart."""

    def __init__(self, bad_pixels=None, **config):
        self.cleaner = FrameCleaner(Tau2CameraConfig(**config), bad_pixels)
        self.stamp_ns = 1_700_000_000_000_000_000

    def __call__(self, counts, periods=1):
        self.stamp_ns += periods * PERIOD_NS
        return self.cleaner.process(self.stamp_ns, counts)


def test_frames_that_are_turned_without_a_copy_are_cleaned_too():
    """Of a camera that is mounted upright: numpy's rot90 leaves the pixels where they are in memory."""
    frame = noisy(scene(), np.random.default_rng(0))
    frame[100, 50] = 12_000
    column, row = np.argwhere(np.rot90(frame) == 12_000)[0][::-1]
    counts = Camera(np.array([[column, row]]))(np.rot90(frame)).counts
    assert counts.max() < 8_000


def test_a_clean_frame_passes_untouched():
    frame = noisy(scene(), np.random.default_rng(0))
    result = Camera()(frame)
    assert result.reason == ''
    assert np.array_equal(result.counts, frame)
    assert not np.shares_memory(result.counts, frame)


@pytest.mark.parametrize('listed', [np.array([[1.5, 2.5]]), np.zeros((2, 3), int), np.array([1, 2]), [['a', 'b']]])
def test_what_is_no_list_of_bad_pixels_is_refused(listed):
    """Fractions were cut off, and six numbers were three pixels."""
    with pytest.raises(InputError, match=r'bad pixels are an array of .* of shape .*, not integers \(N, 2\)'):
        Camera(bad_pixels=listed)


def test_every_frame_says_that_a_listed_bad_pixel_is_outside():
    """Of a list for another camera."""
    camera = Camera(bad_pixels=np.array([[600, 500]]))
    camera(noisy(scene(), np.random.default_rng(0)))
    small = noisy(scene(shape=(256, 320)), np.random.default_rng(1))
    for _ in range(3):
        with pytest.raises(InputError, match='bad pixel 600 500 lies outside the 320x256 frame'):
            camera(small)


def test_8_bit_frames_become_counts():
    frame = (noisy(scene(), np.random.default_rng(0)) // 64).astype(np.uint8)
    result = Camera()(frame)
    assert result.counts.dtype == np.uint16
    assert np.array_equal(result.counts, frame)


def test_flags_above_14_bits_are_masked():
    frame = noisy(scene(), np.random.default_rng(0))
    flagged = frame | np.uint16(0x8000)
    flagged[::7] |= 0x4000
    assert np.array_equal(Camera()(flagged).counts, frame)
    assert np.array_equal(Camera(bits=16)(flagged).counts, flagged)


def test_counts_that_carry_beyond_14_bits_are_no_flags():
    """Kelvin in hundredths: 295 K, and markers of 335 K, beyond 2^15. Masked, these would be the coldest."""
    camera = Camera()
    for seed in range(3):
        counts = noisy(scene(contrast=4000.0), np.random.default_rng(seed), 5.0) + np.uint16(22500)
        assert counts.min() < 1 << 15 < counts.max()
        assert np.array_equal(camera(counts).counts, counts)
    # and from then on, where none passes a multiple of 2^14
    cold = noisy(scene(), np.random.default_rng(3)) + np.uint16(22500)
    assert np.array_equal(camera(cold).counts, cold)


def test_one_garbled_frame_does_not_end_the_masking_of_flags():
    camera, rng = Camera(), np.random.default_rng(5)
    camera(rng.integers(0, 1 << 16, (512, 640)).astype(np.uint16))
    frame = noisy(scene(), rng)
    flagged = frame | rng.integers(0, 4, frame.shape).astype(np.uint16) << np.uint16(14)
    assert np.array_equal(camera(flagged).counts, frame)


@pytest.mark.parametrize(('shift', 'largest'), [(2, 1 << 14), (8, 1 << 8)])
def test_counts_that_a_driver_shifted_up_are_shifted_back(shift, largest):
    """14 bits to fill 16, and 8 bits sent as mono16: masked like flags, the upper ones would wrap."""
    counts = np.random.default_rng(4).integers(0, largest, (512, 640)).astype(np.uint16)
    assert np.array_equal(Camera()(counts << np.uint16(shift)).counts, counts)


def test_a_shift_stays_while_nothing_is_hot():
    """Counts below 4096 fit into 14 bits as they are sent."""
    camera, rng = Camera(), np.random.default_rng(6)
    for hot in (1000, 0, 1000, 0):
        counts = noisy(scene(), rng) - np.uint16(3500)
        counts[:64] += np.uint16(hot)
        assert np.array_equal(camera(counts << np.uint16(2)).counts, counts)


def test_an_empty_frame_says_nothing_of_the_shift():
    """A driver sends zeros now and then; the scene has cooled below 4096 counts since."""
    camera, rng = Camera(), np.random.default_rng(6)
    hot = noisy(scene(), rng)
    camera(hot << np.uint16(2))
    camera(np.zeros_like(hot))
    cold = hot - np.uint16(3500)
    assert np.array_equal(camera(cold << np.uint16(2)).counts, cold)


@pytest.mark.parametrize('rows', [1, 2])
@pytest.mark.parametrize('top', [False, True])
def test_telemetry_rows_are_cut_from_either_side(rows, top):
    rng = np.random.default_rng(1)
    camera = Camera()
    for _ in range(3):
        frame = noisy(scene(), rng)
        telemetry = rng.integers(0, 1 << 14, (rows, 640)).astype(np.uint16)
        telemetry[:, 200:] = 0
        result = camera(np.vstack([telemetry, frame] if top else [frame, telemetry]))
        assert np.array_equal(result.counts, frame)


def test_frames_of_other_heights_are_left_whole():
    frame = noisy(scene(shape=(300, 400)), np.random.default_rng(1))
    assert Camera()(frame).counts.shape == (300, 400)


@pytest.mark.parametrize(
    'frame',
    [
        np.zeros((512, 640, 3), np.uint16),
        np.zeros((512, 640), np.float32),
        np.zeros((8, 640), np.uint16),
        np.zeros(9, 'u1'),
    ],
)
def test_what_is_no_frame_is_refused(frame):
    with pytest.raises(InputError):
        Camera()(frame)


# --- frozen frames -------------------------------------------------------------------------------------


def test_repeated_counts_are_frozen_and_the_first_frame_after_a_freeze_settles():
    rng = np.random.default_rng(2)
    camera = Camera()
    last = noisy(scene(), rng)
    assert camera(last).reason == ''
    assert [camera(last.copy()).reason for _ in range(12)] == [FROZEN] * 12
    assert camera(noisy(scene(20.0), rng)).reason == SETTLING
    assert camera(noisy(scene(21.0), rng)).reason == ''


def test_a_frozen_frame_with_living_telemetry_is_frozen():
    rng = np.random.default_rng(3)
    camera = Camera()
    frame = noisy(scene(), rng)

    def with_telemetry():
        return np.vstack([frame, rng.integers(0, 9000, (1, 640)).astype(np.uint16)])

    assert camera(with_telemetry()).reason == ''
    assert camera(with_telemetry()).reason == FROZEN


@pytest.mark.parametrize('buffers', [2, 4])
def test_buffers_sent_in_turn_are_frozen(buffers):
    rng = np.random.default_rng(4)
    camera = Camera()
    frames = [noisy(scene(k), rng) for k in range(buffers)]
    assert [camera(frames[i % buffers]).reason for i in range(3 * buffers)] == [''] * buffers + [FROZEN] * 2 * buffers


def test_a_frame_torn_between_old_and_new_is_withheld():
    rng = np.random.default_rng(5)
    camera = Camera()
    old, new = noisy(scene(), rng), noisy(scene(5.0), rng)
    assert camera(old).reason == ''
    assert camera(np.vstack([new[:256], old[256:]])).reason == FROZEN


def test_a_driver_that_sends_each_frame_twice_keeps_half_of_them():
    rng = np.random.default_rng(6)
    camera = Camera()
    reasons = []
    for k in range(6):
        frame = noisy(scene(k), rng)
        reasons += [camera(frame).reason, camera(frame).reason]
    assert reasons == ['', FROZEN] * 6


@pytest.mark.parametrize('sigma', [0.15, 1.3])
def test_a_robot_that_stands_still_is_not_frozen(sigma):
    """Also in the low-gain mode, where the noise is a fraction of a count."""
    rng = np.random.default_rng(7)
    camera = Camera()
    assert all(camera(noisy(scene(), rng, sigma)).reason == '' for _ in range(20))


def test_a_clipped_sky_is_not_frozen():
    rng = np.random.default_rng(8)
    camera = Camera()
    for _ in range(4):
        frame = (noisy(scene(), rng) // 64).astype(np.uint8)
        frame[:250] = 0
        assert camera(frame).reason == ''


@pytest.mark.parametrize('sky', [0, 16383])
def test_dead_pixels_before_a_clipped_sky_do_not_freeze_it(sky):
    """Two pixels of a thousand, as an array may have, are in more than a quarter of all rows; so is a dead column."""
    rng, camera = np.random.default_rng(9), Camera()
    dead = rng.random((350, 640)) < 0.002
    dead[:, 200] = True
    stuck = rng.integers(2000, 9000, dead.sum())
    for k in range(4):
        frame = noisy(scene(k), rng)
        frame[:350] = sky
        frame[:350][dead] = stuck
        assert camera(frame).reason == ''
    # What is not clipped still shows a repeated frame, and one that is torn.
    assert camera(frame).reason == FROZEN
    torn = frame.copy()
    torn[350:430] = noisy(scene(5.0), rng)[350:430]
    assert camera(torn).reason == FROZEN


@pytest.mark.parametrize('garbled', [0x8000, 0xFFFF])
def test_a_garbled_first_frame_does_not_decide_on_the_shift(garbled):
    """The memory of a driver before its first frame, say; believed, the shift of 15 would leave two counts."""
    camera, rng = Camera(), np.random.default_rng(6)
    camera(np.full((512, 640), garbled, np.uint16))
    later = [(counts, camera(counts << np.uint16(2))) for counts in (noisy(scene(), rng) for _ in range(6))]
    assert all(np.array_equal(result.counts, counts) for counts, result in later[-2:])


def test_one_garbled_frame_does_not_end_a_shift():
    """The scene has cooled below 4096 counts since the shift has shown."""
    camera, rng = Camera(), np.random.default_rng(6)
    hot = noisy(scene(), rng)
    camera(hot << np.uint16(2))
    camera(rng.integers(0, 1 << 16, hot.shape).astype(np.uint16))
    cold = hot - np.uint16(3500)
    assert np.array_equal(camera(cold << np.uint16(2)).counts, cold)


# --- shutter -------------------------------------------------------------------------------------------


def shutter(rng):
    """The shutter's inside: shading, fixed pattern and noise, no scene."""
    rows, columns = np.mgrid[:512, :640]
    shading = 12.0 * ((rows - 256) / 256) ** 2 + 6.0 * columns / 640
    pattern = np.random.default_rng(99).normal(0.0, 2.0, (512, 640))
    return noisy(7100.0 + shading + pattern, rng)


@pytest.mark.parametrize('contrast', [25.0, 150.0, 1500.0])
def test_the_shutter_is_recognised(contrast):
    rng = np.random.default_rng(10)
    camera = Camera()
    assert all(camera(noisy(scene(k, contrast), rng)).reason == '' for k in range(8))
    assert [camera(shutter(rng)).reason for _ in range(10)] == [SHUTTER] * 10
    assert camera(noisy(scene(9.0, contrast), rng)).reason == SETTLING
    assert all(camera(noisy(scene(10.0 + k, contrast), rng)).reason == '' for k in range(5))


def test_a_flat_scene_is_not_withheld_for_long():
    rng = np.random.default_rng(11)
    camera = Camera()
    for k in range(5):
        camera(noisy(scene(k), rng))
    reasons = [camera(shutter(rng)).reason for _ in range(60)]
    assert reasons[:30] == [SHUTTER] * 30
    assert reasons[48:] == [''] * 12


def test_a_hot_object_that_leaves_does_not_hide_cooler_markers():
    rng = np.random.default_rng(12)
    camera = Camera()
    hot = scene(contrast=25.0)
    hot[400:500, 540:640] += 2500.0
    assert all(camera(noisy(hot, rng)).reason == '' for _ in range(5))
    assert all(camera(noisy(scene(contrast=25.0), rng)).reason == '' for _ in range(5))


def test_the_frame_after_a_garbled_one_is_no_shutter_although_its_scene_is_faint():
    """Beside a garbled frame all structure has gone; four times the noise is left of the markers."""
    rng = np.random.default_rng(13)
    faint = scene(contrast=4.0 * NOISE)
    for before in (0, 1, 8):
        camera = Camera()
        for _ in range(before):
            camera(noisy(faint, rng))
        camera(rng.integers(0, 1 << 14, faint.shape).astype(np.uint16))
        assert all(camera(noisy(faint, rng)).reason == '' for _ in range(5))


# --- stamps --------------------------------------------------------------------------------------------


def test_a_late_frame_passes_once_and_a_restart_is_taken():
    rng = np.random.default_rng(13)
    camera = Camera()
    for _ in range(5):
        camera(noisy(scene(), rng), periods=2)
    assert camera(noisy(scene(), rng), periods=0).reason == REPEATED_STAMP
    late = camera(noisy(scene(), rng), periods=-3)
    assert (late.reason, late.late) == ('', True)
    assert camera(noisy(scene(), rng), periods=0).reason == REPEATED_STAMP
    # The newest one so far, then one after it.
    assert camera(noisy(scene(), rng), periods=3).reason == REPEATED_STAMP
    on_time = camera(noisy(scene(), rng), periods=1)
    assert (on_time.reason, on_time.late) == ('', False)
    back = camera(noisy(scene(), rng), periods=-900)
    assert (back.reason, back.late) == ('', False)
    assert camera(noisy(scene(), rng), periods=1).reason == ''


def test_neighbours_that_swap_places_lose_nothing():
    rng = np.random.default_rng(16)
    camera = Camera()
    frames = [camera(noisy(scene(k), rng), periods=3 if k % 2 == 0 else -1) for k in range(20)]
    assert [frame.reason for frame in frames] == [''] * 20
    assert sum(frame.late for frame in frames) == 10


@pytest.mark.parametrize('late_at', [1, 8, 9, 10])
def test_a_stop_is_one_whenever_a_frame_from_before_it_arrives(late_at):
    """Ten repeated frames, then new ones; a frame from before them comes in late."""
    rng = np.random.default_rng(17)
    camera = Camera()
    camera(noisy(scene(), rng))
    last = noisy(scene(1.0), rng)
    camera(last, periods=2)
    reasons, late = [], None
    for k in range(14):
        reasons.append(camera(last if k < 10 else noisy(scene(20.0 + k), rng)).reason)
        if k == late_at:
            late = camera(noisy(scene(0.5), rng), periods=-(k + 2)).reason
            camera.stamp_ns += (k + 2) * PERIOD_NS
    assert late == ''
    assert reasons == [FROZEN] * 10 + [SETTLING] + [''] * 3


def test_the_first_frame_after_a_stop_settles_even_when_the_second_overtakes_it():
    rng = np.random.default_rng(18)
    camera = Camera()
    last = noisy(scene(), rng)
    camera(last)
    assert [camera(last).reason for _ in range(8)] == [FROZEN] * 8
    assert camera(noisy(scene(20.0), rng), periods=2).reason == SETTLING
    assert camera(noisy(scene(19.0), rng), periods=-1).reason == SETTLING
    assert camera(noisy(scene(21.0), rng), periods=2).reason == ''


def test_late_frames_show_bad_pixels_too():
    rng = np.random.default_rng(19)
    camera = Camera()
    for k in range(60):
        frame = noisy(scene(k, shape=(256, 320)), rng)
        frame[40, 100] = 16383
        result = camera(frame, periods=3 if k % 2 == 0 else -1)
    assert camera.cleaner.bad_pixels.tolist() == [[100, 40]]
    assert abs(int(result.counts[40, 100]) - int(result.counts[40, 101])) < 10 * NOISE


# --- bad pixels ----------------------------------------------------------------------------------------


def test_listed_pixels_are_filled_from_the_first_frame_on():
    rng = np.random.default_rng(14)
    frame = noisy(scene(), rng)
    broken = frame.copy()
    broken[40, 100], broken[0, 0], broken[511, 639], broken[60, 300:302] = 0, 16383, 0, 16383
    listed = np.array([[100, 40], [0, 0], [639, 511], [300, 60], [301, 60]])
    clean = Camera(listed)(broken).counts
    difference = clean.astype(int) - frame
    assert np.count_nonzero(difference) <= len(listed)
    # On a flat wall a neighbour or a mean of two differs by no more than noise.
    assert np.abs(difference).max() < 6 * NOISE


def test_a_listed_pixel_outside_the_frame_is_refused():
    with pytest.raises(InputError, match='640 10'):
        Camera(np.array([[640, 10]]))(noisy(scene(), np.random.default_rng(0)))


def test_bad_pixels_are_found_and_nothing_else():
    """Dead, stuck within the scene's range, and pairs of the same and of opposite polarity; in a scene that moves."""
    rng = np.random.default_rng(15)
    height, width = 320, 400
    bad = rng.choice(height * width, 150, replace=False)
    stuck = np.where(rng.random(150) < 0.5, np.where(rng.random(150) < 0.5, 0, 16383), rng.integers(6800, 7400, 150))
    bad, stuck = np.append(bad, [700, 701, 9000, 9001]), np.append(stuck, [16383, 16383, 16383, 100])
    camera = Camera()
    for k in range(170):
        frame = noisy(scene(60.0 * np.sin(0.05 * k), shape=(height, width)), rng)
        frame.reshape(-1)[bad] = stuck
        result = camera(frame)
    found = {int(row * width + column) for column, row in camera.cleaner.bad_pixels}
    assert found <= set(bad.tolist())
    visible = np.abs(stuck - 7008.0) > 60.0  # the others do not stand out of this wall, so they do no harm either
    assert len(found & set(bad[visible].tolist())) >= 0.98 * visible.sum()
    assert {700, 701, 9000, 9001} <= found
    assert np.abs(result.counts.reshape(-1)[bad[visible]].astype(int) - 7008).max() < 200


@pytest.mark.parametrize('contrast', [25.0, 400.0])
@pytest.mark.parametrize('polarity', [1, -1])
def test_markers_are_never_taken_for_bad_pixels(contrast, polarity):
    """Neither their corners nor bits of two pixels, while the robot stands still for ten seconds."""
    rng = np.random.default_rng(16)
    bits = draw_marker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 6)
    image = np.full((128, 160), 0.0)
    for scale, at in ((2.0, (20, 20)), (3.3, (20, 60)), (8.0, (60, 20))):
        fine = cv2.resize(bits, None, fx=8, fy=8, interpolation=cv2.INTER_NEAREST).astype(np.float64) / 255.0
        side = round(6 * scale)
        image[at[0] : at[0] + side, at[1] : at[1] + side] = cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA)
    image = 7000.0 + polarity * contrast * cv2.GaussianBlur(image, None, 0.5)
    camera = Camera()
    for _ in range(300):
        frame = noisy(image, rng)
        assert np.array_equal(camera(frame).counts, frame)
    assert len(camera.cleaner.bad_pixels) == 0


def test_corners_of_clipped_markers_are_not_stuck():
    """A hovering robot, a camera with automatic gain that clips the warm parts at 255."""
    rng = np.random.default_rng(21)
    camera = Camera()
    for _ in range(200):
        image = scene(0.7 * rng.standard_normal(), 250.0, (512, 200))
        frame = ((image + rng.normal(0.0, NOISE, image.shape)) - 6980.0).clip(0, 200).round() * 1.275
        assert camera(frame.astype(np.uint8)).reason == ''
    assert len(camera.cleaner.bad_pixels) == 0


def test_filling_keeps_an_edge_in_its_place():
    """Bad pixels on a slanted edge: the line fitted to it moves by far less than a hundredth of a pixel."""
    rng = np.random.default_rng(17)
    rows, columns = np.mgrid[:128, :160].astype(np.float64)
    edge = 80.3 + 0.25 * (rows - 64)
    image = 7000.0 + 200.0 * soft_step(columns - edge)
    on_edge = np.array([(round(80.3 + 0.25 * (row - 64)), row) for row in range(10, 120, 11)])
    shifts = []
    for _ in range(40):
        frame = noisy(image, rng)
        broken = frame.copy()
        broken[on_edge[:, 1], on_edge[:, 0]] = 16383
        shifts.append(_edge_offset(Camera(on_edge)(broken).counts, edge) - _edge_offset(frame, edge))
    # One pixel in eleven was lost at the very edge; what it carried is interpolated along the edge.
    assert abs(np.mean(shifts)) < 0.01
    assert np.std(shifts) < 0.01


def _edge_offset(counts, edge):
    """Mean displacement of the edge [px], from the area under its profile in each row."""
    window = slice(60, 104)
    area = ((counts[20:110, window].astype(np.float64) - 7000.0) / 200.0).sum(axis=1)
    return float(np.mean((window.stop - 0.5 - area) - edge[20:110, 0]))


# --- 8-bit view ----------------------------------------------------------------------------------------


def test_the_view_spans_the_scene():
    picture = EightBitView(Tau2CameraConfig())(noisy(scene(), np.random.default_rng(18)))
    assert picture.dtype == np.uint8
    assert picture.shape == (512, 640)
    assert picture[150, 180] > 200 > 60 > picture[300, 550]


@pytest.mark.parametrize('excess', [500.0, 3000.0])
def test_a_hot_object_does_not_make_the_view_pump(excess):
    rng = np.random.default_rng(19)
    view = EightBitView(Tau2CameraConfig())
    cool = scene(shape=(256, 320))
    hot = cool.copy()
    hot[200:, 250:] += excess
    marker = (150, 180)
    before = [int(view(noisy(cool, rng))[marker]) for _ in range(10)]
    during = [int(view(noisy(hot, rng))[marker]) for _ in range(120)]
    after = [int(view(noisy(cool, rng))[marker]) for _ in range(120)]
    # A twentieth of the span at either end: a tenth of 255 grey levels, and what noise adds.
    assert np.abs(np.diff(before + during + after)).max() <= 26 + 8
    # But it does follow, within seconds.
    assert during[-1] < 0.6 * before[-1]
    assert after[-1] > 0.85 * before[-1]


def test_the_view_jumps_to_a_scene_that_is_off_its_scale():
    rng = np.random.default_rng(22)
    view = EightBitView(Tau2CameraConfig())
    small = scene(shape=(256, 320))
    first = view(noisy(small, rng))
    assert np.abs(view(noisy(small + 2000.0, rng)).astype(int) - first).mean() < 6


def test_a_flat_scene_is_not_stretched_to_noise():
    picture = EightBitView(Tau2CameraConfig())(noisy(np.full((512, 640), 7000.0), np.random.default_rng(20)))
    assert picture.std() < 12.0  # 1.3 counts of 40


@pytest.mark.parametrize('shape', [(16, 16), (16, 17), (17, 16), (33, 641), (512, 641), (19, 23)])
def test_frames_of_any_size_from_16_pixels_pass(shape):
    rng = np.random.default_rng(23)
    camera = Camera()
    for _ in range(20):
        frame = noisy(scene(shape=(512, 700))[: shape[0], : shape[1]], rng)
        assert np.array_equal(camera(frame).counts, frame)
