"""Views of a calibration board in pictures or a bag: the usable ones, and the reasons against the others."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.intrinsics import Calibration, LEAST_VIEWS
from thermal_fiducial.calibration.lens_choice import choose_model
from thermal_fiducial.calibration.plots import coverage
from thermal_fiducial.calibration.recognition import BoardNotFound
from thermal_fiducial.calibration.report import BoardView, LeftOut
from thermal_fiducial.calibration.sources import clean_frames, measured_points, pictures, RawFrame, recorded_camera
from thermal_fiducial.calibration.targets import MarkerBoard, settles_a_pose, Sighting, Target
from thermal_fiducial.cli.progress import tracked
from thermal_fiducial.cli.recorded_corners import recorded_rows
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import Markers
from thermal_fiducial.core.types import Counts, Gray
from thermal_fiducial.core.wording import listed, number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.images import read_gray

# Least motion of the board since the last view kept of a bag [px].
_NEW_VIEW_PX = 12.0
# Most reasons, and most frames named of one, in the line that ends a calibration: what can be taken in at a glance.
_MOST_REASONS, _MOST_NAMES = 5, 3


@dataclass
class BoardViews:
    """Views of the board, collected frame by frame.

    Parameters
    ----------
    target : the board; None where its points were measured elsewhere
    kept : usable views
    unusable : each other frame, and why it is unusable
    size : width and height of the image [px]
    """

    target: Target | None = None
    kept: list[BoardView] = field(default_factory=list)
    unusable: list[LeftOut] = field(default_factory=list)
    size: tuple[int, int] = (0, 0)
    _shown: Counter[str] = field(default_factory=Counter)

    def recognise(self, name: str, rows: Markers) -> Sighting | None:
        """The board among the detected markers of a frame; None as by :meth:`find`."""
        assert isinstance(self.target, MarkerBoard)
        return self._sighted(name, None, partial(self.target.sighting, rows))

    def find(self, frame: RawFrame, camera: Camera) -> Sighting | None:
        """The board in a frame; None if it is not found, and the reason is kept in ``unusable``."""
        height, width = frame.counts.shape
        if self.kept and self.size != (width, height):
            reason = f'{width}x{height} pixels, the views before it have {self.size[0]}x{self.size[1]}'
            self.leave(frame.name, reason, frame.counts)
            return None
        self.size = (width, height)
        assert self.target is not None
        return self._sighted(frame.name, frame.counts, partial(self.target.find, frame.counts, camera))

    def _sighted(self, name: str, counts: Counts | Gray | None, look: Callable[[], Sighting]) -> Sighting | None:
        """What ``look`` finds; None if that is no board, and the reason is kept."""
        try:
            return look()
        except BoardNotFound as reason:
            self.leave(name, str(reason), counts)
            return None

    def keep(self, view: BoardView) -> None:
        """Keep a view, and print how much of the image the views cover."""
        self.kept.append(view)
        cells = self.covered()
        print(f'{view.name}: {len(view.sighting.pixels)} points; {np.sum(cells > 0)} of {cells.size} cells covered')

    def leave(self, name: str, reason: str, counts: Counts | Gray | None = None) -> None:
        """Leave out a frame for a reason; of frames with alike reasons the report shows some."""
        kind = _kind(reason)
        self._shown[kind] += counts is not None
        self.unusable.append(LeftOut(name, reason, counts if self._shown[kind] <= _MOST_NAMES else None))

    def print_unusable(self, begin: int = 0) -> None:
        """Print the unusable frames from the number ``begin`` on, with their reasons."""
        for frame in self.unusable[begin:]:
            print(f'{frame.name}: not used: {frame.reason}')

    def covered(self) -> np.ndarray:
        """Number of points in each cell of the image."""
        return coverage(np.concatenate([view.sighting.pixels for view in self.kept]), *self.size)

    def require(self, source: Path) -> None:
        """Require enough views; the error lists the reasons against the unusable frames, the most frequent first.

        Raises
        ------
        InputError
            There are fewer views than a calibration needs.
        """
        if len(self.kept) >= LEAST_VIEWS:
            return
        total = len(self.kept) + len(self.unusable)
        named = self._reasons()
        text = f'{source}: {len(self.kept)} of {total} frames are usable views, a calibration needs {LEAST_VIEWS}'
        raise InputError('; '.join([text, *named]))

    def _reasons(self) -> list[str]:
        """The most frequent reasons with their frames; those that differ only in a figure are one, with the first's."""
        frames: dict[str, list[LeftOut]] = defaultdict(list)
        for frame in self.unusable:
            frames[_kind(frame.reason)].append(frame)
        often = sorted(frames.values(), key=len, reverse=True)[:_MOST_REASONS]
        return [f'{listed((frame.name for frame in alike), _MOST_NAMES)}: {alike[0].reason}' for alike in often]

    def look_again(self, camera: Camera) -> None:
        """Find the board again in all views, with the calibrated camera."""
        assert self.target is not None
        for index, view in enumerate(self.kept):
            if view.counts is None:
                continue
            try:
                self.kept[index] = BoardView(view.name, self.target.find(view.counts, camera), view.counts)
            except BoardNotFound:
                continue

    def solve(
        self, models: Sequence[str], focal_px: float, board_std: float
    ) -> tuple[Calibration, dict[str, Calibration]]:
        """The best calibration, and the best of each lens model, by a board known to ``board_std`` [m]."""
        radius = 0.0 if self.target is None else self.target.radius
        sightings = [view.sighting for view in self.kept]
        return choose_model(sightings, *self.size, models, radius=radius, focal_px=focal_px, board_std=board_std)


