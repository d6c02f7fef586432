"""Images that are used again frame after frame: fresh ones cost more to allocate than to fill."""

import numpy as np

from thermal_fiducial.core.types import Float32Array, Gray


class Scratch:
    """Arrays by name and shape; what is in one holds until it is asked for again."""

    def __init__(self) -> None:
        self._floats: dict[tuple[str, tuple[int, ...]], Float32Array] = {}
        self._bytes: dict[tuple[str, tuple[int, ...]], Gray] = {}

    def floats(self, name: str, shape: tuple[int, ...]) -> Float32Array:
        """An array of float32."""
        if (name, shape) not in self._floats:
            self._floats[name, shape] = np.empty(shape, dtype=np.float32)
        return self._floats[name, shape]

    def bytes(self, name: str, shape: tuple[int, ...]) -> Gray:
        """An array of uint8."""
        if (name, shape) not in self._bytes:
            self._bytes[name, shape] = np.empty(shape, dtype=np.uint8)
        return self._bytes[name, shape]
