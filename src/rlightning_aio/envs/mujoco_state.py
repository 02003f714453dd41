"""The state of MuJoCo's own structs: all that a simulation computes, to the bit.

Rule: not only what `mj_getState` knows, but every array of `MjData`: an env may read what the
last step computed (positions of bodies lag one step behind) before it takes the next one.
Contacts and constraints, which lie in an arena and are computed anew by each step, are those of
`mj_forward`. Of a model, what a task may change as it goes (masses, friction, sizes, options):
all but what was compiled from files.
Absent on purpose: an import of MuJoCo, which only an env that uses it needs.
"""

from __future__ import annotations

import json
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, cast
from weakref import WeakKeyDictionary

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = ["load_data", "load_model", "save_data", "save_model"]

_COMPILED: Final = (
    "tex_", "mesh_", "hfield_", "skin_", "flex", "name_", "names", "text", "tuple_", "paths",
    "oct_", "plugin", "vis", "stat", "B_", "D_", "M_", "map",
)  # fmt: skip
"""How the names of model arrays begin that come from files, or from the model's structure."""
_FLAGS: Final = ("flg_energypos", "flg_energyvel", "flg_subtreevel", "flg_rnepost")
"""What has been computed beside the last step."""

_views: WeakKeyDictionary[Any, dict[str, NDArray[Any]]] = WeakKeyDictionary()
"""Arrays of a struct by name, which stay where they are as long as it lives."""


def _views_of(
    struct: Any, is_state: Callable[[str, NDArray[Any]], bool]
) -> dict[str, NDArray[Any]]:
    found = _views.get(struct)
    if found is None:
        arrays: dict[str, Any] = {
            name: getattr(struct, name) for name in dir(struct) if name[0] != "_"
        }
        found = _views[struct] = {
            name: array
            for name, array in arrays.items()
            if type(array) is np.ndarray and is_state(name, array)
        }
    return found


def _data_views(data: Any) -> dict[str, NDArray[Any]]:
    start = _address(data.qpos)

    def is_state(name: str, array: NDArray[Any]) -> bool:
        # The others lie in the arena.
        return name == "energy" or 0 <= _address(array) - start < data.nbuffer

    return _views_of(data, is_state)


def _address(array: NDArray[Any]) -> int:
    return array.__array_interface__["data"][0]


def save_data(data: Any) -> tuple[float, dict[str, Any], bytes]:
    """All of a simulation; about as many bytes as ``data.nbuffer``."""
    flags = {name: getattr(data, name) for name in _FLAGS if hasattr(data, name)}
    return data.time, flags, _joined(_data_views(data))


def load_data(data: Any, state: tuple[float, dict[str, Any], bytes]) -> None:
    """Put a simulation back; its model must be back already."""
    time, flags, arrays = state
    data.time = time
    views = _data_views(data)
    _copy_back(views, arrays)
    mujoco: Any = import_module("mujoco")
    mujoco.mj_forward(data.model, data)
    # Of these, what differs was computed when the simulation was elsewhere.
    _copy_back(views, arrays)
    for name, flag in flags.items():
        setattr(data, name, flag)


def _joined(views: dict[str, NDArray[Any]]) -> bytes:
    return b"".join([view.tobytes() for view in views.values()])


def _copy_back(views: dict[str, NDArray[Any]], joined: bytes) -> None:
    start = 0
    for view in views.values():
        own = joined[start : start + view.nbytes]
        start += view.nbytes
        # Most of a model never changes.
        if own != view.tobytes():
            view[...] = np.frombuffer(own, view.dtype).reshape(view.shape)


def _model_views(model: Any) -> dict[str, NDArray[Any]]:
    return _views_of(model, lambda name, _: not name.startswith(_COMPILED))


def save_model(model: Any) -> tuple[bytes, bytes]:
    """What may change in a model."""
    options = {
        name: getattr(model.opt, name) for name in _options_of(cast("type[Any]", type(model.opt)))
    }
    values = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in options.items()}
    return json.dumps(values).encode(), _joined(_model_views(model))


@cache
def _options_of(kind: type[Any]) -> tuple[str, ...]:
    return tuple(name for name in dir(kind) if name[0] != "_" and not callable(getattr(kind, name)))


def load_model(model: Any, state: tuple[bytes, bytes]) -> None:
    """Put the values of a model of the same structure back."""
    options, arrays = state
    for name, value in json.loads(options).items():
        if isinstance(value, list):
            getattr(model.opt, name)[:] = value
        else:
            setattr(model.opt, name, value)
    _copy_back(_model_views(model), arrays)
