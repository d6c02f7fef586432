"""Front end for raw infrared frames: telemetry rows, flag bits, bad pixels, and frames that show no new scene.

The latter are withheld: repeated frames, and frames while the shutter is closed. Shutter behaviour follows the
FLIR Tau 2 user's manual: during a flat-field correction (FFC, under half a second) a digital stream repeats the last
frame, shows the shutter, or pauses, depending on the driver.
"""

from collections import deque
from dataclasses import dataclass
from statistics import median

import cv2
import numpy as np

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.camera_frames import FramePeriod, pixel_noise
from thermal_fiducial.core.geometry.plausibility import require_image
from thermal_fiducial.core.imaging.bad_pixels import BadPixelFiller, BadPixelFinder
from thermal_fiducial.core.measurements import MOST_LATE_NS
from thermal_fiducial.core.stamp_clock import NO_CLOCK, StampClock
from thermal_fiducial.core.types import Counts, Gray, IntArray
from thermal_fiducial.errors import InputError

FROZEN = 'frozen'
SHUTTER = 'FFC'
SETTLING = 'settling after FFC'
REPEATED_STAMP = 'stamp seen before: two publishers, or a driver that sets none?'

# Least shift of counts by drivers that fill 16 bits.
_SHIFTED = 2
# Share (a power of two) of the range of counts by which neighbours differ at most, and the fewest pairs that show a
# carry: flags look alike only between a pixel near nought and one near full scale. After so many frames in a row with
# carries, later frames need not show any: a single frame may be garbled.
_NEARLY, _FEWEST_CARRIES, _FRAMES_WITH_CARRIES = 3, 8, 3
# Frames in a row that must show another shift for it to replace one: a single frame may be garbled.
_FRAMES_WITH_SHIFT = 3
# Rows of an image; a frame with up to MAX_TELEMETRY_ROWS more carries telemetry.
STANDARD_HEIGHTS = (1024, 512, 480, 256, 240, 128, 120)
MAX_TELEMETRY_ROWS = 4


@dataclass(frozen=True, slots=True)
class CleanFrame:
    """A clean frame, or the reason for which it is withheld."""

    #: (height, width) counts without telemetry, flags and bad pixels; None: withheld
    counts: Counts | None
    #: reason in words; empty for a clean frame
    reason: str = ''
    #: whether newer frames came before it
    late: bool = False


def _checked_pixels(listed: IntArray) -> IntArray:
    """``listed`` as integers (N, 2)."""
    pixels = np.asarray(listed)
    if pixels.ndim != 2 or pixels.shape[1] != 2 or pixels.dtype.kind not in 'iu':
        raise InputError(f'bad pixels are an array of {pixels.dtype} of shape {pixels.shape}, not integers (N, 2)')
    return pixels.astype(np.int64)


