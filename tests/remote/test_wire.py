"""Messages survive encoding and decoding, and malformed ones are refused."""

from __future__ import annotations

import json
import sys
from functools import reduce
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from remote.random_spaces import any_info, any_space, same, sampled

from rlightning_aio.protocol.columns import Misfit
from rlightning_aio.protocol.net import wire
from rlightning_aio.protocol.net.payload import Packed, ResultFields, ResultLayout, SpaceLayout
from rlightning_aio.protocol.net.space_description import UnsupportedSpace, describe, space_from
from rlightning_aio.protocol.net.wire import (
    ClientResult,
    FromClient,
    Reader,
    Untransferable,
    WireError,
    Writer,
    ping_ms,
    portable,
)

SMALL: dict[str, Any] = {"type": "discrete", "n": 2}


def through_wire(message: Any, frames: list[bytes] | None = None) -> tuple[Any, Any]:
    return Reader[Any](FromClient).read(Writer().write(message, frames))


@given(any_space)
def test_a_space_survives_its_description_even_as_json(space: Any) -> None:
    """Any language with JSON can announce and read a space."""
    text = json.dumps(describe(space, "observation"), allow_nan=False)
    assert space_from(json.loads(text)) == space


@given(any_space, st.integers(0, 2**16))
def test_values_survive_in_structure_dtype_shape_and_content(space: Any, seed: int) -> None:
    """Samples of a space arrive unchanged."""
    value = sampled(space, seed)
    packed = Packed([], [])
    SpaceLayout(space, "observation").pack(value, packed)
    assert same(SpaceLayout(space, "observation").unpack(*packed), value)


@given(any_info)
def test_infos_survive_with_their_arrays(info: dict[str, Any]) -> None:
    """Values of msgpack arrive, and arrays travel as frames."""
    message, _ = through_wire(ClientResult(number=2, info=info))
    assert same(message.info, info)


def test_a_frame_named_in_an_info_is_no_view_of_the_message() -> None:
    """An info's arrays are the reader's own, and writable."""
    message, _ = through_wire(ClientResult(number=2, info={"a": np.arange(3)}))
    message.info["a"][0] = 7


def compressed() -> tuple[ResultLayout, Any]:
    """A layout with an image and a vector, and a value of it."""
    pytest.importorskip("zstandard")
    space = spaces.Dict(
        image=spaces.Box(0, 255, (64, 64, 3), np.uint8), state=spaces.Box(-1, 1, (400,))
    )
    image = np.repeat(np.arange(64, dtype=np.uint8), 192).reshape(64, 64, 3)
    return ResultLayout(space, 1, (), "zstd"), {"image": image, "state": sampled(space["state"], 1)}


def test_images_are_compressed_without_loss_and_what_does_not_shrink_is_not() -> None:
    """Arrays of other dtypes are left as they are."""
    layout, value = compressed()
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    for image, is_small in ((value["image"], True), (noise, False)):
        packed = Packed([], [])
        header = layout.pack(ResultFields({**value, "image": image}, 0.0, False, False), packed)
        assert (len(packed.frames[0]) < 12288) == is_small
        assert len(packed.frames[1]) == 1600
        found = layout.unpack(*packed, header[1:]).observation
        assert same(found, {**value, "image": image})


@pytest.mark.parametrize("fault", ["larger", "smaller", "unknown", "cut", "longer", "noise"])
def test_a_frame_that_states_another_size_is_not_expanded(fault: str) -> None:
    """Nor one that states none, is damaged, or has more behind it."""
    layout, value = compressed()
    import zstandard

    packed = Packed([], [])
    layout.pack(ResultFields(value, 0.0, False, False), packed)
    good = packed.frames[0]
    unknown = zstandard.ZstdCompressor(write_content_size=False)
    packed.frames[0] = {
        "larger": zstandard.compress(bytes(1 << 24)),
        "smaller": zstandard.compress(bytes(100)),
        "unknown": unknown.compress(bytes(12288)),
        "cut": good[:-8],
        "longer": good + b"more",
        "noise": b"no frame",
    }[fault]
    with pytest.raises(WireError, match="a compressed frame"):
        layout.unpack(*packed, (0.0, False, False))


def test_without_the_library_compression_is_refused_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(WireError, match=r"pip install 'rlightning-aio\[zstd\]'"):
        ResultLayout(spaces.Discrete(2), 1, (), "zstd")


