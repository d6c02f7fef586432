"""Drawings as they stand in the files, read back with other libraries than those that wrote them where possible."""

from pathlib import Path
import re
import shutil
import subprocess
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry import box, Point, Polygon
from shapely.ops import unary_union
from support.commands import status
from support.opencv import opencv_detector, opencv_dictionary
from support.waiting import PATIENCE_S

from thermal_fiducial.calibration.targets import CircleGrid
from thermal_fiducial.cli.main import main
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import circle_board
from thermal_fiducial.fabrication.drawing import Circle, Contour, Drawing
from thermal_fiducial.fabrication.paper import tiling
from thermal_fiducial.fabrication.plate import marker_drawing, pattern_origin, PlateOptions
from thermal_fiducial.fabrication.sheet import nest
from thermal_fiducial.fabrication.verification import agree, problems, read_dxf, sheet_of
from thermal_fiducial.fabrication.writers import write
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.marker_map import load_map

ezdxf = pytest.importorskip('ezdxf')
pypdfium2 = pytest.importorskip('pypdfium2')
svgpathtools = pytest.importorskip('svgpathtools')

BITS = load_dictionary('STENCIL_4X4_100').bits
# Geometry in a file is the pattern to this: DXF holds 16 digits, SVG 9 decimals.
TOLERANCE_MM = 1e-6
SVG, INKSCAPE = '{http://www.w3.org/2000/svg}', '{http://www.inkscape.org/namespaces/inkscape}'


def polygons_of(path):
    """All closed polylines of the layers PATTERN and OUTLINE as one shapely shape."""
    shape = Polygon()
    for entity in ezdxf.readfile(path).modelspace().query('LWPOLYLINE[layer!="ENGRAVE"]'):
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
    for marker_id, bits in enumerate(load_dictionary(dictionary).bits[:25]):
        drawing = marker_drawing(bits, str(marker_id), options)
        assert problems(drawing, 1) == []
        cell = options.size / (len(bits) + 2)
        middle = pattern_origin(options, len(bits) + 2) + cell * (np.argwhere(bits >= 0)[:, ::-1] + 1.5)
        middle[:, 1] = drawing.height - middle[:, 1]
        assert np.array_equal(shapely.contains_xy(sheet_of(drawing), middle), bits.reshape(-1) == 0)


def test_corner_radius_rounds_only_where_cracks_start():
    options = PlateOptions(size=90.0, mount='none', kerf=0.0, corner_radius=2.0)
    hole = np.zeros((1, 1), np.uint8) + 1
    drawing = marker_drawing(hole, '0', options)
    outer, inner = sorted(drawing.cuts, key=lambda one: -one.area)
    assert not outer.bulges.any()
    # A square hole of 30 mm without the four corners outside quarter circles of 2 mm.
    assert inner.area == pytest.approx(-(30.0**2 - (4.0 - np.pi) * 2.0**2), abs=1e-9)
    assert abs(Polygon(inner.flattened(2000)).area + inner.area) < 1e-5


def svg_of(path):
    """Root of an SVG, and its layers: label to the elements in them."""
    root = ElementTree.parse(path).getroot()
    groups = [group for group in root.iter(f'{SVG}g') if group.get(f'{INKSCAPE}groupmode') == 'layer']
    return root, {group.get(f'{INKSCAPE}label'): group for group in groups}


def svg_polygons(group):
    """Each path of a group (N, 2), arcs sampled, with another library than the one that wrote it."""
    paths = [svgpathtools.parse_path(element.get('d')) for element in group.iter(f'{SVG}path')]
    assert all(path.isclosed() for path in paths)
    ends = [np.array([segment.point(t) for segment in path for t in (0.0, 0.5)]) for path in paths]
    return [np.stack([points.real, points.imag], axis=1) for points in ends]


def test_svg_is_the_pattern(tmp_path):
    options = PlateOptions(size=120.0, mount='none', kerf=0.0, corner_radius=0.0)
    path = tmp_path / 'marker.svg'
    write(marker_drawing(BITS[7], '7', options), path)
    root, layers = svg_of(path)
    assert (root.get('width'), root.get('height'), root.get('viewBox')) == ('120mm', '120mm', '0 0 120 120')
    shape = Polygon()
    for points in svg_polygons(layers['PATTERN']) + svg_polygons(layers['OUTLINE']):
        shape = shape.symmetric_difference(Polygon(points * (1, -1) + (0, 120)))
    assert shape.symmetric_difference(pattern_of(BITS[7], 120.0, (0, 0))).area < TOLERANCE_MM


