"""The thread that reads a camera: what it does when the camera is gone, silent, unusable or at its end."""

from collections import Counter
import threading
import time

import numpy as np
import pytest
from support.waiting import until

from thermal_fiducial.cameras.capture import Capture
from thermal_fiducial.cameras.choice import longest_silence, make_source
from thermal_fiducial.cameras.source import CapturedFrame, EndOfFramesError
from thermal_fiducial.cameras.teax import ThermalGrabber
from thermal_fiducial.cameras.v4l2 import V4l2Camera
from thermal_fiducial.config import ThermalSourceConfig
from thermal_fiducial.errors import InputError

FRAME = CapturedFrame(5, np.zeros((4, 4), np.uint16))


class Script:
    """A camera whose every opening and reading is written down; at the end it is silent."""

    name = 'a camera'

    def __init__(self, *steps):
        self.events = Counter()
        self._steps = list(steps)
        self.closed = 0
        self.threads = set()

    def _next(self, default):
        self.threads.add(threading.current_thread().name)
        step = self._steps.pop(0) if self._steps else default
        if isinstance(step, Exception):
            raise step
        return step

    def open(self):
        self._next(None)

    def read(self):
        time.sleep(0.002)
        return self._next([])

    def close(self):
        self.closed += 1


def captured(source, done, **options):
    """Frames and states until ``done`` holds for them."""
    frames, states = [], []
    capture = Capture(source, frames.append, states.append, retry=0.01, **options)
    until(lambda: done(frames, states))
    capture.close()
    return capture, frames, states


def test_a_camera_that_is_unplugged_is_connected_again():
    gone = OSError(19, 'No such device')
    source = Script(None, [FRAME], [], gone, gone, gone, None, [FRAME, FRAME])
    capture, frames, states = captured(source, lambda frames, _: len(frames) == 3)
    assert frames == [FRAME] * 3
    assert states == ['', 'a camera: No such device', '']
    assert capture.reconnections == 1
    assert source.closed == 4
    assert source.threads == {'camera'}


def test_a_camera_that_falls_silent_is_opened_anew():
    source = Script(None, [FRAME])
    _, _, states = captured(source, lambda _, states: len(states) == 2, stalled=0.05)
    assert states == ['', 'a camera: no frame for 0.05 s']


@pytest.mark.parametrize(('rate', 'silence'), [(0.0, 3.0), (30.0, 3.0), (0.2, 15.0)])
def test_slow_pictures_are_no_silence(rate, silence):
    """At 0.2 Hz they began again with the first one, every four seconds."""
    assert longest_silence(ThermalSourceConfig(camera='pictures', frame_rate=rate)) == pytest.approx(silence)


@pytest.mark.parametrize(
    ('error', 'state'),
    [
        (InputError('a camera offers no Y16'), 'a camera offers no Y16'),
        (FileNotFoundError(2, 'No such file or directory', 'a camera'), 'a camera: No such file or directory'),
        (OSError('not plugged in'), 'a camera: not plugged in'),
        (KeyError('x'), "a camera: internal error: KeyError: 'x'"),
    ],
)
def test_every_failure_is_reported_and_the_camera_reopened(error, state):
    _, frames, states = captured(Script(error, error, None, [FRAME]), lambda frames, _: frames)
    assert frames == [FRAME]
    assert states == [state, '']


def test_the_end_of_recorded_pictures_is_no_fault_to_mend():
    capture, frames, _ = captured(Script(None, [FRAME], EndOfFramesError()), lambda _, states: len(states) == 2)
    assert (frames, capture.trouble) == ([FRAME], 'all pictures have been shown')
    assert capture.reconnections == 0


@pytest.mark.parametrize(
    ('camera', 'kind'), [('/dev/video3', V4l2Camera), ('teax', ThermalGrabber), ('teax:T42', ThermalGrabber)]
)
def test_the_name_of_a_camera_chooses_the_driver(camera, kind):
    source = make_source(ThermalSourceConfig(camera=camera, image_width=640, image_height=512))
    assert isinstance(source, kind)
    assert camera.partition(':')[2] in source.name


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({}, 'parameter camera'),
        ({'camera': '/home/nobody/pictures'}, 'neither the name of a driver'),
        ({'camera': 'teax', 'image_width': 640}, 'both or none'),
    ],
)
def test_what_names_no_camera_is_refused(changes, reason):
    with pytest.raises(InputError, match=reason):
        make_source(ThermalSourceConfig(**changes))


def test_a_folder_is_a_camera(tmp_path):
    with pytest.raises(InputError, match='no 16-bit'):
        make_source(ThermalSourceConfig(camera=str(tmp_path)))
