"""The map of a mapper and its file: loaded at the start, saved, edited by services, saved at the end."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_srvs.srv import SetBool, Trigger

from thermal_fiducial.config import MarkerMapperConfig, size_overrides
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.core.wording import listed
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import bring_beside, other_patterns
from thermal_fiducial.files.map_keeper import MapKeeper
from thermal_fiducial.files.marker_map import other_frame, other_sides
from thermal_fiducial.files.reading import is_there
from thermal_fiducial.files.robot_folder import file_name_of
from thermal_fiducial.ros.base.node import Made, StageNode
from thermal_fiducial.ros.mapper_node.freeze_memory import FreezeMemory
from thermal_fiducial.ros.mapper_node.map_refinement import MapRefinement

Answer = Callable[[Trigger.Request, Trigger.Response], Trigger.Response]

#: Time for which a service waits for a disk [s]; no frame is processed meanwhile.
_PATIENCE_S = 1.0
#: Largest number of markers that are named at the end, as they are not in the map.
_MOST_NAMED = 20
#: Time for the last refinement [s]: one takes a second or two, and ros2 launch grows impatient after five.
_LAST_REFINEMENT_S = 3.0


class MapServices:
    """Creates the mapper of ``node`` from its map file, offers the map services, and saves the map when it ends.

    Parameters
    ----------
    node : a mapper's node
    publish_jump : called with T_new_old (4, 4), None without common markers, when a service has replaced the map
    """

    def __init__(self, node: StageNode[MarkerMapperConfig], publish_jump: Callable[[FloatArray | None], None]) -> None:
        config = node.config
        self._node = node
        self._publish_jump = publish_jump
        file = Path(config.map_file) if config.map_file else None
        sizes = size_overrides(config.marker_size_overrides)
        robot = file_name_of(node.get_namespace())
        self._keeper = MapKeeper(file, config.marker_size, sizes, flown=node.live, robot=robot)
        self._disk = ThreadPoolExecutor(1)
        self._other_dictionary = ''
        #: the fault of a map file that could not be read at the start
        self._unread: list[str] = []
        self._memory = FreezeMemory(node)
        self.mapper = MarkerMapper(config, self._first_map())
        self.mapper.frozen = self._memory.recalled(self.mapper.frozen)
        self.refinement = MapRefinement(self.mapper, live=node.live)
        node.endings.append(self.close)
        node.completions.append(self._finish)
        for name in ('save', 'load', 'undo', 'reset', 'refine'):
            node.serve(Trigger, f'~/{name}', _answer(getattr(self, name)))
        node.serve(SetBool, '~/freeze', self._on_freeze)
        if node.live and config.autosave_period:
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            node.create_timer(config.autosave_period, self._autosave, clock=clock)

    def _first_map(self) -> MarkerMap:
        node, config = self._node, self._node.config
        empty = MarkerMap(frame_id=config.map_frame, dictionary=Path(config.dictionary).name)
        if not config.map_file:
            return empty
        before = len(node.faults)
        loaded = node.attempt(self._read, empty)
        self._unread = node.faults[before:]
        self._keeper.take()
        may_recover = node.live and (config.mode == 'mapping' or self._memory.asked is not None)
        recovered, note = self._keeper.recover(config.autosave_period if may_recover else 0.0)
        if note:
            node.get_logger().warning(note)
        return loaded if recovered is None else recovered

    def _read(self) -> MarkerMap:
        loaded = self._keeper.read()
        self._node.get_logger().info(f'map of {loaded.size_in_words} from {self._keeper.path}')
        config, folder = self._node.config, self._keeper.path.parent
        self._other_dictionary = other_patterns(loaded.markers, loaded.dictionary, config.dictionary, folder)
        sides = other_sides(loaded, config.marker_size, size_overrides(config.marker_size_overrides))
        for doubt in (other_frame(loaded.frame_id, config.map_frame), sides, self._other_dictionary):
            if doubt:
                self._node.get_logger().warning(doubt)
        return loaded

    @property
    def doubts(self) -> str:
        """Warnings: a map of another dictionary, or that most markers contradict; autosaves that fail. Else empty."""
        return '; '.join(filter(None, (self._other_dictionary, self.mapper.doubt_of_map, self._keeper.fault)))

    def remember(self) -> None:
        """Refresh what a mapper that starts again in flight begins with: whether the map is frozen.

        Raises
        ------
        InputError
            It could not be saved; raised once.
        """
        self._memory.save()

    def _autosave(self) -> None:
        self._node.guard(self._keeper.autosave, self.mapper.map)

    def _in_time(self, act: Callable[[], Made]) -> Made:
        """Result of what is done to files, which a disk that hangs or another program's lock may delay.

        Raises
        ------
        InputError
            It takes too long; it goes on, and so do the frames.
        """
        task = self._disk.submit(act)
        try:
            return task.result(_PATIENCE_S)
        except TimeoutError:
            raise InputError(f'{self._keeper.path}: the disk is busy; this goes on without an answer') from None

    def note_learned(self) -> None:
        """Mark the map as changed since the last save."""
        self._keeper.unsaved = True

    def refine_in_flight(self, stamp_ns: int) -> bool:
        """Go on with the refinement after each frame; returns whether one has changed the map.

        Raises
        ------
        InputError
            A refinement failed.
        """
        changed = self.refinement.step(stamp_ns)
        if changed:
            self.note_learned()
        return changed

    def save(self) -> str:
        """Write the map file, or another one if it cannot be replaced; returns a message with path and reason."""
        marker_map = self._copy_to_save()
        return self._in_time(lambda: self._save(marker_map))

    def _copy_to_save(self) -> MarkerMap:
        """A copy of the map; what is learned from now on is not in it, however long a disk takes."""
        self._keeper.unsaved = False
        return self.mapper.map.copy()

    def _save(self, marker_map: MarkerMap) -> str:
        path = self._keeper.save(marker_map)
        why = f', as {self._keeper.obstacle}' if self._keeper.obstacle else ''
        return f'{marker_map.size_in_words} saved to {path}{why}{self._without_dictionary(marker_map, path.parent)}'

    def _without_dictionary(self, marker_map: MarkerMap, folder: Path) -> str:
        """Copy the dictionary file that a saved map names beside it, if it is not there; why it could not be."""
        own = self._node.config.dictionary
        if marker_map.dictionary != Path(own).name or is_there(folder / marker_map.dictionary):
            return ''
        try:
            bring_beside(own, folder)
        except InputError as error:
            # The map is saved: nodes read the dictionary from their own parameter.
            return f', without its dictionary: {error}'
        return ''

    def load(self) -> str:
        """Reload the map file, for example after edits with ``thermal-fiducial map``."""
        self._refuse_frozen()
        before = self.mapper.map.copy()
        loaded, aside = self._in_time(lambda: (self._read(), self._keeper.put_aside(before)))
        self._keeper.take()
        while self._unread:
            self._node.faults.remove(self._unread.pop())
        self._publish_jump(self.mapper.load(loaded))
        kept = f'; {before.size_in_words} before it, unsaved until now, are in {aside}' if aside else ''
        return f'{loaded.size_in_words} loaded from {self._keeper.path}{kept}'

    def undo(self) -> str:
        """Restore the previous version of the map file and load it."""
        self._refuse_frozen()
        return f'undone: {self._in_time(self._keeper.undo)}; {self.load()}'

    def reset(self) -> str:
        """Reset to the map loaded last."""
        self._refuse_frozen()
        self._publish_jump(self.mapper.reset())
        left = f'{self.mapper.map.size_in_words} left'
        self._node.console.event('map', f'map reset on request: {left}')
        return left

    def refine(self) -> str:
        """Start a bundle adjustment now."""
        self.refinement.start()
        return 'refinement started'

    def _refuse_frozen(self) -> None:
        if self.mapper.frozen:
            raise InputError('the map is frozen')

    def _on_freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.mapper.frozen = bool(request.data)
        self.refinement.prepare()
        self._node.guard(self._memory.ask, self.mapper.frozen)
        response.success, response.message = True, 'map frozen' if request.data else 'map free'
        return response

    def _finish(self) -> None:
        """Name what was seen and is not in the map; refine it with the last keyframes before it is saved at the end.

        A copy is saved first: whoever starts the node may kill it for taking its time.
        """
        if waiting := [candidate.reason for _, candidate in sorted(self.mapper.candidates.items())]:
            self._node.get_logger().warning(f'not in the map: {listed(waiting, _MOST_NAMED)}')
        to_do = self._keeper.unsaved or self.mapper.has_unrefined or self.refinement.busy
        if not (self._node.config.map_file and to_do):
            return
        self._keeper.autosave(self.mapper.map)
        try:
            if self.refinement.finish(_LAST_REFINEMENT_S):
                self.note_learned()
        except InputError as error:
            self._node.get_logger().warning(f'the map is saved as it was in flight: {error}')

    def close(self) -> None:
        """Terminate a running refinement; save the map if it has changed.

        Raises
        ------
        InputError
            The map cannot be saved anywhere.
        """
        try:
            self.refinement.close()
        finally:
            # A save that goes on would be taken for that of another program.
            self._disk.shutdown()
            self._save_at_the_end()

    def _save_at_the_end(self) -> None:
        file = self._node.config.map_file
        lost = not self.mapper.frozen and not is_there(file)
        if file and (self._keeper.unsaved or lost) and self.mapper.map.markers:
            line, logger = self._save(self._copy_to_save()), self._node.get_logger()
            if self._keeper.obstacle:
                logger.warning(line)
            else:
                logger.info(line)


def _answer(act: Callable[[], str]) -> Answer:
    """Trigger callback that returns the message of ``act``."""

    def answer(_: Trigger.Request, response: Trigger.Response) -> Any:
        response.message, response.success = act(), True
        return response

    return answer
