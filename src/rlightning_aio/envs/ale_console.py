"""`StickyConsole`: an Atari console whose sticky actions can be saved and restored.

With sticky actions, a console repeats its last action at random. ale-py's states have the random
generator, but not the last action. So this class keeps an earlier state and the calls since then:
a restore repeats the calls, which sets the last action, and then restores the state itself.
"""

from __future__ import annotations

import math
from typing import Any, Final

_CERTAIN: Final = 1e-15
"""Accepted probability that the console never executes an action given to it repeatedly."""
_FRAMES_BETWEEN_STATES: Final = 128
"""Saving a state takes as long as a frame, so it costs less than 1 % at this interval."""
_NOOP: Final = 0


def is_sticky(console: Any) -> bool:
    """Return True if an `ale_py.ALEInterface` repeats earlier actions at random."""
    # At probability 1 it always repeats the initial NOOP.
    return 0.0 < console.getFloat("repeat_action_probability") < 1.0


class StickyConsole:
    """Wraps an `ale_py.ALEInterface`, and records calls that act.

    Args:
        console: with a loaded game, before any action.
    """

    def __init__(self, console: Any) -> None:
        self._console = console
        probability = console.getFloat("repeat_action_probability")
        self._enough = math.ceil(math.log(_CERTAIN) / math.log(probability))
        self._begin()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_console":
            raise AttributeError(name)
        return getattr(self._console, name)

    def _begin(self) -> None:
        """Begin a new record, with NOOP as the last action."""
        self._earlier = self._clone()
        self._latest, self._since_earlier = self._earlier, 0
        self._calls = list[tuple[str, tuple[Any, ...]]]()

    def _clone(self) -> Any:
        return self._console.cloneState(include_rng=True)

    def loadROM(self, path: Any) -> None:  # noqa: N802  # ale-py's name.
        """Load a game, which resets the random generator and the last action."""
        self._console.loadROM(path)
        self._begin()

    def act(self, action: Any, strength: float = 1.0) -> Any:
        """Execute `action` for a frame, or repeat the last one. Return the reward."""
        self._note("act", action, strength)
        return self._console.act(action, strength)

    def reset_game(self) -> None:
        """Begin the next episode; the last action is kept."""
        self._note("reset_game")
        self._console.reset_game()

    def restoreState(self, state: Any) -> None:  # noqa: N802
        """Restore a state of ale-py's; the last action is kept."""
        self._note("restoreState", state)
        self._console.restoreState(state)

    def _note(self, name: str, *args: Any) -> None:
        calls = self._calls
        if len(calls) - self._since_earlier >= max(self._enough, _FRAMES_BETWEEN_STATES):
            # Calls before the latest state no longer have an effect.
            del calls[: self._since_earlier]
            self._since_earlier = len(calls)
            self._earlier, self._latest = self._latest, self._clone()
        calls.append((name, args))

    def save_state(self) -> Any:
        """Return the state of the console, and the calls that reproduce its last action."""
        return self._clone(), self._earlier, list(self._calls)

    def load_state(self, state: Any) -> None:
        """Restore the result of `save_state` of this or another console with the same game."""
        present, self._earlier, calls = state
        for _ in range(self._enough):
            self._console.act(_NOOP, 1.0)
        self._console.restoreState(self._earlier)
        for name, args in calls:
            getattr(self._console, name)(*args)
        self._console.restoreState(present)
        self._latest, self._calls, self._since_earlier = present, list(calls), len(calls)
