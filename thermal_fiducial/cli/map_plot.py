"""Drawings of a marker map from above, from the side and from the front."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator
import numpy as np
from scipy.spatial import KDTree

from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.writing import new_file

# Axes that point right and up in the views from above and along y.
_VIEWS = (('from above', 0, 1), ('from the side, along y', 0, 2))
_STATUSES = {'fixed': 'black', 'free': 'tab:blue', 'in quarantine': 'tab:red'}
#: Enlargements of the ellipses: millimetres would be invisible beside metres.
_ENLARGEMENTS = (20, 10, 5, 2)
#: Number of labels of four digits that fit into the width of a view.
_MOST_TICKS = 7
#: Height of the legend as a share of the drawing: a title and a row.
_LEGEND = 0.1
#: Passes of the layout: after three nothing moves by a pixel in drawings of walls, rooms and halls.
_LAYOUT_STEPS = 3


def plot_map(marker_map: MarkerMap, path: Path, cloud: FloatArray | None = None) -> None:
    """Write the drawing of :func:`draw_map` to a file.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    figure = draw_map(marker_map, cloud)
    with new_file(path) as new:
        try:
            figure.savefig(new, dpi=120)
        except ValueError as error:
            raise InputError(f'{path}: cannot write the plot: {error}') from error


def draw_map(marker_map: MarkerMap, cloud: FloatArray | None = None) -> Figure:
    """The markers with their normals and enlarged ellipses, over a point cloud (N, 3) if there is one."""
    figure = Figure(figsize=(15, 5.5))
    # A legend 'outside lower center' takes room by itself, but needs matplotlib 3.7; Ubuntu 24.04 has 3.6.
    figure.set_layout_engine('constrained', rect=(0.0, _LEGEND, 1.0, 1.0 - _LEGEND))
    views = (*_VIEWS, (_front(marker_map), 1, 2))
    enlarged = _enlargement(marker_map)
    for axis, (title, i, j) in zip(figure.subplots(1, len(views)), views, strict=True):
        if cloud is not None:
            axis.plot(cloud[:, i], cloud[:, j], ',', color='0.7')
        for marker in marker_map.markers.values():
            _draw(axis, marker, i, j, enlarged)
        axis.set(title=title, xlabel=f'{"xyz"[i]} [m]', ylabel=f'{"xyz"[j]} [m]', aspect='equal')
        axis.grid(alpha=0.3)
        axis.margins(0.12)  # labels are at the tips of the normals
        _space_ticks(axis)
        if title.endswith('along x'):
            axis.invert_xaxis()  # in a view along x, y points to the left
    handles = [Line2D([], [], color=colour, label=status) for status, colour in _STATUSES.items()]
    scale = f' enlarged {enlarged} times' if enlarged > 1 else ''
    title = f'{marker_map.size_in_words}, normals, ellipses of three sigma{scale}'
    figure.legend(handles=handles, title=title, loc='lower center', ncols=len(handles))
    # The layout of views of equal scale converges in passes; after the first, a title is cut off.
    for _ in range(_LAYOUT_STEPS):
        figure.draw_without_rendering()
    return figure


def _enlargement(marker_map: MarkerMap) -> int:
    """The largest enlargement with which the ellipse of a typical marker ends half-way to the nearest other marker."""
    markers = list(marker_map.markers.values())
    if len(markers) < 2:
        return _ENLARGEMENTS[0]
    centres = np.array([marker.T_map_marker[:3, 3] for marker in markers])
    nearest = KDTree(centres).query(centres, k=2)[0][:, 1]
    variances = np.linalg.eigvalsh([marker.covariance[:3, :3] for marker in markers])[:, -1]
    reach = 3.0 * np.median(np.sqrt(np.maximum(variances, 0.0)))
    return next((times for times in _ENLARGEMENTS if times * reach <= 0.5 * np.median(nearest)), 1)


def _space_ticks(axis: Axes) -> None:
    """Thin out the labels of a short axis, such as that across a wall."""
    low, high = axis.get_xlim()
    share = (high - low) / max(np.ptp(axis.get_ylim()), high - low)
    axis.xaxis.set_major_locator(MaxNLocator(nbins=max(1, int(_MOST_TICKS * share)), min_n_ticks=1))


def _front(marker_map: MarkerMap) -> str:
    """The view along x or against it that shows the faces of the markers."""
    facing = sum(float(marker.T_map_marker[0, 2]) for marker in marker_map.markers.values())
    return 'from the front, against x' if facing > 0.0 else 'from the front, along x'


def _draw(axis: Axes, marker: MapMarker, i: int, j: int, enlarged: float) -> None:
    colour = _STATUSES['in quarantine' if not marker.trusted else 'fixed' if marker.fixed else 'free']
    outline = corners_in_map(marker.T_map_marker, marker.size)[[0, 1, 2, 3, 0]]
    axis.plot(outline[:, i], outline[:, j], color=colour)
    centre = marker.T_map_marker[:3, 3]
    tip = centre + 0.75 * marker.size * marker.T_map_marker[:3, 2]
    axis.plot([centre[i], tip[i]], [centre[j], tip[j]], color=colour, linewidth=0.8)
    axis.annotate(str(marker.id), (tip[i], tip[j]), color=colour, fontsize=8)
    values, vectors = np.linalg.eigh(marker.covariance[np.ix_((i, j), (i, j))])
    width, height = enlarged * 6.0 * np.sqrt(np.maximum(values, 0.0))
    angle = np.rad2deg(np.arctan2(vectors[1, 0], vectors[0, 0]))
    axis.add_patch(Ellipse((centre[i], centre[j]), width, height, angle=angle, fill=False, color=colour, alpha=0.5))
