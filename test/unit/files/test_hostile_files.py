"""Files that are meant to hurt: each is refused in one line, within a second of processor time and 200 MB.

All are read in one process of bounded memory, so that none can take more unnoticed.
"""

import gc
import os
from pathlib import Path
import resource
import subprocess
import sys
import time

import pytest
from support.empty_picture import png

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bad_pixel_list import load_bad_pixels
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.files.csv_rows import csv_rows, named_rows
from thermal_fiducial.files.dictionary import load_dictionary
from thermal_fiducial.files.map_history import save_with_history
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.point_cloud import load_alignment, load_cloud
from thermal_fiducial.files.rig_files import densities, of_camchain, of_rig
from thermal_fiducial.files.trajectory_file import load_tum

YAML_LOADERS = (load_map, load_camera, load_dictionary, load_alignment)
TEXT_LOADERS = (*YAML_LOADERS, load_bad_pixels, load_tum)
#: What is left of a second on a machine whose processor is shared; measuring coverage costs as much again.
SECONDS = 1.0 if sys.gettrace() is None else 2.0
#: What they may take beyond what the libraries have taken.
BYTES = 200 << 20

MAP = (
    'format: thermal_fiducial/marker_map\nversion: 1\nrevision: 1\nmarkers:\n'
    '  - {id: 2, size: 0.3, fixed: true, position: [1, 2, 3], orientation: [0, 0, 0, 1]}\n'
)
BOMB = 'a: &a [x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{chr(98 + k)}: &{chr(98 + k)} [{", ".join(["*" + chr(97 + k)] * 9)}]\n' for k in range(9)
)
YAML_TEXTS = {
    'nothing': '',
    'nested 3000 deep': '[' * 3000,
    'nested 100000 deep': 'format: ' + '[' * 100_000,
    'mappings 100000 deep': '{a: ' * 100_000,
    'dashes 20000 deep': '- ' * 20_000,
    'aliases that expand to gigabytes': BOMB,
    'an alias of itself': 'a: &a [*a]',
    'NUL': 'format: thermal\0fiducial',
    'an object': '!!python/object/apply:os.system ["true"]',
    'two documents': MAP + '---\n' + MAP,
    'millions of values': 'format: [' + '1,' * 2_500_000 + ']',
    'a long word': 'format: ' + 'x' * 5_000_000,
    'a long key': 'x' * 5_000_000 + ': 1',
}
VALUES = ('2024-02-31', '2024-13-45T99:99:99', '!!int abc', '!!float {}', '9' * 5000, str(2**70), '-1', '1e400', '.inf')
VALUES += ('.nan', 'null', '[]', '{}', '"\\0"', '0x10', '1:30:00', 'yes please', '!!binary aGk=')


def refused(load, path):
    """The line with which a file is refused; checks what it took."""
    before = time.process_time()
    with pytest.raises(InputError) as caught:
        load(path)
    assert time.process_time() - before < SECONDS
    line = str(caught.value)
    assert line.isprintable()
    assert len(line) < 500
    return line


@pytest.fixture(autouse=True)
def bounded_memory():
    """What a loader takes beyond the limit is a MemoryError, which is no InputError."""
    used = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, hard))
    # What tests before have left is not collected in the time of a loader.
    gc.freeze()
    yield
    gc.unfreeze()
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.mark.parametrize('load', TEXT_LOADERS)
@pytest.mark.parametrize('name', YAML_TEXTS)
def test_texts_that_are_no_document_of_ours(tmp_path, load, name):
    path = tmp_path / 'file.yaml'
    path.write_text(YAML_TEXTS[name])
    if (load, name) == (load_bad_pixels, 'nothing'):
        assert load(path).shape == (0, 2)
        return
    assert str(path) in refused(load, path)


@pytest.mark.parametrize('load', TEXT_LOADERS)
def test_files_that_are_none(tmp_path, load):
    os.mkfifo(tmp_path / 'pipe')
    with (tmp_path / 'sparse').open('wb') as file:
        file.truncate(1 << 34)
    (tmp_path / 'binary').write_bytes(b'\xff\xfe\x00\x81')
    for path in (
        Path('/dev/zero'),
        tmp_path,
        tmp_path / 'missing',
        tmp_path / 'binary',
        tmp_path / 'pipe',
        tmp_path / 'sparse',
        Path('a\0b'),
        tmp_path / ('x' * 300),
        Path('/' + 5000 * '['),
    ):
        refused(load, path)


@pytest.mark.parametrize('value', VALUES)
def test_values_of_a_map(tmp_path, value):
    """Each in the place of each value; where one is a value there, the map loads."""
    path = tmp_path / 'map.yaml'
    accepted = []
    for field, good in (
        ('version', 'version: 1'), ('revision', 'revision: 1'), ('markers', '  - {id: 2'), ('id', 'id: 2'),
        ('size', 'size: 0.3'), ('fixed', 'fixed: true'), ('position', '[1, 2, 3]'), ('x', '[1,'),
        ('orientation', '[0, 0, 0, 1]'),
    ):  # fmt: skip
        bad = {'markers': f'  - {value}\n  - {{id: 2', 'position': value, 'orientation': value, 'x': f'[{value},'}
        path.write_text(MAP.replace(good, bad.get(field, f'{field}: {value}')))
        try:
            load_map(path, 0.3)
            accepted.append(field)
        except InputError:
            refused(lambda file: load_map(file, 0.3), path)
    # Nothing at all leaves a field out that may be left out; -1 is a coordinate.
    assert accepted == {'null': ['version', 'revision', 'size', 'fixed'], '-1': ['x']}.get(value, [])


