import struct
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.images import (
    COUNTS_SUFFIXES,
    header_stamp_ns,
    image_to_array,
    PICTURE_SUFFIXES,
    pictures_in,
    read_gray,
    stamp_to_ns,
)

PIXELS = np.array([[1, 2, 300], [4, 16383, 6]], np.uint16)


def message(data, encoding='mono16', step=6, big=0, width=3, height=2):
    return SimpleNamespace(height=height, width=width, encoding=encoding, step=step, is_bigendian=big, data=data)


@pytest.mark.parametrize('big', [0, 1])
@pytest.mark.parametrize('padding', [0, 1, 5])
@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
def test_any_byte_order_and_row_step(big, padding, encoding):
    rows = PIXELS.astype('>u2' if big else '<u2').view(np.uint8).reshape(2, 6)
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=99).ravel()
    pixels = image_to_array(message(data, encoding, 6 + padding, big))
    np.testing.assert_array_equal(pixels, PIXELS)
    assert pixels.dtype == np.uint16


@pytest.mark.parametrize('big', [0, 1])
def test_bytes_in_another_order_than_is_announced_are_named(big):
    """Markers were found in such images, and poses were 50 mm off."""
    rng = np.random.default_rng(1)
    scene = 7500.0 + 300.0 * np.linspace(0.0, 1.0, 640) + rng.normal(0.0, 4.0, (512, 640))
    low, order = scene - 7450.0, '>u2' if big else '<u2'
    # Counts of 14 bits as they are and left-aligned, few of them, 8 bits left-aligned, and noise alone.
    for counts in (scene, 4.0 * scene, low, 256.0 * np.rint(low / 2.0), rng.uniform(0.0, 65535.0, scene.shape)):
        pixels = np.rint(counts).astype(np.uint16)
        image = message(pixels.astype(order).tobytes(), 'mono16', 1280, big, 640, 512)
        np.testing.assert_array_equal(image_to_array(image), pixels)
    image = message(np.rint(scene).astype(order).tobytes(), 'mono16', 1280, 1 - big, 640, 512)
    with pytest.raises(InputError, match=f'swapped bytes: its driver must set is_bigendian to {big}'):
        image_to_array(image)


def test_eight_bits_and_a_last_row_without_padding():
    pixels = image_to_array(message(np.arange(8, dtype=np.uint8), 'mono8', 5))
    np.testing.assert_array_equal(pixels, [[0, 1, 2], [5, 6, 7]])
    assert pixels.dtype == np.uint8


@pytest.mark.parametrize(
    'broken',
    [
        message(np.zeros(11, np.uint8)),
        message(np.zeros(12, np.uint8), step=5),
        message(np.zeros(12, np.uint8), width=0),
        message(np.zeros(12, np.uint8), height=0),
        message(np.zeros(36, np.uint8), encoding='rgb8'),
    ],
)
def test_inconsistent_images_are_refused(broken):
    with pytest.raises(InputError, match='image'):
        image_to_array(broken)


def compressed(data, form='mono16; png compressed '):
    return SimpleNamespace(format=form, data=np.frombuffer(data, np.uint8))


@pytest.mark.parametrize('suffix', ['.png', '.tiff'])
@pytest.mark.parametrize('pixels', [PIXELS, PIXELS.astype(np.uint8)])
def test_lossless_compression_gives_the_same_pixels(suffix, pixels):
    result = image_to_array(compressed(cv2.imencode(suffix, pixels)[1].tobytes()))
    np.testing.assert_array_equal(result, pixels)
    assert result.dtype == pixels.dtype


@pytest.mark.parametrize(
    ('data', 'words'),
    [
        (cv2.imencode('.jpg', PIXELS.astype(np.uint8))[1].tobytes(), 'only PNG'),
        (b'', 'only PNG'),
        (cv2.imencode('.png', PIXELS)[1].tobytes()[:40], 'cannot be decoded'),
        (cv2.imencode('.png', np.zeros((2, 3, 3), np.uint8))[1].tobytes(), 'not grey'),
        (cv2.imencode('.tiff', PIXELS.astype(np.float32))[1].tobytes(), 'not grey'),
    ],
)
def test_compressed_images_that_are_refused(data, words):
    with pytest.raises(InputError, match=words):
        image_to_array(compressed(data))


