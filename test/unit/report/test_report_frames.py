"""Frames with their markers in the report and in a video, from a small bag; where bag or encoder are missing."""

import base64
from importlib.util import find_spec
import json
import re
import shutil

import cv2
import numpy as np
import pytest
from support import small_bag
from support.run_folders import write_poses
import yaml

from thermal_fiducial.cli.main import main
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.geometry.se3 import apply, inverse, transform
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import IMAGE_TOPIC
from thermal_fiducial.files.images import stamp_to_ns
from thermal_fiducial.report import video
from thermal_fiducial.report.frames import bag_of, strip, ThermalView, write
from thermal_fiducial.report.interruptions import Cause, Interruption
from thermal_fiducial.report.page import evaluate_run, write_page
from thermal_fiducial.report.run_folder import read_run

SECONDS = 0.4
needs_encoder = pytest.mark.skipif(not find_spec('av'), reason='no PyAV')


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """A folder with ``bag``, and ``run`` with the true corners as its detections."""
    folder = tmp_path_factory.mktemp('frames')
    recording = small_bag.recording(SECONDS)
    recording.write(folder / 'bag')
    run = folder / 'run'
    run.mkdir()
    stamps = np.array([stamp_to_ns(message.header.stamp) for message in recording.of(IMAGE_TOPIC)])
    T = np.array([small_bag.true_pose((stamp - small_bag.START_NS) * 1e-9) for stamp in stamps])
    for name in ('fused.tum', 'fiducial.tum'):
        write_poses(run / name, stamps, T)
    rows = ['stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3,sigma_px']
    for stamp, pose in zip(stamps, T, strict=True):
        for marker, corners in true_corners(pose).items():
            rows.append(','.join(map(str, [stamp, marker, *corners.ravel().round(4), 0.03])))
    (run / 'detections.csv').write_text('\n'.join(rows) + '\n')
    (run / 'summary.json').write_text(json.dumps({'bag': 'bag', 'bag_path': str(folder / 'bag')}))
    return folder


def true_corners(T_map_body):
    T_camera_map = inverse(T_map_body @ small_bag.T_BODY_CAMERA)
    return {
        marker: small_bag.CAMERA.project(
            apply(T_camera_map @ transform(small_bag.R_MAP_MARKER, centre), marker_corners(small_bag.SIZE))
        )
        for marker, centre in small_bag.CENTRES.items()
    }


def is_cyan(pixels):
    """(H, W) pixels (BGR) of the colour of an outline; false colours have none like it."""
    b, g, r = (pixels[..., channel].astype(int) for channel in range(3))
    return (b > 150) & (g > 130) & (r < 110)


def test_a_strip_shows_frames_with_their_markers(flight):
    run = read_run(flight / 'run')
    pictures = strip(run)
    assert len(pictures) == 12
    assert pictures[0].caption == '0.0 s, 4 markers'
    data = base64.b64decode(pictures[0].uri.partition('base64,')[2])
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (384, 480, 3)
    cyan = is_cyan(picture)
    for corners in true_corners(small_bag.true_pose(0.002)).values():
        # Along each side there is the outline, within two pixels of where the side is.
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            x, y = np.rint(0.75 * (0.5 * (a + b))).astype(int)
            assert cyan[y - 2 : y + 3, x - 2 : x + 3].any()
    assert np.mean(cyan) < 0.05


def test_pictures_are_made_with_the_parameters_of_the_run(flight, tmp_path):
    """Flag bits were taken for counts, and little else was to be seen."""
    shutil.copytree(flight / 'run', tmp_path / 'run')
    parameters = {'/pose_ekf': {'camera_time_offset': 0.0}, '/tau2_camera': {'bits': 13}}
    sections = {node: {'ros__parameters': values} for node, values in parameters.items()}
    (tmp_path / 'run' / 'parameters.yaml').write_text(yaml.safe_dump(sections))
    recording = small_bag.recording(SECONDS)
    for index, (stamp, topic, message) in enumerate(recording.events):
        if topic == IMAGE_TOPIC:
            counts = message.data.view(np.uint16).copy()
            counts[::4] |= 1 << 13
            recording.events[index] = stamp, topic, small_bag.replaced(message, data=counts.view(np.uint8))
    flagged = recording.write(tmp_path / 'flagged')
    assert [p.uri for p in strip(read_run(tmp_path / 'run'), flagged)] == [
        p.uri for p in strip(read_run(flight / 'run'))
    ]


