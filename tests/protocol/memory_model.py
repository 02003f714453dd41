"""An explicit-state checker for programs of memory accesses, in every order that arm64 permits.

Each program is a list of accesses of one process. Accesses of one process may take effect in any
order, unless a rule keeps two of them apart: they use the same word; a fence is between them or is
one of them; the first is an acquiring load; the second is a releasing store; or the second is a
store that depends on what the first has loaded. All processes see the effects in one order, as on
arm64 (and x86). Loads may run ahead of the branches before them, so the programs have none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

__all__ = ["Access", "Program", "fence", "load", "outcomes", "store"]


@dataclass(frozen=True)
class Access:
    """One access.

    Attributes:
        kind: what it does.
        word: name of the word in memory.
        value: that is stored.
        into: register for the loaded value.
        ordered: a load acquires, a store releases.
        given: register without whose value of at least 1 a store doesn't happen.
    """

    kind: Literal["load", "store", "fence"]
    word: str = ""
    value: int = 0
    into: str = ""
    ordered: bool = False
    given: str = ""


Program: TypeAlias = "tuple[Access, ...]"


def load(word: str, into: str, *, acquire: bool = False) -> Access:
    return Access("load", word, into=into, ordered=acquire)


def store(word: str, value: int, *, release: bool = False, given: str = "") -> Access:
    return Access("store", word, value, ordered=release, given=given)


def fence() -> Access:
    return Access("fence")


def _in_order(first: Access, second: Access) -> bool:
    """Return True if `second` can't take effect before `first`, which is earlier in its program."""
    return (
        "fence" in (first.kind, second.kind)
        or first.word == second.word
        or (first.kind == "load" and first.ordered)
        or (second.kind == "store" and second.ordered)
        or (second.given != "" and second.given == first.into)
    )


def outcomes(programs: Sequence[Program]) -> Iterator[Mapping[str, int]]:
    """Yield the final values of memory and registers, which start at 0, of each execution."""
    steps = [(p, k) for p, program in enumerate(programs) for k in range(len(program))]
    bit = {step: 1 << number for number, step in enumerate(steps)}
    needs = {
        (p, k): sum(
            bit[p, earlier]
            for earlier, before in enumerate(programs[p][:k])
            if _in_order(before, programs[p][k])
        )
        for p, k in steps
    }
    every = sum(bit.values())
    waiting: list[tuple[int, frozenset[tuple[str, int]]]] = [(0, frozenset())]
    seen = set(waiting)
    while waiting:
        done, content = waiting.pop()
        values = dict(content)
        if done == every:
            yield values
        for p, k in steps:
            if done & bit[p, k] or needs[p, k] & ~done:
                continue
            access, after = programs[p][k], dict(values)
            if access.kind == "load":
                after[access.into] = values.get(access.word, 0)
            elif access.kind == "store" and (not access.given or values[access.given]):
                after[access.word] = access.value
            state = done | bit[p, k], frozenset(after.items())
            if state not in seen:
                seen.add(state)
                waiting.append(state)
