"""Gymnasium's registry in workers, as it is in the trainer.

A script registers its tasks when it starts, and may change registered ones; workers don't run it.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import pickle
import sys
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs import registration

from rlightning_aio.protocol.pickling import dumped, dumped_with_code

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from gymnasium.envs.registration import EnvSpec


def known_tasks() -> tuple[bytes, ...]:
    """Return all registered tasks that can be pickled.

    Those that are named by texts come together; another is unpickled by itself, so that one whose
    arguments a worker can't import costs no others.
    """
    specs = list(gym.registry.values())
    named = [spec for spec in specs if _is_text(spec.entry_point, spec.vector_entry_point)]
    others = [spec for spec in specs if not _is_text(spec.entry_point, spec.vector_entry_point)]
    return (*_pickled(named), *(one for spec in others for one in _pickled_alone(spec)))


def _is_text(*entry_points: Any) -> bool:
    return all(isinstance(one, str | None) for one in entry_points)


def _pickled_alone(spec: EnvSpec) -> Iterator[bytes]:
    with contextlib.suppress(Exception):
        entry_points: dict[str, Any] = {
            name: one if _is_text(one) else _Deferred(dumped_with_code(one))
            for name in ("entry_point", "vector_entry_point")
            for one in [getattr(spec, name)]
        }
        later = copy.copy(spec)
        vars(later).update(entry_points)
        yield dumped_with_code([later])


class _Deferred:
    """A class or function of the trainer, which a worker imports when it makes an env of it.

    A trainer that has imported a simulator has all its tasks registered, and the workers of other
    envs would import it, too, with seconds and gigabytes.
    """

    def __init__(self, pickled: bytes) -> None:
        self._pickled = pickled
        self._loaded: list[Any] = []

    def _itself(self) -> Any:
        """Return the class or function: always the same, as it may have a state."""
        if not self._loaded:
            self._loaded.append(pickle.loads(self._pickled))
        return self._loaded[0]

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._itself()(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # Asked by pickle and copy, before there is anything to unpickle.
            raise AttributeError(name)
        return getattr(self._itself(), name)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Deferred, (self._pickled,)

    def __deepcopy__(self, memo: Any) -> _Deferred:
        return self  # Like a function.


def _pickled(specs: Sequence[EnvSpec]) -> Iterator[bytes]:
    try:
        yield dumped(specs, "")
    except TypeError:
        if len(specs) > 1:
            for spec in specs:
                yield from _pickled([spec])


def register_tasks(tasks: Sequence[bytes]) -> None:
    """Register the tasks of `known_tasks` that this process can unpickle.

    They hold whatever this process has imported or will import: in the trainer, that came before
    the program changed them. A call of `gymnasium.register` outside of an import still counts.
    """
    held: set[str] = set()
    for pickled in tasks:
        with contextlib.suppress(Exception):
            for spec in pickle.loads(pickled):
                gym.registry[spec.id] = spec
                held.add(spec.id)
    modules: tuple[Any, ...] = (gym, gym.envs, registration)
    for module in modules:
        module.register = _holding(module.register, held)


def _holding(register: Any, held: set[str]) -> Callable[..., None]:
    """`register` without effect on ids in `held` while a module is imported."""
    original: Any = getattr(register, "__wrapped__", register)

    @functools.wraps(original)
    def register_unless_held(id: str, *args: Any, **kwargs: Any) -> None:  # noqa: A002
        if id not in held or not _is_importing():
            original(id, *args, **kwargs)

    return register_unless_held


def _is_importing() -> bool:
    frame = sys._getframe()  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            return True
        frame = frame.f_back
    return False
