"""Flights known by corners and IMU samples, through mapper and filter with poses that come late, and what came out.

The runs need a ``CornerFlight``, whoever made it: a recording or a simulation.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from support.flights import rms
from thermal_fiducial.config import ImuNoise, MarkerMapperConfig, PoseEkfConfig
from thermal_fiducial.core.error_model import covariance_of_mount
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import (
    inverse,
    quaternion_from_rotation,
    skew,
    so3_exp,
    so3_log,
    transform,
)
from thermal_fiducial.core.mapping.keyframes import VIEWS
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.mapping.second_camera import SecondCamera
from thermal_fiducial.core.measurements import CameraPose, ImuSample, Markers, Odometry
from thermal_fiducial.core.motion_prior import MotionPrior

#: An IMU sample within this [ns] of a frame's instant gives the state there; in longer gaps nothing is compared.
_NEAR_NS = 50_000_000
#: Between poses of the reference farther apart than this [ns] nothing is compared either.
_REFERENCE_GAP_NS = 150_000_000
_SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class CornerFlight:
    """A flight from the corners on."""

    name: str
    samples: list[ImuSample]
    #: stamp of the camera [ns] to rows of MARKER_DTYPE
    frames: dict[int, Markers]
    camera: Camera
    T_body_camera: np.ndarray
    #: None: there is no map of it but the one that is made from it
    marker_map: MarkerMap | None
    #: (N,) [ns] in the clock of the IMU, and (N, 4, 4) T_map_body, near to every frame's instant
    reference_ns: np.ndarray
    reference: np.ndarray
    marker_size: float
    imu_noise: ImuNoise = field(default_factory=ImuNoise)
    #: t_imu = t_camera + offset [s], as far as known
    time_offset: float = 0.0

    def truth(self, stamps_ns):
        """T_map_body (K, 4, 4) at instants within the reference, between two of its poses by a constant twist."""
        stamps_ns = np.asarray(stamps_ns)
        after = np.clip(np.searchsorted(self.reference_ns, stamps_ns), 1, len(self.reference_ns) - 1)
        t0, t1 = self.reference_ns[after - 1], self.reference_ns[after]
        T0, T1 = self.reference[after - 1], self.reference[after]
        share = ((stamps_ns - t0) / (t1 - t0))[:, None]
        turn = so3_log(np.swapaxes(T0[:, :3, :3], -1, -2) @ T1[:, :3, :3])
        position = T0[:, :3, 3] + share * (T1[:, :3, 3] - T0[:, :3, 3])
        return transform(T0[:, :3, :3] @ so3_exp(share * turn), position)


@dataclass(frozen=True)
class Poses:
    """Poses of the body with what they claim: (N,) [ns] in the clock of the IMU, (N, 4, 4), (N, 6, 6)."""

    stamps_ns: np.ndarray
    T_map_body: np.ndarray
    covariance: np.ndarray

    def __len__(self):
        return len(self.stamps_ns)

    def select(self, chosen):
        """Those at ``chosen`` (N,) or (K,)."""
        return Poses(self.stamps_ns[chosen], self.T_map_body[chosen], self.covariance[chosen])

    def at(self, stamps_ns):
        """The latest at each of the instants (K,)."""
        return self.select(np.searchsorted(self.stamps_ns, stamps_ns, side='right') - 1)

    def errors(self, flight):
        """(N, 6) position [m] and rotation vector [rad] in the map that take the estimate to the reference."""
        truth = flight.truth(self.stamps_ns)
        turn = truth[:, :3, :3] @ np.swapaxes(self.T_map_body[:, :3, :3], -1, -2)
        return np.concatenate((truth[:, :3, 3] - self.T_map_body[:, :3, 3], so3_log(turn)), axis=1)

    def score(self, flight):
        """Errors in numbers."""
        e = self.errors(flight)
        distance, angle = np.linalg.norm(e[:, :3], axis=1), np.linalg.norm(e[:, 3:], axis=1)
        nees = np.einsum('ni,nij,nj->n', e, np.linalg.inv(self.covariance), e) / 6.0
        claimed = np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))
        return Score(
            1e3 * rms(distance),
            1e3 * float(np.median(distance)),
            1e3 * float(np.max(distance)),
            float(np.degrees(rms(angle))),
            float(np.mean(nees)),
            1e3 * rms(claimed),
        )


@dataclass(frozen=True)
class Score:
    """Of poses against the reference."""

    rms_mm: float
    median_mm: float
    peak_mm: float
    rms_deg: float
    #: mean normalised estimation error squared per degree of freedom
    nees: float
    #: rms of the standard deviation of the position that they claim
    claimed_mm: float


@dataclass(frozen=True)
class Run:
    """What came out of a flight."""

    flight: CornerFlight
    #: at every IMU sample as published, poses ``late`` seconds late
    published: Poses
    #: from the markers of each frame alone
    markers: Poses
    #: the poses that the filter received
    poses: list[CameraPose]
    #: how often the filter began anew
    resets: int
    marker_map: MarkerMap
    late: float
    #: parameters of the filter
    config: PoseEkfConfig

    @cached_property
    def _prompt(self):
        return _updated(self.flight, PoseEkf(self.config), self.poses)

    @property
    def updated(self) -> Poses:
        """At the instants of the frames, after their update, of a filter that has each pose at its own instant."""
        return _compared(self.flight, self._prompt[1])

    @property
    def refused(self) -> float:
        """Share of the poses that were refused, by the last word on each."""
        return float(np.mean([not update.accepted for update in self._prompt[0]]))

    def latest_marker_errors(self, stamps_ns):
        """(K,) [m] distance of the latest marker pose at hand, late as it is, at these instants."""
        shown = replace(self.markers, stamps_ns=self.markers.stamps_ns + round(self.late * _SECOND_NS))
        at_hand = replace(shown.at(stamps_ns), stamps_ns=np.asarray(stamps_ns))
        return np.linalg.norm(at_hand.errors(self.flight)[:, :3], axis=1)


class _Chain:
    """Mapper and filter with what passes between them."""

    def __init__(self, flight, marker_map, mode, config):
        orientation = tuple(quaternion_from_rotation(flight.T_body_camera[:3, :3]))
        camera = {'camera_position': tuple(flight.T_body_camera[:3, 3]), 'camera_orientation': orientation}
        camera['camera_time_offset'] = flight.time_offset
        self.flight = flight
        self.mapper = MarkerMapper(MarkerMapperConfig(mode=mode, marker_size=flight.marker_size, **camera), marker_map)
        self.config = PoseEkfConfig(**({'imu': flight.imu_noise} | camera | config))
        self.filter = PoseEkf(self.config)
        self._prior = MotionPrior(flight.time_offset)
        self._pair: SecondCamera | None = None

    def add_camera(self, flight):
        """The same flight through a second camera, in the same map."""
        self._second = _Chain(flight, self.mapper.map, 'localization', {})
        mounts = covariance_of_mount(self.config.extrinsics_position_std, self.config.extrinsics_orientation_std)
        places = self.flight.T_body_camera, flight.T_body_camera
        self._pair = SecondCamera(*places, mounts, self.config.time_offset_std, 0.0)

    def add_second_frame(self, stamp_ns) -> None:
        flight, mapper = self._second.flight, self._second.mapper
        pose = mapper.process(stamp_ns, flight.frames[stamp_ns], flight.camera, self._prior).pose
        alone = None if pose is None else self._pair.add_second(pose, self._prior)
        if alone is not None:
            self.filter.add_pose(alone)

    def add_imu(self, sample) -> Odometry | None:
        odometry = self.filter.add_imu(sample)
        if odometry is not None:
            self._prior.add(odometry.stamp_ns, odometry)
        return odometry

    def add_frame(self, stamp_ns) -> CameraPose | None:
        rows = self.flight.frames[stamp_ns]
        pose = self.mapper.process(stamp_ns, rows, self.flight.camera, self._prior).pose
        if pose is not None:
            pose = self._pair.with_second(pose, self._prior) if self._pair else pose
            self.filter.add_pose(pose)
        if (offset := self.filter.camera_time_offset) is not None:
            self._prior.set_clock_offset(offset)
        if self.mapper.refinement_due(stamp_ns):
            self.mapper.refine(VIEWS)
        return pose

    def finish(self) -> None:
        """Refine the map with the last keyframes, as the node does before it saves."""
        if self.mapper.has_unrefined:
            self.mapper.refine(VIEWS)


def fly(flight, marker_map=None, *, mode='localization', late=0.03, left_out=(), second=None, **config) -> Run:
    """The flight through mapper and filter.

    Parameters
    ----------
    flight : :class:`CornerFlight`
    marker_map : to start from; default that of the flight
    mode : ``localization`` on the map as it is, or ``mapping``
    late : poses come so long after their stamps [s]
    second : the same flight through a second camera, whose poses arrive before those of the first
    left_out : (begin, end) [s after the first IMU sample] without frames
    config : parameters of the filter other than the defaults, the flight's camera and its IMU's densities
    """
    chain = _Chain(flight, marker_map or flight.marker_map, mode, config)
    if second is not None:
        chain.add_camera(second)
    offset_ns = round(flight.time_offset * _SECOND_NS)
    begin_ns = flight.samples[0].stamp_ns
    gaps = [[begin_ns + round(1e9 * edge) for edge in gap] for gap in left_out]
    frames = [s for s in flight.frames if not any(a <= s + offset_ns < b for a, b in gaps)]
    arrivals = [(sample.stamp_ns, 0, sample) for sample in flight.samples]
    late_ns = offset_ns + round(late * _SECOND_NS)
    arrivals += [(stamp + late_ns, 2, stamp) for stamp in frames]
    arrivals += [] if second is None else [(stamp + late_ns, 1, stamp) for stamp in second.frames]
    states, poses = [], []
    for _, kind, item in sorted(arrivals, key=lambda entry: entry[:2]):
        if kind == 0:
            states.append(chain.add_imu(item))
        elif kind == 1:
            chain.add_second_frame(item)
        else:
            poses.append(chain.add_frame(item))
    poses = [pose for pose in poses if pose is not None]
    chain.finish()
    return Run(
        flight,
        published(flight, [state for state in states if state]),
        _compared(flight, [_of_body(pose, flight) for pose in poses]),
        poses,
        chain.filter.resets,
        chain.mapper.map,
        late,
        chain.config,
    )


def published(flight, states) -> Poses:
    """Of the odometry at IMU samples, what can be compared."""
    return _compared(flight, [_pose(state.stamp_ns, state.T_map_body, state.pose_covariance) for state in states])


def _updated(flight, ekf, poses):
    """What became of each pose, and the body at each pose's instant after it, where an IMU sample follows soon."""
    offset_ns = round(flight.time_offset * _SECOND_NS)
    arrivals = [(sample.stamp_ns, 1, sample) for sample in flight.samples]
    arrivals += [(pose.stamp_ns + offset_ns, 0, pose) for pose in poses]
    waiting, result, decided = [], [], {}
    for time_ns, kind, item in sorted(arrivals, key=lambda entry: entry[:2]):
        if kind == 0:
            update = ekf.add_pose(item)
            decided[item.stamp_ns] = update
            waiting.append(time_ns)
            continue
        odometry = ekf.add_imu(item)
        decided |= ekf.decided
        if odometry is not None:
            result += [_carried(odometry, at) for at in waiting if time_ns - at <= _NEAR_NS]
        waiting.clear()
    return [update for update in decided.values() if not update.pending], result


