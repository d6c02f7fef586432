"""When the topics of a bag end."""

from collections.abc import Iterable, Iterator

from thermal_fiducial.files.bags import BagMessage
from thermal_fiducial.replay.topics import Playable


class LastStamps:
    """A bag that notes its stamp of the last message on each topic while it is played."""

    def __init__(self, bag: Playable) -> None:
        self._bag = bag
        #: topic to bag stamp
        self.of_topics: dict[str, int] = {}

    @property
    def start_ns(self) -> int:
        """Stamp of the first message."""
        return self._bag.start_ns

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """The messages on ``topics`` in their order."""
        for message in self._bag.messages(topics):
            self.of_topics[message.topic] = message.stamp_ns
            yield message