LAYERS = ['ENGRAVE', 'HOLES', 'PATTERN', 'OUTLINE']
DRAWINGS = {
    'ears': marker_drawing(BITS[5], '5', PlateOptions(size=120.0, kerf=0.4)),
    'frame': marker_drawing(BITS[5], '5', PlateOptions(size=120.0, kerf=0.4, mount='frame')),
    'circles': circle_board(4, 5, 25.0, 20.0, PlateOptions(kerf=0.4)),
    'sheet': nest(
        [marker_drawing(BITS[index], str(index), PlateOptions(size=100.0)) for index in range(2)],
        320.0,
        200.0,
        spacing=5.0,
        margin=10.0,
    )[0],
}


def code_holes(bits):
    """White cells that touch are one hole."""
    return cv2.connectedComponents(bits, connectivity=4)[0] - 1


# A frame has four parts of a ring besides.
HOLES_OF_A_PATTERN = {
    'ears': code_holes(BITS[5]),
    'frame': code_holes(BITS[5]) + 4,
    'circles': 20,
    'sheet': code_holes(BITS[0]) + code_holes(BITS[1]),
}


@pytest.mark.parametrize('kind', DRAWINGS)
def test_all_drawings_have_the_same_layers_and_the_outline_is_cut_last(tmp_path, kind):
    drawing = DRAWINGS[kind]
    write(drawing, tmp_path / 'it.svg')
    write(drawing, tmp_path / 'it.dxf')
    _, layers = svg_of(tmp_path / 'it.svg')
    assert list(layers) == LAYERS
    order = [entity.dxf.layer for entity in ezdxf.readfile(tmp_path / 'it.dxf').modelspace()]
    assert order == sorted(order, key=LAYERS.index)
    for layer in LAYERS:
        assert len(list(layers[layer])) == order.count(layer)
    assert order.count('PATTERN') == HOLES_OF_A_PATTERN[kind]
    assert order.count('OUTLINE') == drawing.parts


@pytest.mark.parametrize('kind', DRAWINGS)
def test_the_page_is_as_large_as_the_paths(tmp_path, kind):
    drawing = DRAWINGS[kind]
    path = tmp_path / 'it.svg'
    write(drawing, path)
    root, layers = svg_of(path)
    _, _, width, height = map(float, root.get('viewBox').split())
    assert (root.get('width'), root.get('height')) == (f'{width:g}mm', f'{height:g}mm')
    points = np.concatenate([points for layer in LAYERS for points in svg_polygons(layers[layer])])
    low, high = points.min(axis=0), points.max(axis=0)
    if kind == 'sheet':
        assert (width, height) == (320.0, 200.0)
        assert low.min() > 9.9
    else:
        assert np.allclose(low, 0.0, atol=TOLERANCE_MM)
        assert np.allclose(high, (width, height), atol=TOLERANCE_MM)
    assert np.all(high - (width, height) <= TOLERANCE_MM)


def test_svg_shows_in_a_browser(tmp_path):
    # 96 pixels an inch: a line of half a pixel is seen, one of 0.04 as it was is not.
    write(DRAWINGS['ears'], tmp_path / 'it.svg')
    _, layers = svg_of(tmp_path / 'it.svg')
    assert all(float(group.get('stroke-width')) * 96 / 25.4 > 0.5 for group in layers.values())
    if shutil.which('chromium') is None:
        pytest.skip('no browser')
    picture = tmp_path / 'it.png'
    options = '--headless', '--no-sandbox', '--disable-gpu', '--hide-scrollbars', '--window-size=700,700'
    subprocess.run(
        ['chromium', *options, f'--screenshot={picture}', str(tmp_path / 'it.svg')],
        capture_output=True,
        check=True,
        timeout=PATIENCE_S,
    )
    pixels = cv2.imread(str(picture)).astype(int)
    spread = pixels.max(axis=2) - pixels.min(axis=2)
    # A third of a saturated colour at least, on paths of 0.9 m at 3.8 pixels a millimetre.
    assert np.count_nonzero(spread > 85) > 3000


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


