"""Raw long-wave infrared frames: what is cut off, masked, filled in or withheld before anybody looks for markers.

Shutter behaviour follows the FLIR Tau 2 user's manual: during a flat-field correction (FFC, under half a second) a
digital stream repeats the last frame, shows the shutter, or pauses, depending on the driver.
"""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.bad_pixels import BadPixelFiller, BadPixelFinder, pixel_noise
from thermal_fiducial.core.types import Counts, FloatArray, Gray, IntArray
from thermal_fiducial.errors import InputError

FROZEN = 'frozen'
SHUTTER = 'FFC'
SETTLING = 'settling after FFC'
REPEATED_STAMP = 'stamp seen before'

# Frames that come later than this after newer ones are those of a clock that was set back [ns].
LATEST_NS = 1_000_000_000

# Bits that a driver shifts counts up by at least, to fill 16.
_SHIFTED = 2
# Rows of an image; a frame with up to MAX_TELEMETRY_ROWS more carries telemetry.
STANDARD_HEIGHTS = (1024, 512, 480, 256, 240, 128, 120)
MAX_TELEMETRY_ROWS = 4


@dataclass(frozen=True, slots=True)
class CleanFrame:
    """A frame to look at, or why there is none."""

    #: (height, width) counts without telemetry, flags and bad pixels; None: withheld
    counts: Counts | None
    #: in words, empty for a frame that is passed on
    reason: str = ''
    #: whether newer ones came before it
    late: bool = False


