"""Drawings as they stand in the files, read back with other libraries than those that wrote them where possible."""

from pathlib import Path
import re

import cv2
import ezdxf
import numpy as np
import pytest
from shapely import affinity
from shapely.geometry import box, Point, Polygon
from shapely.ops import unary_union

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.detection.patterns import marker_bits
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import circle_board
from thermal_fiducial.fabrication.drawing import Circle, Contour, Drawing
from thermal_fiducial.fabrication.plate import marker_drawing, pattern_origin, PlateOptions
from thermal_fiducial.fabrication.sheet import nest
from thermal_fiducial.fabrication.verification import acrylic_at, agree, problems, read_dxf
from thermal_fiducial.fabrication.writers import write
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.marker_map import load_map

BITS = marker_bits(load_dictionary('STENCIL_4X4_100'))
# Geometry in a file is the pattern to this: DXF holds 16 digits, SVG 9 decimals.
TOLERANCE_MM = 1e-6


def polygons_of(path):
    """All closed polylines of layer CUT as one shapely shape."""
    shape = Polygon()
    for entity in ezdxf.readfile(path).modelspace().query('LWPOLYLINE[layer=="CUT"]'):
        assert entity.closed
        shape = shape.symmetric_difference(Polygon([(x, y) for x, y, *_ in entity.get_points()]))
    return shape


def pattern_of(bits, size, origin):
    """The black cells of a marker, one box a cell."""
    cells = np.pad(bits, 1)
    side = size / len(cells)
    squares = [
        box(column * side, (len(cells) - 1 - row) * side, (column + 1) * side, (len(cells) - row) * side)
        for row, column in np.argwhere(cells == 0)
    ]
    return affinity.translate(unary_union(squares), *origin)


@pytest.mark.parametrize('marker_id', [0, 13, 42, 99])
@pytest.mark.parametrize(('mount', 'kerf'), [('none', 0.0), ('none', 0.2), ('ears', 0.15), ('frame', 0.15)])
def test_dxf_is_the_pattern(tmp_path, marker_id, mount, kerf):
    options = PlateOptions(size=120.0, mount=mount, kerf=kerf, corner_radius=0.0)
    drawing = marker_drawing(BITS[marker_id], str(marker_id), options)
    path = tmp_path / 'marker.dxf'
    write(drawing, path)
    # What is left after the laser took half its kerf from both sides of the line.
    left = polygons_of(path).buffer(-0.5 * kerf, join_style='mitre')
    assert left.is_valid
    assert left.geom_type == 'Polygon'
    origin = pattern_origin(options, 6)
    expected = pattern_of(BITS[marker_id], 120.0, origin)
    within = left.intersection(box(*origin, *(origin + 120.0)))
    assert within.hausdorff_distance(expected) < TOLERANCE_MM
    assert within.symmetric_difference(expected).area < TOLERANCE_MM
    assert agree(read_dxf(path), drawing)


@pytest.mark.parametrize('mount', ['ears', 'frame', 'none'])
@pytest.mark.parametrize('dictionary', ['STENCIL_6X6_100', 'DICT_5X5_50', 'DICT_APRILTAG_36h11'])
def test_every_drawing_is_sound(dictionary, mount):
    options = PlateOptions(mount=mount)
    for marker_id, bits in enumerate(marker_bits(load_dictionary(dictionary))[:25]):
        drawing = marker_drawing(bits, str(marker_id), options)
        assert problems(drawing, 1) == []
        cell = options.size / (len(bits) + 2)
        middle = pattern_origin(options, len(bits) + 2) + cell * (np.argwhere(bits >= 0)[:, ::-1] + 1.5)
        middle[:, 1] = drawing.height - middle[:, 1]
        assert np.array_equal(acrylic_at(drawing, middle), bits.reshape(-1) == 0)


def test_corner_radius_rounds_only_where_cracks_start():
    options = PlateOptions(size=90.0, mount='none', kerf=0.0, corner_radius=2.0)
    hole = np.zeros((1, 1), np.uint8) + 1
    drawing = marker_drawing(hole, '0', options)
    outer, inner = sorted(drawing.cuts, key=lambda one: -one.area)
    assert not outer.bulges.any()
    # A square hole of 30 mm without the four corners outside quarter circles of 2 mm.
    assert inner.area == pytest.approx(-(30.0**2 - (4.0 - np.pi) * 2.0**2), abs=1e-9)
    assert abs(Polygon(inner.flattened(2000)).area + inner.area) < 1e-5


