"""Candidates: new markers whose views are collected until only one pose explains them.

A small square seen from one side fits two poses nearly equally well (the planar ambiguity of Schweighofer and Pinz,
"Robust pose estimation from a planar target", 2006). The wrong pose differs between directions, so the marker's pose is
fitted to views from several directions, starting from either solution. The marker enters the map once one of the two
fits is ruled out, unless the views show that its side is not the declared one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from thermal_fiducial.core.error_model import noise_factor, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.se3 import turn_between
from thermal_fiducial.core.mapping.keyframes import Displacement
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.mapping.marker_views import MarkerView, MarkerViews, SAME_POSE, Viewpoint
from thermal_fiducial.core.measurements import Observations
from thermal_fiducial.core.types import FloatArray

#: Least angle between the directions of views that are kept [rad]: closer ones do not resolve the ambiguity.
MIN_SEPARATION = np.deg2rad(1.0)
#: Standard deviation of a view's camera, as a share of that of a view from about the same direction, below which it
#: takes its place. If any better one did, a view would follow a moving camera, and there would never be three.
BETTER = 0.35
MIN_VIEWS = 3
#: Views kept of a candidate, which bounds the cost of the fit.
MAX_VIEWS = 16
#: Difference of the two fits' chi squares that rules the worse one out: odds of e^-12 against a flip.
UNAMBIGUOUS = 25.0
#: Mean chi square of a view (8 residuals) above which the views cannot be of one marker at rest.
INCONSISTENT = 200.0
#: Chi square of the declared side, by the views, above which it is wrong: 99.9 % quantile, one degree of freedom.
WRONG_SIDE = 10.8
#: Candidates that are judged in one frame: bounds its time when many are new.
TRIALS = 3
#: Largest number of candidates, which bounds memory against false positives: those observed longest ago are dropped.
MOST = 1000


@dataclass
class Candidate:
    """A new marker with its views, not in the map yet."""

    id: int
    size: float
    views: list[MarkerView] = field(default_factory=list)
    #: what it waits for, in words
    reason: str = 'not judged yet'
    #: views since it was last judged
    untried: int = 0

    def add(self, view: MarkerView) -> None:
        """Keep ``view`` if its direction is new, or in place of a view of the same frame with an older camera pose.

        Or in place of one from about the same direction whose camera pose is known far less well: directions by such
        poses differ most, so that the worst views would be kept, and hide the good ones between them.
        """
        stamps = [kept.stamp_ns for kept in self.views]
        if view.stamp_ns in stamps:
            self.views[stamps.index(view.stamp_ns)] = view
        elif (alike := self._from_the_same_direction(view)) is None:
            self.views.append(view)
        elif view.viewpoint.turn_std < BETTER * self.views[alike].viewpoint.turn_std:
            self.views[alike] = view
        else:
            return
        self.untried += 1
        if len(self.views) > MAX_VIEWS:
            self._drop_most_redundant()

    def _from_the_same_direction(self, view: MarkerView) -> int | None:
        """Index of the kept view that ``view`` is nearest to, if the two are too near to be two."""
        if not self.views:
            return None
        cosines = self._directions @ view.direction
        nearest = int(np.argmax(cosines))
        return nearest if cosines[nearest] > np.cos(MIN_SEPARATION) else None

    def place(self, camera: Camera, errors: SystematicErrors) -> MapMarker | str:
        """The marker in the map if the views determine it uniquely, else what it waits for, in words."""
        self.untried = 0
        if len(self.views) < MIN_VIEWS:
            return f'marker {self.id} needs views from more directions'
        views = MarkerViews(self.views, self.size, camera, errors)
        fits = views.fit(self._starts)
        if not fits.chi2[0] <= INCONSISTENT * len(self.views) or views.chi2_of_side(fits) > WRONG_SIDE:
            if len(self.views) >= 2 * MIN_VIEWS:
                self._drop_farthest()
            return f'marker {self.id}: its views contradict each other; is its side {self.size:g} m?'
        scale = noise_factor(float(fits.chi2[0]), 8 * len(self.views) - 6)
        others = np.flatnonzero(turn_between(fits.T[0], fits.T) > SAME_POSE)
        if len(others) and fits.cost[others[0]] - fits.cost[0] < UNAMBIGUOUS * scale:
            return f'planar ambiguity of marker {self.id} unsettled'
        # The noise of each marker is its own.
        covariance, draws = views.errors(fits, scale, np.random.default_rng(self.id))
        return MapMarker(self.id, self.size, False, fits.T[0], covariance, draws=draws)

    def solutions(self, camera: Camera) -> list[FloatArray]:
        """All poses (4, 4) that a fit to the views ends in, the best first."""
        fits = MarkerViews(self.views, self.size, camera, SystematicErrors()).fit(self._starts)
        poses = list[FloatArray]()
        for T in fits.T[np.isfinite(fits.cost)]:
            if all(turn_between(T, other) > SAME_POSE for other in poses):
                poses.append(T)
        return poses

    @property
    def _starts(self) -> FloatArray:
        """Initial poses (S, 4, 4) of a fit: from every branch of the views whose cameras are known best."""
        best = sorted(self.views, key=lambda view: view.viewpoint.turn_std)[:MIN_VIEWS]
        pairs = [view.viewpoint.poses[:, None] @ view.branches for view in best]
        starts = np.concatenate([pair.reshape(-1, 4, 4) for pair in pairs])
        return np.asarray(starts[np.all(np.isfinite(starts), axis=(1, 2))])

    def _drop_most_redundant(self) -> None:
        """Drop the view whose nearest neighbour is the nearest of all."""
        directions = self._directions
        cosines = directions @ directions.T - 2.0 * np.eye(len(self.views))
        del self.views[int(np.argmax(np.max(cosines, axis=1)))]

    def _drop_farthest(self) -> None:
        """Drop the view that shows the marker farthest from where most do: another one may have been read as this."""
        places = np.stack([(view.viewpoint.T_map_camera[0] @ view.branches[0])[:3, 3] for view in self.views])
        off = np.linalg.norm(places - np.median(places, axis=0), axis=1)
        del self.views[int(np.argmax(off))]

    @property
    def _directions(self) -> FloatArray:
        """Unit vectors (n, 3) from the marker to the cameras, in the map."""
        return np.stack([view.direction for view in self.views])


class NewMarkers:
    """All candidates; ``size`` is the side of a marker [m], ``sizes`` that of those that differ, by ID."""

    def __init__(self, size: float, sizes: Mapping[int, float]) -> None:
        self._size, self._sizes = size, sizes
        self.candidates: dict[int, Candidate] = {}
        #: in whose pixels all views are
        self._camera: Camera | None = None

    def add_views(
        self, stamp_ns: int, observed: Observations, camera: Camera, viewpoint: Viewpoint, errors: SystematicErrors
    ) -> tuple[list[MapMarker], dict[int, str]]:
        """Add a frame's views to the candidates, except markers without a pose.

        Returns
        -------
        Markers to enter the map, now determined by their views, and what the others wait for, in words by ID.
        """
        if self._camera is not None and not camera.matches(self._camera):
            # The directions of all views stay.
            for candidate in self.candidates.values():
                candidate.views = [view.in_pixels_of(self._camera, camera) for view in candidate.views]
        self._camera = camera
        shown = []
        posed = np.isfinite(observed.branches[:, 0]).all(axis=(1, 2))
        for i, marker_id in zip(np.flatnonzero(posed).tolist(), observed.ids[posed].tolist(), strict=True):
            size = self._sizes.get(marker_id, self._size)
            candidate = self.candidates.setdefault(marker_id, Candidate(marker_id, size))
            candidate.add(
                MarkerView(
                    stamp_ns,
                    viewpoint,
                    observed.corners[i],
                    observed.covariances[i],
                    observed.branches[i],
                    observed.late_px[i],
                )
            )
            shown.append(candidate)
        placed = []
        for candidate in sorted(shown, key=lambda c: -c.untried)[:TRIALS]:
            if not candidate.untried:
                continue
            outcome = candidate.place(camera, errors)
            if isinstance(outcome, str):
                candidate.reason = outcome
                continue
            placed.append(replace(outcome, observations=1, first_seen_ns=stamp_ns, last_seen_ns=stamp_ns))
            del self.candidates[candidate.id]
        while len(self.candidates) > MOST:
            del self.candidates[min(self.candidates, key=lambda key: self.candidates[key].views[-1].stamp_ns)]
        return placed, {c.id: c.reason for c in shown if c.id in self.candidates}

    @property
    def stamps_ns(self) -> set[int]:
        """Stamps of all views."""
        return {view.stamp_ns for candidate in self.candidates.values() for view in candidate.views}

    def move(self, displacement: Displacement) -> None:
        """Apply a displacement of the map to all candidates."""
        for candidate in self.candidates.values():
            candidate.views = [view.moved(displacement.at(view.stamp_ns)) for view in candidate.views]