def pdf_pages(path, scale=3.0):
    """Sizes [mm] of a PDF's pages, and pictures of them of ``scale`` pixels a millimetre."""
    pages = list(pypdfium2.PdfDocument(path))
    sizes = [np.array(page.get_size()) * 25.4 / 72.0 for page in pages]
    return sizes, [page.render(scale=scale * 25.4 / 72.0).to_numpy()[..., :3] for page in pages]


def inked(picture):
    """Pixels (row, column) of any colour, black aside."""
    spread = picture.max(axis=2).astype(int) - picture.min(axis=2)
    return np.argwhere(spread > 15)


def test_pdf_has_true_size(tmp_path):
    path = tmp_path / 'marker.pdf'
    drawing = marker_drawing(BITS[3], '3', PlateOptions(size=200.0, mount='none', kerf=0.5))
    write(drawing, path)
    (size,), (picture,) = pdf_pages(path)
    assert size == pytest.approx((200.5, 200.5), abs=1e-3)
    # The paths fill the page to the pixel, of a third of a millimetre.
    lines = inked(picture)
    assert lines.min() <= 1
    assert lines.max() >= max(picture.shape[:2]) - 2
    write(drawing, tmp_path / 'again.pdf')
    assert path.read_bytes() == (tmp_path / 'again.pdf').read_bytes()


@pytest.mark.parametrize(('paper', 'sheet'), [('A4', (210.0, 297.0)), ('letter', (215.9, 279.4))])
def test_pdf_in_tiles_is_the_drawing_again(tmp_path, paper, sheet):
    drawing = marker_drawing(BITS[3], '3', PlateOptions(size=300.0))
    path = tmp_path / 'tiles.pdf'
    write(drawing, path, paper)
    write(drawing, tmp_path / 'whole.pdf')
    sizes, pictures = pdf_pages(path)
    tiles = tiling(drawing, paper)
    assert len(sizes) == tiles.columns * tiles.rows == 4
    assert all(sorted(size) == pytest.approx(sheet, abs=1e-3) for size in sizes)
    # Glue: each pixel with ink on a tile goes to its place in the drawing, and all of the drawing comes out.
    low, high = drawing.page
    _, (whole,) = pdf_pages(tmp_path / 'whole.pdf')
    glued = np.zeros((2, *whole.shape[:2]), bool)
    for index, picture in enumerate(pictures):
        row, column = divmod(index, tiles.columns)
        below = tiles.corner(column, row) - low
        rows, columns = inked(picture).T
        x = below[0] + (columns + 0.5) / 3.0 - 12.0
        y = high[1] - low[1] - below[1] - tiles.sheet[1] + 12.0 + (rows + 0.5) / 3.0
        place = np.rint(np.stack([y, x]) * 3.0 - 0.5).astype(int)
        glued[(0, *np.clip(place, 0, np.array(whole.shape[:2])[:, None] - 1))] = True
    glued[(1, *inked(whole).T)] = True
    # To a pixel, a third of a millimetre, in both directions.
    near = np.ones((3, 3), np.uint8)
    assert not np.any(glued[1] & (cv2.dilate(glued[0].astype(np.uint8), near) == 0))
    assert not np.any(glued[0] & (cv2.dilate(glued[1].astype(np.uint8), near) == 0))


def test_marks_of_neighbouring_tiles_lie_on_one_another():
    tiles = tiling(marker_drawing(BITS[3], '3', PlateOptions(size=300.0)), 'A4')
    right = tiles.corner(0, 0) + tiles.tile - 5.0
    assert right[0] == pytest.approx(tiles.corner(1, 0)[0] + 5.0)
    assert tiles.corner(0, 0)[1] + 5.0 == pytest.approx(tiles.corner(0, 1)[1] + tiles.tile[1] - 5.0)


def test_preview_is_detected_as_the_marker(tmp_path):
    dictionary = load_dictionary('STENCIL_4X4_100')
    path = tmp_path / 'marker.png'
    write(marker_drawing(BITS[21], '21', PlateOptions()), path)
    preview = cv2.copyMakeBorder(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), *[60] * 4, cv2.BORDER_CONSTANT, value=190)
    _, ids, _ = opencv_detector(opencv_dictionary(dictionary)).detectMarkers(preview)
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


