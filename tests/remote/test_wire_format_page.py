"""``docs/wire-format.md`` describes the code."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
import msgspec
import numpy as np
import pytest
from run_python import blocks

from rlightning_aio.protocol.net import wire
from rlightning_aio.protocol.net.payload import Packed, SpaceLayout
from rlightning_aio.protocol.net.space_description import space_from
from rlightning_aio.protocol.net.wire import (
    ClientHello,
    ClientResult,
    Writer,
)

PAGE = (Path(__file__).parents[2] / "docs" / "wire-format.md").read_text()
MESSAGES = sorted(
    {*get_args(wire.FromClient), *get_args(wire.FromServer)}, key=lambda kind: kind.__name__
)
OBSERVATIONS = gym.spaces.Box(-1, 1, (2,), np.float32)
ACTIONS = gym.spaces.Discrete(2)


def written(message: Any, space: gym.Space[Any] | None = None, value: Any = None) -> list[bytes]:
    packed = Packed([], [])
    if space is not None:
        SpaceLayout(space, "value").pack(value, packed)
    return Writer().write(message, packed.frames)


EXAMPLES = [
    written(
        ClientResult(
            number=1,
            busy_ns=1000,
            reward=1.0,
            terminated=False,
            truncated=True,
            info={"force": np.array([1, 2], np.float32)},
        ),
        OBSERVATIONS,
        np.array([0.25, 1], np.float32),
    ),
]


def examples_of_the_page() -> list[list[bytes]]:
    """Return the parts of each message that the page shows byte by byte."""
    messages: list[list[bytes]] = []
    for block in blocks("hex", PAGE):
        parts = re.split(r"^# part \d+, (\d+) bytes\n", block, flags=re.MULTILINE)[1:]
        message: list[bytes] = []
        for length, lines in zip(parts[::2], parts[1::2], strict=True):
            part = bytes.fromhex(" ".join(line.partition("|")[0] for line in lines.splitlines()))
            assert len(part) == int(length)
            message.append(part)
        messages.append(message)
    return messages


def test_the_bytes_are_those_that_are_written() -> None:
    """The message of the example, header and frames."""
    assert examples_of_the_page() == EXAMPLES


@pytest.mark.parametrize("kind", MESSAGES)
def test_every_field_is_named(kind: Any) -> None:
    """A message's section lists its fields, and no others."""
    tag = kind.__struct_config__.tag
    titles = [title for title in re.findall(r"^### (.*)$", PAGE, re.MULTILINE) if tag in title]
    section = PAGE.partition(f"### {titles[0]}\n")[2].partition("\n#")[0]
    items = re.findall(r"^- (`.*?) \(", section, re.MULTILINE)
    assert re.findall(r"`(\w+)`", " ".join(items)) == [*kind.__struct_fields__]


@pytest.mark.parametrize("dtype", wire.DTYPES)
def test_every_dtype_is_named(dtype: str) -> None:
    """The page lists all dtypes of arrays."""
    assert f"`{dtype}`" in PAGE


def test_the_limits_are_those_of_the_code() -> None:
    """Those of headers, frames and parts."""
    header, hello = wire.MAX_HEADER_BYTES >> 20, wire.MAX_HELLO_BYTES >> 10
    limits = " ".join(PAGE.partition("## Limits")[2].split())
    assert f"A header has at most {header} MiB (that of a hello {hello} KiB)" in limits
    assert f"a frame or an array of a space {wire.MAX_FRAME_BYTES >> 20} MiB" in limits
    assert f"a message {wire.MAX_PARTS:,} parts" in limits


def test_the_hello_is_read() -> None:
    """It is that of the client whose messages follow, with the defaults left out."""
    (text,) = blocks("js", PAGE)
    hello = msgspec.convert(json.loads(text), ClientHello)
    assert hello.version == wire.VERSION
    spaces = (hello.observation_space, hello.action_space)
    assert tuple(map(space_from, spaces)) == (OBSERVATIONS, ACTIONS)
