"""What one frame leaves to the next."""

from dataclasses import dataclass, field

from thermal_fiducial.core.detection.polarity import Polarity
from thermal_fiducial.core.detection.search import SearchScales
from thermal_fiducial.core.detection.tracking import MotionTrack

# Depth of the scene while no marker has shown it [m].
_TYPICAL_DEPTH_M = 3.0


@dataclass(frozen=True, slots=True)
class FrameHistory:
    """What the frames so far have shown."""

    track: MotionTrack
    polarity: Polarity = field(default_factory=Polarity)
    #: mean depth of the last markers [m]
    depth_m: float = _TYPICAL_DEPTH_M
    #: whether the last frame showed markers that are partially visible
    saw_partial: bool = False
    #: frames since the last blind search, and at which resolutions that was
    since_blind: int = 0
    scales: SearchScales = SearchScales.ALL
