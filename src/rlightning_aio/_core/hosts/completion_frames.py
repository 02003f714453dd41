"""Completions as frames, from a worker or a Ray actor to the trainer's end of it.

A frame doesn't name the host, which the trainer's end knows. Payloads are pickles (see
`protocol.frames`).
Invariant: what can't be pickled, or can't be unpickled in the trainer, is an error of its request
(of its env, for the description of one), so each request still ends in one completion.
"""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Final

from rlightning_aio._core.hosts.messages import Built, NotBuilt, Raised, Result, Value
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.frames import Frame, FrameKind
from rlightning_aio.protocol.pickling import dumped

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.messages import Completion

SENDER: Final = 0
"""The host of completions that travel in frames; the trainer's end knows which it is."""


def frame_of(completion: Completion) -> Frame:
    """Return the frame that reports a completion."""
    try:
        if isinstance(completion, Result):
            payload = completion.out_of_band
            assert type(payload) is bytes  # As `completion_of` has made it.
            return Frame(FrameKind.RESULT, completion.entry, payload)
        entry = completion.entry if isinstance(completion, Value) else 0
        return Frame(FrameKind.OTHER, entry, dumped(completion, "what it returned"))
    except BaseException as error:
        if isinstance(completion, Built):
            last = len(completion.started) - 1
            return frame_of(NotBuilt(SENDER, last, ErrorText.of(error)))
        if isinstance(completion, Value):
            return frame_of(Raised(SENDER, completion.entry, ErrorText.of(error)))
        raise


def completion_in(host_id: int, frame: Frame) -> Completion:
    """Return the completion of a host that a frame reports."""
    kind, entry, payload = frame
    if kind == FrameKind.RESULT:
        return Result(host_id, entry, payload)
    try:
        return pickle.loads(payload)._replace(host_id=host_id)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # Unpickling may raise anything.
        text = ErrorText.of(error)
        # Of a worker's own words, only a value and a description of envs hold what others made.
        return Raised(host_id, entry, text) if entry else NotBuilt(host_id, 0, text)
