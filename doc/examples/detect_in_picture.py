"""Detect the markers in one picture: ``python detect_in_picture.py PICTURE CALIBRATION``.

PICTURE has 16 bits a pixel (best: raw counts) or 8, CALIBRATION is a camera_info YAML file.
"""

import sys

from thermal_fiducial import load_camera, load_config, load_dictionary, MarkerDetector
from thermal_fiducial.core.measurements import corners_px
from thermal_fiducial.files.images import read_gray


def main(picture: str, calibration: str) -> None:
    """Print ID, distance and corners of each marker."""
    config = load_config(dictionary='DICT_4X4_50', marker_size=0.3, bolometer_lag=0.0)
    detector = MarkerDetector(config.aruco_detector, load_dictionary('DICT_4X4_50'))
    markers = detector.detect(0, read_gray(picture), load_camera(calibration))
    for row, corners in zip(markers, corners_px(markers), strict=True):
        points = ' '.join(f'({u:.2f}, {v:.2f})' for u, v in corners)
        print(f'marker {row["id"]}: {row["z"]:.3f} m away, corners {points} +- {row["sigma_px"]:.2f} px')


if __name__ == '__main__':
    if len(sys.argv) != 3:
        sys.exit('usage: python detect_in_picture.py PICTURE CALIBRATION')
    main(*sys.argv[1:])