class FrameCleaner:
    """Cleans raw frames to counts of the scene at their stamp.

    Parameters
    ----------
    config : bits, bad pixels, settling
    bad_pixels : (N, 2) column, row of pixels known to be bad

    Raises
    ------
    InputError
        ``bad_pixels`` of another shape, or not of integers.
    """

    def __init__(self, config: Tau2CameraConfig, bad_pixels: IntArray | None = None) -> None:
        self.config = config
        self._known_bad = _checked_pixels(np.zeros((0, 2), np.int64) if bad_pixels is None else bad_pixels)
        self._telemetry_on_top = 0
        #: shift of the counts; frames in a row that show carries into the bits that are masked otherwise, as those of a
        #: radiometric camera, which fills all 16: after a few of them frames without carries are believed too
        self._shift = self._carrying = 0
        #: frames in a row that show another shift; the first one decides at once
        self._other_shift = _FRAMES_WITH_SHIFT
        self._restart((0, 0))

    def _restart(self, shape: tuple[int, int]) -> None:
        self._filler = BadPixelFiller(self._known_bad, shape) if shape != (0, 0) else None
        self._shape = shape
        self._clock = StampClock()
        self._stamps: set[int] = set()
        self._newest_ns = 0
        self._pauses = Pauses()
        self._freeze = FreezeDetector()
        self._shutter = ShutterDetector()
        self._finder = BadPixelFinder(shape)
        self._found: IntArray = np.zeros((0, 2), np.int64)

    @property
    def repeating(self) -> bool:
        """Whether the driver repeats the camera's frames at present, as it is faster than the camera."""
        return self._pauses.repeating

    @property
    def bad_pixels(self) -> IntArray:
        """Pixels (N, 2), column and row, that are filled in at present."""
        return self._known_bad if self._filler is None else self._filler.pixels

    def process(self, stamp_ns: int, counts: Counts | Gray) -> CleanFrame:
        """Clean the next frame; it may come up to a second later than newer ones.

        Parameters
        ----------
        stamp_ns : its stamp
        counts : (height, width) uint16 or uint8, telemetry rows and flag bits included; left as it is

        Raises
        ------
        InputError
            Not an image of 8 or 16 bit, or one too small to hold a scene; a listed bad pixel outside it.
        """
        image = self._image(counts)
        if image.shape != self._shape or stamp_ns < self._newest_ns - MOST_LATE_NS:
            self._restart(image.shape)
        if stamp_ns in self._stamps:
            return CleanFrame(None, REPEATED_STAMP)
        if self._clock.shows_none(stamp_ns):
            return CleanFrame(None, NO_CLOCK)
        late = stamp_ns < self._newest_ns
        self._newest_ns = max(stamp_ns, self._newest_ns)
        self._stamps = {stamp for stamp in self._stamps if stamp >= self._newest_ns - MOST_LATE_NS} | {stamp_ns}
        frozen = self._freeze.repeats(image, coarse=counts.dtype == np.uint8)
        if frozen or self._shutter.closed(stamp_ns, image):
            self._pauses.add_old(stamp_ns, self.config.settle_frames)
            return CleanFrame(None, FROZEN if frozen else SHUTTER, late)
        if self._pauses.add_new(stamp_ns):
            return CleanFrame(None, SETTLING, late)
        self._replace_bad_pixels(image)
        return CleanFrame(image, late=late)

    def _image(self, counts: Counts | Gray) -> Counts:
        """A copy of the image rows as counts, without telemetry and flag bits."""
        require_image(counts)
        height = counts.shape[0]
        extra = next((height - h for h in STANDARD_HEIGHTS if 0 < height - h <= MAX_TELEMETRY_ROWS), 0)
        image = self._without_telemetry(counts, extra) if extra else counts
        if min(image.shape) < 16:
            raise InputError(f'frame of {image.shape[1]}x{image.shape[0]} pixels is too small')
        return self._without_flags(image)

    def _without_flags(self, counts: Counts | Gray) -> Counts:
        """A copy of the counts without the shift of the driver and without flag bits."""
        sample, bits = counts[:: FreezeDetector.ROW_STEP], self.config.bits
        # Some drivers shift counts up; without a shift, noise sets the lowest bits of some pixels. A shift shows where
        # counts need more bits than they have, and stays; a frame of nothing but zeros has no lowest bit.
        used = int(np.bitwise_or.reduce(sample, axis=None))
        lowest = (used & -used).bit_length() - 1
        if 0 <= lowest < _SHIFTED or used >> bits:
            # A frame that stands alone with another shift is not believed.
            shown = lowest if lowest >= _SHIFTED else 0
            self._other_shift = self._other_shift + 1 if shown != self._shift else 0
            if self._other_shift >= _FRAMES_WITH_SHIFT:
                self._shift, self._other_shift = shown, 0
        if self._shift:
            counts = counts >> np.uint16(self._shift)
        elif used >> bits and self._carrying < _FRAMES_WITH_CARRIES:
            self._carrying = self._carrying + 1 if _carries(sample, bits) else 0
        mask = np.uint16((1 << (16 if self._carrying else bits)) - 1)
        return np.bitwise_and(counts, mask, dtype=np.uint16, order='C')

    def _without_telemetry(self, frame: Counts | Gray, extra: int) -> Counts | Gray:
        """Without ``extra`` rows that carry no image, from the side where the picture breaks off."""
        height = frame.shape[0]
        top, bottom = _break_between(frame, extra), _break_between(frame, height - extra)
        self._telemetry_on_top = int(np.clip(self._telemetry_on_top + (1 if top > 2 * bottom else -1), -10, 10))
        return frame[extra:] if self._telemetry_on_top > 0 else frame[: height - extra]

    def _replace_bad_pixels(self, image: Counts) -> None:
        """Fill listed pixels and those found so far, in place."""
        assert self._filler is not None
        if self.config.find_bad_pixels:
            found = self._finder.add(image)
            if found is not None and not np.array_equal(found, self._found) and 100 * len(found) < image.size:
                self._found = found
                self._filler = BadPixelFiller(np.concatenate([self._known_bad, found]), self._shape)
        self._filler.fill(image)


