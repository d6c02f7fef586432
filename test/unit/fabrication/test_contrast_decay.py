import numpy as np
import pytest

from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.contrast_decay import Mounting, remaining_contrast

SECONDS = [30.0, 60.0, 120.0, 300.0, 1e6]


@pytest.mark.parametrize(
    ('gap', 'expected'),
    [
        (0.0, [0.55, 0.29, 0.16, 0.14, 0.14]),
        (0.0005, [0.87, 0.70, 0.49, 0.28, 0.25]),
        (0.002, [0.95, 0.87, 0.75, 0.54, 0.41]),
        (0.010, [0.98, 0.94, 0.87, 0.74, 0.58]),
    ],
)
def test_agrees_with_an_independent_slab_model(gap, expected):
    # Computed once with another program (finite differences in time, h = 10 W/m^2/K), given to two digits; the two
    # assume slightly different radiation across the gap.
    assert remaining_contrast(Mounting(0.003, gap, 10.0), SECONDS) == pytest.approx(np.array(expected), abs=0.016)


def test_steady_state_is_a_chain_of_resistances():
    mounting = Mounting(0.005, 0.004, 15.0)
    resistances = np.array([1.0 / mounting.gap_conductance, 0.005 / 0.19, 1.0 / 15.0])
    expected = 1.0 - resistances[2] / resistances.sum()
    assert remaining_contrast(mounting, 1e7) == pytest.approx(expected, abs=1e-9)


def test_contrast_falls_and_thicker_acrylic_keeps_it_longer():
    seconds = np.linspace(0.0, 600.0, 61)
    thin, thick = (remaining_contrast(Mounting(thickness, 0.01), seconds) for thickness in (0.002, 0.006))
    assert thin[0] == pytest.approx(1.0, abs=1e-9)
    assert np.all(np.diff(thin) < 0.0)
    assert np.all(thick[1:] > thin[1:])


@pytest.mark.parametrize('arguments', [(0.0, 0.01), (0.003, -0.01), (0.003, 0.01, 0.0)])
def test_impossible_mountings(arguments):
    with pytest.raises(InputError):
        Mounting(*arguments)