def _carried(odometry, time_ns):
    """The pose of ``odometry`` at an instant just before it, by its own twist."""
    seconds = (time_ns - odometry.stamp_ns) * 1e-9
    R = odometry.T_map_body[:3, :3]
    position = odometry.T_map_body[:3, 3] + seconds * R @ odometry.velocity_body
    T = transform(R @ so3_exp(seconds * odometry.angular_velocity_body), position)
    return _pose(time_ns, T, odometry.pose_covariance)


def _of_body(pose, flight):
    """The body from a camera pose: its covariance turns with the lever arm."""
    T = pose.T_map_camera @ inverse(flight.T_body_camera)
    J = np.eye(6)
    J[:3, 3:] = -skew(T[:3, 3] - pose.T_map_camera[:3, 3])
    return _pose(pose.stamp_ns + round(flight.time_offset * _SECOND_NS), T, J @ pose.covariance @ J.T)


def _pose(stamp_ns, T, covariance):
    return stamp_ns, T, covariance


def _compared(flight, poses):
    """Those at instants that the reference spans without a gap."""
    stamps, transforms, covariances = (np.array(part) for part in zip(*poses, strict=True))
    after = np.searchsorted(flight.reference_ns, stamps)
    inside = (after > 0) & (after < len(flight.reference_ns))
    after = np.where(inside, after, 1)
    inside &= flight.reference_ns[after] - flight.reference_ns[after - 1] <= _REFERENCE_GAP_NS
    return Poses(stamps, transforms, covariances).select(inside)


