"""Completions as frames, from a worker or a Ray actor to the trainer's end of it.

A frame doesn't name the host, which the trainer's end knows. Payloads are pickles (see
`protocol.frames`).
Invariant: what can't be pickled, or can't be unpickled in the trainer, is an error of its request
(of its env, for the description of one), so each request still ends in one completion.
"""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio._core.hosts.messages import (
    Attached,
    Built,
    Closed,
    ErrorText,
    Lost,
    Moved,
    NewSchema,
    NotBuilt,
    Raised,
    Result,
    Value,
)
from rlightning_aio.protocol.frames import Frame, FrameKind
from rlightning_aio.protocol.pickling import dumped, dumped_with_code

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.hosts.messages import Completion

SENDER: Final = 0
"""The host of completions that travel in frames; the trainer's end knows which it is."""


def frame_of(completion: Completion) -> Frame:
    """Return the frame that reports a completion."""
    try:
        return Frame(*_ENCODED[type(completion)](completion))
    except BaseException as error:
        text = pickle.dumps(ErrorText.of(error))
        if isinstance(completion, Built):
            return Frame(FrameKind.START_ERROR, len(completion.started) - 1, text)
        if isinstance(completion, Result | Value):
            return Frame(FrameKind.ERROR, completion.entry, text)
        raise


def completion_in(host_id: int, frame: Frame) -> Completion:
    """Return the completion of a host that a frame reports."""
    kind, number, payload = frame
    try:
        return _DECODED[kind](host_id, number, payload)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # Unpickling may raise anything.
        if kind == FrameKind.STARTED:
            return NotBuilt(host_id, 0, ErrorText.of(error))
        if kind == FrameKind.VALUE:
            return Raised(host_id, number, ErrorText.of(error))
        raise


def _encoded_result(result: Result) -> tuple[FrameKind, int, bytes]:
    payload = result.out_of_band
    if type(payload) is not bytes:
        payload = dumped(payload, "the result")
    return FrameKind.RESULT, result.entry, payload


_ENCODED: Final[dict[type, Callable[[Any], tuple[FrameKind, int, bytes]]]] = {
    Built: lambda it: (FrameKind.STARTED, 0, dumped_with_code(it.started)),
    NotBuilt: lambda it: (FrameKind.START_ERROR, it.env_index, pickle.dumps(it.error)),
    Attached: lambda _: (FrameKind.ATTACHED, 0, b""),
    NewSchema: lambda it: (FrameKind.INFO_SCHEMA, it.number, pickle.dumps(it.schema)),
    Result: _encoded_result,
    Value: lambda it: (FrameKind.VALUE, it.entry, dumped(it.value, "what it returned")),
    Raised: lambda it: (FrameKind.ERROR, it.entry, pickle.dumps(it.error)),
    Lost: lambda it: (FrameKind.LOST, it.env_index, pickle.dumps(it[2:])),
    Moved: lambda it: (FrameKind.MOVED, it.entry, pickle.dumps(it[2:])),
    Closed: lambda it: (FrameKind.CLOSED, 0, pickle.dumps(it.errors)),
}
"""By the class of a completion: kind, number and payload of its frame."""

_DECODED: Final[dict[int, Callable[[int, int, bytes], Completion]]] = {
    FrameKind.STARTED: lambda host, _, payload: Built(host, pickle.loads(payload)),
    FrameKind.START_ERROR: lambda host, index, payload: NotBuilt(
        host, index, pickle.loads(payload)
    ),
    FrameKind.ATTACHED: lambda host, _, __: Attached(host),
    FrameKind.INFO_SCHEMA: lambda host, number, payload: NewSchema(
        host, number, pickle.loads(payload)
    ),
    FrameKind.RESULT: Result,
    FrameKind.VALUE: lambda host, entry, payload: Value(host, entry, pickle.loads(payload)),
    FrameKind.ERROR: lambda host, entry, payload: Raised(host, entry, pickle.loads(payload)),
    FrameKind.LOST: lambda host, index, payload: Lost(host, index, *pickle.loads(payload)),
    FrameKind.MOVED: lambda host, entry, payload: Moved(host, entry, *pickle.loads(payload)),
    FrameKind.CLOSED: lambda host, _, payload: Closed(host, pickle.loads(payload)),
}
"""By the kind of a frame: its completion, of a host, a number and a payload."""
