"""`Cameras`: pictures for the observations of an arm, within a time limit.

Rule: a camera that hangs holds a thread of its own, and never the arm.
"""

from __future__ import annotations

import queue
import time
from threading import Thread
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    _Answer = tuple[int, dict[str, Any] | BaseException]


class Cameras:
    """Calls a function of the user in a thread, always the same one.

    Args:
        read: returns ``{name: image}``.
        timeout: seconds that it may take.
    """

    def __init__(self, read: Callable[[], dict[str, Any]], timeout: float) -> None:
        self._read, self._timeout = read, timeout
        self._asked: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[_Answer] = queue.SimpleQueue()
        self._last_number = 0
        Thread(target=self._serve, name="cameras", daemon=True).start()

    def _serve(self) -> None:
        while number := self._asked.get():
            try:
                self._answers.put((number, self._read()))
            except BaseException as error:  # noqa: BLE001 - it goes to the caller
                self._answers.put((number, error))

    def read(self) -> dict[str, Any]:
        """Return new images by name.

        Raises:
            TimeoutError: they did not come in time.
            BaseException: what the function raised.
        """
        due = time.monotonic() + self._timeout
        self._last_number += 1
        self._asked.put(self._last_number)
        while True:
            try:
                number, answer = self._answers.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                raise TimeoutError(
                    f"cameras.read returned no images within {self._timeout:g} s (camera_timeout)"
                ) from None
            if number == self._last_number:  # Others are of calls that have given up.
                break
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def close(self) -> None:
        """End the thread, once its present call has returned."""
        self._asked.put(0)
