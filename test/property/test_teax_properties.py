"""A ThermalGrabber's stream, damaged in all ways: no whole frame is lost, nothing else comes out."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from support.teax import packed, picture, WIDTH

from thermal_fiducial.cameras.teax_stream import TeaxStream

FRAMES = [picture(seed) for seed in range(5)]
PACKED = [packed(counts) for counts in FRAMES]
LENGTH = len(PACKED[0])
PITCH = 2 * (WIDTH + 2)


def fed(stream, pieces):
    return [frame for k, piece in enumerate(pieces) for frame in stream.feed(piece, k)]


def pieces_of(data, sizes):
    at, result = 0, []
    for size in sizes:
        result.append(data[at : at + size])
        at += size
    return [*result, data[at:]]


def indices(frames):
    """Which of FRAMES came out; whatever is none of them fails."""
    found = []
    for frame in frames:
        (index,) = [k for k, counts in enumerate(FRAMES) if np.array_equal(counts, frame.counts)]
        found.append(index)
    return found


@given(st.lists(st.integers(0, 2 * LENGTH), max_size=30))
def test_frames_come_whole_however_the_bytes_are_cut_into_reads(sizes):
    stream = TeaxStream()
    assert indices(fed(stream, pieces_of(b''.join(PACKED), sizes))) == [0, 1, 2, 3, 4]
    assert not stream.events


@given(
    st.integers(0, 5 * LENGTH - 1),
    st.one_of(st.integers(1, 64), st.integers(1, 2 * LENGTH)),
    st.lists(st.integers(1, LENGTH), max_size=8),
)
@settings(max_examples=150)
def test_a_cut_loses_the_frames_that_it_touches_and_no_other(start, count, sizes):
    end = min(start + count, 5 * LENGTH)
    data = b''.join(PACKED)
    frames = fed(TeaxStream(), pieces_of(data[:start] + data[end:], sizes))
    first, last = start // LENGTH, (end - 1) // LENGTH
    whole = [k for k in range(5) if not first <= k <= last]
    # From a row of one frame to the same place in a row of another, headers and all: rows that fit, of two frames.
    # A real cut through one header never is one: packets hold 510 bytes, a row of 640 pixels 1284, a header 10.
    if last > first and (end - start - 10 * (last - first)) % PITCH == 0:
        return
    # Bytes of the blanking at the end may be missing from a frame whose pixels are all there.
    assert [k for k in indices(frames) if k in whole] == whole
    assert set(indices(frames)) <= {*whole, first, last}


@given(st.integers(0, 4), st.integers(1, LENGTH - 1), st.binary(min_size=1, max_size=3000), st.booleans())
@settings(max_examples=150)
def test_garbage_costs_the_frame_that_it_is_in(victim, at, garbage, overwrites):
    frame = PACKED[victim]
    damaged = frame[:at] + garbage + frame[at + len(garbage) * overwrites :]
    stream = TeaxStream((FRAMES[0].shape[1], FRAMES[0].shape[0]))
    data = b''.join([*PACKED[:victim], damaged, *PACKED[victim + 1 :]])
    found = []
    for piece in pieces_of(data, [7000] * (len(data) // 7000)):
        for out in stream.feed(piece, 0):
            found += [k for k, counts in enumerate(FRAMES) if np.array_equal(counts, out.counts)]
    assert [k for k in found if k != victim] == [k for k in range(5) if k != victim]


@given(st.lists(st.integers(0, 4), min_size=1, max_size=12))
def test_dropped_and_doubled_frames_come_as_they_are(order):
    frames = fed(TeaxStream(), [b''.join(PACKED[k] for k in order)])
    assert indices(frames) == order


@given(st.binary(max_size=5000))
def test_before_the_first_frame_there_may_be_anything(garbage):
    assert indices(fed(TeaxStream(), [garbage, PACKED[1], PACKED[2]]))[-1] == 2
