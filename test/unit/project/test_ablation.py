"""The studies of what each mechanism buys name what the code has."""

from importlib import import_module

import pytest
from support.taken_out import lines_of, replaced

PACKAGES = {'ablation': 'detection', 'mapper_ablation': 'mapping', 'filter_ablation': 'filter'}


@pytest.mark.parametrize('study', PACKAGES)
def test_every_mechanism_is_there_to_be_taken_out(study):
    mechanisms = import_module(study).MECHANISMS
    for mechanism in mechanisms.values():
        package = f'thermal_fiducial.core.{PACKAGES[study]}'
        # Both raise where what they name is gone.
        lines = lines_of(package, mechanism.parts)
        with replaced(package, mechanism.off):
            assert (lines > 0) == bool(mechanism.parts)