@pytest.mark.parametrize('stamp', ['1e30', '-1e30', '1e999999', 'nan', '9' * 5000, '1e-999999999'])
def test_stamps_of_a_trajectory(tmp_path, stamp):
    path = tmp_path / 'truth.tum'
    path.write_text(f'{stamp} 0 0 0 0 0 0 1\n')
    if stamp == '1e-999999999':
        assert load_tum(path)[0].tolist() == [0]
    else:
        assert 'line 1' in refused(load_tum, path)
    path.write_text('1 0 0 1e300 0 0 0 1\n')
    refused(load_tum, path)


@pytest.mark.parametrize('line', ['1e3 4', f'{2**70} 4', '9' * 5000 + ' 4', '٣ 4', 'nan 4'])
def test_lists_of_bad_pixels(tmp_path, line):
    path = tmp_path / 'bad.txt'
    path.write_text(line)
    assert 'line 1' in refused(load_bad_pixels, path)


PLY = 'ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nend_header\n'
PCD = 'VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n'


@pytest.mark.parametrize('count', [10**6, 10**12, 10**18, 10**30])
def test_clouds_that_promise_more_than_they_hold(tmp_path, count):
    contents = {'a.ply': PLY.format(count)} | {
        f'{kind}.pcd': PCD.format(count, kind) for kind in ('ascii', 'binary', 'binary_compressed')
    }
    for name, head in contents.items():
        (tmp_path / name).write_bytes(head.encode() + 100 * b'\0')
        assert 'promises' in refused(load_cloud, tmp_path / name)


@pytest.mark.parametrize('count', [10**4, 10**9, 10**18])
@pytest.mark.parametrize('kind', ['ascii', 'binary', 'binary_compressed'])
def test_clouds_that_promise_points_of_more_values_than_any_sensor_has(tmp_path, count, kind):
    """The library behind makes a name for each of them."""
    head = PCD.format(1, kind).replace('COUNT 1 1 1', f'COUNT 1 {count} 1')
    (tmp_path / 'a.pcd').write_bytes(head.encode() + 100 * b'\0')
    assert 'promises points of more than 1000 values' in refused(load_cloud, tmp_path / 'a.pcd')


def test_a_cloud_without_a_header(tmp_path):
    (tmp_path / 'a.ply').write_bytes(os.urandom(100_000))
    assert 'no header' in refused(load_cloud, tmp_path / 'a.ply')


@pytest.mark.parametrize('size', [(65_000, 65_000), (30_000, 30_000), (2**31 - 1, 1), (0, 0)])
def test_pictures_that_promise_more_than_any_camera(tmp_path, size):
    """In a process of its own: OpenCV reads its limit when it is loaded, which another test may have done before."""
    path = tmp_path / 'photo.png'
    path.write_bytes(png(*size))
    program = (
        'import resource, sys, time\nimport thermal_fiducial, cv2\nfrom thermal_fiducial.errors import InputError\n'
        'from thermal_fiducial.files.images import read_picture\n'
        'before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()\n'
        'try:\n    read_picture(sys.argv[1], cv2.IMREAD_UNCHANGED)\n'
        'except InputError as error:\n    print(error)\n'
        'print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, time.process_time() - start)\n'
    )
    done = subprocess.run([sys.executable, '-c', program, str(path)], capture_output=True, text=True, check=True)
    line, figures = done.stdout.splitlines()
    kilobytes, seconds = map(float, figures.split())
    assert f'{path}: not a readable picture' in line
    assert kilobytes < BYTES / 1024
    assert seconds < SECONDS


def _sparse(path):
    with path.open('wb') as file:
        file.truncate(400 << 20)


#: What may stand where a table or a bag is looked for; all of it is refused without being read to its end.
NO_TABLES = {
    'a pipe': os.mkfifo,
    'a device': lambda path: path.symlink_to('/dev/zero'),
    'a link to itself': lambda path: path.symlink_to(path),
    'nothing but holes': _sparse,
    'blank lines': lambda path: path.write_bytes(b'\n' * 1_000_000),
    'one long line': lambda path: path.write_bytes(b'1' * 1_000_000),
    'a quotation mark that is never closed': lambda path: path.write_text('"' + '1\n' * 200_000),
    'no text': lambda path: path.write_bytes(b'\xff\xfe1,2\n'),
}
TABLES = {
    'trajectory': load_tum,
    'table': lambda path: list(csv_rows(path)),
    'named columns': lambda path: list(named_rows(path, ('stamp_ns', 'id'))),
}


