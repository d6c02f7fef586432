"""Point clouds of a site (PLY and PCD, needs the extra ``cloud``), and alignments of maps with them."""

from pathlib import Path
import re

import numpy as np

from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.packages import remedy
from thermal_fiducial.files.plain_yaml import save_plain
from thermal_fiducial.files.schema import load_yaml

# Sizes in a PLY or PCD header: elements, points, width and height.
_COUNTS = re.compile(rb'^(?:element +\S+|POINTS|WIDTH|HEIGHT) +([0-9]{1,18})[0-9]*\s*$', re.MULTILINE)
# Values per field in a PCD header; the library allocates them one by one.
_VALUES = re.compile(rb'^COUNT((?: +-?[0-9]{1,18})+)', re.MULTILINE)
_MOST_VALUES = 1000
_PACKED = re.compile(rb'^DATA +binary_compressed', re.MULTILINE)
_HEADER_BYTES = 65_536
_NEEDED = f'reading point clouds needs the extra "cloud": {remedy("cloud")}'


def load_cloud(path: str | Path) -> FloatArray:
    """Finite points (N, 3) [m] of a ``.ply`` or ``.pcd`` file.

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
        _check_promise(path)
        points = reader(path)
    except InputError:
        raise
    except ImportError as error:
        raise InputError(_NEEDED) from error
    except Exception as error:
        # The readers raise arbitrary exceptions for malformed files.
        raise InputError(f'{path}: not a readable point cloud: {type(error).__name__}') from error
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        raise InputError(f'{path}: no points')
    return points


def thinned(points: FloatArray, most: int) -> FloatArray:
    """At most ``most`` of the points (N, 3), by a voxel grid of the smallest sufficient cell."""
    if len(points) <= most:
        return points
    extent = np.ptp(points, axis=0).max()
    cell = max(extent / 1024.0, 1e-6)
    while len(points) > most:
        cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
        _, firsts = np.unique(cells @ [1 << 40, 1 << 20, 1], return_index=True)
        points, cell = points[np.sort(firsts)], 1.3 * cell
    return points


def save_alignment(path: Path, T_cloud_map: FloatArray, cloud: str, frame_id: str) -> None:
    """Write T_cloud_map (4, 4) of the map ``frame_id`` in ``cloud``, as position and quaternion.

    Raises
    ------
    InputError
        The file can't be written.
    """
    document = {
        'parent': cloud,
        'child': frame_id,
        'position': [round(float(v), 9) for v in T_cloud_map[:3, 3]],
        'orientation': [round(float(v), 9) for v in quaternion_from_rotation(T_cloud_map[:3, :3])],
    }
    save_plain(path, document)


def load_alignment(path: str | Path) -> FloatArray:
    """T_cloud_map (4, 4) from a file of :func:`save_alignment`.

    Raises
    ------
    InputError
        Not an alignment file.
    """
    root = load_yaml(path)
    fields = root.mapping()
    if 'position' not in fields or 'orientation' not in fields:
        raise root.error('not a transform written by map align: no position and orientation')
    position = fields['position'].numbers(3, LARGEST_COORDINATE)
    return transform_from_quaternion(position, fields['orientation'].unit_quaternion())


def _check_promise(path: Path) -> None:
    """Refuse a header that claims more data than the file can have, for which a reader would allocate memory.

    Raises
    ------
    InputError
        The claim is too large, or there is no header.
    """
    with path.open('rb') as file:
        header = file.read(_HEADER_BYTES)
    size = path.stat().st_size
    counts = [int(count) for count in _COUNTS.findall(header.partition(b'end_header')[0])]
    if not counts:
        raise InputError(f'{path}: not a readable point cloud: no header')
    # A value takes at least one byte; PCD's compression reaches at most a factor of 100.
    packed = _PACKED.search(header) is not None
    if max(counts) > size * (100 if packed else 1):
        raise InputError(f'{path}: the header promises {max(counts)} points, the file has {size} bytes')
    if any(int(values) > _MOST_VALUES for line in _VALUES.findall(header) for values in line.split()):
        raise InputError(f'{path}: the header promises points of more than {_MOST_VALUES} values')


def _read_ply(path: Path) -> FloatArray:
    from plyfile import PlyData

    vertices = PlyData.read(str(path))['vertex']
    return np.stack([np.asarray(vertices[axis], dtype=np.float64) for axis in 'xyz'], axis=-1)


def _read_pcd(path: Path) -> FloatArray:
    from pypcd4.pypcd4 import PointCloud

    return np.asarray(PointCloud.from_path(path).numpy(('x', 'y', 'z')), dtype=np.float64)
