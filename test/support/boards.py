"""Calibration boards in front of the simulated camera."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from thermal_fiducial.sim.render import Quality, Renderer
from thermal_fiducial.sim.scene import Acrylic, Fog, Plate, Room
from thermal_fiducial.sim.sensor import Sensor
from thermal_fiducial.sim.spline_trajectory import SplineTrajectory

#: A Tau 2 six seconds after its shutter closed.
TIME = 13.0
SENSOR = replace(Sensor(), lag=0.0)
STILL = SplineTrajectory(np.arange(20.0), np.zeros((20, 3)), Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (20, 1))))


def chessboard_levels(columns, rows):
    """Squares of a board with ``columns`` x ``rows`` inner corners and a border of a square."""
    row, column = np.mgrid[0 : rows + 3, 0 : columns + 3]
    inside = (row > 0) & (row < rows + 2) & (column > 0) & (column < columns + 2)
    return ((row + column) % 2 == 0) & inside


def circle_levels(columns, rows, spacing, diameter, cell):
    """Round holes on a grid of cells of side ``cell`` [m], border one spacing; and width and height."""
    height, width = (rows + 1) * spacing, (2 * columns + 1) * spacing
    v, u = (np.mgrid[0 : round(height / cell), 0 : round(width / cell)] + 0.5) * cell - spacing
    row = np.clip(np.rint(v / spacing), 0, rows - 1)
    column = np.clip(np.rint((u / spacing - row % 2) / 2), 0, columns - 1)
    near = np.hypot(u - (2 * column + row % 2) * spacing, v - row * spacing) < 0.5 * diameter
    return near, width, height


def render(lens, T_camera_plate, levels, width, height, contrast, seed, *, opaque=None, samples=97):
    """Counts of a plate (x right, y up, z out of its face) ``contrast`` [K] warmer where ``levels`` is set."""
    opaque = np.ones_like(levels, dtype=bool) if opaque is None else opaque
    cold, hot = (0.0, contrast) if contrast > 0 else (-contrast, 0.0)
    plate = Plate(T_camera_plate, width, height, levels.astype(float), opaque, hot, cold)
    room = Room((-30.0, -30.0, -30.0), (30.0, 30.0, 30.0))
    quality, blur = Quality(samples=samples, warm_up=0), SENSOR.psf_sigma_px
    renderer = Renderer(
        lens, [plate], room, Fog(), Acrylic(), STILL, np.eye(4), lag=0.0, quality=quality, psf_sigma_px=blur
    )
    return SENSOR.counts(renderer.frame(TIME), TIME, 0, seed)


def random_view(lens, points, rng, *, fill=0.75, tilt=0.4):
    """T_camera_board with all board ``points`` (N, 3) in the image, the board rather large in it."""
    middle = points.mean(axis=0)
    extent = np.ptp(points, axis=0)[:2].max()
    while True:
        distance = lens.focal[0] * extent / (lens.width * rng.uniform(0.35, fill))
        aim = np.array([lens.width, lens.height]) * rng.uniform(0.2, 0.8, 2)
        R = Rotation.from_rotvec(rng.normal(0.0, tilt, 3)).as_matrix()
        ray = np.append(lens.slopes(aim), 1.0)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, distance * ray - R @ middle
        seen = points @ R.T + T[:3, 3]
        if np.all(seen[:, 2] > 0.1):
            uv = lens.project(seen)
            if np.all((uv > 14) & (uv < np.array([lens.width, lens.height]) - 15)):
                return T


def plate_pose(T_camera_board, centre):
    """Pose of a plate (y up) whose middle lies at ``centre`` (2,) of a board (y down)."""
    T = T_camera_board.copy()
    T[:3, 3] += T[:3, :2] @ centre
    T[:3, :3] = T[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    return T
