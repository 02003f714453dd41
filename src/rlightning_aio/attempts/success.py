"""`success_of`: whether an episode has succeeded, by its last info."""

from __future__ import annotations

from typing import Any, Final, cast

import numpy as np

__all__ = ["success_of"]

_KEYS: Final = ("success", "is_success")
"""In an info: Gymnasium's robotics and ManiSkill's name, and Stable-Baselines3's."""


def success_of(info: dict[str, Any], sub_env: int = 0) -> bool | None:
    """Read the success of an episode from its last info, or from the ``final_info`` in it.

    None if it says nothing, or something that is neither a bool nor a number.
    """
    final: Any = info.get("final_info")
    marked: Any = info.get("_final_info")
    if isinstance(final, dict) and (marked is None or marked[sub_env]):
        info = cast("dict[str, Any]", final)  # The rest is about the next episode.
    for key in _KEYS:
        given, known = info.get(key), info.get(f"_{key}")
        if given is not None and (known is None or known[sub_env]):
            # It may be a tensor on another device.
            array = np.asarray(given.tolist() if hasattr(given, "tolist") else given).reshape(-1)
            if array.size and array.dtype.kind in "biuf":
                return bool(array[sub_env if array.size > 1 else 0])
    return None
