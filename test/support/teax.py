"""Bytes as a ThermalGrabber sends them."""

import struct

import numpy as np

WIDTH, HEIGHT = 160, 122


def picture(seed, width=WIDTH, height=HEIGHT):
    return np.random.default_rng(seed).integers(0, 1 << 14, (height, width), dtype=np.uint16)


def packed(counts):
    """One frame: time stamp, and a word of blanking on either side of each row."""
    height, width = counts.shape
    words = np.full((height, width + 2), 0x4000, '<u2')
    words[:, 1:-1] = counts | 0xC000
    payload = struct.pack('<H', 0x1234) + words.tobytes()
    return b'TEAX' + struct.pack('<I', len(payload) // 2) + payload