def _carries(rows: Counts | Gray, bits: int) -> bool:
    """Whether the bits above ``bits`` belong to the counts of ``rows`` (N, width), and are no flags.

    Where counts pass a multiple of 2^bits, neighbours are alike as a whole and apart by nearly all of 2^bits without
    the bits above.
    """
    steps, lower = (np.abs(np.diff(part.astype(np.int32), axis=1)) for part in (rows, rows & ((1 << bits) - 1)))
    near = 1 << (bits - _NEARLY)
    return int(np.sum((steps < near) & (lower > (1 << bits) - near))) >= _FEWEST_CARRIES


def _break_between(frame: Counts | Gray, row: int) -> float:
    """Mean difference between ``row`` and the one above it [counts]."""
    return float(np.mean(np.abs(frame[row].astype(np.int32) - frame[row - 1])))


class FreezeDetector:
    """Recognises repeated counts: because of noise, no two frames of a working bolometer array are equal."""

    ROW_STEP = 8
    # With so many repeated rows a frame is torn between old and new. Eight bits may be too coarse for the noise, so
    # there single rows may repeat in a new frame, but not all.
    TORN = 0.25
    TORN_8_BIT = 0.999
    # A row with a larger share of clipped pixels cannot change: no usable array has as many dead pixels as the others.
    CLIPPED = 0.9

    def __init__(self) -> None:
        # Number of buffers of a driver, which may send them in turn while it gets nothing new.
        self._recent: deque[Counts] = deque(maxlen=4)

    def repeats(self, image: Counts, *, coarse: bool) -> bool:
        """Whether an image, or a good part of it, was sent before; ``coarse``: it came as 8 bits."""
        sample = image[:: self.ROW_STEP].copy()
        torn = self.TORN_8_BIT if coarse else self.TORN
        repeated = any(_repeated_rows(sample, earlier) > torn for earlier in self._recent)
        if not repeated:
            self._recent.append(sample)
        return repeated


def _repeated_rows(sample: Counts, earlier: Counts) -> float:
    """Share of the rows that repeat, of those that could change: clipped rows at the end of the scale cannot."""
    # Hardly any two rows with noise begin with the same four pixels; only those are compared whole.
    same = (sample[:, :4] == earlier[:, :4]).all(axis=1)
    if not same.any():
        return 0.0
    same[same] = (sample[same] == earlier[same]).all(axis=1)
    clipped = sample.max(axis=1) == sample.min(axis=1)
    # Dead and stuck pixels stand out of a clipped row, and do not change either.
    at_either_end = (sample == sample.min()) | (sample == sample.max())
    clipped |= at_either_end.mean(axis=1) > FreezeDetector.CLIPPED
    return float(np.mean(same if clipped.all() else same[~clipped]))