class FrameCleaner:
    """Turns what the camera sends into counts that show the scene at their stamp.

    Parameters
    ----------
    config : bits, bad pixels, settling
    bad_pixels : (N, 2) column, row of pixels known to be bad
    """

    def __init__(self, config: Tau2CameraConfig, bad_pixels: IntArray | None = None) -> None:
        self.config = config
        self._known_bad: IntArray = np.reshape([] if bad_pixels is None else bad_pixels, (-1, 2)).astype(np.int64)
        self._telemetry = _TelemetryRows()
        self._restart((0, 0))

    def _restart(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._stamps: set[int] = set()
        self._newest_ns = 0
        self._live_ns: int | None = None
        self._freeze = _FreezeDetector()
        self._shutter = _ShutterDetector()
        self._settling = _Settling()
        self._finder = BadPixelFinder(shape)
        self._found: IntArray = np.zeros((0, 2), np.int64)
        self._filler = BadPixelFiller(self._known_bad, shape) if shape != (0, 0) else None

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
        if image.shape != self._shape or stamp_ns < self._newest_ns - LATEST_NS:
            self._restart(image.shape)
        if stamp_ns in self._stamps:
            return CleanFrame(None, REPEATED_STAMP)
        late = stamp_ns < self._newest_ns
        self._newest_ns = max(stamp_ns, self._newest_ns)
        self._stamps = {stamp for stamp in self._stamps if stamp >= self._newest_ns - LATEST_NS} | {stamp_ns}
        reason = self._stale(stamp_ns, image, coarse=counts.dtype == np.uint8)
        if reason:
            return CleanFrame(None, reason, late)
        self._live_ns = stamp_ns if self._live_ns is None else max(stamp_ns, self._live_ns)
        self._replace_bad_pixels(image)
        return CleanFrame(image, late=late)

    def _image(self, counts: Counts | Gray) -> Counts:
        """A copy of the image rows as counts."""
        if counts.ndim != 2 or counts.dtype not in (np.uint8, np.uint16):
            raise InputError(f'frame of {counts.dtype} with shape {counts.shape} is not an 8 or 16 bit image')
        image = self._telemetry.cut(counts)
        if min(image.shape) < 16:
            raise InputError(f'frame of {image.shape[1]}x{image.shape[0]} pixels is too small')
        return _right_aligned(image.astype(np.uint16), self.config.bits) & np.uint16((1 << self.config.bits) - 1)

    def _stale(self, stamp_ns: int, image: Counts, *, coarse: bool) -> str:
        if self._freeze.repeats(image, coarse=coarse):
            reason = FROZEN
        elif self._shutter.closed(stamp_ns, image):
            reason = SHUTTER
        else:
            return SETTLING if self._settling.withholds(stamp_ns) else ''
        # A single repeated frame is a driver that runs faster than the camera. After a longer stop the first new
        # frame may still hold old counts: in the bolometers, which lag, and in the driver's buffers.
        if self._live_ns is not None and stamp_ns - self._live_ns > 90_000_000:
            self._settling.begin(stamp_ns, self.config.settle_frames)
        return reason

    def _replace_bad_pixels(self, image: Counts) -> None:
        assert self._filler is not None
        if self.config.find_bad_pixels:
            found = self._finder.add(image)
            if found is not None and not np.array_equal(found, self._found) and 100 * len(found) < image.size:
                self._found = found
                self._filler = BadPixelFiller(np.concatenate([self._known_bad, found]), self._shape)
        self._filler.fill(image)


def _right_aligned(image: Counts, bits: int) -> Counts:
    """The image, shifted where a driver has shifted it: in no living picture the lowest bits are zero in all pixels."""
    used = int(np.bitwise_or.reduce(image[:: _FreezeDetector.ROW_STEP], axis=None))
    shift = (used & -used).bit_length() - 1
    return image >> np.uint16(shift) if used >> bits and shift >= _SHIFTED else image


class _TelemetryRows:
    """Cuts the rows that carry no image, from the side where the picture breaks off."""

    def __init__(self) -> None:
        self._top_votes = 0

    def cut(self, frame: Counts | Gray) -> Counts | Gray:
        height = frame.shape[0]
        extra = next((height - h for h in STANDARD_HEIGHTS if 0 < height - h <= MAX_TELEMETRY_ROWS), 0)
        if not extra:
            return frame
        top, bottom = _break_between(frame, extra), _break_between(frame, height - extra)
        self._top_votes = int(np.clip(self._top_votes + (1 if top > 2 * bottom else -1), -10, 10))
        return frame[extra:] if self._top_votes > 0 else frame[: height - extra]


def _break_between(frame: Counts | Gray, row: int) -> float:
    """Mean difference between ``row`` and the one above it [counts]."""
    return float(np.mean(np.abs(frame[row].astype(np.int32) - frame[row - 1])))


class _FreezeDetector:
    """Recognises repeated counts: noise never lets two frames of a living bolometer array agree."""

    ROW_STEP = 8
    # So many rows repeated are a frame torn between old and new. Eight bits may be too coarse to show the noise, so
    # there a row may repeat without being old, but not all of them.
    TORN = 0.25
    TORN_8_BIT = 0.999

    def __init__(self) -> None:
        # As many as a driver has buffers: one that gets nothing new may send them in turn.
        self._recent: deque[Counts] = deque(maxlen=4)

    def repeats(self, image: Counts, *, coarse: bool) -> bool:
        sample = image[:: self.ROW_STEP].copy()
        torn = self.TORN_8_BIT if coarse else self.TORN
        repeated = any(_repeated_rows(sample, earlier) > torn for earlier in self._recent)
        if not repeated:
            self._recent.append(sample)
        return repeated


def _repeated_rows(sample: Counts, earlier: Counts) -> float:
    """Share of the rows that repeat, of those that could change: clipped ones at the end of the scale can't."""
    same = np.all(sample == earlier, axis=1)
    if not same.any():
        return 0.0
    clipped = sample.max(axis=1) == sample.min(axis=1)
    return float(np.mean(same if clipped.all() else same[~clipped]))


class _Settling:
    """Counts frames after a stop, by their stamps: late ones from before it have nothing to settle."""

    def __init__(self) -> None:
        self._left = 0
        self._stopped_ns = self._settled_ns = 0

    def begin(self, stamp_ns: int, frames: int) -> None:
        """Withhold ``frames`` after the one of ``stamp_ns``, which showed nothing new."""
        self._stopped_ns, self._left = max(stamp_ns, self._stopped_ns), frames

    def withholds(self, stamp_ns: int) -> bool:
        """Whether a new frame may still hold old counts."""
        if stamp_ns < self._stopped_ns:
            return False
        if self._left == 0:
            return stamp_ns < self._settled_ns
        self._left -= 1
        self._settled_ns = max(stamp_ns, self._settled_ns)
        return True


class _ShutterDetector:
    """Recognises the closed shutter: from one frame to the next all structure is gone."""

    FLAT_SIGMAS = 4.0
    COLLAPSE = 0.25
    # The longest that a shutter stays closed; after it a flat picture is taken for a flat scene.
    LONGEST_NS = 1_500_000_000
    SMOOTHING = 0.2

    def __init__(self) -> None:
        self._live_structure: float | None = None
        self._closed_ns: int | None = None

    def closed(self, stamp_ns: int, image: Counts) -> bool:
        structure = _structure(image)
        before = self._live_structure
        collapsed = before is not None and structure < self.COLLAPSE * before
        if collapsed and structure < self.FLAT_SIGMAS * pixel_noise(image):
            self._closed_ns = stamp_ns if self._closed_ns is None else self._closed_ns
            if stamp_ns - self._closed_ns < self.LONGEST_NS:
                return True
            before = None
        self._closed_ns = None
        self._live_structure = structure if before is None else before + self.SMOOTHING * (structure - before)
        return False


def _structure(image: Counts) -> float:
    """Steps between neighbouring patches [counts]: the tenth largest, so that a small marker is enough.

    The median takes out bad pixels, the mean most of the noise.
    """
    patches = cv2.resize(cv2.medianBlur(np.ascontiguousarray(image[::4, ::4]), 3), None, fx=0.5, fy=0.5)
    steps = np.abs(np.diff(patches.astype(np.int32), axis=0)).ravel()
    steps = np.concatenate([steps, np.abs(np.diff(patches.astype(np.int32), axis=1)).ravel()])
    return float(np.partition(steps, -10)[-10])


class EightBitView:
    """Counts as an 8-bit picture whose scale follows the scene slowly.

    The scale runs between two percentiles of a sub-sample, smoothed over frames, and in a frame moves by no more than a
    small share of its span: an object that enters or leaves doesn't make the rest of the picture pump. Only when
    nothing of the scene is on the scale any more does it jump there.
    """

    STEP = 8

    def __init__(self, config: Tau2CameraConfig) -> None:
        self.config = config
        self._range: FloatArray | None = None

    def __call__(self, counts: Counts) -> Gray:
        """Picture (height, width) uint8 of ``counts`` (height, width)."""
        low, high = self._follow(counts)
        span = max(high - low, self.config.view_minimum_span)
        # What falls below the scale saturates at zero in the unsigned difference, what exceeds it in the conversion.
        start = max(0.0, 0.5 * (low + high - span))
        above = cv2.subtract(counts, np.array([start]))
        return np.asarray(cv2.convertScaleAbs(above, alpha=255.0 / span), dtype=np.uint8)

    def _follow(self, counts: Counts) -> tuple[float, float]:
        sample = counts[:: self.STEP, :: self.STEP].ravel()
        share = self.config.view_tail_percent / 100.0
        ranks = (int(share * (sample.size - 1)), int((1.0 - share) * (sample.size - 1)))
        part = np.partition(sample, ranks)
        now = np.array([part[ranks[0]], part[ranks[1]]], np.float64)
        if self._range is None or now[0] > self._range[1] or now[1] < self._range[0]:
            self._range = now
        else:
            # Relative to the span, or an object a hundred times hotter than the markers would black them out at once.
            most = max(float(self._range[1] - self._range[0]), self.config.view_minimum_span)
            self._range = self._range + self.config.view_smoothing * np.clip(now - self._range, -most, most)
        return float(self._range[0]), float(self._range[1])
