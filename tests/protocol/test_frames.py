"""Frames: a stream is parsed to the same messages, in pieces of any size."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rlightning_aio.protocol.frames import BELL, Frame, FrameKind, FrameReader, encode

FRAMES = st.lists(
    st.builds(
        Frame,
        st.sampled_from(list(FrameKind)),
        st.integers(-(2**63), 2**63 - 1),
        st.binary(max_size=300),
    ),
    max_size=6,
)


@given(frames=FRAMES, sizes=st.lists(st.integers(1, 64), min_size=1))
def test_a_stream_is_split_into_its_frames(frames: list[Frame], sizes: list[int]) -> None:
    """In order, complete, and without bells, for pieces of any size."""
    stream = b"".join(encode(FrameKind(f.kind), f.number, f.payload) for f in frames)
    reader, found = FrameReader(), list[Frame]()
    position, k = 0, 0
    while position < len(stream):
        size = sizes[k % len(sizes)]
        found += reader.feed(stream[position : position + size])
        position, k = position + size, k + 1
    assert found == [frame for frame in frames if frame.kind != FrameKind.BELL]


@given(payload=st.binary(min_size=1, max_size=2000), at=st.integers(0, 2000))
def test_bytes_of_a_bell_inside_a_frame_are_part_of_it(payload: bytes, at: int) -> None:
    """A bell is only a bell at the beginning of a frame."""
    frame = encode(FrameKind.RESULT, 9, BELL + payload)
    reader = FrameReader()
    at = min(at, len(frame) - 1)
    found = reader.feed(frame[:at]) + reader.feed(frame[at:]) + reader.feed(BELL)
    assert found == [Frame(FrameKind.RESULT, 9, BELL + payload)]
