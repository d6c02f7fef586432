"""Narrowest webs and necks of plates, against figures that one works out by hand."""

import numpy as np
import pytest

from thermal_fiducial.cli.main import main
from thermal_fiducial.fabrication.boards import circle_board
from thermal_fiducial.fabrication.plate import marker_drawing, PlateOptions
from thermal_fiducial.fabrication.strength import acrylic_of, narrowest_web, neck_stress, RESOLUTION_MM, strength_of
from thermal_fiducial.files.dictionary import load_dictionary

BITS = load_dictionary('STENCIL_4X4_100').bits
# Webs are found to twice the resolution of the search; arcs of eight chords are 0.005 mm off.
TOLERANCE_MM = 2.0 * RESOLUTION_MM + 0.005


def web_of(**options):
    plate = PlateOptions(**options)
    strength = strength_of(marker_drawing(BITS[5], '5', plate), plate, 6, 3.0)
    return strength.web_mm, strength.kind


@pytest.mark.parametrize(
    ('options', 'width', 'kind'),
    [
        # A cell of 50 mm; a wall of 3 mm round a hole; necks and ties as asked for.
        ({'mount': 'none', 'kerf': 0.0}, 50.0, 'pattern'),
        ({}, 3.0, 'hole wall'),
        ({'kerf': 0.6}, 3.0, 'hole wall'),
        ({'tie_width': 2.0}, 2.0, 'neck'),
        ({'mount': 'frame', 'tie_width': 3.2}, 3.2, 'tie or frame'),
        ({'mount': 'none', 'size': 15.0, 'corner_radius': 0.1}, 2.5, 'pattern'),
    ],
)
def test_narrowest_web_of_a_plate(options, width, kind):
    found, name = web_of(**options)
    assert found == pytest.approx(width, abs=TOLERANCE_MM)
    assert name == kind


def test_webs_between_round_holes():
    # Dots of 20 mm, 25 mm * sqrt(2) apart.
    plate = PlateOptions(kerf=0.2)
    web = narrowest_web(acrylic_of(circle_board(4, 5, 25.0, 20.0, plate), plate.kerf))
    # A dot's chords lie within 0.05 mm of it.
    assert web.width == pytest.approx(min(25.0 * np.sqrt(2.0) - 20.0, 1.5 * 4.3 - 2.15), abs=0.1)


def test_a_patch_between_cells_that_touch_is_measured_across():
    bits = np.array([[1, 0], [0, 1]], np.uint8)
    plate = PlateOptions(size=100.0, mount='none', kerf=0.0, corner_radius=0.0, bridge_width=4.0)
    web = narrowest_web(acrylic_of(marker_drawing(bits, '0', plate), 0.0))
    # A square of 4 mm on the point where two holes would meet: half its diagonal stays between them.
    assert web.width == pytest.approx(4.0 / np.sqrt(2.0), abs=TOLERANCE_MM)
    assert np.allclose(web.place, 50.0, atol=2.5)


def test_stress_of_necks_is_that_of_a_beam():
    options = PlateOptions(size=300.0, thickness=3.0, tie_width=4.0)
    shape = acrylic_of(marker_drawing(np.zeros((4, 4), np.uint8), '0', options), options.kerf)
    # A sheet of 300 x 300 x 3 mm and 1190 kg/m^3 weighs 3.15 N. Three times that on two necks, 17.15 mm long each.
    weight = 0.3 * 0.3 * 0.003 * 1190.0 * 9.81
    moment = 1.5 * weight * (0.04 * 300.0 + 0.5 * (4.3 + 6.0))
    assert neck_stress(shape, options, 6) == pytest.approx(moment / (4.0 * 3.0**2 / 6.0), rel=0.001)


@pytest.mark.parametrize(
    ('options', 'said'),
    [
        ({'size': 600.0}, 'too heavy for its necks'),
        ({'size': 80.0}, 'too small for its ears'),
        ({'tie_width': 2.0}, 'its narrowest web is 2.0 mm wide'),
    ],
)
def test_what_speaks_against_a_plate(options, said, tmp_path, capsys):
    arguments = [part for name, value in options.items() for part in (f'--{name.replace("_", "-")}', str(value))]
    assert main(['markers', 'make', '--ids', '5', '--formats', 'svg', '--out', str(tmp_path), *arguments]) == 0
    output = capsys.readouterr()
    assert f'marker 5: {said}' in output.err
    assert 'narrowest web' in output.out
    assert main(['markers', 'check', '--ids', '5', *arguments]) == 0
    printed = capsys.readouterr().out
    assert f'1 of 1 marker: {said}' in printed
    assert '0 of 1 marker can be cut' in printed


def test_the_plate_of_the_defaults_is_fine(tmp_path, capsys):
    assert main(['markers', 'make', '--ids', '3', '--formats', 'svg', '--out', str(tmp_path)]) == 0
    output = capsys.readouterr()
    assert output.err == ''
    assert 'marker 3: narrowest web 3.0 mm (hole wall)' in output.out


def test_a_warm_ring_that_is_too_narrow_is_named(tmp_path, capsys):
    command = ['markers', 'make', '--ids', '3', '--formats', 'svg', '--force', '--out', str(tmp_path), '--quiet-cells']
    assert main([*command, '0.7']) == 0
    assert 'warning: a warm ring of 0.7 cells is too narrow' in capsys.readouterr().err
    assert main([*command, '1']) == 0
    assert capsys.readouterr().err == ''


def test_a_neck_of_the_width_in_the_warning_is_strong_enough():
    heavy = PlateOptions(size=600.0)
    complaint = strength_of(marker_drawing(BITS[5], '5', heavy), heavy, 6, 3.0).complaints[0]
    width = float(complaint.split('--tie-width ')[1].split()[0])
    wider = PlateOptions(size=600.0, tie_width=width)
    assert strength_of(marker_drawing(BITS[5], '5', wider), wider, 6, 3.0).complaints == []
