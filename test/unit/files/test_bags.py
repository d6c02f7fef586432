from contextlib import closing
import re
import shutil
import sqlite3

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from support import small_bag

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.bags import BagReader, parse_remaps, resolve_topics
from thermal_fiducial.files.sensor_bag import read_bag, ThermalFrame

STORE = get_typestore(Stores.ROS2_JAZZY)
STRING = 'std_msgs/msg/String'
IMU = 'sensor_msgs/msg/Imu'
IMAGE = 'sensor_msgs/msg/Image'


def string(text):
    return STORE.types[STRING](data=text)


def write(path, topics=('/imu/data', '/other'), storage='mcap', count=20):
    """A bag of strings: message n on topic n modulo the topics, at n milliseconds."""
    with BagWriter(path, storage) as bag:
        for n in range(count):
            bag.write(topics[n % len(topics)], n * 1_000_000, string(f'message {n}'))
    return path


@pytest.fixture(params=['mcap', 'sqlite3'])
def storage(request):
    return request.param


def test_messages_are_read_in_recorded_order(tmp_path, storage):
    with BagReader(write(tmp_path / 'bag', storage=storage)) as bag:
        assert bag.topics == {'imu/data': STRING, 'other': STRING}
        assert bag.message_count() == 20
        assert bag.message_count(['other']) == 10
        assert (bag.start_ns, bag.duration_ns) == (0, 19_000_000)
        messages = list(bag.messages())
    assert [message.stamp_ns for message in messages] == [n * 1_000_000 for n in range(20)]
    assert [message.message.data for message in messages] == [f'message {n}' for n in range(20)]
    assert [message.topic for message in messages[:2]] == ['imu/data', 'other']
    assert STORE.serialize_cdr(string('message 3'), STRING) == messages[3].cdr


def test_reads_chosen_topics(tmp_path, storage):
    with BagReader(write(tmp_path / 'bag', storage=storage)) as bag:
        assert {message.topic for message in bag.messages(['other'])} == {'other'}
        assert list(bag.messages(['none'])) == []


def test_same_messages_same_bytes(tmp_path, storage):
    for folder in ('a', 'b'):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / 'bag', storage=storage)
    for path in (tmp_path / 'a' / 'bag').iterdir():
        assert path.read_bytes() == (tmp_path / 'b' / 'bag' / path.name).read_bytes()


def test_a_single_file_of_a_bag_is_a_bag(tmp_path, storage):
    folder = write(tmp_path / 'bag', storage=storage)
    suffix = {'mcap': '.mcap', 'sqlite3': '.db3'}[storage]
    (file,) = folder.glob('*' + suffix)
    with BagReader(file) as bag:
        assert len(list(bag.messages())) == 20


@pytest.mark.parametrize('suffix', ['.mcap', '.db3', '.bag'])
def test_a_folder_may_be_named_as_a_file(tmp_path, storage, suffix):
    """One named x.bag, as ``ros2 bag record -o x.bag`` makes it, was taken for a bag of ROS 1."""
    with BagReader(write(tmp_path / f'x{suffix}', storage=storage)) as bag:
        assert bag.message_count() == 20


def test_writes_raw_bytes(tmp_path):
    cdr = bytes(STORE.serialize_cdr(string('raw'), STRING))
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('a', 1, cdr, STRING)
    with BagReader(tmp_path / 'bag') as bag:
        assert [message.message.data for message in bag.messages()] == ['raw']


def test_reads_ros_1_bags(tmp_path):
    old = get_typestore(Stores.ROS1_NOETIC)
    header = old.types['std_msgs/msg/Header'](
        seq=7, stamp=old.types['builtin_interfaces/msg/Time'](sec=3, nanosec=5), frame_id='cam'
    )
    image = old.types[IMAGE](header, 2, 3, 'mono16', 0, 6, np.arange(12, dtype=np.uint8))
    own = get_types_from_msg('float64 x\nstd_msgs/Header header', 'mine/msg/Thing')
    old.register(own)
    thing = old.types['mine/msg/Thing'](2.5, header)
    with Rosbag1Writer(tmp_path / 'old.bag') as bag:
        for n, (topic, kind, message) in enumerate((('/cam/image', IMAGE, image), ('/thing', 'mine/msg/Thing', thing))):
            connection = bag.add_connection(topic, kind, typestore=old)
            bag.write(connection, n + 1, old.serialize_ros1(message, kind))
    with BagReader(tmp_path / 'old.bag', {'/cam/image': 'thermal/image_raw'}) as bag:
        first, second = bag.messages()
    assert (first.topic, first.msgtype) == ('thermal/image_raw', IMAGE)
    assert STORE.deserialize_cdr(first.cdr, IMAGE).header.frame_id == 'cam'
    assert (first.message.header.stamp.sec, first.message.data.tolist()) == (3, list(range(12)))
    assert (second.message.x, second.message.header.stamp.nanosec) == (2.5, 5)


