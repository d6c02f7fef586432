"""The one place that knows cv2.aruco's interface (4.10 up to 5.0)."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np

from thermal_fiducial.core.types import FloatArray, Gray, IntArray


class ArucoSearch:
    """Blind search for the markers of a dictionary in an 8-bit view.

    Parameters
    ----------
    dictionary : of the markers
    window_px : of the adaptive threshold
    threshold : levels that black must lie below the mean of its window
    min_side_px : shortest side of a candidate
    error_rate : share of the dictionary's correctable bits that may be wrong
    """

    def __init__(
        self,
        dictionary: cv2.aruco.Dictionary,
        window_px: int,
        threshold: float,
        min_side_px: float,
        error_rate: float,
    ) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.adaptiveThreshWinSizeMin = window_px
        parameters.adaptiveThreshWinSizeMax = window_px
        parameters.adaptiveThreshConstant = threshold
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementMaxIterations = 5
        parameters.detectInvertedMarker = True
        parameters.errorCorrectionRate = error_rate
        parameters.minDistanceToBorder = 1
        self._min_side_px = min_side_px
        self._parameters = parameters
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def find(self, gray: Gray) -> tuple[IntArray, FloatArray]:
        """IDs (N,) and corners (N, 4, 2) [px], clockwise from the marker's top-left."""
        self._parameters.minMarkerPerimeterRate = 3.5 * self._min_side_px / max(gray.shape)
        self._detector.setDetectorParameters(self._parameters)
        corners, ids, _ = self._detector.detectMarkers(gray)
        if ids is None or len(ids) == 0:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
        return ids.ravel().astype(np.int64), np.concatenate(corners).astype(np.float64)


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV on one thread inside: at this image size threads cost more than they give."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)
