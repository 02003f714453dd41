"""Saves and restores the state of an env: simulator, wrappers and random generators.

Rule: a restore keeps the objects that an env consists of, and replaces their contents. The *parts*
are the env itself, the layers of its simulator (wrappers, sub-environments), and objects that only
their library can copy (MuJoCo's data, an ALE console). `parts_of` finds them and names each by its
path. All other contents of the parts are one pickle, with references to parts.
Absent on purpose: state outside the env, such as global generators (`numpy.random`, `random`),
files and windows.
"""

from __future__ import annotations

import io
import pickle
import random
import sys
from dataclasses import dataclass
from inspect import iscoroutinefunction, unwrap
from operator import methodcaller
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from rlightning_aio.envs import mujoco_state
from rlightning_aio.envs.ale_console import is_sticky
from rlightning_aio.protocol.pickling import CodePickler

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

NOT_STATE: Final = frozenset(
    ("config", "worker_index", "env_id", "trainer_pid", "_preprocess_fn", "_background")
)
"""Attributes of a `BaseEnv` that identify the env."""
_PLAIN: Final[tuple[type[Any], ...]] = (str, bytes, int, float, bool, type(None), np.generic)


_BUILT_IN: Final = frozenset((str, bytes, int, float, bool, type(None), tuple, list, dict))


@dataclass(frozen=True)
class SavedState:
    """The saved state of an env.

    Attributes:
        parts: path and type of each part.
        pickled: contents of the parts by path.
    """

    parts: tuple[tuple[str, str], ...]
    pickled: bytes


class _Kind(NamedTuple):
    """Functions for a kind of parts.

    Attributes:
        save: returns the contents of a part, picklable; load: restores them.
        is_layer: attributes of the part may be parts too.
    """

    save: Callable[[Any], Any]
    load: Callable[[Any, Any], None]
    is_layer: bool = False


class _Part(NamedTuple):
    value: Any
    kind: _Kind


# -- kinds of parts -----------------------------------------------------------------------


def _nothing(*_: Any) -> None:
    """Save or load nothing."""


def _held(layer: Any) -> dict[str, Any]:
    return cast("dict[str, Any]", vars(layer))


def _set_attributes(layer: Any, state: dict[str, Any]) -> None:
    held = _held(layer)
    held.clear()
    held.update(state)


def _env_attributes(env: Any) -> dict[str, Any]:
    return {name: value for name, value in _held(env).items() if name not in NOT_STATE}


def _set_env_attributes(env: Any, state: dict[str, Any]) -> None:
    kept = {name: value for name, value in _held(env).items() if name in NOT_STATE}
    _set_attributes(env, {**kept, **state})


def _spaces_in(space: Any) -> list[Any]:
    """Spaces of a `Dict`, a `Tuple` and the like, and those in attributes, as of a `Sequence`."""
    inner: Any = getattr(space, "spaces", ())
    own: list[Any] = [value for _, value in sorted(_held(space).items()) if _is_space(value)]
    return [*cast("Any", inner.values() if isinstance(inner, dict) else inner), *own]


def _is_space(value: Any) -> bool:
    return isinstance(value, gym.Space)


def _generators(space: Any) -> list[Any]:
    """Random generators of a space and of the spaces in it; None for unused ones."""
    # The property would make one.
    own = space._np_random  # noqa: SLF001
    return [own, *map(_generators, _spaces_in(space))]


def _set_generators(space: Any, state: list[Any]) -> None:
    space._np_random = state[0]  # noqa: SLF001
    for one, own in zip(_spaces_in(space), state[1:], strict=True):
        _set_generators(one, own)


def _load_own_state(part: Any, state: Any) -> None:
    part.load_state(state)


def _console_state(console: Any) -> Any:
    if is_sticky(console):
        raise NotImplementedError(
            "a console with sticky actions repeats its last action at random, and ale-py's states "
            "don't include that action: use backend: ale, which keeps it, or make the env with "
            "repeat_action_probability=0"
        )
    return console.cloneState(include_rng=True)


def _set_console_state(console: Any, state: Any) -> None:
    console.restoreState(state)