def svg_paths(text, layer):
    group = re.search(rf'<g id="{layer}".*?</g>', text, re.DOTALL).group()
    return [
        np.array([[float(x), float(y)] for x, y in re.findall(r'[ML]([-\d.]+) ([-\d.]+)', path)])
        for path in re.findall(r'<path d="([^"]+) Z"/>', group)
    ]


def test_svg_is_the_pattern(tmp_path):
    options = PlateOptions(size=120.0, mount='none', kerf=0.0, corner_radius=0.0)
    path = tmp_path / 'marker.svg'
    write(marker_drawing(BITS[7], '7', options), path)
    text = path.read_text()
    assert 'width="120mm" height="120mm" viewBox="0 0 120 120"' in text
    shape = Polygon()
    for points in svg_paths(text, 'CUT'):
        assert np.array_equal(points[0], points[-1])
        shape = shape.symmetric_difference(Polygon(points * (1, -1) + (0, 120)))
    assert shape.symmetric_difference(pattern_of(BITS[7], 120.0, (0, 0))).area < TOLERANCE_MM


def test_svg_arcs_bend_to_the_right_side(tmp_path):
    options = PlateOptions(size=90.0, mount='none', kerf=0.0, corner_radius=2.0)
    write(marker_drawing(np.ones((1, 1), np.uint8), '0', options), tmp_path / 'marker.svg')
    text = (tmp_path / 'marker.svg').read_text()
    arcs = re.findall(r'([\d.]+) ([\d.]+) A2 2 0 0 (\d) ([\d.]+) ([\d.]+)', text)
    assert len(arcs) == 4
    for x0, y0, sweep, x1, y1 in arcs:
        start, end = np.array([float(x0), float(y0)]), np.array([float(x1), float(y1)])
        # Seen with y down, sweep 1 bulges to the left of the chord: away from the centre of the hole.
        along = end - start
        left = np.array([along[1], -along[0]])
        away = 0.5 * (start + end) - (45.0, 45.0)
        assert (left @ away > 0) == (sweep == '1')


def test_pdf_has_true_size(tmp_path):
    path = tmp_path / 'marker.pdf'
    write(marker_drawing(BITS[3], '3', PlateOptions(size=200.0, mount='none')), path)
    page = re.search(rb'/MediaBox \[ *([\d. ]+)\]', path.read_bytes())
    _, _, width, height = map(float, page.group(1).split())
    # Points of 1/72 inch; the page is rounded to whole points or finer.
    assert (width * 25.4 / 72, height * 25.4 / 72) == pytest.approx((200.0, 200.0), abs=0.2)


def test_preview_is_detected_as_the_marker(tmp_path):
    dictionary = load_dictionary('STENCIL_4X4_100')
    path = tmp_path / 'marker.png'
    write(marker_drawing(BITS[21], '21', PlateOptions()), path)
    preview = cv2.copyMakeBorder(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), *[60] * 4, cv2.BORDER_CONSTANT, value=190)
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(preview)
    assert ids is not None
    assert ids.ravel().tolist() == [21]


def test_sheet_holds_every_marker_apart():
    drawings = [marker_drawing(bits, str(index), PlateOptions(size=100.0)) for index, bits in enumerate(BITS[:14])]
    sheets = nest(drawings, 500.0, 400.0, spacing=5.0, margin=10.0)
    assert sum(sheet.parts for sheet in sheets) == 14
    for sheet in sheets:
        assert problems(sheet, sheet.parts) == []
        points = np.concatenate([contour.points for contour in sheet.cuts])
        # Half a kerf lies outside the acrylic.
        assert points.min() >= 10.0 - 0.075 - TOLERANCE_MM
        assert np.all(points.max(axis=0) <= (490.0 + 0.08, 390.0 + 0.08))
        outer = [Polygon(contour.points) for contour in sheet.cuts if contour.area > 0]
        for index, one in enumerate(outer):
            assert all(one.distance(other) >= 5.0 - 0.15 - TOLERANCE_MM for other in outer[index + 1 :])