def test_keys_that_are_not_strings_are_left_out_and_named() -> None:
    """At the top, where a reader would refuse the whole message for them; numbers survive below."""
    info: dict[Any, Any] = {"good": {1: "one", None: "none"}, 0: {"a": 1}, True: 2}
    with pytest.raises(Untransferable, match="info has the key 0; keys must be strings"):
        Writer().write(ClientResult(number=2, info=info))
    lost: list[str] = []
    kept = portable(info, lost)
    assert kept == {"good": {1: "one"}}
    assert lost == ["good.None", "0", "True"]
    message, _ = through_wire(ClientResult(number=2, info=kept))
    assert message.info == kept


def test_an_info_that_contains_itself_is_left_out() -> None:
    """A cycle neither hangs nor crashes a client."""
    info: dict[str, Any] = {"good": 1}
    info["self"] = info
    lost: list[str] = []
    assert portable(info, lost)["good"] == 1
    assert lost


def test_numpy_scalars_and_tuples_travel_as_plain_values() -> None:
    """Infos of simulators contain them."""
    info = {"x": np.float64(0.5), "n": np.int32(3), "t": (1, 2), "words": np.array(["a", "b"])}
    message, _ = through_wire(ClientResult(number=2, info=info))
    assert message.info == {"x": 0.5, "n": 3, "t": [1, 2], "words": ["a", "b"]}


@pytest.mark.parametrize(
    ("space", "value", "says"),
    [
        (spaces.Box(0, 1, (3,)), np.zeros(2, np.float32), r"shape \(3,\).*found shape \(2,\)"),
        (spaces.MultiDiscrete([3]), np.zeros(1), "dtype int64, found .* dtype float64"),
        (spaces.Dict(a=spaces.Discrete(2)), {"b": 1}, "keys \\['a'\\], found keys \\['b'\\]"),
        (spaces.Tuple([spaces.Discrete(2)]), [], "a tuple of 1, found one of 0"),
        (spaces.Text(2), "too long", "not in"),
        (spaces.Discrete(3), 3, "observation is 3, which is not in Discrete"),
        (spaces.Dict(a=spaces.Discrete(3, start=-1)), {"a": 2}, r"\['a'\] is 2, which is not in"),
    ],
)
def test_a_value_that_does_not_fit_its_space_is_not_sent(space: Any, value: Any, says: str) -> None:
    """The message has the expected and the found shape."""
    with pytest.raises(Misfit, match=says):
        SpaceLayout(space, "observation").pack(value, Packed([], []))


@pytest.mark.parametrize(
    ("space", "frames", "texts"),
    [
        (spaces.Box(0, 1, (3,)), [b"\0" * 8], []),
        (spaces.Box(0, 1, (3,)), [], []),
        (spaces.Box(0, 1, (3,)), [b"\0" * 12], ["a text"]),
        (spaces.Box(0, 1, (2,), np.bool_), [b"\1\2"], []),
        (spaces.Discrete(3), [(3).to_bytes(8, "little")], []),
        (spaces.Text(2), [], ["abc"]),
    ],
)
def test_frames_of_the_wrong_size_or_content_are_refused(
    space: Any, frames: list[bytes], texts: list[str]
) -> None:
    """Bytes that do not fit the space are not used."""
    with pytest.raises(WireError):
        SpaceLayout(space, "observation").unpack(frames, texts)


@pytest.mark.parametrize(
    "space",
    [
        spaces.Sequence(spaces.Discrete(2)),
        spaces.Dict(a=spaces.Graph(spaces.Box(0, 1), None)),
        spaces.Box(0, 1, (1,), np.longdouble),
        None,
    ],
)
def test_a_space_that_cannot_be_announced_is_named(space: Any) -> None:
    """The message has its position in the space."""
    with pytest.raises(UnsupportedSpace, match="the observation"):
        describe(space, "the observation")


