"""Errors of the corners in flights that are simulated without pictures."""

from dataclasses import dataclass

from thermal_fiducial.sim.lens import Lens


@dataclass(frozen=True)
class CornerNoise:
    """Errors of corners.

    Parameters
    ----------
    sigma_px : standard deviation of white noise of each coordinate
    claimed_px : standard deviation that the detector claims
    true_lens : lens that projects the corners, if the calibration is not exact; gives systematic errors
    """

    sigma_px: float = 0.25
    claimed_px: float = 0.35
    true_lens: Lens | None = None
