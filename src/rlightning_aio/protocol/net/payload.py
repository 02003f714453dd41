"""Observations, actions, rewards and flags as raw array frames, by their spaces.

Rule: both ends derive the same order of frames from the announced spaces, so a frame has no
description. A frame of another size is refused before it is used, and a value of another shape
before anything is sent. Deliberately left out: Text in frames (strings travel in the header), and
messages (`wire`).
"""

from __future__ import annotations

from importlib import import_module
from math import prod
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rlightning_aio.protocol.columns import (
    Leaf,
    Misfit,
    assemble,
    fitted,
    in_brackets,
    placed,
)
from rlightning_aio.protocol.net.wire import DTYPES, ArrayForm, Part, WireError
from rlightning_aio.trees import as_array, mapped, tree_of, walked

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.protocol.net.wire import Compression

MAX_HEAD = 1 << 20
"""Rewards of one result."""


class Packed(NamedTuple):
    """Encoded values: frames, and strings that travel in the header."""

    frames: list[bytes]
    texts: list[str]


class _Arriving(NamedTuple):
    frames: Iterator[Part]
    texts: Iterator[str]


class SpaceLayout:
    """The encoding of one space's values: one frame for each array, in the space's order.

    Args:
        space: made of Box, Discrete, MultiBinary, MultiDiscrete, Dict, Tuple and Text.
        what: what messages call a value, such as ``"observation"``.
        compression: of arrays of `_LEAST_BYTES` uint8 at least, such as images.

    Attributes:
        num_frames, num_texts: of one value.

    Raises:
        WireError: its library is not installed.
    """

    def __init__(
        self, space: gym.Space[Any], what: str, compression: Compression | None = None
    ) -> None:
        zstd = _Zstd() if compression else None
        parts = walked(tree_of(space))
        codecs = [_codec_of(part, what + in_brackets(path), zstd) for path, part in parts]
        self._what = what
        self._tree = assemble(space, iter(codecs))
        self._only = self._tree.form if type(self._tree) is _Array else None
        self.num_texts = sum(type(codec) is _Text for codec in codecs)
        self.num_frames = len(codecs) - self.num_texts

    def pack(self, value: Any, packed: Packed) -> None:
        """Append `value` to `packed`; the bytes are copies.

        Raises:
            Misfit: it doesn't fit the space; the message says what was expected and found.
        """
        placed(lambda codec, part, _: codec.pack(part, packed), self._tree, value, self._what)

    def unpack(self, frames: Sequence[Part], texts: Sequence[str]) -> Any:
        """Return the value at the start of `frames`; its arrays are read-only views of them.

        Raises:
            WireError: frames are missing or have another size, or a text is not in its space.
        """
        if len(frames) < self.num_frames or len(texts) != self.num_texts:
            raise WireError(
                f"{len(frames)} frames and {len(texts)} texts can't hold a value of "
                f"{self.num_frames} and {self.num_texts}"
            )
        if self._only is not None:
            return self._only.read(frames[0])
        arriving = _Arriving(iter(frames), iter(texts))
        return mapped(lambda codec: codec.unpack(arriving), self._tree)


class _Array:
    def __init__(self, space: gym.Space[Any], what: str) -> None:
        shape = tuple(cast("tuple[int, ...]", space.shape))
        self.form = ArrayForm(DTYPES[np.dtype(space.dtype).name], shape)
        self._leaf = Leaf((), shape, self.form.dtype)
        self._what = what

    def pack(self, value: Any, packed: Packed) -> None:
        array = as_array(value)
        form = self.form
        if array.dtype != form.dtype or array.shape != form.shape:
            array = fitted(array, self._leaf, self._what).astype(form.dtype)
        packed.frames.append(array.tobytes())

    def unpack(self, arriving: _Arriving) -> Any:
        return self.form.read(next(arriving.frames))


class _Zstd:
    """Compresses frames, and expands those that state the size that they should have."""

    def __init__(self) -> None:
        try:
            zstd = import_module("zstandard")
        except ImportError:
            raise WireError(
                "compression: zstd needs zstandard: pip install 'rlightning-aio[zstd]'"
            ) from None
        self._fault: type[Exception] = zstd.ZstdError
        self._size_of = zstd.frame_content_size
        self._expand = zstd.ZstdDecompressor().decompress
        self.compress: Callable[[bytes], bytes] = zstd.ZstdCompressor(level=1).compress

    def expanded(self, part: Part, size: int) -> bytes:
        """Return the `size` bytes of a frame; nothing is allocated if it states another size.

        Raises:
            WireError: it does, or can't be expanded.
        """
        try:
            if (stated := self._size_of(part)) != size:
                raise WireError(f"a compressed frame states {stated} bytes, not {size}")
            return self._expand(part, max_output_size=size, allow_extra_data=False)
        except self._fault as error:
            raise WireError(f"a compressed frame can't be read: {error}") from None


_LEAST_BYTES: Final = 1024
"""Of an array that is compressed."""


