"""Contents of the room: markers, warm clutter, walls, fog. Temperatures are in kelvin above ambient."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray
from thermal_fiducial.sim.spline_trajectory import pose_matrix


def facing(yaw_deg: float, tilt_deg: float = 0.0, roll_deg: float = 0.0) -> Rotation:
    """R_map_plate of a plate (x right, y up, z out of its face) whose face looks along ``yaw_deg``.

    ``tilt_deg`` turns it about its own x, ``roll_deg`` then about its own z.
    """
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    upright = Rotation.from_matrix(np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]]))
    return upright * Rotation.from_euler('XZ', [tilt_deg, roll_deg], degrees=True)


@dataclass(frozen=True)
class Marker:
    """An acrylic stencil in front of a warm plate.

    Parameters
    ----------
    id : in the scenario's dictionary
    position : of its centre in ``map`` [m]
    yaw_deg, tilt_deg, roll_deg : orientation, see :func:`facing`
    size : side of the black square [m]
    """

    id: int
    position: tuple[float, float, float]
    yaw_deg: float
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    size: float = 0.30

    @cached_property
    def rotation(self) -> Rotation:
        """R_map_marker."""
        return facing(self.yaw_deg, self.tilt_deg, self.roll_deg)

    @cached_property
    def T_map_marker(self) -> FloatArray:
        """(4, 4)."""
        return pose_matrix(self.rotation, self.position)

    @cached_property
    def corners_map(self) -> FloatArray:
        """(4, 3) in ``map`` [m], clockwise from the top-left."""
        s = self.size / 2
        local = np.array([[-s, s, 0, 1], [s, s, 0, 1], [s, -s, 0, 1], [-s, -s, 0, 1.0]])
        return np.asarray((local @ self.T_map_marker.T)[:, :3])

    @cached_property
    def spread_map(self) -> FloatArray:
        """Points (25, 3) all over the square, in ``map`` [m]."""
        a, b = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 5))
        first, right, _, down = self.corners_map
        return np.asarray(first + a.reshape(-1, 1) * (right - first) + b.reshape(-1, 1) * (down - first))


@dataclass(frozen=True)
class Clutter:
    """A warm object without a code: ``kind`` is person, heater, pipe or plate.

    Parameters
    ----------
    width, height : [m]
    excess : above ambient [K]
    """

    kind: str
    position: tuple[float, float, float]
    yaw_deg: float
    width: float
    height: float
    excess: float


@dataclass(frozen=True)
class Acrylic:
    """Temperatures of the stencils.

    Parameters
    ----------
    contrast : of plate over sheet while the sheet is cold [K]
    gradient : difference between the two sides of a plate, as a share of the contrast
    steady : final warming of the sheet, as a share of the contrast
    warm_up_time : time constant of the warming [s]
    age : time since the plates were switched on, at the start [s]
    inverted : warm code on a cold ground instead of warm holes in a cold sheet
    """

    contrast: float = 15.0
    gradient: float = 0.12
    steady: float = 0.42
    warm_up_time: float = 240.0
    age: float = 60.0
    inverted: bool = False

    def sheet(self, t: float) -> float:
        """Excess of the sheet at time ``t`` [s] of the flight."""
        return self.contrast * self.steady * (1.0 - float(np.exp(-(t + self.age) / self.warm_up_time)))


@dataclass(frozen=True)
class Fog:
    """Attenuation and path radiance: L = tau L_scene + (1 - tau) L_fog with tau = exp(-extinction * range).

    Parameters
    ----------
    extinction : in the long-wave infrared [1/m]
    excess : temperature of the fog above ambient [K]
    swing, period : relative amplitude [1] and period [s] of the variation of the extinction
    """

    extinction: float = 0.0
    excess: float = 0.5
    swing: float = 0.3
    period: float = 11.0

    def at(self, t: float) -> float:
        """Extinction at time ``t`` [s] [1/m]."""
        return self.extinction * (1.0 + self.swing * float(np.sin(2 * np.pi * t / self.period)))


@dataclass(frozen=True)
class Room:
    """A box whose walls have slightly different, slowly varying temperatures.

    Parameters
    ----------
    low, high : opposite corners in ``map`` [m]
    excess : of the walls -x +x -y +y floor ceiling [K]
    texture : amplitude of the variation along the walls [K]
    """

    low: tuple[float, float, float] = (-4.0, -4.0, 0.0)
    high: tuple[float, float, float] = (5.0, 4.0, 3.0)
    excess: tuple[float, ...] = (0.3, 0.0, -0.4, 0.2, -0.8, 0.9)
    texture: float = 0.25

    def look(self, origin: FloatArray, directions: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Excess [K] and distance (in units of the direction's length) along ``directions`` (..., 3) from inside."""
        safe = np.where(np.abs(directions) < 1e-9, np.float32(1e-9), directions)
        inside = np.asarray(origin, dtype=safe.dtype)
        walls = np.where(safe > 0, np.array(self.high, safe.dtype), np.array(self.low, safe.dtype))
        along = (walls - inside) / safe
        axis = np.argmin(along, axis=-1)
        distance = np.take_along_axis(along, axis[..., None], axis=-1)[..., 0]
        side = np.take_along_axis(safe, axis[..., None], axis=-1)[..., 0] > 0
        x, y, z = np.moveaxis(inside + distance[..., None] * directions, -1, 0)
        wave = np.sin(1.3 * x + 0.7 * z) + np.sin(1.1 * y - 0.9 * z + 1.0) + np.sin(0.6 * (x + y) + 1.7 * z)
        return np.array(self.excess, safe.dtype)[2 * axis + side] + self.texture * wave, distance


