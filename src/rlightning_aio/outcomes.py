"""`Outcome`: how an episode, an attempt or a request ended, and who can have caused that.

Rule: an outcome is made where the cause is known, and carried from there. It says what happened;
what to retry, replace, mask or score is the caller's choice.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias, get_args

if TYPE_CHECKING:
    from collections.abc import Mapping

OutcomeKind: TypeAlias = Literal[
    "terminated",
    "truncated",
    "timed_out",
    "env_raised",
    "env_died",
    "env_hung",
    "env_away",
    "not_started",
    "agent_raised",
    "agent_stopped",
    "cancelled",
]
"""See `Outcome`."""
Blame: TypeAlias = Literal["policy", "either", "env", "infrastructure", "caller"]
"""See `Outcome`."""
BLAMES: Final[frozenset[str]] = frozenset(get_args(Blame))


class TimeSpent(NamedTuple):
    """Where the time of an attempt went, in seconds.

    Attributes:
        env: in resets, steps and calls of its env.
        agent: in the agent's code between them, which includes its model.
        waiting: until an env was free.
    """

    env: float = 0.0
    agent: float = 0.0
    waiting: float = 0.0


_NONE: Final = TimeSpent()


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an episode or an attempt ended.

    Attributes:
        kind: ``terminated`` or ``truncated`` by the env or a step limit; any other is a failure:
            ``timed_out`` (the attempt's time was over), ``env_raised``, ``env_died``, ``env_hung``
            (it exceeded its time limit), ``env_away`` (a client or a server was lost),
            ``not_started`` (a reset or a start failed), ``agent_raised``, ``agent_stopped`` (it
            returned before the end), ``cancelled``.
        blame: who can have caused it: ``policy``; ``env``; ``either`` of the two, where the request
            executed an action; ``infrastructure`` (machine, network, another env of the worker);
            ``caller``.
        cause: one line for people.
        env_id: of the env; empty without one.
        attempt: its number, from 0, among the attempts at the same episode.
        seconds: where its time went; zeros for a single request.
    """

    kind: OutcomeKind
    blame: Blame
    cause: str
    env_id: str = ""
    attempt: int = 0
    seconds: TimeSpent = _NONE

    @property
    def is_failure(self) -> bool:
        """The episode has no end of its own, so it has no return."""
        return self.kind not in ("terminated", "truncated")

    def to_json(self) -> dict[str, Any]:
        """Return the outcome as JSON values."""
        return {**asdict(self), "seconds": self.seconds._asdict()}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Outcome:
        """Make an outcome from `to_json`.

        Raises:
            TypeError, ValueError, KeyError: it is no outcome.
        """
        fields = {**value}
        found = cls(seconds=TimeSpent(**fields.pop("seconds")), **fields)
        if found.kind not in get_args(OutcomeKind) or found.blame not in BLAMES:
            raise ValueError(f"{value!r} is no outcome")
        return found


_ELSEWHERE: Final = " (while it executed "


def bystanders(cause: str, at_fault: str, env_id: str) -> Outcome:
    """Return the outcome of an env whose worker died while it executed another one, `at_fault`."""
    return Outcome("env_died", "infrastructure", f"{cause}{_ELSEWHERE}{at_fault})", env_id)


def is_bystanders(outcome: Outcome) -> bool:
    """Return True if another env of the worker was executed, so it says nothing about this one."""
    return outcome.kind == "env_died" and _ELSEWHERE in outcome.cause


def own_end(
    env_id: str,
    info: Mapping[str, Any],
    *,
    terminated: bool,
    cut: str = "its env or the step limit cut it",
) -> Outcome:
    """The outcome of an episode that its last result has ended.

    Args:
        env_id: of the env.
        info: of the result; an `Outcome` in it, as ``outcome``, says more than the flags do.
        terminated: by its env.
        cut: the cause, if it was truncated.
    """
    reported: Any = info.get("outcome")
    if isinstance(reported, Outcome):
        return replace(reported, env_id=env_id)
    if terminated:
        return Outcome("terminated", "policy", "its env ended it", env_id)
    return Outcome("truncated", "policy", cut, env_id)


class Loss(NamedTuple):
    """Why envs have lost their episodes.

    Attributes:
        cause: a clause whose subject is the worker or the env, such as "was killed by SIGKILL".
        kind: of the outcome of the env at fault.
        blame: likewise.
        at_fault: the id of the env that was executing; None if unknown.
    """

    cause: str
    kind: OutcomeKind
    blame: Blame
    at_fault: str | None = None

    def outcome(self, env_id: str) -> Outcome:
        """The outcome of the episode that an env has lost; see `is_bystanders`."""
        if self.at_fault is None or self.at_fault == env_id:
            return Outcome(self.kind, self.blame, self.cause, env_id)
        return bystanders(self.cause, self.at_fault, env_id)
