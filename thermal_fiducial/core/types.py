"""Array types shared by the core, and records that are made of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
Float32Array: TypeAlias = npt.NDArray[np.float32]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Counts: TypeAlias = npt.NDArray[np.uint16]
Gray: TypeAlias = npt.NDArray[np.uint8]
#: (height, width) as received, or changed.
Pixels: TypeAlias = Counts | Gray | Float32Array

#: Nanoseconds of a second: stamps are whole nanoseconds, and seconds only differences of them.
SECOND_NS = 1_000_000_000
#: Lower bound of divisors: far below all measured values, far above rounding.
TINY = 1e-9
#: Largest ID of a marker, version or revision of a map.
LARGEST_ID = 2**31 - 1
#: Standard deviation of normal variables over the median of their absolute values.
SIGMA_OF_MEDIAN = 1.4826


@dataclass(frozen=True, slots=True)
class Stacked:
    """A batch of N items: arrays and batches among the fields have N entries, other fields are common to all."""

    def only(self, keep: BoolArray | IntArray) -> Self:
        """Some of the items, by a mask (N,) or by their places."""
        places = keep.nonzero()[0] if keep.dtype == np.bool_ else keep
        fields = self._fields()
        for index, field in enumerate(fields):
            if isinstance(field, np.ndarray):
                # In a fourth of the time of an index.
                fields[index] = field.take(places, axis=0)
            elif isinstance(field, Stacked):
                fields[index] = field.only(places)
        return self._of(fields)

    def joined(self, others: Self) -> Self:
        """These items and those of ``others``."""
        fields = self._fields()
        for index, (field, theirs) in enumerate(zip(fields, others._fields(), strict=True)):
            if isinstance(field, np.ndarray):
                fields[index] = np.concatenate((field, theirs))
            elif isinstance(field, Stacked):
                fields[index] = field.joined(theirs)
        return self._of(fields)

    def put(self, which: IntArray, others: Self) -> None:
        """Put ``others`` in the place of the items at ``which``, in their order."""
        for field, theirs in zip(self._fields(), others._fields(), strict=True):
            if isinstance(field, Stacked):
                field.put(which, theirs)
            elif isinstance(field, np.ndarray):
                field[which] = theirs

    def _fields(self) -> list[Any]:
        names: tuple[str, ...] = self.__slots__
        return [getattr(self, name) for name in names]

    def _of(self, fields: list[Any]) -> Self:
        make: Callable[..., Self] = type(self)
        return make(*fields)
