"""Small markers in real pictures: how many of each size are found, beside OpenCV, and none that is not there."""

from collections import Counter, defaultdict
import csv

import cv2
import numpy as np
import pytest
from support.opencv import opencv_detector, opencv_dictionary

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import corners_px
from thermal_fiducial.files.dictionary import load_dictionary

DICTIONARY = load_dictionary('DICT_APRILTAG_36h11')
#: Limits of the classes by the shortest side [px].
CLASSES = (8, 10, 12, 14, 16, 18, 20, 25, 30, 40, 60)


def camera_for(picture):
    height, width = picture.shape
    return Camera(width, height, [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]])


def ours(picture):
    """ID to corners, of a detector that has seen nothing before."""
    detector = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.0), DICTIONARY)
    rows = detector.detect(0, picture, camera_for(picture))
    return dict(zip(rows['id'].tolist(), corners_px(rows), strict=True))


def opencv(picture):
    corners, ids, _ = opencv_detector(opencv_dictionary(DICTIONARY), subpixel=True).detectMarkers(picture)
    found = [] if ids is None else ids.ravel().tolist()
    return {key: quad.reshape(4, 2).astype(float) for key, quad in zip(found, corners, strict=True)}


def smaller(picture, corners, factor):
    """The picture at a lower resolution, and where its corners are by then."""
    size = tuple(round(factor * length) for length in picture.shape[::-1])
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA), {
        key: factor * (quad + 0.5) - 0.5 for key, quad in corners.items()
    }


def room(folder, every):
    """Of every so many: picture, where its markers are as far as either finds them at full resolution, IDs there."""
    for line in (folder / 'swatbotics_room' / 'groundtruth.txt').read_text().split('\n')[:: 3 * every]:
        name, *listed = line.split() or ['']
        if not listed:
            continue
        photo = cv2.imread(str(folder / 'swatbotics_room' / 'photos' / name), cv2.IMREAD_GRAYSCALE)
        ids = set(map(int, listed))
        corners = {key: quad for key, quad in (opencv(photo) | ours(photo)).items() if key in ids}
        for factor in (0.5, 0.35, 0.25):
            yield *smaller(photo, corners, factor), ids


def carpet(folder, every):
    """The same of a real drone's flight; its own corners are good to 0.15 px."""
    corners = defaultdict(dict)
    with (folder / 'real_flights' / 'carpet_mountain' / 'detections.csv').open() as file:
        for row in csv.DictReader(file):
            quad = [[float(row[f'{axis}{corner}']) for axis in 'uv'] for corner in range(4)]
            corners[row['stamp_ns']][int(row['id'])] = np.array(quad)
    ids = {key for quads in corners.values() for key in quads}
    for stamp in sorted(corners)[:: 60 * every]:
        path = folder / 'real_flights' / 'carpet_mountain' / 'frames' / f'{stamp}.jpg'
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if picture is not None:
            for factor in (1.0, 0.6, 0.4):
                yield *smaller(picture, corners[stamp], factor), ids


def size_class(quad):
    side = float(np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min())
    return next(
        (f'{low} to {high} px' for low, high in zip((0, *CLASSES), CLASSES, strict=False) if side < high), 'more'
    )


def by_size(item):
    """Smallest class first, ``more`` last."""
    limit = item[0].split()[0]
    return int(limit) if limit.isdigit() else CLASSES[-1]


#: All pictures at night, some of them always.
all_or_some = pytest.mark.parametrize('every', [pytest.param(1, marks=pytest.mark.nightly), 6], ids=['all', 'some'])


@pytest.mark.slow
@all_or_some
@pytest.mark.parametrize('pictures', [room, carpet])
def test_never_fewer_than_opencv_at_any_size_and_none_false(pictures, every, real_data, measured):
    there, found, theirs, false = Counter(), Counter(), Counter(), []
    for picture, corners, ids in pictures(real_data, every):
        there.update(size_class(quad) for quad in corners.values())
        for answer, count in ((ours(picture), found), (opencv(picture), theirs)):
            count.update(size_class(corners[key]) for key in answer if key in corners)
            if count is found:
                false += [key for key in answer if key not in ids]
    counts = {name: (found[name], theirs[name], number) for name, number in there.items()}
    record = measured if every == 1 else lambda *_: None
    record(
        f'small markers, {pictures.__name__}: shortest side: found, OpenCV, there',
        'never fewer, 0 false',
        ', '.join(f'{name}: {a}, {b}, {c}' for name, (a, b, c) in sorted(counts.items(), key=by_size)),
    )
    assert false == []
    assert {name: each for name, each in counts.items() if each[0] < each[1]} == {}


@pytest.mark.parametrize(
    'name',
    ['DICT_4X4_50', 'DICT_APRILTAG_16h5']
    + [pytest.param(name, marks=pytest.mark.nightly) for name in ('DICT_5X5_1000', 'DICT_ARUCO_ORIGINAL')],
)
@all_or_some
def test_pictures_of_other_markers_show_none_of_few_bits(name, every, real_data, measured):
    """Tags of another dictionary, rooms and carpets: everything that is found is false."""
    detector, found = MarkerDetector(ArucoDetectorConfig(bolometer_lag=0.0), load_dictionary(name)), 0
    photos = sorted((real_data / 'swatbotics_room' / 'photos').iterdir())[:: 6 * every]
    frames = sorted((real_data / 'real_flights' / 'carpet_mountain' / 'frames').iterdir())[:: 40 * every]
    for index, path in enumerate([*photos, *frames]):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        for factor in (1.0, 0.6):
            shown, _ = smaller(picture, {}, factor)
            found += len(detector.detect(10**10 * (2 * index + (factor < 1.0)), shown, camera_for(shown)))
    if every == 1:
        measured(f'pictures of other markers: {name} found', '0', found)
    assert found == 0
