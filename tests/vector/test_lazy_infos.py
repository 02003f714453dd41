"""A lazy list of infos is made once, by whatever reads it first, and is a list to everybody."""

from __future__ import annotations

import copy
import json
import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rlightning_aio.vector.lazy_infos import LazyInfos

if TYPE_CHECKING:
    from collections.abc import Callable

INFOS = [{"x": 1.0}, {"x": 2.0, "done": True}]

READERS: dict[str, Callable[[Any], Any]] = {
    "iter": lambda infos: [*infos],
    "list": list,
    "slice": lambda infos: infos[:],
    "index": lambda infos: [infos[0], infos[-1]],
    "len": lambda infos: INFOS[: len(infos)],
    "equal": lambda infos: INFOS if infos == INFOS else None,
    "bool": lambda infos: INFOS if infos else None,
    "copy": lambda infos: infos.copy(),
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


@pytest.mark.parametrize("name", READERS)
def test_whoever_reads_finds_all(name: str) -> None:
    """Also through functions in C; and the elements are made only once."""
    calls: list[None] = []

    def make() -> list[dict[str, Any]]:
        calls.append(None)
        return copy.deepcopy(INFOS)

    infos = LazyInfos(make)
    assert isinstance(infos, list)
    assert not calls
    assert READERS[name](infos) == INFOS
    list(infos)
    assert len(calls) == 1


def test_changes_stay() -> None:
    """An info that is changed, as wrappers do at an episode's end, is found changed."""
    infos = LazyInfos(lambda: copy.deepcopy(INFOS))
    infos[1]["episode"] = {"r": 1.0}
    infos.append({})
    assert infos == [INFOS[0], {**INFOS[1], "episode": {"r": 1.0}}, {}]
