"""What MuJoCo's threads copy out of each simulation after a step or reset, into arrays of all.

Rule: the data of a simulation are in the cache of the thread that computed them, and contact forces
follow from them only until the thread goes on. So the compiled function `_advance.c` resets or
steps a simulation, computes its forces and copies parts of its fields, before MuJoCo goes on. Where
it was not built, `threads` has MuJoCo copy whole fields, and NumPy picks the parts; for contact
forces MuJoCo then keeps all data of each simulation.
"""

from __future__ import annotations

import ctypes
import math
from ctypes import c_double, c_int64, c_void_p
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from rlightning_aio.protocol import kernel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

__all__ = ["AdvancePlan", "FieldPart", "Output", "address_of", "compiled", "offset_of"]

_MOST_PARTS: Final = 32
_TYPES: Final[dict[str, Any]] = {
    "int": ctypes.c_int,
    "mjtBool": ctypes.c_bool,
    "mjtNum": c_double,
    "mjtSize": c_int64,
    "size_t": ctypes.c_size_t,
    "uint64_t": ctypes.c_uint64,
    "uintptr_t": c_void_p,
}


class FieldPart(NamedTuple):
    """Values `first` to `stop` of a flattened field of a simulation, clipped."""

    field: str
    first: int = 0
    stop: int | None = None
    low: float = -math.inf
    high: float = math.inf

    def of(self, field: NDArray[Any]) -> NDArray[Any]:
        """Copy the part of fields ``[n, ...]``."""
        found = field.reshape(len(field), math.prod(field.shape[1:]))[:, self.first : self.stop]
        if self.low == -math.inf and self.high == math.inf:
            return found
        return found.clip(self.low, self.high)


class _Part(ctypes.Structure):
    _fields_ = (
        ("field", c_int64),
        ("first", c_int64),
        ("count", c_int64),
        ("low", c_double),
        ("high", c_double),
        ("values", c_void_p),
        ("row", c_int64),
        ("column", c_int64),
    )


class AdvancePlan(ctypes.Structure):
    """What the compiled function does; its fields are explained in `_advance.c`."""

    _fields_ = (
        ("reset", c_void_p),
        ("forward", c_void_p),
        ("step", c_void_p),
        ("finish", c_void_p),
        ("get_state", c_void_p),
        ("signature", c_int64),
        ("num_moving", c_int64),
        ("fields", c_int64 * 3),
        ("sizes", c_int64 * 3),
        ("num_steps", c_void_p),
        ("starts", c_void_p),
        ("controls", c_void_p),
        ("before", c_void_p),
        ("num_parts", c_int64),
        ("parts", _Part * _MOST_PARTS),
    )


class Output:
    """Parts of all simulations, next to each other, after their last step or reset.

    Args:
        parts: in order.
        template: data of the model.
        count: the number of simulations.
        plan: of the compiled function, which is to make the copies; None if NumPy makes them.
        by_columns: `values` is ``[width, count]``, not ``[count, width]``.

    Attributes:
        values: as an array; assign another one with `put`.
    """

    def __init__(
        self,
        parts: Sequence[FieldPart],
        template: Any,
        count: int,
        plan: AdvancePlan | None,
        *,
        by_columns: bool = False,
    ) -> None:
        self.parts, self._by_columns = parts, by_columns
        self._slots: list[tuple[_Part, int]] = []
        width = 0
        for part in parts:
            size = len(range(getattr(template, part.field).size)[part.first : part.stop])
            step = count if by_columns else 1
            if plan is not None:
                slot = plan.parts[plan.num_parts]
                plan.num_parts += 1
                slot.field, slot.first = offset_of(part.field, template), part.first
                slot.count, slot.low, slot.high = size, part.low, part.high
                self._slots.append((slot, 8 * width * step))
            width += size
        for slot, _ in self._slots:
            slot.row, slot.column = (1, count) if by_columns else (width, 1)
        self.values: NDArray[np.float64]
        self.put(np.zeros((width, count) if by_columns else (count, width)))

    def put(self, values: NDArray[np.float64]) -> None:
        """Write to `values` from now on."""
        self.values = values
        if self._slots:
            address = address_of(values)
            for slot, offset in self._slots:
                slot.values = address + offset

    def renew(self) -> None:
        """Leave `values` to whoever has them, and write to an array without contents."""
        self.put(np.empty_like(self.values))

    def copy(self) -> None:
        """Leave `values` to whoever has them, and write to a copy."""
        self.put(self.values.copy())

    def read(self, ids: Any, fields: Mapping[str, NDArray[Any]]) -> None:
        """Write the parts of the simulations `ids`, whose fields ``[len(ids), ...]`` are given."""
        rows = self.values.T if self._by_columns else self.values
        first = 0
        for part in self.parts:
            found = part.of(fields[part.field])
            rows[ids, first : first + found.shape[1]] = found
            first += found.shape[1]


def address_of(array: NDArray[Any]) -> int:
    """Return where the values of an array begin; faster than `array.ctypes`."""
    return array.__array_interface__["data"][0]


def compiled() -> int | None:
    """Address of the compiled function; None where it was not built, or is not wanted."""
    if kernel.selected == "python":
        return None
    try:
        from rlightning_aio.envs.mujoco import _advance
    except ImportError:
        return None
    return _advance.ADVANCE


def offset_of(field: str, data: Any) -> int:
    """Offset of the pointer to `field` in MuJoCo's struct `mjData`.

    Raises:
        RuntimeError: the struct `data` has another pointer there than its binding says.
    """
    offset: int = getattr(_struct("mjData"), field).offset
    found = c_void_p.from_address(data._address + offset).value  # noqa: SLF001
    values: NDArray[np.float64] = getattr(data, field)
    if values.size and (found != address_of(values) or values.dtype != np.float64):
        raise RuntimeError(f"mjData.{field} is not where this version of mujoco says")
    return offset


@cache
def _struct(name: str) -> Any:
    """One of MuJoCo's structs, as its own description has it."""
    declared = import_module("mujoco.introspect.structs").STRUCTS[name].fields
    fields = [(field.name, _type(field.type)) for field in declared]
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def _type(declared: Any) -> Any:
    if hasattr(declared, "extents"):
        found = _type(declared.inner_type)
        for extent in reversed(declared.extents):
            found *= extent
        return found
    if not hasattr(declared, "name"):
        return c_void_p
    return _TYPES.get(declared.name) or _struct(declared.name)