def test_stamps_are_exact():
    assert stamp_to_ns(SimpleNamespace(sec=1_700_000_000, nanosec=123_456_789)) == 1_700_000_000_123_456_789
    cdr = struct.pack('<BBHiI', 0, 1, 0, 1_700_000_000, 123_456_789)
    assert header_stamp_ns(cdr) == 1_700_000_000_123_456_789
    for short in (b'', cdr[:5], cdr[:-1]):
        with pytest.raises(InputError, match=f'{len(short)} bytes, which has no stamp'):
            header_stamp_ns(short)


def test_a_compressed_image_whose_chunk_promises_gigabytes_is_refused_at_once():
    """As a cable that flips a bit makes one: the decoder took 2 GB and 1.7 s for it."""
    whole = cv2.imencode('.png', PIXELS)[1].tobytes()
    # Of the chunk behind the header the length: the most significant of its bits.
    broken = whole[:33] + b'\x80' + whole[34:]
    begin = time.process_time()
    with pytest.raises(InputError, match='cannot be decoded'):
        image_to_array(compressed(broken))
    # A tenth of what it took.
    assert time.process_time() - begin < 0.17
    np.testing.assert_array_equal(image_to_array(compressed(whole)), PIXELS)


def test_a_broken_compressed_image_writes_nothing_past_the_log(capfd):
    """libpng wrote a line a frame."""
    whole = bytearray(cv2.imencode('.png', PIXELS)[1].tobytes())
    # In the check sum of the first chunk of pixels.
    whole[-14] ^= 0xFF
    with pytest.raises(InputError, match='cannot be decoded'):
        image_to_array(compressed(bytes(whole)))
    assert capfd.readouterr() == ('', '')


def test_pixels_of_a_photo_stay_where_the_sensor_has_them(tmp_path):
    """A camera that hangs upside down marks its photos so (EXIF); its calibration is that of the sensor."""
    picture = np.random.default_rng(0).integers(0, 255, (32, 48)).astype(np.uint8)
    data = cv2.imencode('.jpg', picture)[1].tobytes()
    turned_by_half = struct.pack('<6s4sIHHHIII', b'Exif', b'II*\0', 8, 1, 0x0112, 3, 1, 3, 0)
    marked = data[:2] + struct.pack('>2sH', b'\xff\xe1', 2 + len(turned_by_half)) + turned_by_half + data[2:]
    for name, content in (('plain.jpg', data), ('marked.jpg', marked)):
        (tmp_path / name).write_bytes(content)
    np.testing.assert_array_equal(read_gray(tmp_path / 'marked.jpg'), read_gray(tmp_path / 'plain.jpg'))


@pytest.mark.parametrize('suffix', PICTURE_SUFFIXES)
@pytest.mark.parametrize('kind', [np.uint8, np.uint16])
def test_pictures_of_a_folder_become_gray(tmp_path, suffix, kind):
    """Colours of equal parts are the gray that they show; 16 bits stay where the format has them."""
    keeps = suffix in COUNTS_SUFFIXES
    gray = np.full((32, 48), 200, kind)
    colour = gray if suffix == '.pgm' else np.dstack([gray] * 3)
    cv2.imwrite(str(tmp_path / f'b{suffix.upper()}'), colour)
    (tmp_path / 'a.txt').write_text('no picture')
    (path,) = pictures_in(tmp_path)
    pixels = read_gray(path)
    np.testing.assert_array_equal(pixels, gray)
    assert pixels.dtype == (kind if keeps else np.uint8)
    assert bool(pictures_in(tmp_path, COUNTS_SUFFIXES)) == keeps
