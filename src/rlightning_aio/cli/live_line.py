"""`LiveLine`: one line on stderr that says how far a command is; plain lines without a terminal.

Rule: the line is one plain text, which Rich shows unchanged, because drawing takes time from the
envs. Left out: what a command says in it.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING, Final, Self

from rich.live import Live
from rich.text import Text

from rlightning_aio.cli.terminal import err

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Sequence

__all__ = ["LiveLine", "time_left"]

_REFRESH_SECONDS: Final = 0.25
_SPINNER: Final = "⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏"
_BAR: Final = 16


class LiveLine:
    """See the module.

    Args:
        parts: called with the time (monotonic); returns the parts of the line, the most important
            first, of which a narrow terminal shows fewer.
        share: likewise; returns how much is done, from 0 to 1, or None for a line without a bar.
        by_thread: a thread draws it, for a command that blocks; else `show` does.
    """

    def __init__(
        self,
        parts: Callable[[float], Sequence[str]],
        share: Callable[[float], float | None] = lambda _now: None,
        *,
        by_thread: bool = False,
    ) -> None:
        self._parts, self._share = parts, share
        self._console = err()
        self.is_live = self._console.is_terminal
        self._by_thread = by_thread
        self._next_at = 0.0
        self._live: Live | None = None

    def __enter__(self) -> Self:
        if self.is_live:
            # It draws at once.
            self._live = Live(
                console=self._console,
                get_renderable=self._drawn,
                auto_refresh=self._by_thread,
                refresh_per_second=1 / _REFRESH_SECONDS,
                transient=True,
            )
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Remove the line; idempotent."""
        if self._live is not None:
            self._live.stop()

    def say(self, words: str) -> None:
        """Print a line that stays."""
        self._console.print(words, soft_wrap=True, markup=False)

    def announce(self, words: str) -> None:
        """Print a line that stays, or draw the live line anew, whose parts say the same."""
        if self.is_live:
            self.show()
        else:
            self.say(words)

    def due(self) -> bool:
        """Return True if the line is old enough to be drawn again."""
        return time.monotonic() >= self._next_at

    def show(self) -> None:
        """Draw the line."""
        self._next_at = time.monotonic() + _REFRESH_SECONDS
        if self._live is not None:
            self._live.refresh()

    @contextlib.asynccontextmanager
    async def ticking(self) -> AsyncGenerator[None]:
        """Keep drawing while this context is open and the event loop is free."""
        if not self.is_live:
            yield
            return
        ticker = asyncio.create_task(self._tick())
        try:
            yield
        finally:
            ticker.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await ticker

    async def _tick(self) -> None:
        while True:
            if self.due():
                self.show()
            await asyncio.sleep(_REFRESH_SECONDS)

    def _drawn(self) -> Text:
        now = time.monotonic()
        head = _SPINNER[int(now / _REFRESH_SECONDS) % len(_SPINNER)] + " "
        share = self._share(now)
        if share is not None:
            done = round(share * _BAR)
            head += "━" * done + "─" * (_BAR - done) + " "
        text = head + fitting(self._parts(now), self._console.width - len(head))
        return Text(text, no_wrap=True, overflow="crop")


def fitting(parts: Sequence[str], room: int) -> str:
    """Return the first of `parts`, as many as fit."""
    text = parts[0]
    for part in parts[1:]:
        if len(text) + 2 + len(part) > room:
            break
        text += "  " + part
    return text


def time_left(seconds: float) -> str:
    """Return hours, minutes and seconds that are left, in words."""
    whole = max(0, round(seconds))
    hours, minutes = divmod(whole // 60, 60)
    clock = f"{hours}:{minutes:02}" if hours else f"{minutes}"
    return f"{clock}:{whole % 60:02} left"
