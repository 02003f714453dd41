"""Estimates of an evaluation, for tables and for JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.evaluation import Estimate, Evaluation


__all__ = ["estimates", "with_interval"]


def estimates(found: Evaluation) -> dict[str, Any]:
    """Return the estimates by name, as JSON values."""
    named = {"total_reward": found.total_reward, "length": found.length, "success": found.success}
    return {name: None if one is None else asdict(one) for name, one in named.items()}


def with_interval(one: Estimate | None, words: Callable[[float], str]) -> tuple[str, str]:
    """Return the texts of an estimate and of its interval."""
    if one is None:
        return "-", "-"
    if one.low is None or one.high is None:
        return words(one.mean), "-"
    return words(one.mean), f"{words(one.low)} to {words(one.high)}"
