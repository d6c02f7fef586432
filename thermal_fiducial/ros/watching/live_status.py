"""Live status for a pilot, from messages as they arrive: whether the pose may be flown on, and if not, why.

Independent of ROS and of the display; times are seconds of one monotonic clock.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from thermal_fiducial.core.imaging.frame_cleaner import FROZEN, SHUTTER
from thermal_fiducial.files.innovations import LAST_REFUSED

#: Timeouts of odometry, after which there is no pose to fly on, and of a node's diagnostics [s].
SILENT_S, MUTE_S = 0.5, 3.0
#: Window of the rates [s]; a topic without a message in it has no rate.
WINDOW_S = 2.0
#: Largest age [s] and number of the refusals shown.
REFUSAL_S, MOST_REFUSALS = 60.0, 5
#: Stamps farther than this from the present time are of another clock [s].
_ONE_CLOCK_S = 5.0
_FILTER, _CAMERA, _DETECTOR, _MAPPER = 'pose_ekf', 'tau2_camera', 'aruco_detector', 'marker_mapper'
STAGES = (_CAMERA, _DETECTOR, _MAPPER, _FILTER)
_OK, _WARNING = 0, 1


class Advice(Enum):
    """Whether the pose may be flown on."""

    FLY = 'may be flown on'
    CARE = 'may be flown on, with care'
    STOP = 'must not be flown on'


@dataclass(frozen=True)
class LiveFigure:
    """One figure with its unit; empty when unknown."""

    name: str
    value: str
    unit: str = ''


@dataclass(frozen=True)
class LiveState:
    """The state at one time."""

    advice: Advice
    reasons: tuple[str, ...]
    readings: tuple[LiveFigure, ...]
    #: node, level (0 ok, 1 warning, 2 error), message of its diagnostic
    nodes: tuple[tuple[str, int, str], ...]
    #: age [s] and message
    refusals: tuple[tuple[float, str], ...]

    @property
    def headline(self) -> str:
        """Advice and reasons in one line."""
        reasons = f': {"; ".join(self.reasons)}' if self.reasons else ''
        return f'The pose {self.advice.value}{reasons}'

    @property
    def line(self) -> str:
        """The whole state in one line of plain text."""
        figures = [f'{r.name} {r.value} {r.unit}'.strip() for r in self.readings if r.value]
        return ' | '.join(
            [self.headline, *figures, *(f'refused {age:.0f} s ago: {why}' for age, why in self.refusals[:1])]
        )


@dataclass
class _Topic:
    """Arrival times of a topic in the last seconds, and latencies."""

    arrivals: deque[float] = field(default_factory=deque)
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=50))

    def add(self, now: float, age: float) -> None:
        self.arrivals.append(now)
        while self.arrivals and self.arrivals[0] < now - WINDOW_S:
            self.arrivals.popleft()
        if 0.0 <= age < _ONE_CLOCK_S:
            self.latencies.append(age)

    def silent(self, now: float) -> float:
        """Time since the last message [s]."""
        return now - self.arrivals[-1] if self.arrivals else float('inf')

    def rate(self, now: float) -> str:
        recent = [time for time in self.arrivals if time >= now - WINDOW_S]
        if len(recent) < 2 or recent[-1] <= recent[0]:
            return ''
        return f'{(len(recent) - 1) / (recent[-1] - recent[0]):.0f}'

    def latency(self, now: float) -> str:
        """Median [ms]; empty if the stamps are of another clock, or nothing comes any more."""
        if not self.latencies or self.silent(now) > WINDOW_S:
            return ''
        return f'{1e3 * sorted(self.latencies)[len(self.latencies) // 2]:.0f}'


@dataclass
class _NodeStatus:
    time: float
    level: int
    message: str
    figures: Mapping[str, str]


class LiveStatus:
    """Collects messages; :meth:`snapshot` evaluates them.

    Parameters
    ----------
    namespace : of the robot; diagnostics of nodes outside it are ignored
    """

    def __init__(self, namespace: str = '') -> None:
        self._prefix = f'{namespace.strip("/")}/'.lstrip('/')
        self._odometry, self._camera_pose, self._frames = _Topic(), _Topic(), _Topic()
        self._markers: tuple[int, ...] = ()
        self._sigma: tuple[float, float] | None = None
        self._nodes: dict[str, _NodeStatus] = {}
        #: namespaces, but for the root, in which a filter runs
        self._elsewhere: set[str] = set()
        self._refusals: deque[tuple[float, str]] = deque(maxlen=MOST_REFUSALS)

    def odometry(self, now: float, age: float, sigma_m: float, sigma_deg: float) -> None:
        """Odometry arrived ``age`` [s] after its stamp, with standard deviations over the three axes together."""
        self._odometry.add(now, age)
        self._sigma = (sigma_m, sigma_deg)

    def camera_pose(self, now: float, age: float) -> None:
        """A camera pose arrived ``age`` [s] after its stamp."""
        self._camera_pose.add(now, age)

    def markers(self, now: float, ids: Iterable[int]) -> None:
        """The detections of a frame arrived."""
        self._frames.add(now, -1.0)
        self._markers = tuple(sorted(ids))

    def diagnostic(self, now: float, name: str, level: int, message: str, figures: Mapping[str, str]) -> None:
        """A diagnostic status of a node arrived."""
        if name.endswith(f'/{_FILTER}'):
            self._elsewhere.add(f'/{name.removesuffix(f"/{_FILTER}")}')
        if not name.startswith(self._prefix):
            return
        node = name.removeprefix(self._prefix)
        if node not in STAGES:
            return
        before = self._nodes.get(node)
        self._nodes[node] = _NodeStatus(now, level, message, figures)
        refusal = figures.get(LAST_REFUSED)
        # The filter repeats it until a pose is accepted, also while no pose comes.
        if refusal and (
            before is None
            or refusal != before.figures.get(LAST_REFUSED)
            or self._camera_pose.silent(now) < now - before.time
        ):
            self._refuse(now, f'pose {refusal}')
        reason, counted = figures.get('last refusal'), figures.get('refused messages', '0')
        if reason and before is not None and counted != before.figures.get('refused messages', '0'):
            self._refuse(now, f'{node}: {reason}')

    def _refuse(self, now: float, words: str) -> None:
        if self._refusals and self._refusals[0][1] == words:
            self._refusals.popleft()
        self._refusals.appendleft((now, words))

    def snapshot(self, now: float) -> LiveState:
        """The state at a time."""
        # Cares, too, with stops: a pose is lost, say, because the camera has stopped.
        stops = self._stops(now)
        # If nothing at all is heard, a line for each stage adds nothing.
        cares = [] if stops and not self._nodes else self._cares(now)
        advice = Advice.STOP if stops else Advice.CARE if cares else Advice.FLY
        return LiveState(
            advice=advice,
            reasons=(*stops, *(care for care in cares if care not in stops)),
            readings=self._readings(now),
            nodes=tuple(self._said(node, now) for node in STAGES),
            refusals=tuple((now - time, why) for time, why in self._refusals if now - time < REFUSAL_S),
        )

    def _stops(self, now: float) -> list[str]:
        """Why the pose must not be flown on."""
        filter_ = self._nodes.get(_FILTER)
        if not self._odometry.arrivals:
            if filter_ is None:
                others = ', '.join(sorted(self._elsewhere))
                hint = f', but in {others}: --ros-args -r __ns:={min(self._elsewhere)}' if others else ''
                return [f'nothing is heard of pose_ekf{hint}']
            known = filter_.figures.get('lost') == 'False'
            return [f'no odometry is heard, but pose_ekf says: {filter_.message}' if known else filter_.message]
        reasons = []
        if (silent := self._odometry.silent(now)) > SILENT_S:
            reasons.append(f'no odometry for {silent:.1f} s')
        if filter_ is None or now - filter_.time > MUTE_S:
            # Odometry is published while the pose is lost, too.
            reasons.append(_silence_of(_FILTER))
        elif filter_.level > _WARNING or filter_.figures.get('lost') == 'True':
            reasons.append(filter_.message)
        return reasons

    def _cares(self, now: float) -> list[str]:
        """Why the pose may be flown on with care only."""
        reasons = []
        for node in STAGES:
            said = self._nodes.get(node)
            if said is None or now - said.time > MUTE_S:
                reasons.append(_silence_of(node))
            elif said.level == _WARNING and node == _CAMERA and (SHUTTER in said.message or said.message == FROZEN):
                continue  # normal operation: a camera that is frozen for longer than a shutter event is stalled
            elif said.level != _OK:
                reasons.append(said.message if node == _FILTER else f'{node}: {said.message}')
        return reasons

    def _said(self, node: str, now: float) -> tuple[str, int, str]:
        said = self._nodes.get(node)
        if said is None:
            return node, _WARNING, 'not heard'
        if now - said.time > MUTE_S:
            return node, _WARNING, f'silent for {now - said.time:.0f} s'
        return node, said.level, said.message

    def _readings(self, now: float) -> tuple[LiveFigure, ...]:
        listed = ' '.join(str(marker) for marker in self._markers)
        in_view = f'{len(self._markers)}' + (f' ({listed})' if listed else '')
        sigma_m, sigma_deg = self._sigma if self._sigma and self._odometry.silent(now) < WINDOW_S else (None, None)
        said = self._nodes.get(_FILTER)
        figures: Mapping[str, str] = said.figures if said is not None and now - said.time <= MUTE_S else {}
        offset, offset_std = _milliseconds(figures, 'time offset'), _milliseconds(figures, 'time offset std')
        known = offset is not None and offset_std is not None
        return (
            LiveFigure('markers in view', in_view if self._frames.silent(now) < WINDOW_S else ''),
            LiveFigure('poses', self._odometry.rate(now), 'Hz'),
            LiveFigure('camera poses', self._camera_pose.rate(now), 'Hz'),
            LiveFigure('latency', self._odometry.latency(now), 'ms'),
            LiveFigure('camera latency', self._camera_pose.latency(now), 'ms'),
            LiveFigure('sigma', '' if sigma_m is None else f'{1e3 * sigma_m:.1f}', 'mm'),
            LiveFigure('sigma of attitude', '' if sigma_deg is None else f'{sigma_deg:.2f}', 'deg'),
            LiveFigure('clock offset', f'{offset:.1f} +- {offset_std:.1f}' if known else '', 'ms'),
            LiveFigure('usable without markers', _rounded(figures, 'usable for'), 's'),
        )


def _silence_of(node: str) -> str:
    return f'{node} says nothing'


def _milliseconds(figures: Mapping[str, str], name: str) -> float | None:
    try:
        return 1e3 * float(figures[name])
    except (KeyError, ValueError):
        return None


def _rounded(figures: Mapping[str, str], name: str) -> str:
    try:
        return f'{float(figures[name]):.1f}'
    except (KeyError, ValueError):
        return ''