class Plate:
    """A rectangle of cells: the only object that the renderer draws.

    Parameters
    ----------
    T_map_plate : (4, 4)
    width, height : [m]
    levels : (rows, columns) in 0..1, row 0 at the top (+y): 0 is the sheet, 1 the plate behind
    opaque : (rows, columns), False where the plate is transparent
    hot : excess of level 1 [K]
    cold : excess of level 0 [K]; None: that of the acrylic
    gradient : relative change of ``hot`` across the width and the height
    """

    def __init__(
        self,
        T_map_plate: FloatArray,
        width: float,
        height: float,
        levels: FloatArray | BoolArray,
        opaque: BoolArray,
        hot: float,
        cold: float | None,
        gradient: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.T_map_plate = T_map_plate
        self.width, self.height = width, height
        self.levels = np.pad(levels.astype(np.float32), 1)
        self.cover = np.pad(opaque.astype(np.float32), 1)
        self.levels *= self.cover
        self.hot, self.cold, self.gradient = hot, cold, gradient

    @cached_property
    def regions(self) -> Gray:
        """Region of each cell, (rows + 2, columns + 2) uint8: cells with equal numbers have equal appearance."""
        _, region = np.unique(self.levels + 2 * self.cover, return_inverse=True)
        return np.asarray(region.reshape(self.levels.shape), dtype=np.uint8)

    @cached_property
    def to_cells(self) -> FloatArray:
        """(3, 3): from metres on the plate to column and row of the padded grids."""
        rows, columns = np.array(self.levels.shape) - 2
        return np.array(
            [[columns / self.width, 0, columns / 2 + 1], [0, -rows / self.height, rows / 2 + 1], [0, 0, 1.0]]
        )

    def hides(self, origin: FloatArray, points: FloatArray) -> BoolArray:
        """Whether each of ``points`` (..., 3) is behind the plate, seen from ``origin`` (3,), all in ``map``."""
        R, centre = self.T_map_plate[:3, :3], self.T_map_plate[:3, 3]
        o, p = (origin - centre) @ R, (points - centre) @ R
        share = o[2] / np.maximum(o[2] - p[..., 2], 1e-9)
        hit = o[:2] + share[..., None] * (p[..., :2] - o[:2])
        column, row = np.moveaxis(hit @ self.to_cells[:2, :2].T + self.to_cells[:2, 2], -1, 0)
        rows, columns = self.cover.shape
        opaque = self.cover[np.clip(row, 0, rows - 1).astype(int), np.clip(column, 0, columns - 1).astype(int)] > 0
        return np.asarray(opaque & (share < 1.0 - 1e-6) & (o[2] > 0))

    @property
    def outline_map(self) -> FloatArray:
        """(4, 3) corners in ``map`` [m]."""
        w, h = self.width / 2, self.height / 2
        return np.asarray(
            np.array([[-w, h, 0, 1], [w, h, 0, 1], [w, -h, 0, 1], [-w, -h, 0, 1.0]]) @ self.T_map_plate.T
        )[:, :3]


def marker_plate(marker: Marker, dictionary: cv2.aruco.Dictionary, acrylic: Acrylic) -> Plate:
    """The stencil of a marker, with one cell of warm plate around the black square."""
    cells = dictionary.markerSize + 2
    packed = dictionary.bytesList[marker.id : marker.id + 1]
    bits = np.pad(cv2.aruco.Dictionary.getBitsFromByteList(packed, dictionary.markerSize) > 0, 1)
    bits = np.pad(bits, 1, constant_values=True)
    if acrylic.inverted:
        bits = ~bits
    side = marker.size * (cells + 2) / cells
    direction = np.random.default_rng([marker.id, 3]).uniform(0, 2 * np.pi)
    gradient = (acrylic.gradient * float(np.cos(direction)), acrylic.gradient * float(np.sin(direction)))
    return Plate(marker.T_map_marker, side, side, bits, np.ones_like(bits), acrylic.contrast, None, gradient)


def clutter_plate(item: Clutter) -> Plate:
    """A person's silhouette, a ribbed heater, a pipe or a plain plate."""
    shapes = {'person': _silhouette(), 'heater': np.tile([1.0, 0.6], (1, 9)), 'pipe': np.ones((1, 1))}
    levels = shapes.get(item.kind, np.ones((1, 1)))
    gradient = (0.05, 0.3) if item.kind == 'heater' else (0.1, 0.1)
    T = pose_matrix(facing(item.yaw_deg), item.position)
    return Plate(T, item.width, item.height, levels, levels > 0, item.excess, 0.0, gradient)


def _silhouette() -> FloatArray:
    """Head, trunk and legs on a grid of 60 x 20 cells; skin is warmer than clothes."""
    y, x = np.mgrid[0:60, 0:20].astype(np.float64)
    body = np.where((np.abs(x - 9.5) < 8.5 - 0.06 * y) & (y > 12) & ((y < 34) | (np.abs(x - 9.5) > 1.5)), 0.6, 0.0)
    head = ((x - 9.5) / 4.0) ** 2 + ((y - 6.0) / 6.0) ** 2 < 1.0
    return np.where(head, 1.0, body)