_ENV = _Kind(_env_attributes, _set_env_attributes, is_layer=True)
_LAYER = _Kind(_held, _set_attributes, is_layer=True)
_OWN = _Kind(methodcaller("save_state"), _load_own_state)
_SPACE = _Kind(_generators, _set_generators)
_KEPT = _Kind(_nothing, _nothing)
_OF_LIBRARIES: Final[dict[str, dict[str, _Kind]]] = {
    "ale_py": {"ALEInterface": _Kind(_console_state, _set_console_state)},
    "rlightning_aio": {"StickyConsole": _OWN},
    "mujoco": {
        "MjData": _Kind(mujoco_state.save_data, mujoco_state.load_data),
        "MjModel": _Kind(mujoco_state.save_model, mujoco_state.load_model),
    },
}
"""Objects that only their library can copy, by module and name."""
_ON_SCREEN: Final = ("pygame", "glfw", "gymnasium.envs.mujoco.mujoco_rendering")
"""Modules of objects that display an env, and don't affect its steps."""


class _Plain:
    pass


def _kind_of(value: Any) -> _Kind | None:
    """Kind of a value that is a part; None for any other value."""
    kind = cast("type[Any]", type(value))
    if kind is np.ndarray:
        return _KEPT if _is_view_of_a_simulator(value) else None
    if kind is FunctionType:
        # Code isn't state, but variables of a closure may be.
        return None if value.__closure__ else _KEPT
    if kind not in _kinds:
        _kinds[kind] = _kind_of_type(value)
    return _kinds[kind]


_kinds: dict[type, _Kind | None] = {}


def _kind_of_type(value: Any) -> _Kind | None:
    kind = cast("type[Any]", type(value))
    module = kind.__module__
    library = module.partition(".")[0]
    if library in _OF_LIBRARIES and kind.__name__ in _OF_LIBRARIES[library]:
        return _OF_LIBRARIES[library][kind.__name__]
    if isinstance(value, gym.Space):
        return _SPACE
    if isinstance(value, EnvSpec | ModuleType) or library in _ON_SCREEN or module in _ON_SCREEN:
        return _KEPT
    if not _is_layer(value):
        return None
    return _OWN if hasattr(value, "save_state") and hasattr(value, "load_state") else _LAYER


def _is_layer(value: Any) -> bool:
    if isinstance(value, gym.Env | gym.vector.VectorEnv):
        return True
    kind = cast("type[Any]", type(value))
    # An awaitable env without a base class.
    if iscoroutinefunction(unwrap(getattr(kind, "step", len))) and hasattr(value, "__dict__"):
        return True
    # By name, so that PettingZoo isn't imported. `EzPickle` pickles constructor arguments only.
    return not isinstance(value, type) and any(
        base.__name__ == "EzPickle"
        or (base.__name__ in ("AECEnv", "ParallelEnv") and base.__module__.startswith("pettingzoo"))
        for base in kind.__mro__
    )


def _is_view_of_a_simulator(array: np.ndarray[Any, Any]) -> bool:
    """Return True if the memory of `array` belongs to an object of a library, not to NumPy."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    return base is not None and type(base).__name__ == "PyCapsule"


# -- finding them -------------------------------------------------------------------------


def parts_of(env: Any) -> dict[str, _Part]:
    """Parts of an env by path, from the outermost inwards, without duplicates."""
    found = {"env": _Part(env, _ENV)}
    known = {id(env)}
    for path, part in (queue := list(found.items())):
        if not part.kind.is_layer:
            continue
        # `env` first, because some wrappers also have the inner env under another name.
        for name, value in sorted(_held(part.value).items(), key=_env_first):
            if part.kind is _ENV and name in NOT_STATE:
                continue
            for inner_path, inner in _within(f"{path}.{name}", value):
                kind = _kind_of(inner)
                if kind is not None and id(inner) not in known:
                    known.add(id(inner))
                    found[inner_path] = _Part(inner, kind)
                    queue.append((inner_path, found[inner_path]))
    return found


def _env_first(item: tuple[str, Any]) -> tuple[bool, str]:
    return item[0] != "env", item[0]


def _within(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield `value`, or its elements if it is a container."""
    items: Any = ()
    if type(value) in (list, tuple):
        items = enumerate(value) if value and not isinstance(value[0], _PLAIN) else ()
    elif type(value) is dict:
        items = cast("dict[Any, Any]", value).items()
    elif not isinstance(value, _PLAIN):
        yield path, value
    for key, inner in items:
        if not isinstance(inner, _PLAIN):
            yield from _within(f"{path}[{key!r}]", inner)


