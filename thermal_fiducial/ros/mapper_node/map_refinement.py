"""Bundle adjustment of the map in the background: in a separate process while the map may change."""

import time

from thermal_fiducial.core.mapping.adjustment_problem import Snapshot
from thermal_fiducial.core.mapping.bundle_adjustment import AdjustedMap, refine
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.process.worker import Background, Foreground

Worker = Background[Snapshot, AdjustedMap | None] | Foreground[Snapshot, AdjustedMap | None]


class MapRefinement:
    """Refines the map of ``mapper``; ``live``: in the background, else synchronously (lock-step replay)."""

    def __init__(self, mapper: MarkerMapper, *, live: bool) -> None:
        self._mapper = mapper
        self._live = live
        self._worker: Worker | None = None
        self.prepare()

    @property
    def busy(self) -> bool:
        """Whether no refinement can be started: one is running, or its process is starting."""
        return self._worker is not None and self._worker.busy

    def prepare(self) -> None:
        """Start the process if the map may change; it takes a while to be ready."""
        if self._worker is None and not self._mapper.frozen:
            self._worker = Background(refine) if self._live else Foreground(refine)

    def step(self, stamp_ns: int) -> bool:
        """After each frame: start a refinement if one is due, apply a finished one; returns whether one was applied.

        Raises
        ------
        InputError
            A refinement failed.
        """
        if self._worker is None:
            return False
        if not self._worker.busy and self._mapper.refinement_due(stamp_ns):
            self._begin(self._worker)
        return self._apply(self._worker.take())

    def start(self) -> None:
        """Start a refinement now.

        Raises
        ------
        InputError
            The map is frozen, a refinement is running already, or there is nothing to refine yet.
        """
        if self._mapper.frozen or self._worker is None:
            raise InputError('the map is frozen')
        snapshot = self._mapper.snapshot()
        if snapshot is None:
            raise InputError('nothing to refine yet')
        # So is a process that starts, until the first frame.
        if self._worker.busy:
            raise InputError('a refinement is under way')
        self._worker.start(snapshot)

    def finish(self, seconds: float) -> bool:
        """Refine the map of a flight that has ended, with its last keyframes, if ``seconds`` are enough.

        Returns
        -------
        Whether a refinement was applied.

        Raises
        ------
        InputError
            A refinement failed.
        """
        if self._worker is None:
            return False
        until = time.monotonic() + seconds
        # First one that is under way, or the start of its process.
        changed = self._apply(self._worker.take(seconds))
        if not self._worker.busy and self._mapper.has_unrefined and self._begin(self._worker):
            changed |= self._apply(self._worker.take(until - time.monotonic()))
        return changed

    def _begin(self, worker: Worker) -> bool:
        snapshot = self._mapper.snapshot()
        if snapshot is not None:
            worker.start(snapshot)
        return snapshot is not None

    def _apply(self, refinement: AdjustedMap | None) -> bool:
        return refinement is not None and self._mapper.apply(refinement)

    def close(self) -> None:
        """Terminate the process, even during a refinement."""
        if self._worker is not None:
            self._worker.close()
