"""Bit patterns of the markers of a dictionary."""

import cv2
import numpy as np

from thermal_fiducial.core.types import Gray


def marker_bits(dictionary: cv2.aruco.Dictionary) -> Gray:
    """Bits (M, n, n) of all M markers, rows from the top, 1 for white, without the black border."""
    size = int(dictionary.markerSize)
    table = np.asarray(dictionary.bytesList, dtype=np.uint8)
    # LagTail holds the four rotations one after the other, whatever the shape says; the first is upright.
    upright = table.reshape(len(table), -1)[:, : table.shape[1]]
    unpacked = np.unpackbits(upright, axis=1)
    # The last byte holds the remaining bits right-aligned.
    padding = -(size * size) % 8
    bits = np.concatenate([unpacked[:, :-8], unpacked[:, -8 + padding :]], axis=1)
    return bits.reshape(-1, size, size)


def correctable_bits(bits: Gray) -> int:
    """Number of wrong bits that still leave the nearest of the markers (M, n, n), in any turn, certain.

    Half of what the smallest Hamming distance leaves.
    """
    flat = bits.reshape(len(bits), -1).astype(np.float32)
    turned = np.concatenate([np.rot90(bits, turn, axes=(1, 2)).reshape(len(bits), -1) for turn in range(4)])
    turned = turned.astype(np.float32)
    # Bits that differ: set in the one and not in the other.
    distance = flat.sum(axis=1)[:, None] + turned.sum(axis=1) - 2.0 * flat @ turned.T
    np.fill_diagonal(distance, np.inf)
    return max((int(distance.min()) - 1) // 2, 0)
