"""Seconds become nanoseconds by one constant."""

from pathlib import Path
import re

import thermal_fiducial

_BY_HAND = re.compile(r'1_000_000_000|\* ?1e9\b|\b1e9 ?[*/]|10 ?\*\* ?9')
PACKAGE = Path(thermal_fiducial.__file__).parent


def test_nanoseconds_of_a_second_are_one_constant():
    again = [
        f'{path.relative_to(PACKAGE)}: {line.strip()}'
        for path in PACKAGE.rglob('*.py')
        if path.relative_to(PACKAGE).parts[0] not in ('core', 'calibration')
        for line in path.read_text(encoding='utf-8').splitlines()
        if _BY_HAND.search(line)
    ]
    assert again == []
