"""Bundle adjustment of the map in the background: in a separate process while the map may change."""

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
        refinement = self._worker.take()
        return refinement is not None and self._mapper.apply(refinement)

    def start(self) -> None:
        """Start a refinement now.

        Raises
        ------
        InputError
            The map is frozen, a refinement is running already, or there is nothing to refine yet.
        """
        if self._mapper.frozen or self._worker is None:
            raise InputError('the map is frozen')
        if self._worker.busy:
            raise InputError('a refinement is under way')
        if not self._begin(self._worker):
            raise InputError('nothing to refine yet')

    def _begin(self, worker: Worker) -> bool:
        snapshot = self._mapper.snapshot()
        if snapshot is not None:
            worker.start(snapshot)
        return snapshot is not None

    def close(self) -> None:
        """Terminate the process, even during a refinement."""
        if self._worker is not None:
            self._worker.close()
