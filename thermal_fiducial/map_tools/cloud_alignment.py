"""Alignment of a marker map to a point cloud of the site.

Each marker hangs on, or close to, a surface, so its plane should coincide with that of the cloud's points around it.
ICP (small_gicp: K. Koide, "small_gicp: Efficient and parallel algorithms for point cloud registration", JOSS 2024)
aligns the marker squares roughly; a least-squares fit to the plane under each marker refines, except in directions
that the planes leave unobservable (along a single wall, say).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from thermal_fiducial.core.geometry.se3 import apply, skew, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.types import FloatArray, TINY
from thermal_fiducial.errors import InputError

# Points along a side of the grid that represents a marker in ICP.
_GRID = 5
# Fewest points of a plane.
_FEWEST = 12
# Smallest eigenvalue of the information matrix, relative to the largest, of an observable direction.
_OPEN = 1e-3
_ITERATIONS = 20


@dataclass(frozen=True)
class PlaneFit:
    """The surface plane at one marker, after the alignment."""

    id: int
    #: distance from the surface to the marker's centre, along the surface's normal [m]
    distance_m: float
    #: angle between the normals of marker and surface [rad]
    angle: float
    #: number of cloud points on the surface
    points: int


@dataclass(frozen=True)
class CloudAlignment:
    """Pose of the map in the cloud."""

    #: (4, 4) T_cloud_map
    T: FloatArray
    fits: list[PlaneFit]
    #: number of unobservable directions, of six, in which the initial transform is kept
    open_directions: int
    #: markers with too few points around them
    without_surface: tuple[int, ...]


def align_to_cloud(
    markers: Iterable[MapMarker], cloud: FloatArray, T_initial: FloatArray, reach_m: float = 0.5
) -> CloudAlignment:
    """Align the map with a cloud (N, 3).

    Parameters
    ----------
    T_initial : (4, 4) rough T_cloud_map
    reach_m : how far a marker may be from its surface at first [m]

    Raises
    ------
    InputError
        No marker has points around it.
    ImportError
        small_gicp is not installed.
    """
    markers = list(markers)
    tree = cKDTree(cloud)
    T = _icp(markers, cloud, T_initial, reach_m)
    planes = _planes(markers, cloud, tree, T, reach_m)
    if _step(markers, planes, T)[1]:
        # ICP drifts in unobservable directions: start from the initial transform, and move only in observable ones.
        T = T_initial
    for _ in range(_ITERATIONS):
        planes = _planes(markers, cloud, tree, T, reach_m)
        T, opened = _step(markers, planes, T)
    fits = [_fit(marker, planes[marker.id], T) for marker in markers if marker.id in planes]
    return CloudAlignment(T, fits, opened, tuple(m.id for m in markers if m.id not in planes))


@dataclass(frozen=True)
class _Plane:
    centre: FloatArray
    normal: FloatArray
    points: int


def _icp(markers: list[MapMarker], cloud: FloatArray, T_initial: FloatArray, reach_m: float) -> FloatArray:
    import small_gicp

    resolution = max(float(np.median([marker.size for marker in markers])) / 4.0, 0.02)
    result = small_gicp.align(
        cloud,
        np.concatenate([_grid(marker) for marker in markers]),
        T_initial,
        registration_type='PLANE_ICP',
        downsampling_resolution=resolution,
        max_correspondence_distance=reach_m,
        max_iterations=50,
    )
    T = np.asarray(result.T_target_source, dtype=np.float64)
    return T if np.all(np.isfinite(T)) else T_initial


def _grid(marker: MapMarker) -> FloatArray:
    """Grid of points (25, 3) on a marker's square, in the map."""
    u = np.linspace(-0.5, 0.5, _GRID) * marker.size
    x, y = np.meshgrid(u, u)
    return apply(marker.T_map_marker, np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1))


def _planes(
    markers: list[MapMarker], cloud: FloatArray, tree: cKDTree, T: FloatArray, reach_m: float
) -> dict[int, _Plane]:
    """Plane of the points around each marker, by total least squares on those near its surface."""
    planes = {}
    for marker in markers:
        centre = apply(T, marker.T_map_marker[None, :3, 3])[0]
        _, nearest = tree.query(centre)
        if np.linalg.norm(cloud[nearest] - centre) > reach_m:
            continue
        around = cloud[tree.query_ball_point(cloud[nearest], marker.size)]
        if len(around) < _FEWEST:
            continue
        middle = np.median(around, axis=0)
        for _ in range(3):
            _, _, Vt = np.linalg.svd(around - middle, full_matrices=False)
            off = np.abs((around - middle) @ Vt[2])
            inside = off <= max(3.0 * float(np.median(off)), 1e-4)
            middle = around[inside].mean(axis=0)
        towards = T[:3, :3] @ marker.T_map_marker[:3, 2]
        normal = Vt[2] if Vt[2] @ towards > 0.0 else -Vt[2]
        planes[marker.id] = _Plane(middle, normal, int(np.count_nonzero(inside)))
    if not planes:
        raise InputError('the cloud has no surface near any marker: is the initial transform right?')
    return planes


def _step(markers: list[MapMarker], planes: dict[int, _Plane], T: FloatArray) -> tuple[FloatArray, int]:
    """T_cloud_map after a least-squares step towards all planes, and the number of unobservable directions."""
    rows, residuals = [], []
    middle = apply(T, np.stack([marker.T_map_marker[:3, 3] for marker in markers])).mean(axis=0)
    for marker in markers:
        plane = planes.get(marker.id)
        if plane is not None:
            points = apply(T, _grid(marker))
            rows.append(np.concatenate([np.tile(plane.normal, (len(points), 1)),
                                        -(plane.normal @ skew(points - middle))], axis=-1))  # fmt: skip
            residuals.append((points - plane.centre) @ plane.normal)
    J, r = np.concatenate(rows), np.concatenate(residuals)
    scale = np.array([1.0] * 3 + [1.0 / max(float(np.abs(J[:, 3:]).max()), TINY)] * 3)
    values, vectors = np.linalg.eigh((J * scale).T @ (J * scale))
    known = values > _OPEN * values[-1]
    step = vectors[:, known] @ ((vectors[:, known].T @ ((J * scale).T @ -r)) / values[known])
    shift, turn = step[:3], so3_exp(step[3:] * scale[3:])
    about_middle = transform(turn, middle + shift - turn @ middle)
    return about_middle @ T, int(np.count_nonzero(~known))


def _fit(marker: MapMarker, plane: _Plane, T: FloatArray) -> PlaneFit:
    centre = apply(T, marker.T_map_marker[None, :3, 3])[0]
    normal = T[:3, :3] @ marker.T_map_marker[:3, 2]
    angle = float(np.arctan2(np.linalg.norm(np.cross(normal, plane.normal)), normal @ plane.normal))
    return PlaneFit(marker.id, float((centre - plane.centre) @ plane.normal), angle, plane.points)