def test_corners_that_reach_across_a_ring_are_refused():
    # A corner of radius r reaches 0.41 r towards the black square, whose corner is 1.41 times the ring away: 3.5 mm.
    with pytest.raises(InputError, match='corners of radius 10 mm reach across a gap'):
        marker_drawing(BITS[0], '0', PlateOptions(size=50.0, mount='frame', corner_radius=10.0, quiet_cells=0.3))
    sound = PlateOptions(size=50.0, mount='frame', corner_radius=8.0, quiet_cells=0.3)
    assert problems(marker_drawing(BITS[0], '0', sound), 1) == []


@pytest.mark.parametrize('grid', [(1, 11), (2, 2)])
def test_no_board_is_drawn_that_calibration_refuses(grid):
    with pytest.raises(InputError, match='2 x 3 circles or more'):
        CircleGrid(*grid, 0.025, 0.020)
    with pytest.raises(InputError, match='2 x 3 circles or more'):
        circle_board(*grid, 25.0, 20.0, PlateOptions())


def test_small_circles_of_a_board_keep_away_from_its_mounting_holes():
    for spacing, diameter in ((5.0, 6.0), (5.0, 5.0), (25.0, 20.0)):
        drawing = circle_board(4, 5, spacing, diameter, PlateOptions())
        webs = [
            np.hypot(hole.x - dot.x, hole.y - dot.y) - hole.radius - dot.radius
            for hole in drawing.holes
            for dot in drawing.dots
        ]
        # Three millimetres, as between the holes of a marker; of 6 mm, 5 mm apart in rows, holes and circles were one.
        assert min(webs) > 3.0


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
    document.modelspace().add_lwpolyline([(0, 0), (1, 0), (1, 1)], dxfattribs={'layer': 'OUTLINE'})
    document.saveas(tmp_path / 'open.dxf')
    with pytest.raises(InputError, match='open polyline'):
        read_dxf(tmp_path / 'open.dxf')


