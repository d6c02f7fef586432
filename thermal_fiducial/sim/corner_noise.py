"""Errors of the corners of a flight that is simulated from the corners on, without a picture being rendered."""

from dataclasses import dataclass

from thermal_fiducial.sim.lens import Lens


@dataclass(frozen=True)
class CornerNoise:
    """Errors of corners.

    Parameters
    ----------
    sigma_px : white, of each coordinate
    claimed_px : what the detector says of it
    true_lens : through which the corners are seen, where the calibration is not exact: errors that last as long as
        the view
    """

    sigma_px: float = 0.25
    claimed_px: float = 0.35
    true_lens: Lens | None = None
