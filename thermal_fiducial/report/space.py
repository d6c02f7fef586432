"""The flight in three dimensions: path, markers and covariance ellipsoids."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.marker_table import FIXED, QUARANTINED, Tag
from thermal_fiducial.report.stacked_plots import Chart, FIDUCIAL, FUSED, GOOD, MOST_DOTS, thinned, TRUTH
from thermal_fiducial.report.trajectory import Trajectory

#: Most points of the path.
MOST_PATH_POINTS = 4_000
#: Most ellipsoids of markers and along the path; more would hide each other.
MOST_MARKERS, MOST_POSES = 300, 16
#: Drawn size of a typical ellipsoid [m]; its millimetres would be invisible at the scale of the flight.
_TYPICAL_M = 0.1
_LARGEST_FACTOR = 500.0
#: Largest drawn size [m]; ellipsoids from before the convergence of the filter would hide everything else.
_LARGEST_M = 0.4
_SIGMAS = 3.0
#: View point, chosen so that the titles of all axes are visible.
_CAMERA = {'eye': {'x': -1.6, 'y': -1.26, 'z': 0.95}, 'center': {'x': 0.0, 'y': 0.0, 'z': -0.15}}
#: As in RViz and Foxglove: red is a fault.
_COLOURS = {FIXED: '#e2a400', 'seen': GOOD, 'not seen': TRUTH, QUARANTINED: FIDUCIAL}


def scene_chart(evaluation: Evaluation) -> list[Chart]:
    """Path, markers and ellipsoids of uncertainty; nothing for a run without any pose."""
    run = evaluation.run
    if not (len(run.fused) or len(run.fiducial)):
        return []
    markers = [] if run.marker_map is None else list(run.marker_map.markers.values())
    factor = _enlargement(evaluation, markers)
    figure = go.Figure(
        [*_paths(evaluation), *_plates(evaluation, markers), *_ellipsoids(evaluation, markers, factor)],
    )
    axes = {f'{axis}axis': {'title': {'text': f'{axis} [m]'}} for axis in 'xyz'}
    figure.update_layout(
        template='none',
        height=620,
        margin={'l': 0, 'r': 0, 't': 0, 'b': 0},
        legend={'x': 0.0, 'y': 1.0, 'itemsizing': 'constant'},
        scene={**axes, 'aspectmode': 'data', 'camera': _CAMERA},
    )
    text = (
        f'Drag to turn, scroll to zoom. Ellipsoids: {_SIGMAS:.0f} sigma of markers and of the pose, '
        f'enlarged {factor:.0f} times; those of the pose that are larger than the view allows are left out.'
    )
    return [Chart('scene', 'Path, markers and their uncertainty', text, figure, timed=False, wide=True)]


def _paths(evaluation: Evaluation) -> list[Any]:
    run = evaluation.run
    made = []
    if run.truth is not None:
        made.append(_path(run.truth, 'ground truth', MOST_PATH_POINTS, line={'color': TRUTH, 'width': 6}, opacity=0.5))
    dots = {'mode': 'markers', 'marker': {'color': FIDUCIAL, 'size': 1.8}}
    made.append(_path(run.fiducial, 'markers alone', MOST_DOTS, visible='legendonly', **dots))
    made.append(_path(run.fused, 'fused', MOST_PATH_POINTS, line={'color': FUSED, 'width': 4}))
    if len(run.fused):
        start = run.fused.take(np.arange(1))
        made.append(_path(start, 'start', 1, mode='markers', marker={'color': FUSED, 'size': 6, 'symbol': 'diamond'}))
    return made


def _path(trajectory: Trajectory, name: str, most: int, **look: Any) -> Any:
    points = trajectory.positions[thinned(len(trajectory), most)].astype(np.float32)
    return go.Scatter3d(x=points[:, 0], y=points[:, 1], z=points[:, 2], name=name, **({'mode': 'lines'} | look))


def _kind(tag: Tag) -> str:
    return tag.status if tag.status in _COLOURS else 'seen' if tag.views else 'not seen'


def _plates(evaluation: Evaluation, markers: Sequence[MapMarker]) -> list[Any]:
    """Squares of the markers, one trace per kind, with details of each as hover text."""
    kinds = {tag.id: _kind(tag) for tag in evaluation.tags}
    words = {tag.id: f'{tag.status}: {tag.why}<br>{number_of(tag.views, "view")}' for tag in evaluation.tags}
    made: list[Any] = []
    for kind, colour in _COLOURS.items():
        chosen = [marker for marker in markers if kinds[marker.id] == kind]
        if not chosen:
            continue
        corners = np.array([corners_in_map(marker.T_map_marker, marker.size) for marker in chosen])
        first = 4 * np.arange(len(chosen))[:, None]
        faces = (first + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
        made.append(_mesh(corners.reshape(-1, 3), faces, colour, 0.85, f'marker {kind}'))
        centres = corners.mean(axis=1)
        labels = {
            'text': [str(marker.id) for marker in chosen],
            'hovertext': [f'marker {marker.id}<br>{words.get(marker.id, "")}' for marker in chosen],
            'hoverinfo': 'text',
        }
        made.append(
            go.Scatter3d(
                x=centres[:, 0], y=centres[:, 1], z=centres[:, 2], mode='text', showlegend=False, **labels
            )
        )  # fmt: skip
    return made


def _enlargement(evaluation: Evaluation, markers: Sequence[MapMarker]) -> float:
    """Factor that makes the typical ellipsoid visible, a round number."""
    covariances = _marker_covariances(markers)
    if not len(covariances):
        covariances = evaluation.run.output.covariances[:, :3, :3]
    axes = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0)) if len(covariances) else np.zeros(0)
    typical = _SIGMAS * float(np.median(axes)) if len(axes) else 0.0
    if typical <= 0.0:
        return 1.0
    factor = float(np.clip(_TYPICAL_M / typical, 1.0, _LARGEST_FACTOR))
    return max((step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500) if step <= factor), default=1)


def _marker_covariances(markers: Sequence[MapMarker]) -> FloatArray:
    known = [marker.covariance[:3, :3] for marker in markers if np.any(marker.covariance[:3, :3])]
    return np.array(known).reshape(-1, 3, 3)


def _ellipsoids(evaluation: Evaluation, markers: Sequence[MapMarker], factor: float) -> list[Any]:
    known = [marker for marker in markers if np.any(marker.covariance[:3, :3])][:MOST_MARKERS]
    centres = np.array([marker.T_map_marker[:3, 3] for marker in known]).reshape(-1, 3)
    made = [_ellipsoid_mesh(centres, _marker_covariances(known), factor, GOOD, 'uncertainty of markers')]
    output, fused = evaluation.run.output, evaluation.run.fused
    shown = thinned(len(output.stamps_ns), MOST_POSES)
    at = np.searchsorted(fused.stamps_ns, output.stamps_ns[shown])
    shown, at = shown[at < len(fused)], at[at < len(fused)]
    covariances = output.covariances[shown, :3, :3]
    drawn = np.linalg.eigvalsh(covariances)[:, -1] < (_LARGEST_M / (_SIGMAS * factor)) ** 2
    centres = fused.positions[at[drawn]]
    made.append(_ellipsoid_mesh(centres, covariances[drawn], factor, FUSED, 'uncertainty of the pose'))
    return [mesh for mesh in made if mesh is not None]


def _ellipsoid_mesh(centres: FloatArray, covariances: FloatArray, factor: float, colour: str, name: str) -> Any:
    if not len(centres):
        return None
    sphere, faces = _sphere()
    values, vectors = np.linalg.eigh(covariances)
    axes = _SIGMAS * factor * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    points = centres[:, None, :] + np.einsum('nij,pj->npi', axes, sphere)
    every = faces[None] + (len(sphere) * np.arange(len(centres)))[:, None, None]
    return _mesh(points.reshape(-1, 3), every.reshape(-1, 3), colour, 0.2, name)


def _mesh(points: FloatArray, faces: IntArray, colour: str, opacity: float, name: str) -> Any:
    x, y, z = points.astype(np.float32).T
    i, j, k = faces.astype(np.int32).T
    return go.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, color=colour, opacity=opacity, name=name, showlegend=True, hoverinfo='name'
    )


def _sphere() -> tuple[FloatArray, IntArray]:
    """Points (P, 3) of a unit sphere and its triangles (F, 3)."""
    rings, sectors = 8, 12
    theta = np.linspace(0.0, np.pi, rings + 1)[:, None]
    phi = np.linspace(0.0, 2.0 * np.pi, sectors, endpoint=False)[None, :]
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi], axis=-1)
    ring, sector = np.meshgrid(np.arange(rings), np.arange(sectors), indexing='ij')
    a = (ring * sectors + sector).ravel()
    b = (ring * sectors + (sector + 1) % sectors).ravel()
    faces = np.concatenate([np.stack([a, a + sectors, b], axis=1), np.stack([b, a + sectors, b + sectors], axis=1)])
    return points.reshape(-1, 3), faces
