"""JSON that every reader accepts.

Rule: NaN and infinity, which JSON lacks a number for, are null.
"""

from __future__ import annotations

import json
import math
from typing import Any, cast

__all__ = ["finite", "json_of"]


def json_of(value: Any, *, indent: int | None = None) -> str:
    """Return `value`, made of dicts, lists, texts and numbers, as JSON."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(finite(value), indent=indent, allow_nan=False)


def finite(value: Any) -> Any:
    """Return `value` with None in place of NaN and infinity."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(held) for key, held in cast("dict[Any, Any]", value).items()}
    if isinstance(value, (list, tuple)):
        return [finite(held) for held in cast("list[Any]", value)]
    return value