class _Compressed(_Array):
    """An array of bytes; a frame of its full size is not compressed."""

    def __init__(self, space: gym.Space[Any], what: str, zstd: _Zstd) -> None:
        super().__init__(space, what)
        self._zstd = zstd

    def pack(self, value: Any, packed: Packed) -> None:
        super().pack(value, packed)
        small = self._zstd.compress(packed.frames[-1])
        if len(small) < self.form.size:
            packed.frames[-1] = small

    def unpack(self, arriving: _Arriving) -> Any:
        part = next(arriving.frames)
        if len(part) < self.form.size:
            part = self._zstd.expanded(part, self.form.size)
        return self.form.read(part)


class _Number(_Array):
    """A Discrete value, which comes back as a NumPy scalar."""

    def __init__(self, space: spaces.Discrete, what: str) -> None:
        super().__init__(space, what)
        self._space = space
        self._values = range(int(space.start), int(space.start + space.n))

    def pack(self, value: Any, packed: Packed) -> None:
        super().pack(value, packed)
        number = self.form.read(packed.frames[-1])[()]
        if int(number) not in self._values:
            packed.frames.pop()
            raise Misfit(f"{self._what} is {number}, which is not in {self._space}")

    def unpack(self, arriving: _Arriving) -> Any:
        number = super().unpack(arriving)[()]
        if int(number) not in self._values:
            raise WireError(f"{self._what} is {number}, which is not in its space")
        return number


class _Text:
    def __init__(self, space: spaces.Text, what: str) -> None:
        self._space = space
        self._what = what

    def pack(self, value: Any, packed: Packed) -> None:
        if value not in self._space:
            raise Misfit(f"{self._what} is {value!r}, which is not in {self._space}")
        packed.texts.append(value)

    def unpack(self, arriving: _Arriving) -> Any:
        text = next(arriving.texts)
        if text not in self._space:
            raise WireError(f"{self._what} is a text that is not in its space")
        return text


def _codec_of(space: gym.Space[Any], what: str, zstd: _Zstd | None) -> _Array | _Text:
    if isinstance(space, spaces.Text):
        return _Text(space, what)
    if isinstance(space, spaces.Discrete):
        return _Number(space, what)
    shape = cast("tuple[int, ...]", space.shape)
    if zstd is not None and space.dtype == np.uint8 and prod(shape) >= _LEAST_BYTES:
        return _Compressed(space, what, zstd)
    return _Array(space, what)


class ResultFields(NamedTuple):
    """One env's result as values.

    Of a multi-agent env, reward and flags are dicts by agent before they are packed, and arrays in
    the order of the agents when they have arrived.
    """

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any


class ResultLayout:
    """The encoding of results: an observation, then rewards and flags.

    A single env's reward and flags are numbers in the header. Those of several
    sub-environments or agents are three frames, float64, bool and bool, of shape `head`.

    Attributes:
        head: ``()``, ``(num_envs,)``, and with agents ``(num_agents,)`` or
            ``(num_agents, num_envs)``.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        num_envs: int,
        agents: Sequence[str],
        compression: Compression | None = None,
    ) -> None:
        self._observation = SpaceLayout(observation_space, "observation", compression)
        self._agents = tuple(agents)
        self._each = (num_envs,) if num_envs > 1 else ()
        self.head = (len(agents), *self._each) if agents else self._each
        self._columns = [ArrayForm(DTYPES[name], self.head) for name in ("float64", "bool", "bool")]
        if prod(self.head) > MAX_HEAD:
            raise WireError(f"{prod(self.head)} rewards in one result; {MAX_HEAD} are allowed")

    def pack(self, outcome: ResultFields, packed: Packed) -> ResultFields:
        """Append `outcome` to `packed`; return the part that belongs in the header.

        Raises:
            Misfit: it doesn't fit the layout.
        """
        self._observation.pack(outcome.observation, packed)
        if not self.head:
            _, reward, terminated, truncated = outcome
            return ResultFields(None, float(reward), bool(terminated), bool(truncated))
        for name, dtype in (("reward", "float64"), ("terminated", "bool"), ("truncated", "bool")):
            column = self._column(getattr(outcome, name), name)
            packed.frames.append(column.astype(DTYPES[dtype]).tobytes())
        return ResultFields(None, None, None, None)

    def _column(self, value: Any, name: str) -> NDArray[Any]:
        try:
            if self._agents:
                parts = (as_array(value.get(agent, 0)) for agent in self._agents)
                return np.stack([np.broadcast_to(part, self._each) for part in parts])
            return np.broadcast_to(as_array(value), self.head)
        except ValueError as error:
            raise Misfit(f"last_{name} doesn't have the shape {self.head}: {error}") from None

    def unpack(
        self, frames: Sequence[Part], texts: Sequence[str], header: tuple[Any, Any, Any]
    ) -> ResultFields:
        """Return the outcome at the start of `frames`; `header` is the part that `pack` returned.

        Raises:
            WireError: it doesn't fit the layout.
        """
        observation = self._observation.unpack(frames, texts)
        if not self.head:
            if None in header:
                raise WireError("a result lacks its reward or a flag")
            return ResultFields(observation, *header)
        rest = frames[self._observation.num_frames :]
        if len(rest) < 3:
            raise WireError("a result lacks the frames of its rewards and flags")
        columns = (form.read(part) for form, part in zip(self._columns, rest, strict=False))
        return ResultFields(observation, *columns)
