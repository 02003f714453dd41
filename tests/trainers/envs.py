"""An env as TRL wants it."""

from __future__ import annotations

import os
import time
from typing import Any

__all__ = ["Adder"]


class Adder:
    """An env as TRL wants it."""

    def reset(self, start: int = 0, seconds: float = 0.0, **row: Any) -> str:
        """Begin."""
        time.sleep(seconds)
        self.total = start
        return f" It is {start}."

    def add(self, number: int) -> str:
        """Add a number.

        Args:
            number: what is added
        """
        if number == 13:
            raise ValueError("13 brings bad luck")
        self.total += number
        return f"It is {self.total}."

    def wait(self, seconds: int) -> str:
        """Wait.

        Args:
            seconds: for how long
        """
        time.sleep(seconds)
        return "done"

    def die(self) -> str:
        """End the process."""
        os._exit(3)

    def get_reward(self) -> float:
        return float(self.total)
