"""Bit patterns of the markers of a dictionary."""

import cv2
import numpy as np

from thermal_fiducial.core.types import Gray


def marker_bits(dictionary: cv2.aruco.Dictionary) -> Gray:
    """Bits (M, n, n) of all M markers, rows from the top, 1 for white, without the black border."""
    size = int(dictionary.markerSize)
    table = np.asarray(dictionary.bytesList, dtype=np.uint8)
    # Memory holds the four rotations one after the other, whatever the shape says; the first is upright.
    upright = table.reshape(len(table), -1)[:, : table.shape[1]]
    unpacked = np.unpackbits(upright, axis=1)
    # The last byte holds the remaining bits right-aligned.
    padding = -(size * size) % 8
    bits = np.concatenate([unpacked[:, :-8], unpacked[:, -8 + padding :]], axis=1)
    return bits.reshape(-1, size, size)
