"""Measures of a trajectory: errors against ground truth, jitter, consistency, latency.

Truth is interpolated at the stamps of the estimate (nearest neighbours within 10 ms, as in some tools, add an error of
up to 10 mm at 1 m/s). Errors are ``d`` of the package's covariance convention: the true pose is
``p_hat + d[:3]``, ``exp(d[3:]) R_hat``, all in ``map``; accuracy is measured in the map, without alignment.

Terms: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", 2012 (absolute and relative
error); S. Umeyama, "Least-squares estimation of transformation parameters", 1991 (alignment); Y. Bar-Shalom et al.,
"Estimation with applications to tracking and navigation", 2001, 5.4 (NEES).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from thermal_fiducial.core.geometry.se3 import (
    apply,
    inverse,
    quaternion_from_rotation,
    rigid_alignment,
    rotation_from_quaternion,
    so3_exp,
    so3_log,
    transform,
)
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, SECOND_NS
from thermal_fiducial.files.innovations import Innovations
from thermal_fiducial.report.trajectory import Trajectory

#: Interval of the jitter: a period of the camera [ns].
FRAME_NS = 33_333_333
#: Interval of the relative pose error [ns].
RELATIVE_NS = SECOND_NS
#: Gap of the poses above which it is a pause, which disturbs a controller [ns].
PAUSE_NS = 100_000_000
#: Truth is not interpolated over holes longer than this [ns].
TRUTH_HOLE_NS = 200_000_000
#: 95 % quantile of chi-square by degrees of freedom; two-sided 95 % interval for a pose.
CHI2_95 = {3: 7.815, 6: 12.592}
CHI2_BAND_6 = (1.237, 14.449)
#: Units beside the metre that trackers write positions in, and how many of them are a metre.
_OTHER_UNITS = {'millimetres': 1e3, 'centimetres': 1e2}
#: Largest rms residual, as a share of the path's extent, with which a truth in another unit fits the run. A truth in
#: metres leaves 0.99 or more, a run that is usable at all hardly a tenth.
_RESIDUAL_OF_UNIT = 0.2


def interpolate(truth: Trajectory, stamps_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    """Poses (N, 4, 4) of ``truth`` at stamps, linear in position and SLERP in attitude, and which of them exist (N,).

    No pose exists before the first, after the last, and in holes of more than :data:`TRUTH_HOLE_NS`.
    """
    if len(truth) < 2:
        return np.tile(np.eye(4), (len(stamps_ns), 1, 1)), np.zeros(len(stamps_ns), np.bool_)
    right = np.clip(np.searchsorted(truth.stamps_ns, stamps_ns), 1, len(truth) - 1)
    t0, t1 = truth.stamps_ns[right - 1], truth.stamps_ns[right]
    T0, T1 = truth.T_map_body[right - 1], truth.T_map_body[right]
    share = ((stamps_ns - t0) / (t1 - t0))[:, None]
    R0, R1 = T0[:, :3, :3], T1[:, :3, :3]
    R = R0 @ so3_exp(share * so3_log(np.swapaxes(R0, 1, 2) @ R1))
    p = (1.0 - share) * T0[:, :3, 3] + share * T1[:, :3, 3]
    exists = (stamps_ns >= t0) & (stamps_ns <= t1) & (t1 - t0 <= TRUTH_HOLE_NS)
    return transform(R, p), exists


@dataclass(frozen=True)
class Errors:
    """Errors of the poses of a trajectory that have a truth.

    Parameters
    ----------
    stamps_ns : (N,)
    d : (N, 6) position [m] and rotation [rad] from the estimate to the truth, in ``map``
    estimate, truth : (N, 4, 4) T_map_body
    """

    stamps_ns: IntArray
    d: FloatArray
    estimate: FloatArray
    truth: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def position_m(self) -> FloatArray:
        """(N,) distances [m]."""
        return np.asarray(np.linalg.norm(self.d[:, :3], axis=1))

    @property
    def attitude_deg(self) -> FloatArray:
        """(N,) angles [deg]."""
        return np.asarray(np.rad2deg(np.linalg.norm(self.d[:, 3:], axis=1)))


def errors(estimate: Trajectory, truth: Trajectory) -> Errors:
    """Errors of ``estimate`` at its stamps within ``truth``."""
    T_true, exists = interpolate(truth, estimate.stamps_ns)
    T_true, T_hat = T_true[exists], estimate.T_map_body[exists]
    rotation = so3_log(T_true[:, :3, :3] @ np.swapaxes(T_hat[:, :3, :3], 1, 2))
    d = np.concatenate([T_true[:, :3, 3] - T_hat[:, :3, 3], rotation], axis=1)
    return Errors(estimate.stamps_ns[exists], d, T_hat, T_true)


def accuracy(e: Errors) -> dict[str, float]:
    """Absolute errors in the map: rms, median, 95 % and largest [mm, deg]; and after alignment in position [mm]."""
    if not len(e):
        return {}
    return {
        **spread(1e3 * e.position_m, e.attitude_deg, ('rms', 'median', 'p95', 'max')),
        'position_aligned_rms_mm': 1e3 * rms(np.linalg.norm(aligned_residuals(e), axis=1)),
    }


def spread(position_mm: FloatArray, attitude_deg: FloatArray, kinds: Sequence[str]) -> dict[str, float]:
    """Figures of errors in position and attitude; ``kinds`` are some of rms, median, p95 (95 %) and max."""
    measures: dict[str, Callable[[FloatArray], Any]] = {
        'rms': rms,
        'median': np.median,
        'p95': partial(np.percentile, q=95),
        'max': np.max,
    }
    errors = (('position', 'mm', position_mm), ('attitude', 'deg', attitude_deg))
    return {f'{name}_{kind}_{unit}': float(measures[kind](values)) for name, unit, values in errors for kind in kinds}


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def aligned_residuals(e: Errors) -> FloatArray:
    """Position residuals (N, 3) [m] after the best rigid alignment of the estimate to the truth (no scale)."""
    return rigid_residuals(e.estimate[:, :3, 3], e.truth[:, :3, 3])


def other_unit(e: Errors) -> tuple[str, float]:
    """Unit of the truth's positions in which they fit the run, and how many of it are a metre; '', 1: metres.

    ``e`` has at least one pose.
    """
    p_hat, p_true = e.estimate[:, :3, 3], e.truth[:, :3, 3]
    extent = rms(np.linalg.norm(p_hat - p_hat.mean(axis=0), axis=1))
    for unit, count in _OTHER_UNITS.items():
        if rms(np.linalg.norm(rigid_residuals(p_hat, p_true / count), axis=1)) < _RESIDUAL_OF_UNIT * extent:
            return unit, count
    return '', 1.0


def attitude_in_other_order(e: Errors) -> float:
    """Rms error of the attitude [deg] with the truth's quaternions read as w x y z."""
    as_read = quaternion_from_rotation(e.truth[:, :3, :3])
    R = rotation_from_quaternion(np.roll(as_read, -1, axis=-1))
    return rms(np.rad2deg(np.linalg.norm(so3_log(R @ np.swapaxes(e.estimate[:, :3, :3], 1, 2)), axis=1)))


