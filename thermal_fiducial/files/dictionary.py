"""Marker dictionaries: those of OpenCV by name, and files of our own.

A dictionary file is YAML::

    format: thermal_fiducial/dictionary
    version: 1
    name: STENCIL_4X4_20        # what parameter `dictionary` may say when the package ships the file
    marker_size: 4              # bits along one side, without the black border of one bit
    max_correction_bits: 1      # bit errors that still name a marker, as far as the patterns differ enough
    markers:                    # IDs 0, 1, 2 ... each its rows from the top, 1 for white (hot, cut out)
      - ['0110', '1011', '0010', '1101']
"""

from collections.abc import Iterable
import difflib
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from thermal_fiducial.core.detection.patterns import correctable_bits, Dictionary
from thermal_fiducial.core.types import Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import is_there, read_text
from thermal_fiducial.files.schema import parse_yaml, Value
from thermal_fiducial.files.writing import write_text

FORMAT = 'thermal_fiducial/dictionary'
#: Folder of the dictionaries that the package ships, loadable by their bare name.
PACKAGED = Path(__file__).resolve().parent.parent / 'dictionaries'


def load_dictionary(name_or_path: str | os.PathLike[str]) -> Dictionary:
    """Dictionary by OpenCV name (``DICT_4X4_50``), packaged name, or path of a dictionary file.

    Raises
    ------
    InputError
        Neither a known name nor a readable file, or a file that is not a dictionary.
    """
    name = str(name_or_path)
    if name in _predefined():
        theirs = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        bits = _unpacked(theirs.bytesList, theirs.markerSize)
        # OpenCV 4 has maxCorrectionBits 0 for the AprilTag families.
        return Dictionary(bits, max(theirs.maxCorrectionBits, correctable_bits(bits)))
    path = packaged().get(name, Path(name))
    try:
        text = read_text(path)
    except InputError:
        close = difflib.get_close_matches(Path(name).name.upper(), [*_predefined(), *packaged()], 1)
        hint = f'; did you mean {close[0]}?' if close else ''
        raise InputError(
            f'dictionary {name[:200]!r}: neither a dictionary of OpenCV nor a readable file{hint}'
        ) from None
    try:
        return _from_document(parse_yaml(str(path), text))
    except InputError as error:
        raise InputError(f'dictionary file {error}') from None


def _predefined() -> list[str]:
    """Dictionaries of OpenCV."""
    return [word for word in dir(cv2.aruco) if word.startswith('DICT_')]


def packaged() -> dict[str, Path]:
    """Dictionaries of the package by name."""
    return {path.stem: path for path in PACKAGED.glob('*.yaml')}


def other_patterns(markers: Iterable[int], of: str, read_as: str, folder: Path = Path()) -> str:
    """Warning if IDs ``markers`` of a map with dictionary ``of`` have other patterns in ``read_as``; else empty.

    A map is untrusted input: its dictionary may only be a name, or a file in the map's ``folder``.
    """
    if Path(of).name == Path(read_as).name:
        return ''
    differ = f'the map has markers of {of}, but dictionary is {read_as}'
    try:
        theirs, ours = load_dictionary(dictionary_of_map(of, folder)).bits, load_dictionary(read_as).bits
    except InputError as error:
        return f'{differ}: {error}'
    both = min(len(theirs), len(ours))
    other = [m for m in sorted(markers) if m >= both or not np.array_equal(theirs[m], ours[m])]
    return f'{differ}, whose marker {other[0]} looks different' if other else ''


def is_own_file(name: str) -> bool:
    """Whether :func:`load_dictionary` takes a name for the path of a file, not for a dictionary that it knows."""
    return name not in _predefined() and name not in packaged()


def not_in_dictionary(markers: Iterable[int], name: str, folder: Path) -> list[int]:
    """IDs ``markers`` that the dictionary of a map in ``folder`` lacks.

    Raises
    ------
    InputError
        The dictionary cannot be opened.
    """
    known = len(load_dictionary(dictionary_of_map(name, folder)).bits)
    return [marker for marker in sorted(markers) if marker >= known]


def dictionary_of_map(name: str, folder: Path) -> str:
    """The dictionary of a map in ``folder``: a name, or a file beside the map; other paths are refused.

    Raises
    ------
    InputError
        Neither.
    """
    if name in _predefined() or Path(name).name in packaged():
        return Path(name).name
    if name != Path(name).name:
        raise InputError(f'{name} is not opened, as it is neither a name nor a file beside the map')
    return str(folder / name)


