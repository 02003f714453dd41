"""Executes a request on an env, and makes the completion that reports its outcome.

Every host with envs of its own uses it, in whatever process and thread; hosts differ in when they
execute a request, and in where they put its completion.
Left out: what a request does to an env (see `EnvRunner`), and how a completion travels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio._core.hosts.messages import Moved, Raised, Result, Value
from rlightning_aio._core.hosts.running.renewal import HandedOn
from rlightning_aio.envs.results import explained
from rlightning_aio.protocol.entries import answers_with_value, op_of
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.pickling import dumped

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.hosts.running.runner import EnvRunner


def execute(
    host_id: int,
    runner: EnvRunner,
    entry: int,
    arguments: Any,
    on_end: Callable[[BaseException | None], object] | None = None,
) -> Result | Value | Raised | Moved | None:
    """Execute one request.

    Args:
        host_id: of the env's host.
        runner: of the env.
        entry: of the request.
        arguments: as of `EnvRunner.execute`.
        on_end: called after that, with what it has raised, if it has.

    Returns its completion, or None if the row holds the whole result.
    """
    outcome = error = None
    try:
        outcome = runner.execute(op_of(entry), arguments)
    except BaseException as raised:
        error = raised
    if on_end is not None:
        on_end(error)
    return completion_of(host_id, runner, entry, outcome, error)


def completion_of(
    host_id: int,
    runner: EnvRunner,
    entry: int,
    outcome: Any,
    error: BaseException | None = None,
) -> Result | Value | Raised | Moved | None:
    """Return the completion of a request, or None if the row holds the whole result.

    What can't leave this process is an error of the env.

    Args:
        host_id: of the env's host.
        runner: of the env.
        entry: of the request.
        outcome: the part of the result that is out of band; for a call, its value.
        error: what the env has raised instead.
    """
    if isinstance(error, HandedOn):
        return Moved(host_id, entry, error.arguments, error.is_due, error.resident_mb)
    returns_value = answers_with_value(op_of(entry))
    travels = outcome is not None and not (returns_value or runner.inline)
    if error is None and travels:
        try:
            outcome = dumped(outcome, "the result")
        except TypeError as misfit:
            error = misfit
    if error is not None:
        text = ErrorText.of(explained(error))
        runner.note_error(op_of(entry), text)
        return Raised(host_id, entry, text)
    if returns_value:
        return Value(host_id, entry, outcome)
    return None if outcome is None else Result(host_id, entry, outcome)
