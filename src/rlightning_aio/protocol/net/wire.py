"""The messages between a trainer and the env clients that dial in, as bytes.

Rule: a message is one msgpack header and any number of raw array frames; what arrives
is checked for size, type and shape before it is used, and any fault raises `WireError` and nothing
else. docs/wire-format.md describes the format for people. Deliberately left out: I/O, pickle, and
the order of messages (see `server_session` and `client_session`).
"""

from __future__ import annotations

from math import prod
from typing import TYPE_CHECKING, Annotated, Any, Final, Generic, Literal, TypeAlias, TypeVar, cast

import msgspec
import numpy as np
from msgspec import Meta, Struct

from rlightning_aio.trees import as_array
from rlightning_aio.types import Autoreset

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

VERSION: Final = 3
MAX_HEADER_BYTES: Final = 4 << 20
MAX_HELLO_BYTES: Final = 256 << 10
"""Size of a hello's header; reading one takes 50 ms at most."""
MAX_FRAME_BYTES: Final = 64 << 20
MAX_PARTS: Final = 1024
"""Header and frames of one message."""
MAX_NAME_LENGTH: Final = 128
DEFAULT_HEARTBEAT: Final = 5.0
HARDWARE_HEARTBEAT: Final = 1.0
MIN_HEARTBEAT: Final = 0.4
MAX_HEARTBEAT: Final = 86400
"""Seconds within which an end that is gone is found."""
_TTL_MS: Final = (100, 6553599)
"""The shortest that ZMQ doesn't take for none, and the longest that it accepts."""
HANDSHAKE_SECONDS: Final = 2.0
"""Time for the handshake of a connection."""

DTYPES: Final[Mapping[str, np.dtype[Any]]] = {
    # From the name: a dtype that is made otherwise equals that of arrays, and is not identical.
    name: np.dtype(np.dtype(name).newbyteorder("<").str)
    for name in (
        "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
        "float16", "float32", "float64",
    )
}  # fmt: skip
"""Dtypes of arrays; little-endian on the wire."""

_ARRAY_EXTENSION: Final = 1
_MAX_AXES: Final = 32
_MAX_DEPTH: Final = 32
"""Levels of maps in which `portable` looks for what can't be sent."""

Part: TypeAlias = bytes | memoryview
Compression: TypeAlias = Literal["zstd"]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME_LENGTH)]


class WireError(ValueError):
    """The format does not allow a message that arrived."""


class Untransferable(ValueError):
    """The format has no form for a value that should be sent."""


def ping_ms(heartbeat: float) -> tuple[int, int, int]:
    """Return how often ZMQ pings a peer that may be silent for `heartbeat` seconds, how long it
    waits for a sign of life then, and after which silence the peer is to give up, in milliseconds.
    """
    least, most = _TTL_MS
    ttl = min(max(least, int(750 * heartbeat)), most)
    return int(250 * heartbeat), int(500 * heartbeat), ttl


class ClientHello(Struct, tag="hello", tag_field="type", kw_only=True):
    """Client: I own an env, let me in. Answered by `Welcome` or `Refusal`."""

    version: Count
    name: Name
    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    num_envs: Annotated[int, Meta(ge=1, le=1 << 20)] = 1
    agents: Annotated[list[Name], Meta(max_length=256)] = []
    max_episode_steps: Annotated[int, Meta(ge=1, le=2**63 - 1)] | None = None
    autoreset: Autoreset = "disabled"
    """Behaviour of sub-environments after an episode's end; see `EnvMeta`."""
    free_actions: bool = False
    """Actions may not fit the action space: the client transforms them."""
    reads_extras: bool = False
    """The client reads columns that the policy attaches to the action."""
    hardware: bool = True
    """The env moves something real, which only its user's reset may set in motion."""
    compression: Compression | None = None
    """Of the observations' frames of bytes, such as images."""


class Welcome(Struct, tag="welcome", tag_field="type", kw_only=True):
    """Server: you are in. The first request will be a reset; until then, nothing moves."""

    env_id: str
    heartbeat: Annotated[float, Meta(ge=MIN_HEARTBEAT, le=MAX_HEARTBEAT)]
    """Seconds within which either end finds that the other is gone."""