def test_the_page_holds_the_strip(flight):
    page = write_page(*evaluate_run(flight / 'run')).read_text()
    assert page.count('<img src="data:image/webp;base64,') == len(strip(read_run(flight / 'run')))
    assert '4 markers</figcaption>' in page
    # A picture that is loaded when it is reached takes no room until then: links jumped past their sections.
    assert 'loading="lazy"' not in page


def test_the_video_shows_a_frame_before_it_is_played(flight, tmp_path):
    """On phones and in a page on paper it was a black square."""
    shutil.copytree(flight / 'run', tmp_path / 'run')
    (tmp_path / 'run' / 'flight.mp4').write_bytes(b'')
    page = write_page(*evaluate_run(tmp_path / 'run')).read_text()
    assert re.search(r'<video [^>]*src="flight.mp4" poster="data:image/webp;base64,', page)


@needs_encoder
def test_a_missing_bag_is_reported_and_another_path_can_be_given(flight, tmp_path, capsys):
    shutil.copytree(flight / 'run', tmp_path / 'run')
    run = read_run(tmp_path / 'run')
    assert bag_of(run).path == flight / 'bag'
    (tmp_path / 'run' / 'summary.json').write_text(json.dumps({'bag': 'nowhere', 'bag_path': '/nowhere'}))
    moved = read_run(tmp_path / 'run')
    assert (bag_of(moved), strip(moved)) == (None, [])
    assert 'the bag is not where it was (--bag names it)' in write_page(*evaluate_run(tmp_path / 'run')).read_text()
    assert len(strip(moved, flight / 'bag')) > 5
    assert main(['evaluate', str(tmp_path / 'run'), '--video', '--no-report']) == 2
    assert '--bag names it' in capsys.readouterr().err


def later(message):
    """The same image, 1000 s later."""
    stamp_ns = stamp_to_ns(message.header.stamp) + 10**12
    return small_bag.replaced(message, header=small_bag.header(stamp_ns, message.header.frame_id))


@needs_encoder
def test_the_bag_of_another_flight_is_refused(flight, tmp_path, capsys):
    """The page had no frames and asked for --bag; the video showed the other flight."""
    shutil.copytree(flight / 'run', tmp_path / 'run')
    recording = small_bag.recording(SECONDS)
    bags = {'later': recording.changed(IMAGE_TOPIC, later), 'blind': recording.without(IMAGE_TOPIC)}
    words = {
        'later': 'none of its frames; its images begin at 1700001000.0 s, the markers of the run at 1700000000.0 s',
        'blind': 'no images on thermal/image_raw in it',
    }
    for name, made in bags.items():
        bag = made.write(tmp_path / name)
        for options in ([], ['--video', '--no-report']):
            assert main(['evaluate', str(tmp_path / 'run'), '--bag', str(bag), *options]) == 2
            assert words[name] in capsys.readouterr().err
    # What was recorded as the bag of the run may have been replaced since, or have no images.
    (tmp_path / 'run' / 'summary.json').write_text(json.dumps({'bag_path': str(tmp_path / 'blind')}))
    assert strip(read_run(tmp_path / 'run')) == []


def test_a_bag_beside_a_moved_run_is_found(flight, tmp_path):
    shutil.copytree(flight / 'run', tmp_path / 'run')
    (tmp_path / 'run' / 'summary.json').write_text(json.dumps({'bag': 'bag', 'bag_path': '/nowhere'}))
    (tmp_path / 'bag').mkdir()
    assert bag_of(read_run(tmp_path / 'run')).path == tmp_path / 'bag'