def test_frames_for_the_library_may_be_compressed(tmp_path):
    recording = small_bag.recording(0.1)
    read = []
    for name, kind in (('raw', recording), ('png', recording.compressed())):
        read.append([item.counts for item in read_bag(kind.write(tmp_path / name)) if isinstance(item, ThermalFrame)])
    assert len(read[0]) > 1
    np.testing.assert_array_equal(read[1], read[0])


# --- topics -------------------------------------------------------------------------------------------


@pytest.mark.parametrize('recorded', ['imu/data', '/imu/data', '/drone/imu/data', '/a/b/imu/data'])
def test_finds_topics_in_any_namespace(recorded):
    assert resolve_topics([recorded, '/tf']) == {recorded: 'imu/data', '/tf': 'tf'}


def test_the_topic_itself_goes_before_one_in_a_namespace():
    names = resolve_topics(['/imu/data', '/other/imu/data'])
    assert names == {'/imu/data': 'imu/data', '/other/imu/data': 'other/imu/data'}


def test_a_remap_goes_before_a_namespace():
    names = resolve_topics(['/a/imu/data', '/vn100/imu'], {'vn100/imu': '/imu/data'})
    assert names == {'/a/imu/data': 'a/imu/data', '/vn100/imu': 'imu/data'}


def test_ambiguous_topics_are_refused():
    with pytest.raises(InputError, match=r'/a/imu/data and /b/imu/data could both be imu/data'):
        resolve_topics(['/a/imu/data', '/b/imu/data'])
    with pytest.raises(InputError, match='several topics'):
        resolve_topics(['/imu/data', '/mine'], {'/mine': 'imu/data'})
    with pytest.raises(InputError, match='several topics'):
        resolve_topics(['/imu/data', 'imu/data'])
    with pytest.raises(InputError, match=r'no topic nothing to remap; the bag has: imu/data'):
        resolve_topics(['/imu/data'], {'/nothing': 'imu/data'})


def test_parses_remaps():
    assert parse_remaps(['/a:=imu/data', 'b:=c']) == {'/a': 'imu/data', 'b': 'c'}
    for wrong in ('a', 'a:=', ':=b', 'a=b'):
        with pytest.raises(InputError, match='from:=to'):
            parse_remaps([wrong])


def test_missing_topics_are_named_beside_the_recorded_ones(tmp_path):
    with BagReader(write(tmp_path / 'bag')) as bag:
        bag.require({'imu/data': STRING})
        with pytest.raises(InputError, match=rf'no topic thermal/image_raw .*imu/data \({STRING}\), other'):
            bag.require({'thermal/image_raw': IMAGE})
        with pytest.raises(InputError, match='remap another to it, or give a calibration_file'):
            bag.require({'thermal/camera_info': 'sensor_msgs/msg/CameraInfo'})
        with pytest.raises(InputError, match=r'no topic ground_truth/odometry \(give a TUM file\?\)'):
            bag.require({'ground_truth/odometry': 'nav_msgs/msg/Odometry'})
        with pytest.raises(InputError, match=f'imu/data is {STRING}, not {IMU}'):
            bag.require({'imu/data': IMU})


