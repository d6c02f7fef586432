"""Maps of many markers, and flights past ten or twenty of them at a time."""

import numpy as np

from support.walls import flight, see
from thermal_fiducial.core.geometry.se3 import retract, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap

SIZE = 0.15
_UPRIGHT = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def crowd(count):
    """T_map_marker by ID of ``count`` small markers close together, all in view of every frame."""
    rng = np.random.default_rng(count)
    return {
        i: transform(
            so3_exp(0.1 * rng.normal(size=3)) @ _UPRIGHT,
            [rng.uniform(-0.1, 0.1), (i % 5 - 2) * 0.45, 1.5 + (i // 5 + 0.5 - count / 10) * 0.4],
        )
        for i in range(count)
    }


def mapped(poses, total):
    """A map of ``poses`` and so many markers far away that there are ``total``."""
    rng = np.random.default_rng(total)
    away = transform(np.eye(3), [100.0, 0.0, 0.0])
    many = {i: retract(away @ poses[i % len(poses)], 0.1 * rng.normal(size=6)) for i in range(len(poses), total)}
    return MarkerMap({i: MapMarker(i, SIZE, i == 0, T, 1e-6 * np.eye(6)) for i, T in (poses | many).items()})


def frames(poses, count):
    """Rows of each frame of a flight in which all of ``poses`` are in view."""
    rng = np.random.default_rng(1)
    seen = [see(flight(k / 30), poses, 0.05, rng, size=SIZE) for k in range(count)]
    assert all(len(rows) == len(poses) for rows in seen)
    return seen
