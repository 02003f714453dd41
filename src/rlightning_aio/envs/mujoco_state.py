"""The exact state of MuJoCo's structs.

Rule: the state of `MjData` is every array, not only those of `mj_getState`, because an env may read
results of the last step (positions of bodies lag one step behind) before the next one. Contacts and
constraints, which are in an arena and recomputed by each step, come from `mj_forward`. The state of
a model is what a task may change (masses, friction, sizes, options), not what was compiled from
files.
Absent on purpose: an import of MuJoCo, which only envs that use it need.
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

_COMPILED: Final = (
    "tex_", "mesh_", "hfield_", "skin_", "flex", "name_", "names", "text", "tuple_", "paths",
    "oct_", "plugin", "vis", "stat", "B_", "D_", "M_", "map",
)  # fmt: skip
"""Prefixes of model arrays that come from files, or from the structure of the model."""
_FLAGS: Final = ("flg_energypos", "flg_energyvel", "flg_subtreevel", "flg_rnepost")
"""Flags of quantities computed in addition to the last step."""

_views: WeakKeyDictionary[Any, dict[str, NDArray[Any]]] = WeakKeyDictionary()
"""Arrays of a struct by name; their memory is fixed for the life of the struct."""


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
        # Other arrays are in the arena.
        return name == "energy" or 0 <= _address(array) - start < data.nbuffer

    return _views_of(data, is_state)


def _address(array: NDArray[Any]) -> int:
    return array.__array_interface__["data"][0]


def save_data(data: Any) -> tuple[float, dict[str, Any], bytes]:
    """Return the state of a simulation, of about ``data.nbuffer`` bytes."""
    flags = {name: getattr(data, name) for name in _FLAGS if hasattr(data, name)}
    return data.time, flags, _joined(_data_views(data))


def load_data(data: Any, state: tuple[float, dict[str, Any], bytes]) -> None:
    """Restore a simulation, after its model."""
    time, flags, arrays = state
    data.time = time
    views = _data_views(data)
    _copy_back(views, arrays)
    mujoco: Any = import_module("mujoco")
    mujoco.mj_forward(data.model, data)
    # `mj_forward` has overwritten some of the restored arrays.
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
        # Most arrays of a model never change.
        if own != view.tobytes():
            view[...] = np.frombuffer(own, view.dtype).reshape(view.shape)


def _model_views(model: Any) -> dict[str, NDArray[Any]]:
    return _views_of(model, lambda name, _: not name.startswith(_COMPILED))


def save_model(model: Any) -> tuple[bytes, bytes]:
    """Return the values of a model that may change."""
    options = {
        name: getattr(model.opt, name) for name in _options_of(cast("type[Any]", type(model.opt)))
    }
    values = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in options.items()}
    return json.dumps(values).encode(), _joined(_model_views(model))


@cache
def _options_of(kind: type[Any]) -> tuple[str, ...]:
    return tuple(name for name in dir(kind) if name[0] != "_" and not callable(getattr(kind, name)))


def load_model(model: Any, state: tuple[bytes, bytes]) -> None:
    """Restore the values of a model with the same structure."""
    options, arrays = state
    for name, value in json.loads(options).items():
        if isinstance(value, list):
            getattr(model.opt, name)[:] = value
        else:
            setattr(model.opt, name, value)
    _copy_back(_model_views(model), arrays)
