"""JSON that every reader accepts.

Rule: NaN and infinity, which JSON lacks a number for, are null.
"""

from __future__ import annotations

import json
import math
from typing import Any

from rlightning_aio.trees import converted


def json_of(value: Any, *, indent: int | None = None) -> str:
    """Return `value`, made of dicts, lists, texts and numbers, as JSON."""
    try:
        return json.dumps(value, indent=indent, allow_nan=False)
    except ValueError:
        return json.dumps(finite(value), indent=indent, allow_nan=False)


def finite(value: Any) -> Any:
    """Return `value` with None in place of NaN and infinity."""
    return converted(
        lambda one: None if isinstance(one, float) and not math.isfinite(one) else one, value
    )
