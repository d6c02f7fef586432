"""Small markers in pictures and in counts, and squares and leaves that are none, drawn finely and then blurred."""

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL_PX = 320, 240, 400.0
PRINCIPAL_POINT_PX = np.array([WIDTH / 2, HEIGHT / 2])
#: Fine pixels in one, and in a cell of the drawn marker.
_FINE, _CELL = 6, 16
_BLACK, _WHITE = 60.0, 190.0
_COLUMNS, _ROWS = 4, 3


def _tilted(rng, place, side, tilt_deg):
    """Corners (4, 2) [px] of a square whose middle is seen at a place, turned at random, tilted about a random axis."""
    azimuth, roll = rng.uniform(0.0, 2.0 * np.pi, 2)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R = cv2.Rodrigues(axis * np.radians(tilt_deg))[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    middle = np.array([*(place - PRINCIPAL_POINT_PX), FOCAL_PX]) / side
    corners = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]]) @ R.T + middle
    return FOCAL_PX * corners[:, :2] / corners[:, 2:] + PRINCIPAL_POINT_PX


def _seen(fine, blur_px):
    """Pixels of a finely drawn scene before noise."""
    blurred = cv2.GaussianBlur(fine, (0, 0), blur_px * _FINE)
    return cv2.resize(blurred, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def _developed(rng, fine, blur_px, noise, quality=None):
    """The picture of a finely drawn scene; of a JPEG where there is a quality."""
    seen = _seen(fine, blur_px)
    gray = np.clip(np.rint(seen + rng.normal(0.0, noise, seen.shape)), 0, 255).astype(np.uint8)
    if quality is None:
        return gray
    _, file = cv2.imencode('.jpg', gray, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)


def _drawn(fine, cells, corners, fall=0.0):
    """Draw ``cells`` (m, m), 1 for white, with a white margin of one, to ``corners`` (4, 2) [px].

    White falls to black by the share ``fall`` from the middle to the corners, with the squared distance.
    """
    white = np.kron(np.pad(cells, 1, constant_values=1.0), np.ones((_CELL, _CELL)))
    along = (np.arange(len(white)) + 0.5 - 0.5 * len(white)) / (len(cells) * _CELL)
    white *= 1.0 - 2.0 * fall * (along[:, None] ** 2 + along**2)
    texture = _BLACK + (_WHITE - _BLACK) * white
    low, high = _CELL - 0.5, texture.shape[0] - _CELL - 0.5
    source = np.float32([[low, low], [high, low], [high, high], [low, high]])
    place = np.float32((corners + 0.5) * _FINE - 0.5)
    warp = cv2.getPerspectiveTransform(source, place)
    (left, top), (right, bottom) = _bounds(warp, len(texture), fine.shape)
    seen = fine[top:bottom, left:right]
    moved = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]]) @ warp
    shown = cv2.warpPerspective(texture, moved, seen.shape[::-1], flags=cv2.INTER_NEAREST, borderValue=-1.0)
    seen[shown >= 0.0] = shown[shown >= 0.0]


def _bounds(warp, width, shape):
    """First and last fine pixel (x, y) that a texture (width, width) can reach, within a scene of ``shape``."""
    reach = np.array([[[-1.0, -1.0], [width, -1.0], [width, width], [-1.0, width]]])
    reached = cv2.perspectiveTransform(reach, warp)[0]
    limits = shape[::-1]
    first = np.clip(np.floor(reached.min(axis=0)), 0, limits).astype(int)
    last = np.clip(np.ceil(reached.max(axis=0)) + 1, first + 1, limits).astype(int)
    return first.tolist(), last.tolist()


def _scene(rng):
    """A gray wall, and twelve places on it [px]."""
    fine = np.full((HEIGHT * _FINE, WIDTH * _FINE), 0.5 * (_BLACK + _WHITE), dtype=np.float32)
    rows, columns = np.divmod(np.arange(_COLUMNS * _ROWS), _COLUMNS)
    places = np.stack([(columns + 0.5) * WIDTH / _COLUMNS, (rows + 0.5) * HEIGHT / _ROWS], axis=-1)
    return fine, places + rng.uniform(-5.0, 5.0, places.shape)


def with_markers(rng, bits, side, tilt_deg, *, blur_px=0.5, noise=1.5, quality=None):
    """Picture of twelve markers of a dictionary with ``bits`` (M, n, n), and ID to their corners (4, 2) [px]."""
    fine, corners = _with_markers(rng, bits, side, tilt_deg)
    return _developed(rng, fine, blur_px, noise, quality), corners


def counts_with_markers(rng, bits, side, tilt_deg, *, optics_px, contrast=330.0, noise=1.5, fall=0.0):
    """The same in counts of 14 bits, behind optics with a blur of ``optics_px`` beside that of the pixels.

    ``fall``: share by which the warm surface behind each marker falls from its middle to its corners.
    """
    fine, corners = _with_markers(rng, bits, side, tilt_deg, fall)
    seen = 3600.0 + contrast / (_WHITE - _BLACK) * (_seen(fine, optics_px) - _BLACK)
    return np.rint(seen + rng.normal(0.0, noise, seen.shape)).astype(np.uint16), corners


def _with_markers(rng, bits, side, tilt_deg, fall=0.0):
    fine, places = _scene(rng)
    ids = rng.choice(len(bits), len(places), replace=False).tolist()
    corners = {key: _tilted(rng, place, side, tilt_deg) for key, place in zip(ids, places, strict=True)}
    for key, quad in corners.items():
        _drawn(fine, np.pad(bits[key].astype(float), 1), quad, fall)
    return fine, corners


def with_other_squares(rng, cells, side):
    """Picture of twelve squares with a black border around random gray ``cells`` x ``cells``."""
    fine, places = _scene(rng)
    for place in places:
        _drawn(fine, np.pad(rng.random((cells, cells)).round(), 1), _tilted(rng, place, side, rng.uniform(0.0, 50.0)))
    return _developed(rng, fine, 0.5, 1.5)


def with_leaves(rng):
    """Picture of leaves of all sizes, one over the other, as of trees and gravel."""
    fine = np.full((HEIGHT * _FINE, WIDTH * _FINE), 128.0, dtype=np.float32)
    for _ in range(3000):
        u, v = (rng.random(2) * fine.shape[::-1]).astype(int).tolist()
        long = int(min(16.0 / np.sqrt(rng.random()), 300.0))
        short = max(int(long * rng.uniform(0.3, 1.0)), 1)
        turn, gray = float(rng.uniform(0.0, 360.0)), float(rng.uniform(20.0, 230.0))
        cv2.ellipse(fine, (u, v), (long, short), turn, 0.0, 360.0, gray, -1)
    return _developed(rng, fine, 0.5, 1.5)
