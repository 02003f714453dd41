"""What `VectorEnv` and `MujocoVectorEnv` share: checks before calls, and lookups by name.

The order of `…_async` and `…_wait`, and the errors, are those of Gymnasium's `AsyncVectorEnv`.
"""

from __future__ import annotations

from typing import Any, Final

from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

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


def check_running(env: Any) -> None:
    """Check that a vector env is not closed.

    Raises:
        ClosedEnvironmentError: it is.
    """
    if env.closed:
        raise ClosedEnvironmentError(f"this {type(env).__name__} is closed")


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
