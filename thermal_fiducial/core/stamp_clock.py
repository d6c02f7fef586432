"""Stamps that are no clock, as somebody has written milliseconds into their nanoseconds."""

from thermal_fiducial.core.types import SECOND_NS

#: What is wrong, in words.
NO_CLOCK = 'stamps stay within a millisecond of the full second: milli- or microseconds in nanosec?'
# Micro- and milliseconds of a second are less than a million.
_FIRST_NS = 1_000_000
# Fewest different stamps in a row, and of more than so many in each second: an IMU has less in a millisecond, and a
# camera that a clock triggers each second or each half has no more.
_FEWEST, _OF_A_SECOND = 20, 2


class StampClock:
    """Watches whether stamps ever leave the first millisecond of their seconds."""

    def __init__(self) -> None:
        self._count = self._first_second = self._last_ns = 0

    def shows_none(self, stamp_ns: int) -> bool:
        """Take in the next stamp; whether it and those before it show that there is no clock."""
        second, rest_ns = divmod(stamp_ns, SECOND_NS)
        if rest_ns >= _FIRST_NS:
            self._count = 0
            return False
        if not self._count:
            self._first_second = second
        if stamp_ns != self._last_ns or not self._count:
            self._count += 1
        self._last_ns = stamp_ns
        return self._count >= _FEWEST and self._count > _OF_A_SECOND * (second - self._first_second + 1)
