"""A marker map drawn from above and from the side."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
import numpy as np

from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

_VIEWS = (('from above', 0, 1), ('from the side', 0, 2), ('from the front', 1, 2))


def plot_map(marker_map: MarkerMap, path: Path, cloud: FloatArray | None = None) -> None:
    """Draw the markers with their normals and three-sigma ellipses, over a point cloud (N, 3) if there is one.

    Raises
    ------
    InputError
        The file can't be written.
    """
    figure = Figure(figsize=(15, 5.5), layout='constrained')
    for axis, (title, i, j) in zip(figure.subplots(1, len(_VIEWS)), _VIEWS, strict=True):
        if cloud is not None:
            axis.plot(cloud[:, i], cloud[:, j], ',', color='0.7')
        for marker in marker_map.markers.values():
            _draw(axis, marker, i, j)
        axis.set(title=title, xlabel=f'{"xyz"[i]} [m]', ylabel=f'{"xyz"[j]} [m]', aspect='equal')
        axis.grid(alpha=0.3)
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise InputError(f'{path}: cannot write the plot: {error}') from error


def _draw(axis: Axes, marker: MapMarker, i: int, j: int) -> None:
    colour = 'black' if marker.fixed else 'tab:red' if not marker.trusted else 'tab:blue'
    outline = corners_in_map(marker.T_map_marker, marker.size)[[0, 1, 2, 3, 0]]
    axis.plot(outline[:, i], outline[:, j], color=colour)
    centre = marker.T_map_marker[:3, 3]
    tip = centre + 0.75 * marker.size * marker.T_map_marker[:3, 2]
    axis.plot([centre[i], tip[i]], [centre[j], tip[j]], color=colour, linewidth=0.8)
    axis.annotate(str(marker.id), (tip[i], tip[j]), color=colour, fontsize=8)
    values, vectors = np.linalg.eigh(marker.covariance[np.ix_((i, j), (i, j))])
    width, height = 6.0 * np.sqrt(np.maximum(values, 0.0))
    angle = np.rad2deg(np.arctan2(vectors[1, 0], vectors[0, 0]))
    axis.add_patch(Ellipse((centre[i], centre[j]), width, height, angle=angle, fill=False, color=colour, alpha=0.5))
