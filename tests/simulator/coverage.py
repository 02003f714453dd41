"""Reached or not: what the programs made happen, of what can happen.

These are the transitions of the tables `LEGAL` (of requests and of losses of
episodes), the classes of errors, the rows of docs/faults.md, and the operations.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from kit.checked import CheckedRequests
from simulator.program import OPS

from rlightning_aio import errors
from rlightning_aio._core.group.state import episodes
from rlightning_aio._core.group.state.request_states import LEGAL, Owner, State

if TYPE_CHECKING:
    from collections import Counter

FAULTS_PAGE: Final = Path(__file__).parents[2] / "docs" / "faults.md"

FAULTS: Final = (
    "deaths", "stops", "fork servers killed", "lags", "interrupts", "refusals", "slow starts",
    "EnvRaised",
)  # fmt: skip
"""What is counted where something went wrong."""

ELSEWHERE: Final = "elsewhere: "
ROWS: Final[dict[str, str]] = {
    "the environment raises in `reset`": "EnvRaised",
    "… in `reset` or `step`, with": "restarted after an exception",
    "a worker is killed": "died",
    "… during a call of a method": "died in a call",
    "… while it was idle": "died while idle",
    "a step or reset takes longer": "hung",
    "… and its fork server hangs": "fork servers killed",
    "a worker is stopped for a while": "stops",
    "an environment can't be built": "start failed",
    "a replacement dies while it starts": "refusals",
    "an environment raises in `close`": "close raised",
    "an action of the wrong shape": "BadAction",
    "a group is used from another": ELSEWHERE + "tests/group/test_ownership.py, in real threads",
    "a collect while nothing": "NothingPending",
    "`deadline` passes": "deadline",
    "an agent leaves `group.episode`": "attempts cancelled",
    "Ctrl-C while a synchronous group waits": "Ctrl-C",
    "… while an inline environment steps": "Ctrl-C in an env",
    "… while a call moves data": "interrupts again",
    "the process that drives a robot": ELSEWHERE + "tests/envs/test_piper_guard.py",
    "the trainer dies": ELSEWHERE + "tests/faults/test_shutdown.py, which kills trainers",
}
"""For each row of the table of faults, by its beginning: what is counted where it is reached."""

_OTHERS: Final = ELSEWHERE + "tests/group/test_aborting.py; programs abort no call of another task"
OTHERS: Final[dict[str, str]] = {
    "BUSY TICKET ABORTED": _OTHERS,
    "GroupClosed": ELSEWHERE + "tests/group/test_life.py; programs use no closed group",
}
"""The same for transitions and errors that no program reaches."""

NOT_OF_GROUPS: Final = {
    "ClientRefused", "PolicyServerError", "RLightningError", "EnvFault", "ConfigError",
}  # fmt: skip
"""Errors that are bases of others, or that no group of local envs raises."""


def rows() -> list[str]:
    """The first cells of the table of docs/faults.md."""
    text = FAULTS_PAGE.read_text()
    table = text[text.index("| fault |") : text.index("## A marked result")]
    return [line.split("|")[1].strip() for line in table.splitlines()[2:] if line[:1] == "|"]


def row_key(row: str) -> str:
    """The key of a row in `ROWS`."""
    found = [key for key in ROWS if row.startswith(key)]
    assert len(found) == 1, f"docs/faults.md has a row that the simulator does not know: {row}"
    return found[0]


def watch(counts: Counter[str]) -> None:
    """Count each transition from now on."""
    original, owners = CheckedRequests.changes, list(Owner)

    def changes(self: Any, *events: Any) -> Any:
        if not self._is_changing:
            for event, slots in events:
                for code in set(self._known[slots].tolist()):
                    state, owner = divmod(code, len(owners))
                    counts[f"request {State(state).name} {owners[owner].name} {event.name}"] += 1
        return original(self, *events)

    CheckedRequests.changes = changes  # type: ignore[method-assign]

    class Counting(dict[Any, Any]):
        def get(self, key: Any, default: Any = None) -> Any:
            counts[f"loss {key[0].name} {key[1].name}"] += 1
            return super().get(key, default)

    episodes.LEGAL = Counting(episodes.LEGAL)  # type: ignore[misc]


def possible() -> dict[str, list[tuple[str, str]]]:
    """What can be reached, by kind: a name of each, and what is counted where it is."""
    requests = [f"{state.name} {owner.name} {event.name}" for state, owner, event in LEGAL]
    losses = [f"{phase.name} {event.name}" for phase, event in episodes.LEGAL]
    kinds = [name for name in errors.__all__ if name not in NOT_OF_GROUPS]
    faults = [(re.sub(r"`", "", key), ROWS[key]) for key in map(row_key, rows())]
    return {
        "transitions of requests": [(n, OTHERS.get(n, f"request {n}")) for n in requests],
        "transitions of losses": [(n, OTHERS.get(n, f"loss {n}")) for n in losses],
        "errors": [(name, OTHERS.get(name, name)) for name in kinds],
        "rows of docs/faults.md": faults,
        "operations": [(name, f"op {name}") for name in OPS],
    }


def report(counts: Counter[str]) -> list[str]:
    """Say what was reached, and name what was not."""
    lines: list[str] = []
    for kind, names in possible().items():
        elsewhere = [name for name, key in names if key.startswith(ELSEWHERE)]
        here = [(name, key) for name, key in names if name not in elsewhere]
        missing = [name for name, key in here if not counts[key]]
        lines.append(f"{len(here) - len(missing)} of {len(here)} {kind} were reached")
        lines += [f"    not reached: {name}" for name in missing]
        lines += [f"    {name}: {dict(names)[name]}" for name in elsewhere]
    return lines
