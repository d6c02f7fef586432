"""OpenCV's own drawing and detection of markers, to compare with; before 4.7 it has them otherwise, or not."""

import cv2
import numpy as np
import pytest

#: Picture of a marker, from a dictionary of OpenCV, its ID and the side in pixels.
draw_marker = getattr(cv2.aruco, 'generateImageMarker', None) or cv2.aruco.drawMarker


def opencv_dictionary(dictionary):
    """A dictionary of ours as OpenCV's detector wants it."""
    need_4_7()
    packed = np.concatenate([cv2.aruco.Dictionary.getByteListFromBits(bits) for bits in dictionary.bits])
    return cv2.aruco.Dictionary(packed, dictionary.bits.shape[1], dictionary.correctable)


def opencv_detector(dictionary, *, subpixel=False):
    """OpenCV's detector of a dictionary of its own."""
    need_4_7()
    parameters = cv2.aruco.DetectorParameters()
    if subpixel:
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(dictionary, parameters)


def need_4_7():
    """Skip a test where OpenCV has no detector of its own, as that of Ubuntu 24.04."""
    if not hasattr(cv2.aruco, 'ArucoDetector'):
        pytest.skip(f'OpenCV {cv2.__version__} has no ArucoDetector')
