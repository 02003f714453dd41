"""Lazy infos are made once, by whatever reads them first, and are plain ones to everybody."""

from __future__ import annotations

import copy
import json
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rlightning_aio.vector.lazy_infos import LazyColumns, LazyInfos

if TYPE_CHECKING:
    from collections.abc import Callable

INFOS = [{"x": 1.0}, {"x": 2.0, "done": True}]

READERS: dict[str, Callable[[Any], Any]] = {
    "list": list,
    "copy.copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda infos: pickle.loads(pickle.dumps(infos)),
    "json": lambda infos: json.loads(json.dumps(infos)),
    "repr": lambda infos: eval(repr(infos)),
    "right operand": lambda infos: [] + infos,  # noqa: RUF005 - This is what is tested.
    "left operand": lambda infos: infos + [],  # noqa: RUF005
    "extend": lambda infos: (made := [], made.extend(infos))[0],
    "slice assignment": lambda infos: (made := [0], made.__setitem__(slice(None), infos))[0],
    "zip": lambda infos: [info for (info,) in zip(infos, strict=True)],
    "reversed": lambda infos: [*reversed(infos)][::-1],
    "numpy": lambda infos: np.array(infos).tolist(),
    "sorted": lambda infos: sorted(infos, key=len),
    "pop": lambda infos: [infos.pop(0), infos.pop()],
}


def test_changes_stay() -> None:
    """An info that is changed, as wrappers do at an episode's end, is found changed."""
    infos = LazyInfos(lambda: copy.deepcopy(INFOS))
    infos[1]["episode"] = {"r": 1.0}
    infos.append({})
    assert infos == [INFOS[0], {**INFOS[1], "episode": {"r": 1.0}}, {}]


COLUMNS = {"x": [1, 2], "_x": [True, False]}
READERS_OF_COLUMNS: dict[str, Callable[[Any], Any]] = {
    "dict": dict,
    "unpacked": lambda infos: {**infos},
    "update": lambda infos: (made := {}, made.update(infos))[0],
    "or": lambda infos: infos | {},
    "or of a dict": lambda infos: {} | infos,
    "in place": lambda infos: (made := {}, made.__ior__(infos))[0],
    "keys": lambda infos: {key: infos[key] for key in infos.keys()},  # noqa: SIM118
    "equal to": lambda infos: COLUMNS if COLUMNS == infos else None,  # noqa: SIM300
    "keywords": lambda infos: dict(**infos),
    "copy.copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda infos: pickle.loads(pickle.dumps(infos)),
    "repr": lambda infos: eval(repr(infos)),
    "pop": lambda infos: {key: infos.pop(key) for key in ("x", "_x")},
    "match": lambda infos: COLUMNS if _matched(infos) else None,
}


def _matched(infos: Any) -> bool:
    match infos:
        case {"x": [1, 2]}:
            return True
        case _:
            return False


KINDS = {"list": (LazyInfos, INFOS), "dict": (LazyColumns, COLUMNS)}
ALL_READERS = [("list", name) for name in READERS] + [("dict", name) for name in READERS_OF_COLUMNS]


@pytest.mark.parametrize(("kind", "name"), ALL_READERS)
def test_whoever_reads_finds_all(kind: str, name: str) -> None:
    """Also through functions in C; and the elements are made only once."""
    calls: list[None] = []
    lazy, expected = KINDS[kind]

    def make() -> Any:
        calls.append(None)
        return copy.deepcopy(expected)

    infos: Any = lazy(make)
    assert isinstance(infos, type(expected))
    assert not calls
    assert (READERS if kind == "list" else READERS_OF_COLUMNS)[name](infos) == expected
    list(infos)
    assert len(calls) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_another_thread_finds_all_while_they_are_made(kind: str) -> None:
    """It waits until they are there; they are made only once."""
    lazy, expected = KINDS[kind]
    begun, go_on, calls = threading.Event(), threading.Event(), list[None]()

    def make() -> Any:
        calls.append(None)
        begun.set()
        assert go_on.wait(60)
        return copy.deepcopy(expected)

    infos: Any = lazy(make)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(infos.copy)
        assert begun.wait(60)
        second = pool.submit(infos.copy)
        go_on.set()
        assert first.result() == second.result() == expected
    assert len(calls) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_infos_that_could_not_be_made_are_not_empty(kind: str) -> None:
    """Each reading says so, until it works."""
    lazy, expected = KINDS[kind]
    answers: list[Any] = [MemoryError(), MemoryError(), copy.deepcopy(expected)]

    def make() -> Any:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    infos: Any = lazy(make)
    for _ in range(2):
        with pytest.raises(MemoryError):
            len(infos)
    assert infos.copy() == infos.copy() == expected