def versions_of(env: Any) -> dict[str, str]:
    """Versions of the libraries of an env's parts, sorted by name."""
    values: list[Any] = []
    for part in parts_of(env).values():
        values.append(part.value)
        if part.kind is _OWN:
            values += _held(part.value).values()
    names = {type(value).__module__.partition(".")[0] for value in values}
    found = {name: getattr(sys.modules.get(name), "__version__", None) for name in names}
    return {name: str(found[name]) for name in sorted(found) if isinstance(found[name], str)}


# -- saving and loading -------------------------------------------------------------------


class _Pickler(CodePickler):
    """Replaces parts by references to their paths."""

    def __init__(self, file: io.BytesIO, paths: Mapping[int, str]) -> None:
        super().__init__(file)
        self._paths = paths

    def persistent_id(self, obj: Any) -> str | None:
        if type(obj) in _BUILT_IN:  # Most objects are.
            return None
        path = self._paths.get(id(obj))
        if path is None:
            kind = _kind_of(obj)
            if kind not in (None, _KEPT, _SPACE) or (kind is _KEPT and type(obj) is np.ndarray):
                raise TypeError(
                    f"a {type(obj).__name__} of a simulator is in an object that is not a layer"
                )
        return path


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, parts: Mapping[str, _Part]) -> None:
        super().__init__(file)
        self._parts = parts

    def persistent_load(self, pid: str) -> Any:
        return self._parts[pid].value


def save_state(env: Any) -> SavedState:
    """Return the state of an env.

    Raises:
        NotImplementedError: a part of it can't be saved; the message names it.
    """
    parts = parts_of(env)
    for path, part in parts.items():
        if part.kind.is_layer and type(part.value).__basicsize__ > _Plain.__basicsize__:
            raise NotImplementedError(
                f"{path} of {_described(env)} is a {type(part.value).__name__}, whose state is "
                f"in a library that gives no access to it; {_WAY_OUT}"
            )
    paths = {id(part.value): path for path, part in parts.items()}
    states = {path: part.kind.save(part.value) for path, part in parts.items()}
    try:
        pickled = _pickled(states, paths)
    except Exception as error:
        raise NotImplementedError(_culprit(env, states, paths, error)) from error
    return SavedState(tuple((path, _name_of(part)) for path, part in parts.items()), pickled)


def _described(env: Any) -> str:
    """An env in an error: by its id, or by its type if it is a simulator within an env."""
    env_id = getattr(env, "env_id", None)
    return f"a {type(env).__name__}" if env_id is None else f"env {env_id!r}"


def _name_of(part: _Part) -> str:
    """Type of a part; of a MuJoCo model also its structure."""
    name = type(part.value).__qualname__
    return f"{name} {part.value.signature}" if name == "MjModel" else name


_WAY_OUT: Final = "your own BaseEnv can define save_state() and load_state()"


def _pickled(value: Any, paths: Mapping[int, str]) -> bytes:
    file = io.BytesIO()
    _Pickler(file, paths).dump(value)  # pyright: ignore[reportUnknownMemberType]
    return file.getvalue()


def _culprit(
    env: Any, states: Mapping[str, Any], paths: Mapping[int, str], error: Exception
) -> str:
    """Describe the object that can't be pickled."""
    for path, state in states.items():
        held = cast("dict[str, Any]", state) if isinstance(state, dict) else {}
        for name, value in held.items():
            try:
                _pickled(value, paths)
            except Exception as own:  # noqa: BLE001  # An object may raise anything.
                return (
                    f"{path}.{name} of {_described(env)}, a {type(value).__name__}, can't be "
                    f"saved: {own}; {_WAY_OUT}"
                )
    return f"{_described(env)} can't be saved: {error}; {_WAY_OUT}"