def test_a_topic_without_messages_is_missing(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('imu/data', IMU)
        bag.write('other', 1, string('x'))
    with BagReader(tmp_path / 'bag') as bag, pytest.raises(InputError, match='no message on topic imu/data'):
        bag.require({'imu/data': IMU})


# --- bad bags -----------------------------------------------------------------------------------------


def read_all(path):
    with BagReader(path) as bag:
        return [message.message for message in bag.messages()]


def test_missing_bag(tmp_path):
    with pytest.raises(InputError, match='no such bag'):
        read_all(tmp_path / 'nothing')


def test_folder_without_metadata(tmp_path):
    with pytest.raises(InputError, match=r'neither metadata\.yaml nor a file'):
        read_all(tmp_path)


def test_a_folder_without_metadata_names_the_file_that_can_be_read(tmp_path):
    """After a loss of power, on a computer without ROS."""
    folder = write(tmp_path / 'bag')
    (folder / 'metadata.yaml').unlink()
    with pytest.raises(InputError, match=r'no metadata\.yaml \(ros2 bag reindex .* or give its file .*\)') as caught:
        read_all(folder)
    assert read_all(str(caught.value).partition('its file ')[2].rstrip(')'))
    (folder / 'another.db3').touch()
    with pytest.raises(InputError, match=r'\(ros2 bag reindex makes one\)'):
        read_all(folder)


@pytest.mark.parametrize('text', ['', '{', 'a: 1', 'rosbag2_bagfile_information: 3', '\x00\x01'])
def test_broken_metadata(tmp_path, text):
    folder = write(tmp_path / 'bag')
    (folder / 'metadata.yaml').write_text(text)
    with pytest.raises(
        InputError, match=r'bag: the bag cannot be read|bag/metadata\.yaml: .*(not valid YAML|not a set of fields)'
    ):
        read_all(folder)


def test_missing_data_file(tmp_path):
    folder = write(tmp_path / 'bag')
    (folder / 'bag.mcap').unlink()
    with pytest.raises(InputError, match='missing'):
        read_all(folder)


def test_empty_bag(tmp_path, storage):
    with BagWriter(tmp_path / 'bag', storage) as bag:
        bag.add_topic('imu/data', IMU)
    with pytest.raises(InputError, match='empty'):
        read_all(tmp_path / 'bag')


@pytest.mark.parametrize('share', [0.0, 0.02, 0.5, 0.9, 0.999])
def test_truncated_bag(tmp_path, storage, share):
    folder = write(tmp_path / 'bag', storage=storage, count=2000)
    (file,) = (path for path in folder.iterdir() if path.name != 'metadata.yaml')
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match='bag') as raised:
        read_all(folder)
    assert '\n' not in str(raised.value)


@pytest.mark.parametrize('bytes_left', [8, -8, -1])
def test_a_recording_that_was_cut_off_names_the_remedy(tmp_path, bytes_left):
    """As after a crash or a loss of power, when no end is written."""
    folder = write(tmp_path / 'bag')
    (file,) = folder.glob('*.mcap')
    file.write_bytes(file.read_bytes()[:bytes_left] + b'\0')
    for path in (folder, file):
        with pytest.raises(InputError) as raised:
            read_all(path)
        remedy = f'the recording of this bag was cut off, or goes on: mcap recover {file} -o NEW.mcap'
        assert str(raised.value) == f'{file}: {remedy}'


def test_messages_that_a_crash_left_beside_a_bag_are_not_left_out(tmp_path):
    """SQLite keeps the last ones in a file of its own; half of a bag was read without a word."""
    folder = write(tmp_path / 'bag', storage='sqlite3')
    (file,) = folder.glob('*.db3')
    with closing(sqlite3.connect(file)) as recorder:
        recorder.execute('PRAGMA journal_mode=WAL')
        recorder.execute('UPDATE messages SET timestamp = timestamp + 1')
        recorder.commit()
        crashed = shutil.copytree(folder, tmp_path / 'crashed') / file.name
    for path in (crashed.parent, crashed):
        with pytest.raises(InputError, match='was cut off, or goes on: sqlite3 ') as raised:
            read_all(path)
    command = str(raised.value).partition('sqlite3 ')[2].partition('"')[2].partition('"')[0]
    with closing(sqlite3.connect(crashed)) as recovered:
        count = recovered.execute(command).fetchone()[0]
    assert len(read_all(crashed)) == count


@pytest.mark.parametrize('name', ['a.bag', 'a.mcap', 'a.db3', 'a.txt'])
@pytest.mark.parametrize('content', [b'', b'#ROSBAG V2.0\n', b'\x89MCAP0\r\n', bytes(range(256)) * 20])
def test_garbage(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name) as raised:
        read_all(tmp_path / name)
    assert '\n' not in str(raised.value)


def test_truncated_ros_1_bag(tmp_path):
    old = get_typestore(Stores.ROS1_NOETIC)
    with Rosbag1Writer(tmp_path / 'old.bag') as bag:
        connection = bag.add_connection('/a', STRING, typestore=old)
        for n in range(100):
            bag.write(connection, n, old.serialize_ros1(old.types[STRING]('x'), STRING))
    content = (tmp_path / 'old.bag').read_bytes()
    for share in (0.1, 0.5, 0.95):
        (tmp_path / 'old.bag').write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError, match=r'old\.bag'):
            read_all(tmp_path / 'old.bag')


