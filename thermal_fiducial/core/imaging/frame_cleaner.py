"""Raw long-wave infrared frames: what is cut off, masked, filled in or withheld before anybody looks for markers."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.bad_pixels import BadPixelFiller, BadPixelFinder
from thermal_fiducial.core.imaging.stops import FreezeDetector, Pauses, ShutterDetector
from thermal_fiducial.core.measurements import LATEST_NS
from thermal_fiducial.core.types import Counts, Gray, IntArray
from thermal_fiducial.errors import InputError

FROZEN = 'frozen'
SHUTTER = 'FFC'
SETTLING = 'settling after FFC'
REPEATED_STAMP = 'stamp seen before'

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
        self._telemetry_on_top = 0
        self._restart((0, 0))

    def _restart(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._stamps: set[int] = set()
        self._newest_ns = 0
        self._pauses = Pauses()
        self._freeze = FreezeDetector()
        self._shutter = ShutterDetector()
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
        self._replace_bad_pixels(image)
        return CleanFrame(image, late=late)

    def _image(self, counts: Counts | Gray) -> Counts:
        """A copy of the image rows as counts."""
        if counts.ndim != 2 or counts.dtype not in (np.uint8, np.uint16):
            raise InputError(f'frame of {counts.dtype} with shape {counts.shape} is not an 8 or 16 bit image')
        image = self._without_telemetry(counts)
        if min(image.shape) < 16:
            raise InputError(f'frame of {image.shape[1]}x{image.shape[0]} pixels is too small')
        # Some drivers shift counts up: in no living picture the lowest bits are zero in all pixels.
        used = int(np.bitwise_or.reduce(image[:: FreezeDetector.ROW_STEP], axis=None))
        shift = (used & -used).bit_length() - 1
        down = shift if used >> self.config.bits and shift >= _SHIFTED else 0
        own = image.astype(np.uint16)
        if down:
            own >>= np.uint16(down)
        own &= np.uint16((1 << self.config.bits) - 1)
        return own

    def _stale(self, stamp_ns: int, image: Counts, *, coarse: bool) -> str:
        if self._freeze.repeats(image, coarse=coarse):
            reason = FROZEN
        elif self._shutter.closed(stamp_ns, image):
            reason = SHUTTER
        else:
            return SETTLING if self._pauses.add_new(stamp_ns) else ''
        self._pauses.add_old(stamp_ns, self.config.settle_frames)
        return reason

    def _without_telemetry(self, frame: Counts | Gray) -> Counts | Gray:
        """Without the rows that carry no image, from the side where the picture breaks off."""
        height = frame.shape[0]
        extra = next((height - h for h in STANDARD_HEIGHTS if 0 < height - h <= MAX_TELEMETRY_ROWS), 0)
        if not extra:
            return frame
        top, bottom = _break_between(frame, extra), _break_between(frame, height - extra)
        self._telemetry_on_top = int(np.clip(self._telemetry_on_top + (1 if top > 2 * bottom else -1), -10, 10))
        return frame[extra:] if self._telemetry_on_top > 0 else frame[: height - extra]

    def _replace_bad_pixels(self, image: Counts) -> None:
        assert self._filler is not None
        if self.config.find_bad_pixels:
            found = self._finder.add(image)
            if found is not None and not np.array_equal(found, self._found) and 100 * len(found) < image.size:
                self._found = found
                self._filler = BadPixelFiller(np.concatenate([self._known_bad, found]), self._shape)
        self._filler.fill(image)


def _break_between(frame: Counts | Gray, row: int) -> float:
    """Mean difference between ``row`` and the one above it [counts]."""
    return float(np.mean(np.abs(frame[row].astype(np.int32) - frame[row - 1])))