def load_state(env: Any, state: SavedState) -> None:
    """Restore the state of this env or of one with the same config.

    Raises:
        ValueError: the env has other parts; nothing was changed.
    """
    parts = parts_of(env)
    for path, name in state.parts:
        here = _name_of(parts[path]) if path in parts else "missing"
        if here != name:
            raise ValueError(
                f"{path} is a {name} in the snapshot, and {here} in {_described(env)}: it is "
                "another env, or has not been reset yet"
            )
    states = _Unpickler(io.BytesIO(state.pickled), parts).load()
    # Models come before the data that are computed from them.
    for path, _ in sorted(state.parts, key=lambda part: not part[1].startswith("MjModel")):
        parts[path].kind.load(parts[path].value, states[path])


# -- generators alone ---------------------------------------------------------------------

_GENERATORS: Final = (
    *(np.random.Generator, np.random.RandomState, np.random.BitGenerator),
    random.Random,
)
_CODE: Final = (type, ModuleType, FunctionType, BuiltinFunctionType, MethodType)
_WITHOUT: Final[tuple[type[Any], ...]] = (*_PLAIN, *_CODE, *_GENERATORS, np.ndarray)
_OF_GYMNASIUM: Final = ("_np_random", "_np_random_seed")
"""Attributes of envs and spaces; they are None until the first draw."""


def save_generators(env: Any) -> dict[str, Any]:
    """Return the random generators of an env, its wrappers and all that they hold; to be pickled.

    With them, another env goes on with the random numbers of this one from its next reset on. What
    saves itself (see `BaseEnv.save_state`), and a console, is saved as a whole.

    Raises:
        NotImplementedError: a state can't be read.
    """
    found: dict[str, Any] = {}
    for path, holder in _holders(env):
        if (kind := _saves_generators(holder)) is not None:
            found[path] = kind.save(holder)
        elif own := {k: v for k, v in _members(holder) if _is_generator(k, v)}:
            found[path] = own
    return found


def load_generators(env: Any, saved: Mapping[str, Any]) -> None:
    """Go on with the random numbers of another env; what isn't made yet begins as it is made."""
    for path, holder in _holders(env):
        if path not in saved:
            continue
        if (kind := _saves_generators(holder)) is not None:
            kind.load(holder, saved[path])
        elif type(holder) is list:
            for place, generator in saved[path].items():
                cast("list[Any]", holder)[place : place + 1] = [generator]
        elif type(holder) is tuple:
            for place, generator in saved[path].items():
                _go_on(cast("tuple[Any, ...]", holder)[place], generator)
        else:
            held = cast("dict[Any, Any]", holder if isinstance(holder, dict) else _held(holder))
            held.update(saved[path])


def _go_on(generator: Any, saved: Any) -> None:
    """Go on with the random numbers of another generator."""
    # A Generator of NumPy has its state in another object.
    own, other = (getattr(one, "bit_generator", one) for one in (generator, saved))
    own.__setstate__(other.__getstate__())


def _is_generator(name: Any, value: Any) -> bool:
    return isinstance(value, _GENERATORS) or name in _OF_GYMNASIUM


def _saves_generators(holder: Any) -> _Kind | None:
    """Return how to save an object whose generators are only in its whole state."""
    kind = cast("Any", type(holder))
    if hasattr(kind, "save_state") and hasattr(kind, "load_state"):
        is_default = kind.save_state.__module__ == "rlightning_aio.envs.base"
        return None if is_default else _OWN
    known = _kind_of(holder)
    return known if known is not None and known.save is _console_state else None


def _holders(env: Any) -> Iterator[tuple[str, Any]]:
    """Yield all that an env consists of, by path; each object once."""
    queue = [("env", env)]
    known = {id(env)}
    for path, holder in queue:
        yield path, holder
        for name, value in sorted(_members(holder), key=_name_first):
            if id(value) in known or isinstance(value, _WITHOUT) or name in NOT_STATE:
                continue
            if _kind_of(value) is not _KEPT:
                known.add(id(value))
                queue.append((f"{path}.{name}", value))


def _name_first(member: tuple[Any, Any]) -> str:
    return str(member[0])


def _members(holder: Any) -> Iterator[tuple[Any, Any]]:
    """Yield what an object, a list, a tuple or a dict holds, by name."""
    if type(holder) in (list, tuple):
        if holder and not isinstance(holder[0], _PLAIN):
            yield from enumerate(cast("list[Any]", holder))
    elif isinstance(holder, dict):
        yield from cast("dict[Any, Any]", holder).items()
    else:
        yield from getattr(holder, "__dict__", {}).items()
