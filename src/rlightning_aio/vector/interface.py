"""What `VectorEnv` and `MujocoVectorEnv` share: arguments, checks before calls, lookups by name.

The order of `…_async` and `…_wait`, and the errors, are those of Gymnasium's `AsyncVectorEnv`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError
from gymnasium.vector import AutoresetMode

from rlightning_aio._core.group.state.episodes import checked_seed
from rlightning_aio.envs.wrappers import check_running

if TYPE_CHECKING:
    from numpy.typing import NDArray

_NOT_TO_BE_CALLED: Final = ("reset", "step", "close")


class CalledEnvs:
    """Mixin for vector envs that answer calls on their envs."""

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of each env, found through its wrappers, or get an attribute."""
        raise NotImplementedError

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Attribute `name` of each env, found through its wrappers."""
        return self.call(name)

    @property
    def np_random(self) -> Any:
        """Random generators of the envs: a tuple."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """Seeds of the envs' random generators: a tuple."""
        return self.get_attr("np_random_seed")


def check_name(name: str) -> None:
    """Check that `name` may be called on single envs.

    Raises:
        ValueError: it is a method for all envs.
    """
    if name in _NOT_TO_BE_CALLED:
        raise ValueError(f"call {name}() of the vector env itself, not of its envs")


def check_free(env: Any, pending: str | None, what: str) -> None:
    """Check that the call `what` may begin while the call `pending`, if any, is to be awaited."""
    if pending is None and not env.closed:
        return  # As in every step.
    check_running(env)
    raise AlreadyPendingCallError(
        f"Calling `{what}` while waiting for a pending call to `{pending}` to "
        f"complete; call `{pending}_wait` first.",
        str(pending),
    )


def check_sent(env: Any, pending: str | None, what: str) -> None:
    """Check that the call `what` is the pending one."""
    check_running(env)
    if pending != what:
        raise NoAsyncCallError(
            f"Calling `{what}_wait` without any prior call to `{what}_async`.", what
        )


# -- arguments ----------------------------------------------------------------------------


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
