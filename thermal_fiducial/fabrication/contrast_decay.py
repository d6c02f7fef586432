"""Decay of the contrast of a stencil while its acrylic warms up.

One-dimensional heat conduction through the sheet. Its back faces the warm surface across an air gap (conduction
through the air and radiation) or touches it; its front loses heat to the room by convection and radiation. What the
camera sees is the warm surface through the holes against the front of the sheet.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

# Cast PMMA (manufacturers' data sheets) and still air at 300 K.
_CONDUCTIVITY = 0.19  # W/m/K
_HEAT_CAPACITY = 1190.0 * 1470.0  # J/m^3/K
_AIR_CONDUCTIVITY = 0.026  # W/m/K
# 4 sigma T^3 at 310 K between two surfaces of emissivity 0.95 and 0.95.
_RADIATION = 4.0 * 5.67e-8 * 310.0**3 / (2.0 / 0.95 - 1.0)  # W/m^2/K
# Layers of the sheet in the computation: twice as many change the contrast by less than 0.002 of it.
_LAYERS = 40


@dataclass(frozen=True)
class Mounting:
    """How a sheet hangs in front of a warm surface.

    Parameters
    ----------
    thickness : of the acrylic [m]
    gap : distance between warm surface and sheet [m]; 0: in contact
    loss : heat transfer from the front to the room [W/m^2/K]: 10 in still air, 25 in a rotor's wash
    """

    thickness: float = 0.003
    gap: float = 0.010
    loss: float = 10.0

    def __post_init__(self) -> None:
        if not (0.0 < self.thickness < 0.1 and 0.0 <= self.gap < 1.0 and 0.0 < self.loss < 1e3):
            raise InputError(
                f'a sheet of {1e3 * self.thickness:g} mm with a stand-off of {1e3 * self.gap:g} mm: choose 0 to 100 mm '
                f'of acrylic and less than 1 m of stand-off'
            )

    @property
    def gap_conductance(self) -> float:
        """Heat transfer across the gap [W/m^2/K]; infinite in contact."""
        return _AIR_CONDUCTIVITY / self.gap + _RADIATION if self.gap > 0.0 else np.inf


def remaining_contrast(mounting: Mounting, seconds: npt.ArrayLike) -> FloatArray:
    """Remaining contrast after ``seconds`` (...), as a share (...) of the difference between warm surface and room.

    The sheet starts at room temperature. Solved exactly in time (eigenvalues of the conduction matrix), in layers
    across the thickness.
    """
    layer = mounting.thickness / _LAYERS
    between = _CONDUCTIVITY / layer
    back = 1.0 / (1.0 / mounting.gap_conductance + 0.5 / between)
    front = 1.0 / (1.0 / mounting.loss + 0.5 / between)
    flow = np.zeros((_LAYERS, _LAYERS))
    inner = np.arange(_LAYERS - 1)
    flow[inner, inner + 1] = flow[inner + 1, inner] = between
    flow -= np.diag(flow.sum(axis=1))
    flow[0, 0] -= back
    flow[-1, -1] -= front
    rates, modes = np.linalg.eigh(flow / (_HEAT_CAPACITY * layer))
    steady = np.linalg.solve(flow, -back * np.eye(_LAYERS)[0])
    decay = np.exp(rates * np.asarray(seconds, dtype=np.float64)[..., None])
    last_layer = steady[-1] - (decay * (modes.T @ steady)) @ modes[-1]
    surface = last_layer * front / mounting.loss
    return np.asarray(1.0 - surface)
