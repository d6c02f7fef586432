"""Point clouds of a place: PLY and PCD files, read by the libraries of the extra ``cloud``."""

from pathlib import Path

import numpy as np

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

_NEEDED = "reading point clouds needs the extra 'cloud': pip install thermal_fiducial[cloud]"


def load_cloud(path: str | Path) -> FloatArray:
    """Points (N, 3) [m] of a ``.ply`` or ``.pcd`` file; those that are not finite are left out.

    Raises
    ------
    InputError
        No such file, not a point cloud, or the reader is not installed.
    """
    path = Path(path)
    readers = {'.ply': _read_ply, '.pcd': _read_pcd}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f'{path}: a point cloud is a .ply or a .pcd file')
    if not path.is_file():
        raise InputError(f'{path}: no such file')
    try:
        points = reader(path)
    except ImportError as error:
        raise InputError(_NEEDED) from error
    except Exception as error:
        # The readers raise whatever a broken file makes them stumble over.
        raise InputError(f'{path}: not a readable point cloud: {type(error).__name__}') from error
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        raise InputError(f'{path}: no points')
    return points


def _read_ply(path: Path) -> FloatArray:
    from plyfile import PlyData

    vertices = PlyData.read(str(path))['vertex']
    return np.stack([np.asarray(vertices[axis], dtype=np.float64) for axis in 'xyz'], axis=-1)


def _read_pcd(path: Path) -> FloatArray:
    from pypcd4.pypcd4 import PointCloud

    return np.asarray(PointCloud.from_path(path).numpy(('x', 'y', 'z')), dtype=np.float64)
