"""What an env may offer beside `reset` and `step` to save time.

Rule: everything here may be left out, and changes no result. `fast_path_of` is how the runtime
asks, so that an env without the mixin offers nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

BareReset = Callable[..., tuple[Any, dict[str, Any]]]
BareResult = tuple[Any, Any, Any, Any, dict[str, Any]]
BareStep = Callable[[Any], BareResult]


class FastPath:
    """A mixin for a `BaseEnv` whose simulator can be stepped without wrapping each result::

        class MyEnv(FastPath, BaseEnv): ...

    Attributes:
        fresh_results: `bare_step` returns new arrays and dicts, and keeps no reference to them.
            With inline placement, observation and info are then passed on without a copy.
    """

    fresh_results: bool = False

    def bare_step(self) -> BareStep | None:
        """Return the simulator's own ``action -> (obs, reward, terminated, truncated, info)``.

        Return it only if `step` adds nothing to it but a call of ``self._preprocess_fn``, which
        the runtime then makes itself. With None (the default) the runtime calls `step`. The
        function owns the action: the runtime doesn't write to it again.
        """
        return None

    def bare_reset(self) -> BareReset | None:
        """Return the simulator's own ``(seed=, options=) -> (obs, info)``, if `reset` adds nothing.

        The runtime uses it together with `bare_step`.
        """
        return None


_NOTHING: Final = FastPath()


def fast_path_of(env: object) -> FastPath:
    """Return what an env offers.

    Raises:
        TypeError: it has a `bare_step`, but not the mixin.
    """
    if isinstance(env, FastPath):
        return env
    if hasattr(env, "bare_step"):
        raise TypeError(
            f"{type(env).__name__} has a bare_step, which only a class with the mixin "
            "rlightning_aio.envs.fast_path.FastPath may have"
        )
    return _NOTHING
