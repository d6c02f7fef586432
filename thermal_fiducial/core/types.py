"""Array types shared by the core."""

from typing import TypeAlias

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