def test_an_undecodable_message_is_refused(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('imu/data', 12, b'\x00\x01\x00\x00\x01\x02', IMU)
    with BagReader(tmp_path / 'bag') as bag:
        (message,) = bag.messages()
        with pytest.raises(InputError, match=f'imu/data at 12: no {IMU}'):
            _ = message.message


def test_an_unknown_type_keeps_its_bytes(tmp_path):
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        connection = bag.add_connection('/a', 'mine/msg/Thing', msgdef='', rihs01='RIHS01_0')
        bag.write(connection, 1, b'\x00\x01\x00\x00abcd')
    with BagReader(tmp_path / 'bag') as bag:
        (message,) = bag.messages()
        assert message.cdr.endswith(b'abcd')
        with pytest.raises(InputError, match='mine/msg/Thing'):
            _ = message.message


def test_writer_refuses(tmp_path):
    with pytest.raises(InputError, match='exists already'):
        BagWriter(tmp_path)
    with pytest.raises(InputError, match='one of mcap, sqlite3'):
        BagWriter(tmp_path / 'a', 'zip')
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError), BagWriter(tmp_path / 'file' / 'bag'):
        pass
    with BagWriter(tmp_path / 'b') as bag, pytest.raises(InputError, match='unknown'):
        bag.write('a', 1, b'', 'mine/msg/Thing')


# --- bags that are meant to hurt ----------------------------------------------------------------------


def compressed(path, mode, data):
    """A bag of one string of ``data``, compressed as ``mode`` says."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection('/a', STRING, typestore=STORE)
        writer.write(connection, 1, STORE.serialize_cdr(string(data), STRING))
    return path


@pytest.mark.parametrize('mode', [CompressionMode.STORAGE, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_compressed_bags_are_read_but_none_that_expands_without_bound(tmp_path, mode):
    (message,) = read_all(compressed(tmp_path / 'good', mode, 'as recorded'))
    assert message.data == 'as recorded'
    bomb = compressed(tmp_path / 'bomb', mode, 'x' * (40 << 20))
    with pytest.raises(InputError, match=r'bomb: the bag cannot be read: \d+ compressed bytes expand to more than'):
        read_all(bomb)


def test_a_single_file_of_compressed_messages_names_the_folder(tmp_path):
    """That they are compressed stands in metadata.yaml alone: "cannot be decoded" was all."""
    folder = compressed(tmp_path / 'bag', CompressionMode.MESSAGE, 'as recorded')
    (file,) = (path for path in folder.iterdir() if path.name != 'metadata.yaml')
    with pytest.raises(InputError, match=r'its messages are compressed, as .* says: give the folder'):
        read_all(file)


@pytest.mark.parametrize('kind', [Rosbag1Writer.CompressionFormat.BZ2, Rosbag1Writer.CompressionFormat.LZ4])
def test_chunks_of_ros_1_expand_as_little(tmp_path, kind):
    old = get_typestore(Stores.ROS1_NOETIC)
    for name, text in (('good', 'as recorded'), ('bomb', 'x' * (40 << 20))):
        writer = Rosbag1Writer(tmp_path / f'{name}.bag')
        writer.set_compression(kind)
        with writer:
            connection = writer.add_connection('/a', STRING, typestore=old)
            writer.write(connection, 1, old.serialize_ros1(old.types[STRING](data=text), STRING))
    assert [message.data for message in read_all(tmp_path / 'good.bag')] == ['as recorded']
    with pytest.raises(InputError, match='expand to more than'):
        read_all(tmp_path / 'bomb.bag')


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('nanoseconds_since_epoch', '-1'),
        ('nanoseconds_since_epoch', 'noon'),
        ('nanoseconds', '1.5'),
        ('message_count', 'many'),
        ('message_count', str(2**70)),
        ('name', '17'),
        ('name', '~'),
        ('type', '[]'),
    ],
)
def test_invalid_metadata_is_refused(tmp_path, field, value):
    path = write(tmp_path / 'bag', count=2)
    file = path / 'metadata.yaml'
    file.write_text(re.sub(rf'\b{field}: .*', f'{field}: {value}', file.read_text()))
    with (
        pytest.raises(InputError, match=r'bag: the bag cannot be read: its metadata|bag/metadata.yaml: line \d+: '),
        BagReader(path),
    ):
        pass
