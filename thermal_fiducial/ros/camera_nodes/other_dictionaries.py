"""Notices that the markers in view are of another dictionary than the parameter says."""

from dataclasses import replace

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.detector import MarkerDetector
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import Counts, Gray, SECOND_NS
from thermal_fiducial.core.wording import listed
from thermal_fiducial.files.dictionary import load_dictionary, packaged

#: Dictionaries that are looked for: all that the package ships, and the usual ones of OpenCV, which hold the smaller
#: ones of their size. Larger ones (1000 markers of 4x4 bits) find their markers in anything.
_USUAL = (*sorted(packaged()), 'DICT_4X4_250', 'DICT_5X5_250', 'DICT_6X6_250', 'DICT_APRILTAG_36h11')
#: Time between looks: each takes a blind search, two where it shows something.
_PERIOD_NS = SECOND_NS
#: Looks in a row that show the same marker of another dictionary: clutter that looks like one rarely does so for long.
_CERTAIN = 3
#: Looks at markers of our own dictionary after which it is right: one for each other dictionary.
_SETTLED = len(_USUAL)
#: Most IDs that the warning names.
_MOST_NAMES = 5


class OtherDictionaries:
    """Compares the exact markers of our dictionary in a frame with those of another one, once a second.

    Exact: without a wrong bit, as 4 of 100 markers of one dictionary are one wrong bit from a marker of another.
    """

    def __init__(self, config: ArucoDetectorConfig) -> None:
        self._own = config.dictionary
        self.configure(config)
        self._names = [name for name in _USUAL if name != self._own]
        self._turn = self._settled = self._hits = 0
        self._ids: set[int] = set()
        self._due_ns: int | None = None
        #: warning that names both dictionaries; empty without a doubt
        self.doubt = ''

    def configure(self, config: ArucoDetectorConfig) -> None:
        """Take over the detector's dynamic parameters, as far as they say what is visible."""
        self._config = replace(config, guided=False, polarity='any', whitelist=(), whitelist_from_map=False)

    def settle(self) -> None:
        """Look no more: a filter that runs has poses by our markers, and a look would delay the next frame."""
        self._settled = _SETTLED
        self.doubt = ''

    def look(self, stamp_ns: int, image: Counts | Gray, camera: Camera, *, any_seen: bool) -> None:
        """Compare with the next dictionary if a look is due, until our own markers have been seen for long enough.

        ``any_seen``: whether the detector has found markers in this image.
        """
        if self._settled >= _SETTLED or (self._due_ns is not None and 0 < self._due_ns - stamp_ns <= _PERIOD_NS):
            return
        self._due_ns = stamp_ns + _PERIOD_NS
        other = self._exact(self._names[self._turn], image, camera)
        if other and not (any_seen and len(self._exact(self._own, image, camera)) >= len(other)):
            self._count(other, image, camera)
            return
        if any_seen:
            self._settled += 1
            self.doubt = ''
        self._hits = 0
        self._turn = (self._turn + 1) % len(self._names)

    def _count(self, other: set[int], image: Counts | Gray, camera: Camera) -> None:
        """Count a look that another dictionary explains better."""
        self._ids = self._ids & other if self._hits else other
        self._hits = self._hits + 1 if self._ids else 0
        if self._hits < _CERTAIN or self.doubt:
            return
        found = {name: self._exact(name, image, camera) for name in self._names}
        most = max(map(len, found.values()))
        words = [f'{listed(sorted(ids), _MOST_NAMES)} of {name}' for name, ids in found.items() if len(ids) == most]
        seen = ' or '.join(words)
        self.doubt = f'dictionary is {self._own}, but the markers in view are {seen}: set the parameter dictionary'

    def _exact(self, name: str, image: Counts | Gray, camera: Camera) -> set[int]:
        """IDs in an image that has nothing to do with the one before it: a detector that knows of none."""
        exact = replace(load_dictionary(name), correctable=0)
        rows = MarkerDetector(self._config, exact).detect(0, image, camera)
        return {int(marker_id) for marker_id in rows['id']}