@pytest.mark.parametrize('kind', NO_TABLES)
@pytest.mark.parametrize('table', TABLES)
def test_tables_that_are_none(tmp_path, table, kind):
    path = tmp_path / 'table.csv'
    NO_TABLES[kind](path)
    if (table, kind) == ('table', 'a quotation mark that is never closed'):
        # It ends with its line.
        assert [cells for _, cells in csv_rows(path)][:2] == [['1'], ['1']]
        return
    assert str(path) in refused(TABLES[table], path)


def test_tables_of_a_spreadsheet(tmp_path):
    """They begin with a byte order mark, and lines end with both characters."""
    path = tmp_path / 'table.csv'
    path.write_bytes('\ufeffstamp_ns,id\r\n1,2\r\n'.encode())
    assert list(named_rows(path, ('stamp_ns', 'id'))) == [(2, ['1', '2'])]
    assert list(csv_rows(path)) == [(1, ['stamp_ns', 'id']), (2, ['1', '2'])]
    path.write_bytes('\ufeff1.5 1 2 3 0 0 0 1\r\n'.encode())
    assert load_tum(path)[0].tolist() == [1_500_000_000]


@pytest.mark.parametrize('kind', ['a pipe', 'a device', 'nothing but holes'])
@pytest.mark.parametrize('suffix', ['.mcap', '.db3', '.bag'])
@pytest.mark.parametrize('in_folder', [False, True])
def test_files_that_are_no_bags(tmp_path, suffix, kind, in_folder):
    path = tmp_path / f'file{suffix}'
    NO_TABLES[kind](path)
    if in_folder:
        (tmp_path / 'metadata.yaml').write_text('rosbag2_bagfile_information: {version: 9}\n')

    def opened(bag):
        with BagReader(bag):
            pass

    refused(opened, tmp_path if in_folder else path)


def _untouched(path):
    """All of what stands at a path but the time of the last look: following a link counts as one."""
    status = path.lstat()
    return status.st_mode, status.st_ino, status.st_size, status.st_mtime_ns


@pytest.mark.parametrize('kind', ['a pipe', 'a device', 'a link to itself', 'nothing but holes'])
def test_a_map_does_not_overwrite_another_kind_of_file(tmp_path, kind):
    good, out = tmp_path / 'map.yaml', tmp_path / 'out.yaml'
    good.write_text(MAP)
    NO_TABLES[kind](out)
    before = _untouched(out)
    refused(lambda path: save_with_history(path, load_map(good), 'test'), out)
    assert _untouched(out) == before
    assert Path('/dev/zero').is_char_device()


RIG = {
    'width': '640', 'height': '512', 'model': 'plumb_bob', 'K': '[500, 0, 320, 0, 500, 256, 0, 0, 1]',
    'D': '[0, 0, 0, 0]', 'camera_position': '[0.1, 0, 0]', 'time_offset': '0.01',
    'camera_orientation': '[-0.5, 0.5, -0.5, 0.5]',
}  # fmt: skip
CHAIN = {
    'camera_model': 'pinhole', 'intrinsics': '[500, 500, 320, 256]', 'distortion_model': 'radtan',
    'distortion_coeffs': '[0, 0, 0, 0]', 'resolution': '[640, 512]', 'timeshift_cam_imu': '0.01',
    'T_cam_imu': '[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]',
}  # fmt: skip
IMU = {'gyroscope_noise_density': '1.0e-3', 'accelerometer_random_walk': '1.0e-3'}
RIG_FILES = {
    'rig': ('cameras: {cam0: {%s}}\n', RIG, lambda path: of_rig(path, 'cam0')),
    'camchain': ('cam0: {%s}\n', CHAIN, lambda path: of_camchain(path, 'cam0', {})),
    'noise': ('imu0: {%s}\n', IMU, densities),
}


@pytest.mark.parametrize('name', RIG_FILES)
@pytest.mark.parametrize('value', [*VALUES, '1e300', '[.nan]', '[[1]]', '{a: 1}', 'true', '1' * 400])
def test_values_of_a_rig(tmp_path, name, value):
    """Each in the place of each field, and of the camera or IMU as a whole."""
    form, fields, read = RIG_FILES[name]
    path = tmp_path / f'{name}.yaml'
    path.write_text(form % ', '.join(f'{field}: {text}' for field, text in fields.items()))
    read(path)
    optional = {
        'model',
        'D',
        'time_offset',
        'camera_model',
        'distortion_model',
        'distortion_coeffs',
        'timeshift_cam_imu',
    }
    possible = {
        'null': optional | set(IMU),
        '-1': {'time_offset', 'timeshift_cam_imu'},
        '[]': {'D', 'distortion_coeffs'},
    }
    for changed in fields:
        if changed in possible.get(value, ()):
            continue
        path.write_text(
            form % ', '.join(f'{field}: {value if field == changed else text}' for field, text in fields.items())
        )
        assert f'{path}: line 1' in refused(read, path)
    path.write_text(form.replace('{%s}', value))
    if value not in ('null', '{}', '{a: 1}', '!!float {}') or name != 'noise':
        refused(read, path)