class Refusal(Struct, tag="refusal", tag_field="type", kw_only=True):
    """Server: you are not in. ``retry`` is true if the same hello may succeed later."""

    text: str
    retry: bool


class Step(Struct, tag="step", tag_field="type", kw_only=True, omit_defaults=True):
    """Server: step the env. The action is in frames, or in ``action`` where it is free."""

    number: Count
    texts: list[str] = []
    action: Any = None
    extras: dict[str, Any] = {}


class Reset(Struct, tag="reset", tag_field="type", kw_only=True, omit_defaults=True):
    """Server: reset the env."""

    number: Count
    seed: int | list[int] | None = None
    options: dict[str, Any] | None = None


class ClientResult(Struct, tag="result", tag_field="type", kw_only=True, omit_defaults=True):
    """Client: the result of request ``number``. The observation is in frames."""

    number: Count
    busy_ns: Count = 0
    """Duration of the env's call."""
    sent_ns: Count = 0
    """Time of the result, in ns since the epoch by the client's clock; 0: unknown."""
    reward: float | None = None
    terminated: bool | None = None
    truncated: bool | None = None
    texts: list[str] = []
    info: dict[str, Any] = {}
    extra: dict[str, Any] = {}


class Failure(Struct, tag="error", tag_field="type", kw_only=True, omit_defaults=True):
    """Client: request ``number`` raised."""

    number: Count
    exception_type: str
    text: str
    traceback: str
    blame: str = ""
    """Whom the env names, see `Outcome`."""


class Bye(Struct, tag="bye", tag_field="type", kw_only=True):
    """Either side: the session is over, for this reason."""

    reason: str = ""


FromClient: TypeAlias = ClientHello | ClientResult | Failure | Bye
FromServer: TypeAlias = Welcome | Refusal | Step | Reset | Bye
Message = TypeVar("Message")

_OPEN_FIELDS: Final[Mapping[type[Struct], tuple[str, ...]]] = {
    Step: ("extras",),
    Reset: ("options",),
    ClientResult: ("info", "extra"),
}
"""Fields whose contents an env or a policy has made."""


