"""Arguments of vector envs: autoreset modes, one seed for each env, the mask of envs to reset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from gymnasium.vector import AutoresetMode

from rlightning_aio._core.group.state.episodes import checked_seed

if TYPE_CHECKING:
    from numpy.typing import NDArray


def checked_mode(mode: Any) -> AutoresetMode:
    """Return an autoreset mode that was given as one of Gymnasium's members, or as its value.

    Raises:
        ValueError: there is no such mode.
    """
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = ", ".join(repr(member.value) for member in AutoresetMode)
        raise ValueError(
            f"autoreset_mode must be one of {known}, or a member of "
            f"gymnasium.vector.AutoresetMode, not {mode!r}"
        ) from None


def seeds_of_envs(seed: int | Sequence[int | None] | None, num_envs: int) -> list[Any]:
    """Return a seed or None for each env; a single seed counts up.

    Raises:
        ValueError: there are not `num_envs` seeds, or one is out of range.
    """
    if seed is None:
        return [None] * num_envs
    if not isinstance(seed, Sequence | np.ndarray):
        first = checked_seed(seed)
        return [first + k for k in range(num_envs)]
    if len(seed) != num_envs:
        raise ValueError(f"{len(seed)} seeds for num_envs={num_envs}; give one for each")
    return [
        None if one is None else checked_seed(one, f" of env {k}") for k, one in enumerate(seed)
    ]


def options_of_envs(options: Any, num_envs: int) -> list[Any]:
    """Return the options of each env, which are given for all, or as a list or tuple.

    Raises:
        ValueError: there are not options of `num_envs` envs.
    """
    if not isinstance(options, list | tuple):
        return [options] * num_envs
    each = list(cast("list[Any]", options))
    if len(each) != num_envs:
        raise ValueError(f"options of {len(each)} envs for num_envs={num_envs}; give each its own")
    return each


def mask_and_options(options: Any, num_envs: int) -> tuple[NDArray[np.bool_] | None, Any]:
    """Return the mask that `options` have, or None if it selects all envs; and the rest of them.

    Raises:
        TypeError, ValueError: as of `checked_mask`.
    """
    if not isinstance(options, dict):
        return None, options
    rest = dict(cast("dict[str, Any]", options))
    if "reset_mask" not in rest:
        return None, rest
    mask = checked_mask(rest.pop("reset_mask"), num_envs)
    return None if mask.all() else mask, rest


def checked_mask(mask: Any, num_envs: int) -> NDArray[np.bool_]:
    """Return a copy of ``options["reset_mask"]``, a bool array ``[num_envs]``.

    Raises:
        TypeError: it is no array of bools.
        ValueError: it has another shape, or selects no env.
    """
    # Gymnasium's tests match these messages.
    what = "`options['reset_mask']` must"
    if not isinstance(mask, np.ndarray):
        raise TypeError(f"{what} be a numpy array, got {type(mask)}")
    array = cast("NDArray[Any]", mask)
    if array.shape != (num_envs,):
        raise ValueError(f"{what} have shape `({num_envs},)`, got {array.shape}")
    if array.dtype != np.bool_:
        raise TypeError(f"{what} have `dtype=np.bool_`, got {array.dtype}")
    if not array.any():
        raise ValueError(
            f"{what} contain a boolean array with at least one True value, got reset_mask={array}"
        )
    return array.copy()
