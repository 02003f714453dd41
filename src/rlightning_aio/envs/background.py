"""`Background`: a step that another thread computes, for simulators that release the GIL."""

from __future__ import annotations

import threading
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Background"]


def _nobody() -> None: ...


class Background:
    """Calls a function in a thread of its own, one call at a time.

    `start` and `wait` are the two halves of `FastPath.bare_step_async`. If the thread has not begun
    when the caller waits, the caller computes: that saves two switches between threads.

    Args:
        function: called with the argument of `start`; `wait` returns its result, or raises its
            error.

    Attributes:
        notify: called in the thread after each call that it made; set it before the first.
    """

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.notify: Callable[[], None] = _nobody
        self._function = function
        # Arguments; an empty tuple ends the thread.
        self._asked: SimpleQueue[tuple[Any] | tuple[()]] = SimpleQueue()
        self._answers: SimpleQueue[tuple[Any, BaseException | None]] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def start(self, argument: Any) -> None:
        """Start a call; `wait` must follow before the next one."""
        if self._thread is None:
            # A daemon, so that it can't keep the program from ending.
            self._thread = threading.Thread(target=self._run, name="env steps", daemon=True)
            self._thread.start()
        self._asked.put((argument,))

    def wait(self) -> Any:
        """Wait for the end of the call; its result."""
        try:
            arguments = self._asked.get_nowait()
        except Empty:
            return self._answer()
        return self._function(*arguments)

    def _answer(self) -> Any:
        try:
            result, error = self._answers.get()
        except BaseException:
            self._answers.get()  # An interrupt: nothing else may use the simulator until then.
            raise
        if error is not None:
            raise error from None
        return result

    def _run(self) -> None:
        while arguments := self._asked.get():
            try:
                answer = self._function(*arguments), None
            except BaseException as error:  # noqa: BLE001  # The waiter raises it.
                answer = None, error
            self._answers.put(answer)
            self.notify()

    def close(self) -> None:
        """End the thread, after the call that it makes."""
        if self._thread is not None:
            self._asked.put(())
            self._thread.join()
            self._thread = None