class ArrayForm:
    """The form of a frame that holds an array of one dtype and shape."""

    def __init__(self, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        self.dtype = dtype
        self.shape = shape
        self.size = prod(shape) * dtype.itemsize
        self._is_bool = dtype.kind == "b"

    def read(self, part: Part) -> NDArray[Any]:
        """`part` as an array: a read-only view of it.

        Raises:
            WireError: it has another size, or is no array of bools.
        """
        if len(part) != self.size:
            raise WireError(
                f"a frame for {self.dtype}{[*self.shape]} has {len(part)} bytes, not {self.size}"
            )
        if not self.size:
            return np.zeros(self.shape, self.dtype)
        array = np.frombuffer(part, self.dtype).reshape(self.shape)
        # A bool with any other byte equals neither True nor False.
        if self._is_bool and array.view(np.uint8).max() > 1:
            raise WireError("a frame of bools holds bytes other than 0 and 1")
        return array


class Reader(Generic[Message]):
    """Reads messages of the kinds `kinds`, which must be a union of message types."""

    def __init__(self, kinds: Any) -> None:
        decoder = msgspec.msgpack.Decoder(kinds, ext_hook=self._array)
        self._decode = cast("Callable[[Part], Message]", decoder.decode)
        self._reference = msgspec.msgpack.Decoder(tuple[str, list[Count], Count])
        self._frames: Sequence[Part] = ()
        self._named: set[int] = set()

    def read(self, parts: Sequence[Part]) -> tuple[Message, Sequence[Part]]:
        """Return the message in `parts`, and its frames.

        Raises:
            WireError: they are no valid message.
        """
        if not 1 <= len(parts) <= MAX_PARTS:
            raise WireError(f"a message has {len(parts)} parts; 1 to {MAX_PARTS} are allowed")
        header, frames = parts[0], parts[1:]
        if len(header) > MAX_HEADER_BYTES:
            raise WireError(f"a header has {len(header)} bytes; {MAX_HEADER_BYTES} are allowed")
        self._frames = frames
        self._named.clear()
        try:
            return self._decode(header), frames
        except WireError:
            raise
        # Not msgspec's own: what bad UTF-8 and deep nesting raise, and keys that have no hash.
        except (msgspec.MsgspecError, TypeError, ValueError, RecursionError) as error:
            raise WireError(f"a header can't be read: {error}") from None

    def _array(self, code: int, data: memoryview) -> NDArray[Any]:
        if code != _ARRAY_EXTENSION:
            raise WireError(f"a header uses the unknown extension {code}")
        dtype_name, shape, position = self._reference.decode(data)
        dtype = DTYPES.get(dtype_name)
        # Each frame may be named once; otherwise a small message could expand to any size.
        is_there = position < len(self._frames) and position not in self._named
        if dtype is None or not is_there or len(shape) > _MAX_AXES:
            raise WireError(f"a header names an array {dtype_name!r}{shape} that is not there")
        self._named.add(position)
        return ArrayForm(dtype, tuple(shape)).read(self._frames[position]).copy()


class Writer:
    """Writes messages; arrays found in the header's values become frames."""

    def __init__(self) -> None:
        self._encode = msgspec.msgpack.Encoder(enc_hook=self._plain).encode
        self._frames: list[bytes] = []

    def write(self, message: Struct, frames: list[bytes] | None = None) -> list[bytes]:
        """Return the parts of `message`: header, `frames`, and arrays within the header.

        Raises:
            Untransferable: a value has no form in this format, is too large or nested too deep.
        """
        self._frames = frames = [] if frames is None else frames
        for name in _OPEN_FIELDS.get(type(message), ()):
            _check_open(name, getattr(message, name))
        try:
            header = self._encode(message)
        except Untransferable:
            raise
        # What msgspec raises for ints beyond 64 bits, lone surrogates, cycles.
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise Untransferable(str(error)) from None
        if len(header) > MAX_HEADER_BYTES:
            raise Untransferable(f"{len(header)} bytes; {MAX_HEADER_BYTES} are allowed")
        if len(frames) >= MAX_PARTS:
            raise Untransferable(f"{len(frames)} arrays; fewer than {MAX_PARTS} are allowed")
        return [header, *frames]

    def _plain(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            return cast("Any", value.item())
        if hasattr(value, "detach") or isinstance(value, np.ndarray):
            return self._framed(as_array(cast("Any", value)))
        raise Untransferable(f"a {type(value).__qualname__} can't travel")

    def _framed(self, array: NDArray[Any]) -> Any:
        dtype = DTYPES.get(array.dtype.name)
        if dtype is None:
            return array.tolist()
        if array.nbytes > MAX_FRAME_BYTES:
            raise Untransferable(
                f"an array has {array.nbytes} bytes; {MAX_FRAME_BYTES} are allowed"
            )
        reference = (array.dtype.name, array.shape, len(self._frames))
        self._frames.append(array.astype(dtype, copy=False).tobytes())
        return msgspec.msgpack.Ext(_ARRAY_EXTENSION, msgspec.msgpack.encode(reference))


def _check_open(name: str, values: dict[Any, Any] | None) -> None:
    """Raise `Untransferable` if the reader of a field would refuse `values`."""
    for key in values or ():
        # It could be encoded, but the reader would refuse the whole message.
        if not isinstance(key, str):
            raise Untransferable(f"{name} has the key {key!r}; keys must be strings")


def portable(values: Mapping[str, Any], lost: list[str]) -> dict[str, Any]:
    """Return the values that can be sent; append the paths of the others to `lost`."""
    kept = _portable(dict(values), "", lost, Writer(), depth=0)
    return cast("dict[str, Any]", kept)


class _Lost:
    """Stands for a value that cannot be sent."""


class _Value(Struct):
    value: Any


def _portable(value: Any, path: str, lost: list[str], writer: Writer, depth: int) -> Any:
    if isinstance(value, dict) and depth < _MAX_DEPTH:
        kept: dict[Any, Any] = {}
        # Readers require strings at the top level, and accept numbers below.
        kinds = str | int if depth else str
        for key, inner in cast("dict[Any, Any]", value).items():
            place = f"{path}.{key}" if path else str(key)
            portable_inner = _portable(inner, place, lost, writer, depth + 1)
            if not isinstance(key, kinds):
                lost.append(place)
            elif portable_inner is not _Lost:
                kept[key] = portable_inner
        return kept
    try:
        writer.write(_Value(value))
    except Untransferable:
        lost.append(path)
        return _Lost
    return cast("Any", value)