class Pauses:
    """Period of new frames, and which new frames after a longer pause may still hold old counts.

    A driver may send each frame several times. The period is that of new frames: neither a shutter event nor the beat
    of two clocks (a frame now and then stands for two ticks of the driver) changes it. Frames are counted by their
    stamps: late ones from before the pause have nothing to settle.
    """

    #: Periods without anything new that are a pause. A frame that was lost makes two of one, an FFC of 0.35 s
    #: is 2.6 of the slowest cameras (7.5 Hz).
    LONG = 2.5

    def __init__(self) -> None:
        self._period = FramePeriod()
        #: whether old frames came since the last new one, and before each of the latest new ones
        self._old = False
        self._repeated: deque[bool] = deque(maxlen=FramePeriod.INTERVALS)
        self._paused = False
        self._left = 0
        self._paused_ns = self._settled_ns = 0

    def add_new(self, stamp_ns: int) -> bool:
        """Log a new frame; whether it may still hold old counts."""
        self._period.add(stamp_ns)
        self._repeated.append(self._old)
        self._old = self._paused = False
        if stamp_ns < self._paused_ns:
            return False
        if self._left == 0:
            return stamp_ns < self._settled_ns
        self._left -= 1
        self._settled_ns = max(stamp_ns, self._settled_ns)
        return True

    def add_old(self, stamp_ns: int, settling: int) -> None:
        """Log a repeated or shutter frame; after a longer pause the next ``settling`` new frames are withheld.

        A few repeated frames are a driver that runs faster than the camera. After a longer pause the first new frame
        may still hold old counts: in the bolometers, which lag, and in the driver's buffers.
        """
        self._old, newest_ns = True, self._period.newest_ns
        if newest_ns is not None and stamp_ns - newest_ns > self.LONG * self._period.ns:
            self._paused, self._paused_ns, self._left = True, max(stamp_ns, self._paused_ns), settling

    @property
    def repeating(self) -> bool:
        """Whether the driver repeats frames at present, as it is faster than the camera."""
        return not self._paused and len(self._repeated) == FramePeriod.INTERVALS and all(self._repeated)


class ShutterDetector:
    """Recognises the closed shutter: all structure disappears from one frame to the next."""

    FLAT_SIGMAS = 4.0
    COLLAPSE = 0.25
    # Longest shutter event; a picture that is flat for longer is a flat scene.
    LONGEST_NS = 1_500_000_000
    # Latest frames whose median structure is that of the scene, and the fewest for it to be known: one may be garbled.
    FRAMES, ENOUGH = 5, 3
    # Fewer pixels have too few patches (8x8 px) to distinguish structure from noise.
    LEAST_PIXELS = 50 * 64

    def __init__(self) -> None:
        self._live: deque[float] = deque(maxlen=self.FRAMES)
        self._closed_ns: int | None = None

    def closed(self, stamp_ns: int, image: Counts) -> bool:
        """Whether an image shows the shutter."""
        if image.size < self.LEAST_PIXELS:
            return False
        structure = _structure(image)
        collapsed = len(self._live) >= self.ENOUGH and structure < self.COLLAPSE * median(self._live)
        if collapsed and structure < self.FLAT_SIGMAS * pixel_noise(image):
            self._closed_ns = stamp_ns if self._closed_ns is None else self._closed_ns
            if stamp_ns - self._closed_ns < self.LONGEST_NS:
                return True
            self._live.clear()
        self._closed_ns = None
        self._live.append(structure)
        return False


def _structure(image: Counts) -> float:
    """Steps between neighbouring patches [counts]: the tenth largest, so that a small marker is enough.

    The median removes bad pixels, the mean most of the noise.
    """
    patches = cv2.resize(cv2.medianBlur(np.ascontiguousarray(image[::4, ::4]), 3), None, fx=0.5, fy=0.5)
    down, across = cv2.absdiff(patches[1:], patches[:-1]), cv2.absdiff(patches[:, 1:], patches[:, :-1])
    steps = np.concatenate([down.ravel(), across.ravel()])
    return float(np.partition(steps, -10)[-10])