def test_too_large_for_the_sheet():
    with pytest.raises(InputError, match='does not fit'):
        nest([marker_drawing(BITS[0], '0', PlateOptions())], 200.0, 200.0, spacing=5.0, margin=5.0)


def test_circle_board_reads_as_a_grid(tmp_path):
    drawing = circle_board(4, 11, 25.0, 20.0, PlateOptions())
    assert problems(drawing, 1) == []
    path = tmp_path / 'board.png'
    write(drawing, path)
    preview = 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    found, centres = cv2.findCirclesGrid(preview, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    assert len(centres) == 44


def square(x, y, side, *, hole=False):
    points = np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]], dtype=float)
    return Contour(points[::-1] if hole else points, np.zeros(4))


@pytest.mark.parametrize(
    ('cuts', 'holes', 'complaint'),
    [
        ((square(0, 0, 10), square(5, 5, 10)), (), 'crossings'),
        ((square(0, 0, 10), square(20, 0, 10)), (), '2 pieces'),
        ((square(0, 0, 10), square(20, 0, 10, hole=True)), (), 'nested'),
        ((square(0, 0, 10),), (Circle(9.5, 5.0, 1.0),), 'leaves the acrylic'),
        ((square(0, 0, 10), square(0, 0, 10, hole=True)), (), 'crossings'),
    ],
)
def test_unsound_drawings_are_found_out(cuts, holes, complaint):
    assert any(complaint in problem for problem in problems(Drawing('bad', 30.0, 15.0, cuts, holes), 1))


def test_shapely_agrees_about_round_holes():
    drawing = marker_drawing(BITS[5], '5', PlateOptions())
    outer = Polygon(max(drawing.cuts, key=lambda one: one.area).flattened())
    assert len(drawing.holes) == 4
    assert all(outer.contains(Point(hole.x, hole.y).buffer(hole.radius + 2.9)) for hole in drawing.holes)


def test_open_polyline_is_refused(tmp_path):
    document = ezdxf.new(units=ezdxf.units.MM)
    document.modelspace().add_lwpolyline([(0, 0), (1, 0), (1, 1)], dxfattribs={'layer': 'CUT'})
    document.saveas(tmp_path / 'open.dxf')
    with pytest.raises(InputError, match='open polyline'):
        read_dxf(tmp_path / 'open.dxf')


@pytest.mark.parametrize(
    'wrong',
    [
        ['make', '--ids', '200'],
        ['make', '--ids', 'x'],
        ['make', '--formats', 'doc'],
        ['make', '--size', '-1'],
        ['make', '--dictionary', 'NONE'],
        ['make', '--dictionary', 'DICT_5X5_50', '--size', '20', '--bridge-width', '4'],
        ['make', '--mount', 'frame', '--frame-width', '5'],
        ['make', '--kerf', '60', '--size', '100'],
        ['sheet', '--sheet', '100', '100'],
        ['board', 'circles', '--diameter', '60'],
        ['board', 'markers', '--grid', '50', '50'],
    ],
)
def test_unusable_input_is_one_line(wrong, tmp_path, capsys):
    assert main(['markers', *wrong, '--out', str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_commands_write_what_they_say(tmp_path, capsys):
    assert main(['markers', 'make', '--ids', '2-3', '--size', '120', '--out', str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        f'marker-{marker}.{kind}' for marker in (2, 3) for kind in ('svg', 'dxf', 'pdf', 'png')
    )
    assert main(['markers', 'check', '--ids', '0-4']) == 0
    assert '5 of 5 markers can be cut' in capsys.readouterr().out
    assert main(['markers', 'bridge', '--dictionary', 'DICT_4X4_50', '--ids', '0']) == 0
    assert (
        main(['markers', 'board', 'markers', '--grid', '2', '1', '--formats', 'dxf', '--out', str(tmp_path / 'b')]) == 0
    )
    assert (Path(tmp_path) / 'b' / 'base-plate.dxf').is_file()
    board = load_map(tmp_path / 'b' / 'board.yaml')
    # Two markers of 80 mm with 40 mm between them.
    assert [marker.T_map_marker[0, 3] for marker in board.markers.values()] == pytest.approx([-0.06, 0.06])
    assert board.markers[0].size == pytest.approx(0.08)
