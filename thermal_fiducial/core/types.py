"""Array types shared by the core, and records that are made of them."""

from collections.abc import Callable, Iterable
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
        """The items at ``keep``."""
        return self._of(_at(field, keep) for field in self._fields())

    def joined(self, others: Self) -> Self:
        """These items and those of ``others``."""
        pairs = zip(self._fields(), others._fields(), strict=True)
        return self._of(a.joined(b) if isinstance(a, Stacked) else np.concatenate([a, b]) for a, b in pairs)

    def put(self, which: IntArray, others: Self) -> None:
        """Put ``others`` in the place of the items at ``which``, in their order."""
        for field, there in zip(self._fields(), others._fields(), strict=True):
            if isinstance(field, Stacked):
                field.put(which, there)
            elif isinstance(field, np.ndarray):
                field[which] = there

    def _fields(self) -> list[Any]:
        names: tuple[str, ...] = self.__slots__
        return [getattr(self, name) for name in names]

    def _of(self, fields: Iterable[Any]) -> Self:
        make: Callable[..., Self] = type(self)
        return make(*fields)


def _at(field: Any, keep: BoolArray | IntArray) -> Any:
    if isinstance(field, Stacked):
        return field.only(keep)
    return field[keep] if isinstance(field, np.ndarray) else field
