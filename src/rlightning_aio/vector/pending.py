"""The order of `…_async` and `…_wait`, with the errors of Gymnasium's `AsyncVectorEnv`."""

from __future__ import annotations

from typing import Any

from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

__all__ = ["check_free", "check_running", "check_sent"]


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
