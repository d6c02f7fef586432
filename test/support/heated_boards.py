"""Pictures of calibration boards as heat makes them: graded, reversed, beside something hot, blurred, in a hand.

An image formation of its own (a texture on a plane, a pinhole, a Gaussian), with nothing of the package's renderer.
"""

from dataclasses import dataclass

import cv2
import numpy as np

#: Texels a step of the board.
TEXELS = 32
NETD = 0.05
COUNTS_PER_KELVIN = 25.0


@dataclass(frozen=True)
class Heat:
    """How a board looks; temperatures in kelvin.

    Parameters
    ----------
    contrast : of the warm squares or circles; negative: cold ones
    fading : contrast falls to exp(-fading) over the board
    reversed_to : contrast falls to minus this share of itself: a reflection
    lamp : a spot of heat on the board
    hot : something hot beside the board
    hand : whether a finger covers a corner of the border
    diffusion : blur in the board by conduction [steps]
    gap : how far the warm squares draw back [steps]
    defocus : [px]
    """

    contrast: float = 6.0
    fading: float = 0.0
    reversed_to: float = 0.0
    lamp: float = 0.0
    hot: float = 0.0
    hand: bool = False
    diffusion: float = 0.0
    gap: float = 0.0
    defocus: float = 0.66


def picture(points, heat, rng, *, radius=None, width=640, height=512, fill=0.6, outside=False):
    """Counts (height, width) of a board with ``points`` (N, 2) [steps], and their pixels (N, 2).

    Parameters
    ----------
    radius : of circles [steps]; None: corners of a chessboard
    outside : whether a part of the board lies outside the picture
    """
    # A whole number of texels, so that edges lie between them.
    low, high = points.min(axis=0) - 1.75, points.max(axis=0) + 1.75
    H = _homography(points, rng, width, height, fill, outside)
    step = 1.0 / TEXELS
    x, y = np.meshgrid(np.arange(low[0] + 0.5 * step, high[0], step), np.arange(low[1] + 0.5 * step, high[1], step))
    warm = _squares(x, y, points, heat.gap) if radius is None else _circles(x, y, points, radius)
    if heat.diffusion > 0.0:
        warm = cv2.GaussianBlur(warm, (0, 0), heat.diffusion * TEXELS)
    across = (x - low[0]) / (high[0] - low[0])
    contrast = (
        heat.contrast
        * np.exp(-heat.fading * across)
        * (1.0 - (1.0 + heat.reversed_to) * across * (heat.reversed_to > 0))
    )
    spot = heat.lamp * np.exp(-(across**2 + ((y - low[1]) / (high[1] - low[1]) - 0.4) ** 2) / 0.2)
    texture = (contrast * warm + spot).astype(np.float32)
    if heat.hand:
        texture[-3 * TEXELS :, : 2 * TEXELS] = 10.0
    fine = 2
    from_texture = np.array([[step, 0.0, low[0] + 0.5 * step], [0.0, step, low[1] + 0.5 * step], [0.0, 0.0, 1.0]])
    enlarged = np.array([[fine, 0.0, 0.5 * (fine - 1)], [0.0, fine, 0.5 * (fine - 1)], [0.0, 0.0, 1.0]])
    room = _room(rng, fine * width, fine * height, heat.hot)
    to_picture = enlarged @ H @ from_texture
    scene = cv2.warpPerspective(texture, to_picture, room.shape[::-1], room, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    scene = cv2.GaussianBlur(scene, (0, 0), fine * heat.defocus)
    kelvin = cv2.resize(scene, (width, height), interpolation=cv2.INTER_AREA) + rng.normal(0.0, NETD, (height, width))
    seen = np.column_stack([_circle_centres(points, radius, H) if radius else _projected(points, H)])
    return np.rint(7000.0 + COUNTS_PER_KELVIN * kelvin).astype(np.uint16), seen


def _squares(x, y, points, gap):
    high = points.max(axis=0) + 1.0
    inside = (x > -1.0) & (x < high[0]) & (y > -1.0) & (y < high[1])
    near_middle = np.maximum(np.abs(x % 1.0 - 0.5), np.abs(y % 1.0 - 0.5)) < 0.5 - gap
    return ((np.floor(x) + np.floor(y)) % 2 == 0) * (inside & near_middle) * np.float32(1.0)


def _circles(x, y, points, radius):
    warm = np.zeros(x.shape, np.float32)
    for point in points:
        # Only the texels around the circle: the whole texture for each point took longer than finding the board.
        first = ((point - radius - [x[0, 0], y[0, 0]]) * TEXELS).astype(int).clip(0)
        last = first + round(2.0 * radius * TEXELS) + 2
        near = slice(first[1], last[1]), slice(first[0], last[0])
        warm[near][np.hypot(x[near] - point[0], y[near] - point[1]) < radius] = 1.0
    return warm


def _room(rng, width, height, hot):
    room = cv2.resize(rng.normal(0.0, 0.7, (5, 6)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(5):
        middle, size = rng.uniform(0, [width, height]), rng.uniform(0.05, 0.3, 2) * width
        corners = cv2.boxPoints((middle.tolist(), size.tolist(), float(rng.uniform(0, 180))))
        cv2.fillPoly(room, [corners.astype(int)], float(rng.normal(0.0, 1.5)))
    if hot:
        cv2.ellipse(room, (0, height // 2), (width // 8, height // 3), 0, 0, 360, hot, -1)
    return room


def _homography(points, rng, width, height, fill, outside):
    """Of a board tilted by some 25 degrees, with all points in the picture, or some of them not."""
    middle, extent = points.mean(axis=0), np.ptp(points, axis=0).max()
    while True:
        focal, distance = 1.2 * width, 1.2 * extent / rng.uniform(0.8 * fill, fill)
        R = cv2.Rodrigues(rng.normal(0.0, 0.3, 3))[0]
        aim = rng.uniform(-0.45, 0.45, 2) * [width, height] * (1.0 if outside else 0.5)
        t = distance * np.array([*(aim / focal), 1.0]) - R[:, :2] @ middle
        K = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
        H = K @ np.column_stack([R[:, :2], t])
        seen = _projected(points, H)
        within = np.all((seen > 12.0) & (seen < [width - 13.0, height - 13.0]), axis=1)
        if R[2, 2] > 0.5 and (0.4 < within.mean() < 0.8 if outside else within.all()):
            return H


def _projected(points, H):
    seen = np.column_stack([points, np.ones(len(points))]) @ H.T
    return seen[:, :2] / seen[:, 2:]


def _circle_centres(points, radius, H):
    """Middles of the ellipses: the poles of the line at infinity."""
    centres = []
    for x, y in points:
        circle = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [-x, -y, x * x + y * y - radius**2]])
        inverse = np.linalg.inv(H)
        conic = inverse.T @ circle @ inverse
        centres.append(-np.linalg.solve(conic[:2, :2], conic[:2, 2]))
    return np.array(centres)
