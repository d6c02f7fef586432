"""Where the rays of many points of an image meet a marker's plane: what pictures drawn from geometry alone rest on."""

import numpy as np
from scipy.interpolate import RectBivariateSpline

#: Pixels between those for which the lens is solved.
_KNOTS_PX = 4.0


def plane_points(camera, T_camera_marker, u, v):
    """x and y (M, N) [m] on the marker's plane of the pixels at columns ``u`` (N,) and rows ``v`` (M,)."""
    return on_plane(T_camera_marker, *rays(camera, u, v))


def rays(camera, u, v):
    """Normalised coordinates, two of (M, N), of the pixels at columns ``u`` (N,) and rows ``v`` (M,).

    A lens is smooth: cubic splines between solutions four pixels apart are off by less than 1e-6 px, of these lenses.
    """
    u_knots, v_knots = (np.arange(axis[0] - _KNOTS_PX, axis[-1] + 2.0 * _KNOTS_PX, _KNOTS_PX) for axis in (u, v))
    solved = camera.normalise(np.stack(np.meshgrid(u_knots, v_knots), axis=-1))
    return tuple(RectBivariateSpline(v_knots, u_knots, solved[..., axis])(v, u) for axis in range(2))


def on_plane(T_camera_marker, a, b):
    """x and y (M, N) [m] where rays of normalised coordinates ``a``, ``b`` (M, N) meet a marker's plane."""
    x_axis, y_axis, normal, centre = T_camera_marker[:3].T
    depth = (normal @ centre) / (normal[0] * a + normal[1] * b + normal[2])
    return tuple(depth * (axis[0] * a + axis[1] * b + axis[2]) - axis @ centre for axis in (x_axis, y_axis))
