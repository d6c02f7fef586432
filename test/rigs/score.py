"""What poses, maps and flights are worth, beside the truth."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

#: Of position, or of attitude.
THREE_SIGMA = float(chi2.ppf(0.9973, 3))
#: More than chance: errors of a rig last as long as its flight, so its NEES is not 1, but hardly ever so large.
MOST_NEES, MOST_BEYOND = 2.0, 0.1


@dataclass(frozen=True)
class Worth:
    """Of poses: rms of the position [m], NEES a degree of freedom, share beyond 3 sigma in position or attitude.

    Without any it is nan, which is beyond nothing.
    """

    count: int = 0
    rms: float = np.nan
    nees: float = np.nan
    beyond: float = np.nan

    @classmethod
    def of(cls, poses: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> 'Worth':
        """Of true poses (4, 4), estimated ones, and their covariances (6, 6) in the ROS convention."""
        if not poses:
            return cls()
        truth, estimated, covariance = map(np.array, zip(*poses, strict=True))
        turned = Rotation.from_matrix(truth[:, :3, :3] @ estimated[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        errors = np.hstack((truth[:, :3, 3] - estimated[:, :3, 3], turned))
        position, attitude = (_squares(errors[:, k], covariance[:, k, k]) for k in (slice(3), slice(3, 6)))
        return cls(
            count=len(errors),
            rms=float(np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1)))),
            nees=float(np.mean(_squares(errors, covariance)) / 6.0),
            beyond=float(np.mean(np.maximum(position, attitude) > THREE_SIGMA)),
        )


def _squares(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Squares (N,) in sigma of errors (N, K)."""
    return np.einsum('nk,nk->n', errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


@dataclass(frozen=True)
class Score:
    """What a flight in a mode came to.

    Parameters
    ----------
    poses : while the filter did not declare itself lost
    markers : those that the mapper placed
    lost : share of the time that it did
    resets : of the filter
    found : share of the legible markers in view that were detected
    false, false_mapped : detections of IDs that are not there, and such IDs in the map
    """

    mode: str
    poses: Worth
    markers: Worth
    lost: float
    resets: int
    found: float
    false: int
    false_mapped: int

    @property
    def is_beyond_claims(self) -> bool:
        """Whether poses or map are worse than they claim."""
        is_wrong = self.poses.nees > MOST_NEES or self.markers.nees > MOST_NEES or self.poses.beyond > MOST_BEYOND
        return is_wrong or self.false_mapped > 0
