"""Drawings for a laser cutter: closed contours of straight lines and arcs, circles, and engraved outlines.

Millimetres, x to the right, y up, the origin at the lower left of the acrylic. The paths reach half a kerf beyond it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from thermal_fiducial.core.types import FloatArray


@dataclass(frozen=True)
class Contour:
    """A closed line.

    Parameters
    ----------
    points : (N, 2) vertices [mm]; counter-clockwise round acrylic, clockwise round a hole
    bulges : (N,) of the segment that leaves each vertex: tangent of a quarter of the arc's angle, positive when the
        arc turns left, 0 for a straight line (as in DXF)
    """

    points: FloatArray
    bulges: FloatArray

    @property
    def area(self) -> float:
        """Area [mm^2], positive for a counter-clockwise contour."""
        x, y = self.points.T
        following = np.roll(self.points, -1, axis=0)
        polygon = 0.5 * float(np.sum(x * following[:, 1] - following[:, 0] * y))
        chord = np.linalg.norm(following - self.points, axis=1)
        return polygon + float(np.sum(_segment_area(chord, self.bulges)))

    def moved(self, dx: float, dy: float) -> 'Contour':
        """The contour, shifted."""
        return Contour(self.points + np.array([dx, dy]), self.bulges)

    def flattened(self, points_per_arc: int = 8) -> FloatArray:
        """Vertices (M, 2) [mm] of the polygon that replaces each arc by ``points_per_arc`` chords."""
        pieces = []
        following = np.roll(self.points, -1, axis=0)
        for start, end, bulge in zip(self.points, following, self.bulges, strict=True):
            pieces.append(start[None] if bulge == 0.0 else _arc(start, end, bulge, points_per_arc))
        return np.concatenate(pieces)


def _segment_area(chord: FloatArray, bulge: FloatArray) -> FloatArray:
    """Signed area between an arc and its chord."""
    angle = 4.0 * np.arctan(bulge)
    sine = np.where(bulge == 0.0, 1.0, np.sin(angle / 2.0))
    radius = chord / (2.0 * sine)
    return np.asarray(np.where(bulge == 0.0, 0.0, 0.5 * radius**2 * (angle - np.sin(angle))))


def _arc(start: FloatArray, end: FloatArray, bulge: float, count: int) -> FloatArray:
    """``count`` points of an arc, its end left out."""
    chord = end - start
    middle = 0.5 * (start + end)
    # The centre lies to the left of the chord by (1 - b^2) / (4 b) of its length.
    centre = middle + np.array([-chord[1], chord[0]]) * (1.0 - bulge**2) / (4.0 * bulge)
    turn = 4.0 * np.arctan(bulge) * np.arange(count) / count
    radius = start - centre
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.asarray(
        centre + np.stack([cosine * radius[0] - sine * radius[1], sine * radius[0] + cosine * radius[1]], axis=1)
    )


@dataclass(frozen=True)
class Circle:
    """A drilled or cut round hole [mm]."""

    x: float
    y: float
    radius: float

    def moved(self, dx: float, dy: float) -> 'Circle':
        """The hole, shifted."""
        return Circle(self.x + dx, self.y + dy, self.radius)


Shape: TypeAlias = Contour | Circle


@dataclass(frozen=True)
class Drawing:
    """One drawing: paths to cut, drill and engrave on a sheet of ``width`` times ``height`` [mm]."""

    name: str
    width: float
    height: float
    #: round acrylic (counter-clockwise) and round the holes of a pattern (clockwise)
    cuts: tuple[Contour, ...]
    #: mounting holes
    holes: tuple[Circle, ...] = ()
    engraving: tuple[Contour, ...] = ()
    #: round holes of a pattern: the dots of a calibration board
    dots: tuple[Circle, ...] = ()
    #: expected number of separate pieces of acrylic
    parts: int = 1
    #: instructions for cutting and mounting, one line a part
    notes: tuple[str, ...] = ()

    def moved(self, dx: float, dy: float) -> 'Drawing':
        """The drawing, shifted."""
        return replace(
            self,
            cuts=tuple(contour.moved(dx, dy) for contour in self.cuts),
            holes=tuple(circle.moved(dx, dy) for circle in self.holes),
            engraving=tuple(contour.moved(dx, dy) for contour in self.engraving),
            dots=tuple(circle.moved(dx, dy) for circle in self.dots),
        )

    @property
    def layers(self) -> dict[str, tuple[Shape, ...]]:
        """Layers in the order of the work: a piece that has come loose can be neither engraved nor cut.

        ``ENGRAVE``, ``HOLES`` (mounting), ``PATTERN`` (openings for the camera), ``OUTLINE``.
        """
        return {
            'ENGRAVE': self.engraving,
            'HOLES': self.holes,
            'PATTERN': (*(cut for cut in self.cuts if cut.area < 0.0), *self.dots),
            'OUTLINE': tuple(cut for cut in self.cuts if cut.area >= 0.0),
        }

    @property
    def page(self) -> tuple[FloatArray, FloatArray]:
        """Lower left and upper right corner (2,) [mm] of the sheet, or of the paths where these reach beyond it."""
        corners = [contour.points for contour in self.cuts]
        ends = np.concatenate([*corners, np.zeros((1, 2)), np.array([[self.width, self.height]])])
        return ends.min(axis=0), ends.max(axis=0)


def combined(name: str, width: float, height: float, drawings: Sequence[Drawing]) -> Drawing:
    """One drawing of all ``drawings``, in place, on a sheet of ``width`` times ``height`` [mm]."""
    return Drawing(
        name,
        width,
        height,
        cuts=tuple(contour for drawing in drawings for contour in drawing.cuts),
        holes=tuple(circle for drawing in drawings for circle in drawing.holes),
        engraving=tuple(contour for drawing in drawings for contour in drawing.engraving),
        dots=tuple(circle for drawing in drawings for circle in drawing.dots),
        parts=sum(drawing.parts for drawing in drawings),
        notes=tuple(note for drawing in drawings for note in drawing.notes),
    )
