"""Every error the runtime raises, in one tree.

Rule: a message says which env it is about, what was being done, and what to do
next; the class says whose fault it is. Errors that carry results hold what did
succeed, so that nothing is lost by an exception.
Absent on purpose: exceptions that rebuild a user's own exception type.
"""

from __future__ import annotations

import traceback
from typing import Any

__all__ = [
    "ActionRefused",
    "BadAction",
    "ClientRefused",
    "ConfigError",
    "EnvAway",
    "EnvBusy",
    "EnvFault",
    "EnvHung",
    "EnvRaised",
    "GroupClosed",
    "NothingPending",
    "RLightningError",
    "RemoteTraceback",
    "ReplayDiverged",
    "SnapshotError",
    "StartFailed",
    "UnknownEnv",
    "WorkerDied",
]


class RLightningError(Exception):
    """Base of every error raised by this package.

    All of them can be pickled and copied, as a process pool does, with their attributes; a cause
    that is not an error of this package arrives as its text (`RemoteTraceback`).
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (type(self), self.args), {**self.__dict__, "__cause__": _portable(self)}


def _made_again(kind: type[RLightningError], args: tuple[Any, ...]) -> RLightningError:
    """An error whose attributes are still to be set: its constructor may ask for more."""
    return kind.__new__(kind, *args)


def _portable(error: BaseException) -> BaseException | None:
    """The cause of `error`, in a form that any process can read."""
    cause = error.__cause__
    if cause is None or isinstance(cause, RLightningError | RemoteTraceback):
        return cause
    return RemoteTraceback("".join(traceback.format_exception(cause)))


class ConfigError(RLightningError, ValueError):
    """The configuration is wrong; the message names file, entry and field."""


class BadAction(RLightningError, ValueError):
    """A response doesn't fit its env: its action's shape, dtype, count or numbers, or its id.

    Nothing was sent.
    """


class UnknownEnv(RLightningError, KeyError):
    """No env of this group has that id."""

    def __str__(self) -> str:
        # KeyError would print the message quoted.
        return str(self.args[0]) if self.args else ""


class EnvBusy(RLightningError, RuntimeError):
    """An env got a new request before its outstanding reply was collected; nothing was sent."""


class NothingPending(RLightningError, RuntimeError):
    """A collect would never end: no request is outstanding."""


class ReplayDiverged(RLightningError, RuntimeError):
    """A replay can't follow the recorded order of results; the message says where it left it."""


class GroupClosed(RLightningError, RuntimeError):
    """The group was used before ``init`` or after ``close``."""


class SnapshotError(RLightningError, ValueError):
    """A snapshot can't be restored: it is damaged, or of other envs; nothing was changed.

    Or it can't be taken: the envs are robots or clients, or were never reset.
    """


class RemoteTraceback(Exception):
    """The traceback text of an exception that was raised where the env lives.

    It is the ``__cause__`` of `EnvRaised`, so that Python prints it above
    the local traceback.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text

    def __str__(self) -> str:
        return "\n" + self.text


class EnvFault(RLightningError):
    """Base of errors of one env that leave the group itself usable.

    Attributes:
        env_id: the env at fault.
        results: for `step` and `reset`, a `BatchedData` of the other envs of the same
            call, which succeeded; None where the call had no other envs.
        others: further faults of the same call.
    """

    def __init__(self, message: str, *, env_id: str) -> None:
        super().__init__(message)
        self.env_id = env_id
        self.results: Any = None
        self.others: tuple[EnvFault, ...] = ()


class EnvRaised(EnvFault):
    """The env's own code raised; the remote traceback is the cause. The env stays usable.

    Attributes:
        exception_type: qualified name of the remote exception's class.
        exception_text: ``str()`` of the remote exception.
        traceback_text: the remote traceback as text.
    """

    def __init__(
        self,
        message: str,
        *,
        env_id: str,
        exception_type: str,
        exception_text: str,
        traceback_text: str,
    ) -> None:
        super().__init__(message, env_id=env_id)
        self.exception_type = exception_type
        self.exception_text = exception_text
        self.traceback_text = traceback_text
        self.__cause__ = RemoteTraceback(traceback_text)


class ActionRefused(EnvRaised, BadAction):
    """The env itself raised `BadAction`, as a robot does for an action beyond its limits.

    Unlike other bad actions, it comes after the batch was sent: the other envs have stepped.
    """


class WorkerDied(EnvFault):
    """The process of an env ended without being asked to.

    Attributes:
        exit_code: the process's exit code; negative for a signal; None if unknown.
        stderr_tail: the last lines it wrote to stderr.
        env_ids: the envs whose outstanding request this error answers.
    """

    def __init__(
        self, message: str, *, env_id: str, exit_code: int | None, stderr_tail: str
    ) -> None:
        super().__init__(message, env_id=env_id)
        self.exit_code = exit_code
        self.stderr_tail = stderr_tail
        self.env_ids: tuple[str, ...] = ()


class EnvHung(WorkerDied):
    """An env took longer than its timeout; its worker was dumped, then killed.

    ``stderr_tail`` ends with the stack dump of the worker's threads.
    """


class EnvAway(EnvFault):
    """The client of a remote env is not connected; it may come back."""


class StartFailed(EnvFault):
    """An env could not be built; ``init`` has stopped everything it had started."""


class ClientRefused(RLightningError, ConnectionError):
    """An env_server will not let this env client in, now or later; the message has its reason."""
