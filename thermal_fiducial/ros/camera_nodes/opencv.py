"""Whether the installed OpenCV can be used."""

import cv2

from thermal_fiducial.errors import InputError

#: Oldest version that the tests have run with, that of Ubuntu 24.04.
_OPENCV = (4, 6)


def require_opencv() -> None:
    """Report an unusable OpenCV at the start, before a missing function fails in flight."""
    if tuple(int(part) for part in cv2.__version__.split('.')[:2]) < _OPENCV:
        needed = '.'.join(map(str, _OPENCV))
        raise InputError(f'OpenCV {cv2.__version__}: {needed} or newer is needed')
    if not hasattr(cv2, 'aruco'):
        raise InputError(f'OpenCV {cv2.__version__} without aruco: take opencv-contrib-python-headless of that version')
