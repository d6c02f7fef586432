"""Recorded pictures in the place of a camera."""

import os
from pathlib import Path
import struct
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from support.empty_picture import png
from support.waiting import PATIENCE_S

from thermal_fiducial.cameras.pictures import Pictures
from thermal_fiducial.cameras.source import EndOfFramesError
from thermal_fiducial.errors import InputError

PICTURES = [np.random.default_rng(k).integers(0, 1 << 14, (48, 64), dtype=np.uint16) for k in range(3)]


def shown(source, count):
    """That many pictures, however long each is waited for."""
    frames = []
    while len(frames) < count:
        frames += source.read()
    return frames


@pytest.fixture
def folder(tmp_path):
    for k, suffix in enumerate(('png', 'tiff', 'pgm')):
        cv2.imwrite(str(tmp_path / f'frame_{k:03}.{suffix}'), PICTURES[k])
    (tmp_path / 'notes.txt').write_text('no picture')
    return tmp_path


def test_a_folder_is_shown_in_order_at_its_rate_and_again(folder):
    source = Pictures(str(folder), 50.0)
    source.open()
    start = time.time_ns()
    frames = shown(source, 7)
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.counts, PICTURES[k % 3])
    assert frames[-1].stamp_ns - start >= 0.119e9  # six periods of 20 ms, by another clock
    assert not source.events


def test_it_ends_where_it_may(folder):
    source = Pictures(str(folder), 1000.0, repeat=False)
    source.open()
    shown(source, 3)
    with pytest.raises(EndOfFramesError):
        shown(source, 1)


def test_a_folder_that_is_emptied_ends(folder):
    source = Pictures(str(folder), 1000.0)
    source.open()
    shown(source, 3)
    for path in folder.iterdir():
        path.unlink()
    with pytest.raises(EndOfFramesError):
        shown(source, 4)


def test_a_slow_rate_does_not_hold_the_reader(folder):
    source = Pictures(str(folder), 0.5 / PATIENCE_S)
    source.open()
    shown(source, 1)
    before = time.monotonic()
    assert source.read() == []
    # Half of what it would take to wait for the next one.
    assert time.monotonic() - before < PATIENCE_S


def test_pictures_that_cannot_be_used_are_counted(folder):
    (folder / 'frame_000.png').write_bytes(b'no PNG')
    cv2.imwrite(str(folder / 'frame_003.png'), (PICTURES[0] >> 6).astype(np.uint8))
    source = Pictures(str(folder), 1000.0, repeat=False)
    source.open()
    np.testing.assert_array_equal(shown(source, 1)[0].counts, PICTURES[1])
    shown(source, 1)
    with pytest.raises(EndOfFramesError):
        shown(source, 1)
    assert source.events == {'unusable pictures': 2}


def test_a_stack_of_pictures_in_one_file(tmp_path):
    path = str(tmp_path / 'stack.tif')
    cv2.imwritemulti(path, PICTURES)
    source = Pictures(path, 1000.0, repeat=False)
    source.open()
    for frame, expected in zip(shown(source, 3), PICTURES, strict=True):
        np.testing.assert_array_equal(frame.counts, expected)


@pytest.mark.parametrize('suffix', ['png', 'PNG', 'pgm', 'tiff'])
def test_a_single_picture(tmp_path, suffix):
    path = str(tmp_path / f'one.{suffix}')
    cv2.imwrite(path, PICTURES[0])
    source = Pictures(path, 1000.0)
    source.open()
    for frame in shown(source, 2):
        np.testing.assert_array_equal(frame.counts, PICTURES[0])
    assert not source.events


def test_a_video_of_16_bits(tmp_path):
    path = str(tmp_path / 'flight.mkv')
    settings = [cv2.VIDEOWRITER_PROP_DEPTH, cv2.CV_16U, cv2.VIDEOWRITER_PROP_IS_COLOR, 0]
    writer = cv2.VideoWriter(path, cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*'FFV1'), 30.0, (64, 48), settings)
    for picture in PICTURES:
        writer.write(picture)
    writer.release()
    if not Path(path).exists():
        pytest.skip(f'OpenCV {cv2.__version__} writes no video of 16 bits')
    source = Pictures(path, 1000.0, repeat=False)
    source.open()
    for frame, expected in zip(shown(source, 3), PICTURES, strict=True):
        np.testing.assert_array_equal(frame.counts, expected)


def test_what_is_no_source_is_refused(tmp_path):
    with pytest.raises(InputError, match='neither the name of a driver'):
        Pictures(str(tmp_path / 'nothing'))
    with pytest.raises(InputError, match='no 16-bit'):
        Pictures(str(tmp_path))
    (tmp_path / 'a.avi').write_bytes(b'no video')
    with pytest.raises(InputError, match='no 16-bit'):
        Pictures(str(tmp_path / 'a.avi'))


def test_pictures_larger_than_any_camera_takes_are_refused_before_they_are_read(tmp_path):
    """65,000 x 65,000 pixels of 16 bits are 8 GB; in a process of its own, as OpenCV reads its limit when loaded."""
    (tmp_path / 'huge.png').write_bytes(png(65_000, 65_000))
    pages = tmp_path / 'huge.tif'
    cv2.imwrite(str(pages), PICTURES[0])
    tiff = pages.read_bytes()
    for tag, side in ((256, 64), (257, 48)):
        tiff = tiff.replace(struct.pack('<HHII', tag, 3, 1, side), struct.pack('<HHII', tag, 3, 1, 65_000))
    pages.write_bytes(tiff)
    program = (
        'import resource, sys, time\n'
        'from thermal_fiducial.cameras.pictures import Pictures\nfrom thermal_fiducial.errors import InputError\n'
        'before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()\n'
        'for path in sys.argv[1:]:\n'
        '    try:\n        Pictures(path)\n    except InputError as error:\n        print(error)\n'
        'print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, time.process_time() - start)\n'
    )
    words = [sys.executable, '-c', program, str(tmp_path), str(pages)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    *lines, figures = done.stdout.splitlines()
    assert lines == [f'camera {path}: no 16-bit grey picture in it' for path in (tmp_path, pages)]
    kilobytes, seconds = map(float, figures.split())
    # As of every other file: see test_hostile_files.
    assert kilobytes < 200 << 10
    assert seconds < 1.0


def test_what_never_ends_is_no_video(tmp_path):
    os.mkfifo(tmp_path / 'pipe.tif')
    with pytest.raises(InputError, match='not a regular file'):
        Pictures(str(tmp_path / 'pipe.tif'))
