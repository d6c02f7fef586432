import cv2
import numpy as np
import pytest

from thermal_fiducial.fabrication.bridges import darkest_white, find_bridges
from thermal_fiducial.fabrication.cuttability import examine
from thermal_fiducial.fabrication.shape import paint, Rectangle
from thermal_fiducial.files.dictionary import load_dictionary


def bits_of(*rows):
    return np.array([[int(bit) for bit in row] for row in rows], dtype=np.uint8)


def test_one_piece():
    found = examine(bits_of('0110', '0110', '0000', '1110'))
    assert (found.islands, found.point_contacts, found.longest_arm) == (0, 0, 2)
    assert found.cuttable


def test_island():
    found = examine(bits_of('1110', '1010', '1110', '0000'))
    assert (found.islands, found.point_contacts) == (1, 0)
    assert not found.cuttable


def test_holes_that_touch_at_a_point():
    found = examine(bits_of('1000', '0100', '0000', '0000'))
    assert (found.islands, found.point_contacts) == (0, 1)
    assert not found.cuttable


def test_arm():
    # The upper end of the acrylic inside the U is four cells away from the border below.
    assert examine(bits_of('11110', '10010', '10010', '10010', '00000')).longest_arm == 4


def test_standard_dictionary_needs_bridges():
    # Counted by hand from the drawings: in 7 of these 50 markers a cell falls out.
    bits = load_dictionary('DICT_4X4_50').bits
    found = [examine(marker) for marker in bits]
    assert sum(one.islands > 0 for one in found) == 7


@pytest.mark.parametrize('name', ['DICT_4X4_50', 'DICT_6X6_50', 'DICT_APRILTAG_36h11'])
def test_bridged_markers_are_one_piece_and_keep_their_bits(name):
    width = 0.2
    for marker in load_dictionary(name).bits[:60]:
        cells = len(marker) + 2
        bridges = find_bridges(marker)
        rectangles = [Rectangle(0, 0, cells, cells)]
        for row, column in np.argwhere(marker):
            x, y = column + 1, cells - 2 - row
            rectangles.append(Rectangle(x, y, x + 1, y + 1, acrylic=False))
        _, _, acrylic = paint(rectangles + bridges.rectangles(cells, 1.0, width))
        # Acrylic that hangs together by edges of the grid of rectangles is one piece, and no two holes meet at a point.
        assert cv2.connectedComponents(acrylic.astype(np.uint8), connectivity=4)[0] == 2
        assert cv2.connectedComponents(acrylic.astype(np.uint8), connectivity=8)[0] == 2
        # A web reaches 0.1 cell into a white cell; bits are read from 0.13 cell inwards.
        assert darkest_white(marker, bridges, 1.0, width) == 0.0
        assert darkest_white(marker, bridges, 1.0, 0.4) < 0.3


def test_web_goes_the_shortest_way():
    bridges = find_bridges(bits_of('11111', '11111', '11011', '11111', '11111'))
    assert bridges.patches == ()
    assert [len(web) - 1 for web in bridges.webs] == [2]


def test_cuttable_marker_has_no_bridges():
    bridges = find_bridges(bits_of('0110', '0110', '0000', '1110'))
    assert bridges.patches == ()
    assert bridges.webs == ()