@pytest.mark.parametrize(
    "description",
    [
        {"type": "box", "shape": [2**40], "dtype": "float64", "low": 0, "high": 1},
        {"type": "box", "shape": [-1], "dtype": "float64", "low": 0, "high": 1},
        {"type": "box", "shape": [2], "dtype": "object", "low": 0, "high": 1},
        {"type": "box", "shape": [2], "dtype": "uint8", "low": 0, "high": 300},
        {"type": "box", "shape": [2], "dtype": "float32", "low": float("nan"), "high": 1},
        {"type": "box", "shape": [2], "dtype": "float32", "low": [0, [1]], "high": 1},
        {"type": "box", "shape": 2, "dtype": "float32", "low": 0, "high": 1},
        {"type": "discrete", "n": 0},
        {"type": "discrete", "n": True},
        {"type": "multi_binary", "n": 2**40},
        {"type": "multi_discrete", "nvec": [], "start": "no"},
        {"type": "text", "max_length": 2**40, "charset": "a"},
        {"type": "dict", "spaces": [["a", {"type": "discrete", "n": 2}]] * 2},
        {"type": "tuple", "spaces": [{"type": "discrete", "n": 2}] * 300},
        {"type": "pickle"},
        {},
        [],
        "box",
        reduce(lambda inner, _: {"type": "tuple", "spaces": [inner]}, range(100), SMALL),
    ],
)  # fmt: skip
def test_an_invalid_or_huge_description_is_refused(description: Any) -> None:
    """No description makes the trainer allocate without limit, or fail in another way; depth is
    bounded before anything is built.
    """
    with pytest.raises(WireError):
        space_from(description)


def reference(*payload: Any) -> msgspec.msgpack.Ext:
    return msgspec.msgpack.Ext(1, msgspec.msgpack.encode(payload))


@pytest.mark.parametrize(
    "info",
    [
        {"a": reference("float64", [3], 0)},  # A frame of another size.
        {"a": reference("object", [1], 0)},
        {"a": reference("uint8", [8], 1)},  # No such frame.
        {"a": reference("uint8", [8], 0), "b": reference("uint8", [8], 0)},  # Twice the same.
        {"a": reference("uint8", [-8], 0)},
        {"a": reference("uint8")},
        {"a": msgspec.msgpack.Ext(2, b"")},
        {"a": msgspec.msgpack.Ext(1, b"\xff")},
    ],
)
def test_an_info_that_names_frames_wrongly_is_refused(info: dict[str, Any]) -> None:
    """A reference to a frame must fit the frame, and each frame is named once at most."""
    header = {"type": "result", "session": 1, "number": 2, "info": info}
    with pytest.raises(WireError):
        Reader[Any](FromClient).read([msgspec.msgpack.encode(header), b"\0" * 8])


RESULT_WITH_KEY = b"\x83\xa4type\xa6result\xa6number\x01\xa4info\x81\xa1a\x81%b\x01"


@pytest.mark.parametrize(
    "parts",
    [
        [],
        [b""],
        [b"\xc1"],
        [b"\x91" * 100_000],
        [msgspec.msgpack.encode({"type": "step", "number": 1})],
        [msgspec.msgpack.encode({"type": "result", "number": -1})],
        [msgspec.msgpack.encode({"type": "result", "number": 2**63})],
        [msgspec.msgpack.encode({"type": "bye", "reason": 1})],
        [b"\x82\xa4type\xa3bye\xa6reason\xa1\xff"],
        [RESULT_WITH_KEY % b"\x80"],  # A map as key.
        [RESULT_WITH_KEY % b"\xc7\x0a\x01\x93\xa5uint8\x91\x08\0", b"\0" * 8],  # An array as key.
        [b"\0" * (wire.MAX_HEADER_BYTES + 1)],
        [b"\x80"] * (wire.MAX_PARTS + 1),
    ],
)
def test_every_malformed_message_raises_one_kind_of_error(parts: list[bytes]) -> None:
    """`WireError`, whatever is wrong."""
    with pytest.raises(WireError):
        Reader[Any](FromClient).read(parts)


def test_a_map_as_key_is_refused_with_every_version_of_msgspec(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Some versions let the TypeError of an unhashable key through."""
    reader: Reader[Any] = Reader(FromClient)
    monkeypatch.setattr(reader, "_decode", lambda _: {cast("Any", {}): 1})
    with pytest.raises(WireError, match="unhashable"):
        reader.read([b"\x80"])


def test_an_impatient_end_is_missed_soon() -> None:
    """ZeroMQ counts its peer's patience in tenths of a second, and takes less than one for none."""
    assert [ping_ms(seconds)[2] for seconds in (0.1, 1.0)] == [100, 750]