@dataclass(frozen=True)
class Coasting:
    """At the ends of gaps without frames: distances from the reference [m], claimed [m], squares in sigma."""

    errors: np.ndarray
    claimed: np.ndarray
    squares: np.ndarray

    @property
    def covered(self) -> float:
        """Share within three sigma (3 degrees of freedom)."""
        return float(np.mean(self.squares < chi2.ppf(0.9973, 3)))

    def percentile(self, percent) -> float:
        """Of the errors [m]."""
        return float(np.percentile(self.errors, percent))

    @property
    def claimed_over_true(self) -> float:
        """Ratio of the rms values."""
        return rms(self.claimed) / rms(self.errors)


def coast(flight, seconds, *, every=6.0, first=4.0, phases=3, **config) -> Coasting:
    """Errors where frames are left out for ``seconds`` every so often, in some runs so that gaps lie anywhere."""
    begin_ns, end_ns = (flight.samples[k].stamp_ns for k in (0, -1))
    last = (end_ns - begin_ns) * 1e-9 - seconds - 0.5
    errors, claimed, squares = [], [], []
    for phase in range(phases):
        gaps = [(a, a + seconds) for a in np.arange(first + phase * every / phases, last, every)]
        run = fly(flight, left_out=gaps, **config)
        ends = [begin_ns + round(1e9 * b) for _, b in gaps]
        poses = run.published.at(ends)
        e = poses.errors(flight)[:, :3]
        P = poses.covariance[:, :3, :3]
        errors.append(np.linalg.norm(e, axis=1))
        claimed.append(np.sqrt(np.trace(P, axis1=1, axis2=2)))
        squares.append(np.einsum('ni,nij,nj->n', e, np.linalg.inv(P), e))
    return Coasting(*(np.concatenate(parts) for parts in (errors, claimed, squares)))


def jitter_mm(poses, longest_ns=75_000_000):
    """Rms second difference of the position between frames in steady succession, as one pose's noise [mm]."""
    steps = np.diff(poses.stamps_ns)
    p = poses.T_map_body[:, :3, 3]
    even = (np.abs(steps[1:] - steps[:-1]) < 2_000_000) & (steps[1:] < longest_ns)
    # Of white noise, a second difference has six times the variance.
    return 1e3 * rms(np.linalg.norm(p[2:] - 2.0 * p[1:-1] + p[:-2], axis=1)[even]) / np.sqrt(6.0)
