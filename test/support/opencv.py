"""OpenCV's own drawing and detection of markers, to compare with."""

import cv2
import numpy as np

#: Picture of a marker, from a dictionary of OpenCV, its ID and the side in pixels; it has its later name since 4.7.
draw_marker = getattr(cv2.aruco, 'generateImageMarker', None) or cv2.aruco.drawMarker


def opencv_dictionary(dictionary):
    """A dictionary of ours as OpenCV's detector wants it."""
    packed = np.concatenate([cv2.aruco.Dictionary.getByteListFromBits(bits) for bits in dictionary.bits])
    return cv2.aruco.Dictionary(packed, dictionary.bits.shape[1], dictionary.correctable)