def test_a_run_with_the_name_of_its_bag_is_not_taken_for_the_bag(flight, tmp_path):
    """Without its bag it had no report any more: "no bag, the folder has neither metadata.yaml nor a file .mcap"."""
    shutil.copytree(flight / 'run', tmp_path / 'monday')
    summary = json.dumps({'bag': 'monday', 'bag_path': '/nowhere/monday'})
    (tmp_path / 'monday' / 'summary.json').write_text(summary)
    assert main(['evaluate', str(tmp_path / 'monday')]) == 0


def test_a_recorder_with_another_clock_shows_the_same_frames(flight, tmp_path):
    recording = small_bag.recording(SECONDS)
    late = small_bag.Recording([(stamp + 10**15, topic, message) for stamp, topic, message in recording.events])
    run = read_run(flight / 'run')
    assert [p.uri for p in strip(run, late.write(tmp_path / 'late'))] == [p.uri for p in strip(run)]


def test_a_video_of_all_frames(flight):
    av = pytest.importorskip('av')
    path = flight / 'frames.mp4'
    shares = []
    video.write_video(read_run(flight / 'run'), path, progress=shares.append)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format='bgr24') for frame in container.decode(stream)]
        assert stream.codec_context.name == 'h264'
        # 12 frames, the IMU before the first of them and after the last.
        assert float(stream.average_rate) == pytest.approx(30.0, rel=0.15)
    assert len(frames) == round(30 * SECONDS)
    assert frames[0].shape == (512, 640, 3)
    assert is_cyan(frames[-1]).any()
    # The caption: white on black.
    assert (frames[0][450:].min(axis=2) > 200).any()
    assert shares[-1] == 1.0


@needs_encoder
def test_an_interrupt_leaves_the_earlier_video(flight):
    folder = flight / 'videos'
    folder.mkdir()
    (folder / 'flight.mp4').write_bytes(b'earlier')

    def interrupt(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video.write_video(read_run(flight / 'run'), folder / 'flight.mp4', progress=interrupt)
    assert [(path.name, path.read_bytes()) for path in folder.iterdir()] == [('flight.mp4', b'earlier')]


def test_letters_can_be_read_on_white():
    on_black, on_white = np.zeros((40, 200, 3), np.uint8), np.full((40, 200, 3), 255, np.uint8)
    for picture in (on_black, on_white):
        write(picture, '12.00 s', (8, 28))
    letters = (on_black[..., 0] > 64).astype(np.uint8)
    edge = (cv2.dilate(letters, np.ones((3, 3))) > 0) & (letters == 0)
    # Black, but where letters fade out into it: with the outline that OpenCV 5 makes it is 248, the ground.
    assert on_white[edge].mean() < 60


@needs_encoder
def test_the_video_calls_the_shutter_by_its_name(flight, monkeypatch):
    """Its first frames look frozen to the camera node, which knows only later why."""
    run = read_run(flight / 'run')
    stamps = np.unique(run.detections.stamps_ns)
    closed = Interruption(int(stamps[3]), int(stamps[7]), Cause.SHUTTER, fused_poses=4, step_mm=0.0)
    pixels = np.zeros((512, 640, 3), np.uint8)
    seen = [ThermalView(int(stamp), None if 3 < k < 7 or k == 9 else pixels, 'frozen' if 3 < k < 7 or k == 9 else '')
            for k, stamp in enumerate(stamps)]  # fmt: skip
    lines = []
    monkeypatch.setattr(video, 'views', lambda reader, front_end: iter(seen))
    monkeypatch.setattr(video, 'interruptions', lambda run, errors: [closed])
    monkeypatch.setattr(video, 'write', lambda picture, text, place: lines.append(text))
    video.write_video(run, flight / 'shutter.mp4')
    reasons = [line.partition(' s ')[2].strip() for line in lines[::2]]
    assert reasons == [''] * 4 + ['shutter (FFC)'] * 3 + [''] * 2 + ['frozen'] + [''] * (len(stamps) - 10)


def test_a_video_that_cannot_be_written_is_one_line(flight, tmp_path):
    pytest.importorskip('av')
    with pytest.raises(InputError, match=r'flight\.mp4'):
        video.write_video(read_run(flight / 'run'), tmp_path / 'none' / 'flight.mp4')
