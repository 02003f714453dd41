"""Ctrl-C at a chosen line of this library, in a call of a synchronous group."""

from __future__ import annotations

import signal
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType


DRIVER = ("/group/api/sync.py", "/group/drivers/sync_driver.py", "/collecting/procedure.py")


def press() -> None:
    """Press Ctrl-C."""
    signal.raise_signal(signal.SIGINT)


class Strike:
    """A trace function that presses Ctrl-C at the n-th line of this library.

    Lines of the driver count only while it holds Ctrl-C back: where it doesn't any more, nothing is
    called before it returns, so Python doesn't look for signals there.

    Attributes:
        left: lines until then; 0 afterwards.
    """

    def __init__(self, line: int) -> None:
        self.left = line

    def __call__(self, frame: FrameType, event: str, arg: Any) -> Any:
        return self._line if "/rlightning_aio/" in frame.f_code.co_filename else None

    def _line(self, frame: FrameType, event: str, arg: Any) -> Any:
        if event == "line" and self.left and self._counts(frame.f_code.co_filename):
            self.left -= 1
            if not self.left:
                press()
        return self._line

    def _counts(self, path: str) -> bool:
        holds_back = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        return holds_back or not path.endswith(DRIVER)


def struck(line: int, call: Callable[[], Any]) -> tuple[bool, bool, Any]:
    """Make a call with Ctrl-C at that line.

    Returns True if the line was reached, True if the call was interrupted, and what it returned.
    """
    strike, interrupted, returned = Strike(line), False, None
    sys.settrace(strike)
    try:
        returned = call()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        sys.settrace(None)
    reached = strike.left == 0
    assert reached or not interrupted
    return reached, interrupted, returned
