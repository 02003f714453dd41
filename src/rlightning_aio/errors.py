"""The errors of this package.

Rule: a message names the env, the operation, and what to do next; the class says which side is at
fault. An error of a batch carries the results of the other envs, so an exception loses nothing.
Absent on purpose: rebuilding a user's own exception type. Only builtin exception classes are kept,
as a base of the error's class.
"""

from __future__ import annotations

import builtins
import functools
import traceback
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

from rlightning_aio.outcomes import Outcome

if TYPE_CHECKING:
    from rlightning_aio.outcomes import Blame, OutcomeKind

__all__ = [
    "BadAction",
    "ClientRefused",
    "ConfigError",
    "EnvAway",
    "EnvBusy",
    "EnvError",
    "EnvFault",
    "EnvHung",
    "EnvRaised",
    "EpisodeLost",
    "GroupClosed",
    "NothingPending",
    "PolicyServerError",
    "RLightningError",
    "ResetNeeded",
    "SnapshotError",
    "StartFailed",
    "UnknownEnv",
    "WorkerDied",
]


class RLightningError(Exception):
    """Base of all errors of this package.

    It is the class of those that no program needs to tell from others: a group was used before
    `init`, or from another thread.

    They can be pickled and copied, with their attributes; a cause that is not an error of this
    package is converted to its text.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (type(self), self.args), {**self.__dict__, "__cause__": _portable(self)}


def _unpickled(kind: type[RLightningError], args: tuple[Any, ...]) -> RLightningError:
    """Make an error without its constructor, which may need more arguments."""
    return kind.__new__(kind, *args)


def _portable(error: BaseException) -> BaseException | None:
    """Convert the cause of `error` to a form that any process can unpickle."""
    cause = error.__cause__
    if cause is None or isinstance(cause, RLightningError | RemoteTraceback):
        return cause
    return RemoteTraceback("".join(traceback.format_exception(cause)))


class ConfigError(RLightningError, ValueError):
    """The configuration is wrong; the message names file, entry and field."""


class BadAction(RLightningError, ValueError):
    """A response doesn't fit its env: shape, dtype, count or numbers of the action, or the env id.

    Nothing was sent; unless the env itself refuses the action, as robots do beyond their limits.
    Then the other envs have stepped, and the error is an `EnvRaised` as well.
    """


class UnknownEnv(RLightningError, KeyError):
    """No env of this group has that id."""

    def __str__(self) -> str:
        # KeyError would print the message quoted.
        return str(self.args[0]) if self.args else ""


class EnvBusy(RLightningError, RuntimeError):
    """An env got a request before the result or error of its last one was collected.

    Nothing was sent. The message says what to call first.
    """


class NothingPending(RLightningError, RuntimeError):
    """A collect would never return, because no request is outstanding."""


class PolicyServerError(RLightningError, ConnectionError):
    """A policy server is missing or silent, reports an error, or breaks its protocol."""


class ResetNeeded(RLightningError):
    """What is built on a group has lost its episodes with a call that was cut off, as by Ctrl-C.

    A vector environment raises it as Gymnasium's error of that name, too.
    """


class GroupClosed(RLightningError, RuntimeError):
    """The group was used before ``init`` or after ``close``, or closed while a call was waiting."""


class SnapshotError(RLightningError, ValueError):
    """A snapshot can't be restored, because it is damaged or of other envs; nothing was changed.

    Or it can't be taken, because envs are robots, were never reset, or have lost their episode in a
    restore that failed or in an abort.
    """


class RemoteTraceback(Exception):
    """The traceback of an exception in another process, as text.

    It is the ``__cause__`` of `EnvRaised`, so Python prints it above the local traceback.
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
        results: of `step` and `reset`: a `BatchedData` of the envs of the same call that succeeded;
            None if there are none.
        others: further faults of the same call.
        outcome: of the episode that the fault has ended: what happened, and who can be to blame.
    """

    _outcome: ClassVar[tuple[OutcomeKind, Blame]] = "env_died", "env"
    """Kind and blame where nothing more is known."""

    def __init__(self, message: str, *, env_id: str) -> None:
        # Not `super()`: a builtin exception among the bases may need more than a message.
        BaseException.__init__(self, message)
        self.env_id = env_id
        self.outcome = Outcome(*self._outcome, message.strip().partition("\n")[0], env_id)
        self.results: Any = None
        self.others: tuple[EnvFault, ...] = ()


class EnvRaised(EnvFault):
    """The code of the env raised; the remote traceback is the cause. The env stays usable.

    If the exception has a builtin class, such as `KeyError`, the error is also an instance of that
    class, so ``except KeyError`` catches it. Attributes of the builtin class, such as `errno`, are
    not transferred. Excluded are classes that are not an `Exception`, exception groups, and
    `StopIteration` and `StopAsyncIteration`, which Python replaces in generators.

    Attributes:
        exception_type: qualified name of the class of the remote exception.
        exception_text: ``str()`` of the remote exception.
        traceback_text: the remote traceback as text.
    """

    _outcome = "env_raised", "either"

    def __init__(self, message: str, *, env_id: str) -> None:
        super().__init__(message, env_id=env_id)
        self.exception_type = self.exception_text = self.traceback_text = ""
        if isinstance(self, SyntaxError):
            self.msg = message  # Tracebacks print this, not `str`.

    def __str__(self) -> str:
        # Some builtin exceptions print something else.
        return str(self.args[0]) if self.args else ""

    def __reduce__(self) -> tuple[Any, ...]:
        if type(self) is not _kind_of(self.exception_type):
            return super().__reduce__()
        # Pickle can't find classes made by `_kind_of`, so choose the class again.
        _, (_, args), state = super().__reduce__()
        return _unpickled_of, (*args, self.exception_type), state


def env_raised(
    message: str, *, env_id: str, exception_type: str, exception_text: str, traceback_text: str
) -> EnvRaised:
    """Make the error for an exception of the code of an env."""
    error = _kind_of(exception_type)(message, env_id=env_id)
    error.exception_type, error.exception_text = exception_type, exception_text
    error.traceback_text = traceback_text
    error.__cause__ = RemoteTraceback(traceback_text)
    return error


def unreadable(error: Exception, env_id: str) -> EnvRaised:
    """Make the error for a result of an env that raises where it is read."""
    what = f"returned what can't be read in this process: {type(error).__name__}: {error}"
    kind = type(error).__qualname__
    fault = _kind_of(kind)(
        f"env {env_id!r} {what}; put plain values into its observation and info, such as "
        "str(error) for an exception",
        env_id=env_id,
    )
    fault.exception_type, fault.exception_text = kind, str(error)
    fault.outcome = Outcome("env_raised", "env", what, env_id)
    return fault


class ActionRefused(EnvRaised, BadAction):
    """`EnvRaised` for `BadAction`."""

    _outcome = "env_raised", "policy"


_WITHOUT_KIND: Final = (BaseExceptionGroup, StopIteration, StopAsyncIteration)


def _kind_of(exception_type: str) -> type[EnvRaised]:
    """Class of the `EnvRaised` for a remote exception."""
    if exception_type == f"{BadAction.__module__}.{BadAction.__qualname__}":
        return ActionRefused
    builtin = vars(builtins).get(exception_type)
    if not isinstance(builtin, type) or not issubclass(builtin, Exception):
        return EnvRaised
    return EnvRaised if issubclass(builtin, _WITHOUT_KIND) else _kind_with(builtin)


@functools.cache
def _kind_with(builtin: type[Exception]) -> type[EnvRaised]:
    name = builtin.__name__
    own = {"__doc__": f"`EnvRaised` for {name}.", "__module__": __name__}
    return cast("type[EnvRaised]", type(f"EnvRaised{name}", (EnvRaised, builtin), own))


def _unpickled_of(message: str, exception_type: str) -> EnvRaised:
    """Make an error without its attributes, which pickle sets."""
    return _kind_of(exception_type)(message, env_id="")


class WorkerDied(EnvFault):
    """The process of an env ended unexpectedly.

    One such error answers the requests of all its ``env_ids``. Its ``env_id`` is the env that the
    process was executing, or the first of the process if it executed none.

    Attributes:
        exit_code: of the process; negative for a signal; None if unknown.
        stderr_tail: the end of what it wrote to stdout, then of what it wrote to stderr.
        env_ids: the envs whose requests this error answers: outstanding ones, or new ones that it
            refuses.
    """

    def __init__(self, message: str, *, env_id: str) -> None:
        super().__init__(message, env_id=env_id)
        self.exit_code: int | None = None
        self.stderr_tail = ""
        self.env_ids: tuple[str, ...] = ()


class EnvHung(WorkerDied):
    """An env exceeded its timeout, and its worker was killed.

    ``stderr_tail`` ends with the stacks of the worker's threads, unless it was an actor of Ray.
    """

    _outcome = "env_hung", "either"


class EnvAway(EnvFault):
    """No client lends a remote env, or not any more; another may dial in.

    An awaitable env whose step raises it has lost what it talks to, and so its episode: the env is
    made again, as a worker that has died is.
    """

    _outcome = "env_away", "infrastructure"
    env_ids: tuple[str, ...] = ()
    """All envs of which that is so, where it ends the requests of several."""


class EpisodeLost(EnvFault):
    """A call has no result, because the episode of its env has ended without one.

    Its env was replaced during a step of an `EnvEpisode` (whose `lost` is the outcome), or `abort`
    or `drain` of the group has ended the request, or it moves something real and was lost before a
    step. The env can be reset.

    Attributes:
        results: where the env was replaced, the first result of the episode that it has begun; None
            for further steps.
    """

    _outcome = "cancelled", "caller"


class StartFailed(EnvFault):
    """An env could not be built; ``init`` has stopped all workers."""

    _outcome = "not_started", "env"


class EnvError(RLightningError, RuntimeError):
    """Raised by an env that knows who is to blame for what went wrong.

    The `EnvRaised` in the trainer has the blame in its `outcome`. Any exception of an env may have
    such an attribute ``blame``.

    Args:
        message: what went wrong.
        blame: see `Outcome`.
    """

    def __init__(self, message: str, *, blame: Blame) -> None:
        super().__init__(message)
        self.blame = blame


class ClientRefused(RLightningError, ConnectionError):
    """An env_server refuses this env client permanently; the message has the reason."""