def _kind(reason: str) -> str:
    """A reason without its figures."""
    return re.sub(r'\d+(\.\d+)?', '', reason)


def look_at_points(source: Path, size: tuple[int, int]) -> BoardViews:
    """Views of a CSV file of measured points, of images of ``size`` (width, height)."""
    views = BoardViews(size=size)
    for name, sighting in measured_points(source, *size):
        if settles_a_pose(sighting):
            views.kept.append(BoardView(name, sighting))
        else:
            points = number_of(len(sighting.pixels), 'point')
            views.leave(name, f'{points}, where a view needs four, no three of them on a line')
    views.print_unusable()
    return views


def look_at_pictures(source: Path, views: BoardViews, focal_px: float, most: int) -> None:
    """Look for the board in the pictures of a folder until there are ``most`` views."""
    for index, path in enumerate(pictures(source)):
        if len(views.kept) == most:
            return
        before = len(views.unusable)
        _look_at_picture(path, index, views, focal_px)
        views.print_unusable(before)


def _look_at_picture(path: Path, index: int, views: BoardViews, focal_px: float) -> None:
    try:
        counts = read_gray(path)
    except InputError as reason:
        views.leave(path.name, str(reason).removeprefix(f'{path}: '))
        return
    frame = RawFrame(path.name, index * 10_000_000_000, counts)
    sighting = views.find(frame, _guess(frame, focal_px))
    if sighting is not None:
        views.keep(BoardView(frame.name, sighting, frame.counts))


class BagFrame(NamedTuple):
    """A frame of a bag, whose board is looked for when it is asked for."""

    name: str
    counts: Counts | Gray | None
    find: Callable[[], Sighting | None]


def images_of(bag: BagReader, views: BoardViews, focal_px: float) -> Iterator[BagFrame]:
    """Frames of the images of a bag."""
    for frame in tracked(clean_frames(bag), 'looking for the board', bag.message_count([bag.image_topic])):
        yield BagFrame(frame.name, frame.counts, partial(views.find, frame, _guess(frame, focal_px)))


def corners_of(bag: BagReader, views: BoardViews) -> Iterator[BagFrame]:
    """Frames of a bag that has the corners of markers instead of images."""
    camera = recorded_camera(bag)
    views.size = camera.width, camera.height
    for index, (_, rows) in enumerate(recorded_rows(bag)):
        yield BagFrame(str(index), None, partial(views.recognise, str(index), rows))


def look_at_bag(frames: Iterable[BagFrame], views: BoardViews, most: int, every: int, most_motion_px: float) -> None:
    """Look in every n-th frame of a bag for the board, in a new place, and nearly at rest until the next frame."""
    pending: BoardView | None = None
    for index, frame in enumerate(frames):
        if pending is None and index % every:
            continue
        sighting = frame.find()
        if pending is not None and sighting is not None:
            motion_px = _distance(pending.sighting, sighting)
            if motion_px < most_motion_px:
                views.keep(pending)
            else:
                moving = f'the board moves by {motion_px:.1f} px until the next frame (--most-motion)'
                views.leave(pending.name, moving, pending.counts)
        pending = None
        if sighting is not None and _is_new(sighting, views.kept):
            pending = BoardView(frame.name, sighting, frame.counts)
        if len(views.kept) >= most:
            return


def _guess(frame: RawFrame, focal_px: float) -> Camera:
    height, width = frame.counts.shape
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return Camera(width, height, K)


def _is_new(sighting: Sighting, kept: Sequence[BoardView]) -> bool:
    return all(_distance(sighting, view.sighting) > _NEW_VIEW_PX for view in kept)


def _distance(a: Sighting, b: Sighting) -> float:
    """Mean distance of the common points [px]; infinite without common points."""
    there = {tuple(point): pixel for point, pixel in zip(a.points.tolist(), a.pixels, strict=True)}
    both = [
        (there[tuple(point)], pixel)
        for point, pixel in zip(b.points.tolist(), b.pixels, strict=True)
        if tuple(point) in there
    ]
    return float(np.mean([np.linalg.norm(p - q) for p, q in both])) if both else np.inf