def rigid_residuals(p_hat: FloatArray, p_true: FloatArray) -> FloatArray:
    """Residuals (N, 3) [m] of points (N, 3) after the rigid motion that fits them best to ``p_true`` (N, 3)."""
    return p_true - apply(rigid_alignment(p_true, p_hat), p_hat)


def pairs_apart(stamps_ns: IntArray, interval_ns: int) -> tuple[IntArray, IntArray]:
    """Indices i and j of samples that lie ``interval_ns`` apart, within a fifth of it and 20 ms."""
    if len(stamps_ns) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    wanted = stamps_ns + interval_ns
    right = np.clip(np.searchsorted(stamps_ns, wanted), 1, len(stamps_ns) - 1)
    j = np.where(wanted - stamps_ns[right - 1] < stamps_ns[right] - wanted, right - 1, right)
    i = np.arange(len(stamps_ns))
    close = (np.abs(stamps_ns[j] - wanted) <= min(interval_ns // 5, 20_000_000)) & (j > i)
    return i[close], j[close]


def jitter(e: Errors) -> dict[str, float]:
    """Rms of the change of the error over one camera period [mm, deg], which excites a controller."""
    i, j = pairs_apart(e.stamps_ns, FRAME_NS)
    if not len(i):
        return {}
    turned = so3_log(so3_exp(e.d[j, 3:]) @ np.swapaxes(so3_exp(e.d[i, 3:]), 1, 2))
    moved = np.linalg.norm(e.d[j, :3] - e.d[i, :3], axis=1)
    return {
        'position_mm': 1e3 * rms(moved),
        'position_p95_mm': 1e3 * float(np.percentile(moved, 95)),
        'attitude_deg': float(np.rad2deg(rms(np.linalg.norm(turned, axis=1)))),
    }


def relative_pose_error(e: Errors) -> dict[str, float]:
    """Drift over ``RELATIVE_NS``: rms of the relative pose error [mm, deg]."""
    i, j = pairs_apart(e.stamps_ns, RELATIVE_NS)
    if not len(i):
        return {}
    true_step = inverse(e.truth[i]) @ e.truth[j]
    step = inverse(e.estimate[i]) @ e.estimate[j]
    E = inverse(true_step) @ step
    return {
        'interval_s': RELATIVE_NS / SECOND_NS,
        'position_mm': 1e3 * rms(np.linalg.norm(E[:, :3, 3], axis=1)),
        'attitude_deg': float(np.rad2deg(rms(np.linalg.norm(so3_log(E[:, :3, :3]), axis=1)))),
    }


def consistency(e: Errors, covariances: FloatArray) -> dict[str, float]:
    """NEES of pose, position and attitude: mean (ideally 1 per degree of freedom) and share within 95 %.

    Parameters
    ----------
    e : N errors
    covariances : (N, 6, 6) of the estimates, ROS convention
    """
    usable = np.linalg.eigvalsh(covariances)[:, 0] > 0.0 if len(e) else np.zeros(0, np.bool_)
    if not np.any(usable):
        return {}
    result: dict[str, float] = {'samples': int(np.sum(usable))}
    for name, part in (('pose', slice(0, 6)), ('position', slice(0, 3)), ('attitude', slice(3, 6))):
        d, P = e.d[usable, part], covariances[usable, part, part]
        nees = np.einsum('ni,ni->n', d, np.linalg.solve(P, d[..., None])[..., 0])
        result[f'{name}_nees_per_dof'] = float(np.mean(nees)) / d.shape[1]
        result[f'{name}_within_95'] = float(np.mean(nees <= CHI2_95[d.shape[1]]))
    return result


def innovation_consistency(innovations: Innovations) -> dict[str, float]:
    """NIS of the accepted poses: mean (ideally 1 per degree of freedom), share within the 95 % interval."""
    result: dict[str, float] = {
        'poses': len(innovations.nis),
        'refused': int(np.sum(~innovations.accepted)),
    }
    nis = innovations.nis[innovations.accepted]
    if len(nis):
        low, high = CHI2_BAND_6
        result |= {
            'nis_per_dof': float(np.mean(nis)) / 6.0,
            'within_95': float(np.mean((low < nis) & (nis < high))),
            'above_95': float(np.mean(nis >= high)),
        }
    return result


def steps(trajectory: Trajectory) -> FloatArray:
    """Distance of each position from the linear extrapolation of those before it [m]: the steps by corrections.

    Over no longer than the velocity was measured, as stamps of samples that were read together are close; and not over
    pauses, in which the body goes where it likes.
    """
    p, t = trajectory.positions, trajectory.stamps_ns
    ahead = np.diff(t)[1:]
    before = np.searchsorted(t, t[1:-1] - ahead, side='right') - 1
    known = np.flatnonzero((before >= 0) & (ahead <= PAUSE_NS))
    first, newest = before[known], known + 1
    share = (ahead[known] / (t[newest] - t[first]))[:, None]
    predicted = p[newest] + (p[newest] - p[first]) * share
    return np.asarray(np.linalg.norm(p[newest + 1] - predicted, axis=1))


def output(trajectory: Trajectory) -> dict[str, float]:
    """Rate between pauses and smoothness of the output, without truth: rate, longest gap, steps."""
    if len(trajectory) < 3:
        return {'poses': len(trajectory)}
    dt = np.diff(trajectory.stamps_ns)
    flowing = dt[dt <= PAUSE_NS]
    result = {
        'poses': len(trajectory),
        'rate_hz': SECOND_NS / float(np.mean(flowing if len(flowing) else dt)),
        'longest_pause_ms': 1e-6 * float(dt.max()),
        'path_length_m': path_length(trajectory),
    }
    if len(step_mm := 1e3 * steps(trajectory)):
        result |= {'step_p95_mm': float(np.percentile(step_mm, 95)), 'step_max_mm': float(step_mm.max())}
    return result


def path_length(trajectory: Trajectory) -> float:
    """Path length flown [m], from positions a tenth of a second apart, so that noise adds little."""
    if not len(trajectory):
        return 0.0
    stamps = trajectory.stamps_ns
    picked = np.searchsorted(stamps, np.arange(stamps[0], stamps[-1], 100_000_000))
    return float(np.sum(np.linalg.norm(np.diff(trajectory.positions[picked], axis=0), axis=1)))


def latency(milliseconds: FloatArray) -> dict[str, float]:
    """Median, 99 % and largest latency [ms]."""
    if not len(milliseconds):
        return {}
    p50, p99 = np.percentile(milliseconds, [50, 99])
    return {'p50_ms': float(p50), 'p99_ms': float(p99), 'max_ms': float(milliseconds.max())}
