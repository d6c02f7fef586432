"""Many drawings on sheets of a given size."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.drawing import combined, Drawing


@dataclass
class _Shelf:
    """A row of drawings, the tallest first; the next one begins at ``x``."""

    y: float
    height: float
    x: float


@dataclass
class _Sheet:
    """A sheet that fills up shelf by shelf from the bottom."""

    width: float
    height: float
    spacing: float
    margin: float
    shelves: list[_Shelf] = field(default_factory=list)
    placed: list[Drawing] = field(default_factory=list)

    def put(self, drawing: Drawing) -> bool:
        """Place ``drawing`` on the first shelf with room for it, or on a new one; False if it does not fit."""
        right = self.width - self.margin
        for shelf in (*self.shelves, self._next_shelf(drawing.height)):
            fits = drawing.height <= shelf.height and shelf.y + shelf.height <= self.height - self.margin
            if fits and shelf.x + drawing.width <= right:
                if shelf not in self.shelves:
                    self.shelves.append(shelf)
                self.placed.append(drawing.moved(shelf.x, shelf.y))
                shelf.x += drawing.width + self.spacing
                return True
        return False

    def _next_shelf(self, height: float) -> _Shelf:
        y = self.shelves[-1].y + self.shelves[-1].height + self.spacing if self.shelves else self.margin
        return _Shelf(y, height, self.margin)


def nest(drawings: Sequence[Drawing], width: float, height: float, *, spacing: float, margin: float) -> list[Drawing]:
    """Sheets of ``width`` times ``height`` [mm] that hold all ``drawings``.

    Shelves are filled from the bottom, tallest drawings first (first fit by decreasing height;
    E. Coffman et al., "Performance bounds for level-oriented two-dimensional packing algorithms", 1980).

    Parameters
    ----------
    spacing : between drawings [mm]
    margin : along the border of the sheet [mm]

    Raises
    ------
    InputError
        A drawing that is larger than the sheet.
    """
    sheets: list[_Sheet] = []
    for drawing in sorted(drawings, key=lambda item: -item.height):
        if any(sheet.put(drawing) for sheet in sheets):
            continue
        sheets.append(_Sheet(width, height, spacing, margin))
        if not sheets[-1].put(drawing):
            raise InputError(
                f'marker {drawing.name} of {drawing.width:g} x {drawing.height:g} mm does not fit on a sheet of '
                f'{width:g} x {height:g} mm with a margin of {margin:g} mm'
            )
    return [combined(f'sheet-{index}', width, height, sheet.placed) for index, sheet in enumerate(sheets, 1)]