@pytest.mark.parametrize(
    'wrong',
    [
        ['make', '--ids', '200'],
        ['make', '--ids', 'x'],
        ['make', '--ids', '0-1,7-5'],
        ['make', '--formats', 'doc'],
        ['make', '--ids', '1', '--paper', 'B9'],
        ['make', '--size', '0'],
        ['make', '--dictionary', 'NONE'],
        ['make', '--dictionary', 'DICT_5X5_50', '--size', '20', '--bridge-width', '4'],
        ['make', '--mount', 'frame', '--frame-width', '5'],
        ['make', '--kerf', '60', '--size', '100'],
        ['sheet', '--sheet', '100', '100'],
        ['sheet', '--ids', '0-1', '--spacing', '0'],
        ['board', 'circles', '--diameter', '60'],
        ['board', 'markers', '--grid', '50', '50'],
        ['board', 'markers', '--grid', '1', '1'],
    ],
)
def test_unusable_input_is_one_line(wrong, tmp_path, capsys):
    assert main(['markers', *wrong, '--out', str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    # What the check of the drawing itself finds names no remedy.
    assert 'crossings' not in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    'command',
    [['make', '--ids', '2', '--size', '120'], ['sheet', '--ids', '2', '--size', '120'], ['board', 'circles']],
)
def test_files_that_exist_are_kept_unless_forced(tmp_path, capsys, command):
    arguments = ['markers', *command, '--formats', 'dxf', '--out', str(tmp_path)]
    assert main(arguments) == 0
    (made,) = tmp_path.iterdir()
    made.write_text('mine')
    assert main(arguments) == 2
    assert f'{made}: the file exists; --force overwrites it' in capsys.readouterr().err
    assert made.read_text() == 'mine'
    assert main([*arguments, '--force']) == 0
    assert made.read_text() != 'mine'


def test_nothing_is_written_where_one_file_exists(tmp_path):
    (tmp_path / 'marker-3.dxf').write_text('mine')
    assert main(['markers', 'make', '--ids', '2-3', '--formats', 'dxf', '--out', str(tmp_path)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ['marker-3.dxf']


def test_a_plate_without_mount_has_no_spacers(tmp_path, capsys):
    """It was said to have "0 spacers of 10 mm, holes of 4.3 mm"."""
    words = ['markers', 'make', '--ids', '0', '--formats', 'svg', '--out', str(tmp_path)]
    assert main([*words, '--mount', 'none']) == 0
    assert 'spacers' not in capsys.readouterr().out
    assert main([*words, '--force']) == 0
    assert '; 4 spacers of 10 mm, holes of 4.3 mm' in capsys.readouterr().out


def test_a_marker_that_is_named_twice_is_drawn_once(tmp_path, capsys):
    arguments = ['--ids', '2-3,3,2', '--size', '120', '--formats', 'svg', '--out', str(tmp_path)]
    assert main(['markers', 'make', *arguments]) == 0
    assert capsys.readouterr().out.count('marker-2:') == 1


def test_commands_write_the_files_that_they_print(tmp_path, capsys):
    assert main(['markers', 'make', '--ids', '2-3', '--size', '120', '--out', str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        f'marker-{marker}.{kind}' for marker in (2, 3) for kind in ('svg', 'dxf', 'pdf', 'png')
    )
    head, last = capsys.readouterr().out.splitlines()[-1].rsplit(': dictionary: ')
    assert head == 'parameters of the nodes for these markers'
    assert last == 'STENCIL_4X4_100, marker_size: 0.12, plate_thickness: 0.003'
    assert main(['markers', 'check', '--ids', '0-4']) == 0
    assert '5 of 5 markers can be cut' in capsys.readouterr().out
    assert main(['markers', 'bridge', '--dictionary', 'DICT_4X4_50', '--ids', '0']) == 0
    assert (
        main(['markers', 'board', 'markers', '--grid', '2', '1', '--formats', 'dxf', '--out', str(tmp_path / 'b')]) == 0
    )
    assert capsys.readouterr().out.rstrip().endswith('board.yaml --plate-thickness 0.003')
    assert (Path(tmp_path) / 'b' / 'base-plate.dxf').is_file()
    board = load_map(tmp_path / 'b' / 'board.yaml')
    # Two markers of 130 mm with 40 mm between them.
    assert [marker.T_map_marker[0, 3] for marker in board.markers.values()] == pytest.approx([-0.085, 0.085])
    assert board.markers[0].size == pytest.approx(0.13)


def test_sizes_in_metres_and_a_file_in_the_place_of_the_folder_are_named(tmp_path, capsys):
    assert main(['markers', 'make', '--ids', '1', '--size', '0.3', '--out', str(tmp_path / 'plates')]) == 2
    assert 'a marker of 0.3 mm: sizes are in millimetres' in capsys.readouterr().err
    # The nodes would take 3 micrometres for no thickness at all, and refuse 0.3 m.
    for thickness in ('0.003', '300'):
        assert main(['markers', 'make', '--ids', '1', '--thickness', thickness, '--out', str(tmp_path / 'plates')]) == 2
        assert f'a plate of {thickness} mm: thicknesses are in millimetres' in capsys.readouterr().err
    for size in ('30000', 'nan', 'inf', '-300'):
        assert status(['markers', 'bridge', '--ids', '1', f'--size={size}']) == 2
        assert f"argument --size: '{size}' is not a number from 0 to 10000 mm" in capsys.readouterr().err
    (tmp_path / 'file').write_text('')
    assert main(['markers', 'make', '--ids', '1', '--out', str(tmp_path / 'file')]) == 2
    assert f'{tmp_path}/file: is a file, not a folder' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('option', 'value', 'says'),
    [
        ('--kerf', 'nan', "argument --kerf: 'nan' is not a number from 0 to 10000 mm"),
        ('--stand-off', 'inf', "argument --stand-off: 'inf' is not"),
        ('--quiet-cells', '0', 'quiet cells of a plate: 0 is not more than 0'),
        ('--hole-diameter', '1e6', "argument --hole-diameter: '1e6' is not"),
        ('--tie-width', '301', 'tie width of a plate: 301 mm is more than its side, 300 mm'),
        ('--ids', '0-999999999999', 'STENCIL_4X4_100 has no marker 100: its IDs are 0 to 99'),
    ],
)
def test_lengths_that_no_plate_has_and_markers_that_no_dictionary_has_are_refused(
    tmp_path, capsys, option, value, says
):
    out = tmp_path / 'plates'
    options = {'--ids': '0', '--formats': 'svg', option: value}
    assert status(['markers', 'make', '--out', out, *(word for pair in options.items() for word in pair)]) == 2
    assert says in capsys.readouterr().err.splitlines()[-1]
    assert not out.exists()


def test_a_board_without_spacing_is_not_one_of_the_default(tmp_path, capsys):
    assert main(['markers', 'board', 'circles', '--spacing', '0', '--out', str(tmp_path / 'board')]) == 2
    assert 'a millimetre of acrylic between them' in capsys.readouterr().err