def copied_beside(name: str, folder: Path) -> Path | None:
    """Where in ``folder`` a map finds a copy of its dictionary file; None for a known name, or if it is that file."""
    copy = folder / Path(name).name
    return copy if is_own_file(name) and copy.resolve() != Path(name).resolve() else None


def bring_beside(name: str, folder: Path, *, anew: bool = False) -> None:
    """Copy a dictionary file into the ``folder`` of a map, which names it without a path; nothing for a known name.

    Raises
    ------
    InputError
        The file cannot be read or written, or another one has its place, unless the folder is made ``anew``.
    """
    copy = copied_beside(name, folder)
    if copy is None:
        return
    text = read_text(name)
    if not anew and is_there(copy) and read_text(copy) != text:
        raise InputError(f'{copy}: not the dictionary {name}, which a map in its folder would look for there')
    write_text(copy, text)


def bring_from_map(name: str, map_folder: Path, folder: Path, *, anew: bool = False) -> None:
    """Copy the dictionary file of a map in ``map_folder`` into the ``folder`` of one that is made from it.

    Nothing for a known name, or if the map has no such file beside it: it may be on the robot alone.

    Raises
    ------
    InputError
        As :func:`bring_beside`.
    """
    own = map_folder / name
    if is_own_file(name) and name == own.name and is_there(own):
        bring_beside(str(own), folder, anew=anew)


def save_dictionary(path: str | os.PathLike[str], name: str, dictionary: Dictionary, comment: str = '') -> None:
    """Write ``dictionary`` as a dictionary file below a ``comment``. Raises InputError if it cannot be written."""
    document = {
        'format': FORMAT,
        'version': 1,
        'name': name,
        'marker_size': dictionary.bits.shape[1],
        'max_correction_bits': dictionary.correctable,
        'markers': [[''.join(map(str, row)) for row in bits] for bits in dictionary.bits.tolist()],
    }
    head = f'# {comment}\n' if comment else ''
    write_text(path, head + yaml.safe_dump(document, sort_keys=False, width=120))


def _from_document(document: Value) -> Dictionary:
    fields = document.mapping() if isinstance(document.content, dict) else {}
    if 'format' not in fields or fields['format'].content != FORMAT:
        raise document.error(f'not of format {FORMAT}')
    if 'version' not in fields or fields['version'].content != '1':
        raise document.error('no version 1')
    for needed in ('marker_size', 'markers'):
        if needed not in fields:
            raise document.error(f'no {needed}')
    size = fields['marker_size'].integer(2, 10)
    correction = fields['max_correction_bits'].integer(0, size**2) if 'max_correction_bits' in fields else 0
    markers = fields['markers'].items()
    if not markers:
        raise fields['markers'].error('no markers')
    bits = np.stack([_bits(rows, size) for rows in markers])
    known: dict[bytes, int] = {}
    for index, (rows, marker) in enumerate(zip(markers, bits, strict=True)):
        look = min(np.rot90(marker, turn).tobytes() for turn in range(4))
        if look in known:
            raise rows.error(f'looks like marker {known[look]}, upright or turned: neither would be detected')
        known[look] = index
    # What a file claims beyond this would name wrong markers.
    return Dictionary(bits, min(correction, correctable_bits(bits)))


def _bits(rows: Value, size: int) -> Gray:
    words = [row.content if isinstance(row.content, str) else '' for row in rows.items()]
    if len(words) != size or any(len(word) != size or set(word) - {'0', '1'} for word in words):
        raise rows.error(f'not {size} strings of {size} bits')
    return np.array([[int(bit) for bit in word] for word in words], dtype=np.uint8)


def _unpacked(packed: Any, size: int) -> Gray:
    """Bits (M, size, size) from OpenCV's packed bytes (M, bytes, 4 rotations)."""
    table = np.asarray(packed, dtype=np.uint8)
    # Whatever the shape says, the memory holds the four rotations one after the other; the first is upright.
    upright = table.reshape(len(table), -1)[:, : table.shape[1]]
    unpacked = np.unpackbits(upright, axis=1)
    # The last byte holds the remaining bits right-aligned.
    padding = -(size * size) % 8
    bits = np.concatenate([unpacked[:, :-8], unpacked[:, -8 + padding :]], axis=1)
    return bits.reshape(-1, size, size)
