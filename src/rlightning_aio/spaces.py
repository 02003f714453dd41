"""`Anything`: the space of plain Python values, such as texts, messages and tool calls."""

from __future__ import annotations

from typing import Any, NoReturn

import gymnasium as gym

__all__ = ["Anything"]


class Anything(gym.Space[Any]):
    """Contains every Python value.

    A column of such values is a list with one value for each row. It may stand for a whole
    observation or action, or for a part of a `gymnasium.spaces.Dict` or `Tuple` beside arrays.
    """

    def __init__(self) -> None:
        super().__init__()

    def contains(self, x: Any) -> bool:
        """True of every value."""
        del x
        return True

    @property
    def is_np_flattenable(self) -> bool:
        """False: nothing is known of the values."""
        return False

    def sample(self, mask: Any = None, probability: Any = None) -> NoReturn:
        """Raises NotImplementedError: a policy must choose."""
        del mask, probability
        raise NotImplementedError(
            "spaces.Anything() has no random values; give a policy that chooses the actions"
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Anything)

    def __hash__(self) -> int:
        return hash(Anything)

    def __repr__(self) -> str:
        return "Anything()"
