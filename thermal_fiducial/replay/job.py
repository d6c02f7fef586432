"""What a replay plays, records and reports, for either transport."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.replay.recorder import Sink
from thermal_fiducial.replay.topics import Playable, TopicTypes

#: Longest time without a message that is played as it is [ns]; a computer without a battery for its clock sets it by
#: years when it finds a network, also in the middle of a recording.
LONGEST_GAP_NS = 60 * SECOND_NS


@dataclass(frozen=True)
class ReplayJob:
    """One replay of an open bag.

    Parameters
    ----------
    bag : the bag, open
    nodes : names of the nodes to run, those of a second camera with its namespace
    played : the topics to play
    files : sink of the published messages
    recorded : the topics to record
    ros_arguments : for the nodes, after ``--ros-args``
    progress : called with the bag's time [ns since its start]
    warn : called with a message on a long wait without progress
    check_interrupt : raises KeyboardInterrupt if the user has pressed Ctrl-C, which is raised nowhere else
    """

    bag: Playable
    nodes: Sequence[str]
    played: TopicTypes
    files: Sink
    recorded: TopicTypes
    ros_arguments: Sequence[str]
    progress: Callable[[int], None]
    warn: Callable[[str], None]
    check_interrupt: Callable[[], None]
