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
import sys
from ctypes import c_double, c_int64, c_void_p
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from rlightning_aio.protocol import kernel

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

__all__ = [
    "AdvancePlan",
    "FieldPart",
    "Output",
    "address_of",
    "compiled",
    "inline_offset_of",
    "live_timestep",
    "offset_of",
]

_MOST_PARTS: Final = 32
_MOST_KNOWN: Final = 6
_KINDS: Final = ("copy", "squares", "within", "also_within")
"""Of parts, in the order of the compiled function's."""
_TYPES: Final[dict[str, Any]] = {
    "int": ctypes.c_int,
    "mjtBool": ctypes.c_bool,
    "mjtNum": c_double,
    "mjtSize": c_int64,
    "size_t": ctypes.c_size_t,
    "uint64_t": ctypes.c_uint64,
    "uintptr_t": c_void_p,
}


def _num_references(known: Iterable[tuple[Any, int]]) -> list[int]:
    return [sys.getrefcount(values) for values, _ in known]


(_UNSHARED,) = _num_references([(np.empty(1), 0)])
# Without the GIL, another thread may be about to take a reference.
_HAS_GIL: Final[bool] = getattr(sys, "_is_gil_enabled", lambda: True)()


class FieldPart(NamedTuple):
    """Values `first` to `stop` of a flattened field of a simulation.

    Attributes:
        kind: ``copy``, clipped; ``squares``, the sum of squares of the clipped values; ``within``,
            1 if all are between `low` and `high`, else 0; ``also_within``, the same, and to be
            joined to the part before, which is 0 then.
    """

    field: str
    first: int = 0
    stop: int | None = None
    low: float = -math.inf
    high: float = math.inf
    kind: Literal["copy", "squares", "within", "also_within"] = "copy"

    def of(self, field: NDArray[Any]) -> NDArray[Any]:
        """Make the part of fields ``[n, ...]``."""
        found = field.reshape(len(field), math.prod(field.shape[1:]))[:, self.first : self.stop]
        if self.kind.endswith("within"):
            return np.all((self.low < found) & (found < self.high), axis=1, keepdims=True)
        if self.low != -math.inf or self.high != math.inf:
            found = found.clip(self.low, self.high)
        if self.kind == "squares":
            return np.add.reduce(np.square(found), axis=1, keepdims=True)
        return found


class _Part(ctypes.Structure):
    _fields_ = (
        ("kind", c_int64),
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
        ("before", c_void_p),
        ("controls", c_void_p),
        ("squares", c_void_p),
        ("is_single", c_int64),
        ("warning", c_int64),
        ("unstable", c_int64 * 3),
        ("warned", c_int64),
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
            width -= part.kind == "also_within"
            if plan is not None:
                slot = plan.parts[plan.num_parts]
                plan.num_parts += 1
                slot.field, slot.first = offset_of(part.field, template), part.first
                slot.count, slot.low, slot.high = size, part.low, part.high
                slot.kind = _KINDS.index(part.kind)
                self._slots.append((slot, 8 * width * step))
            width += size if part.kind == "copy" else 1
        for slot, _ in self._slots:
            slot.row, slot.column = (1, count) if by_columns else (width, 1)
        self.values: NDArray[np.float64]
        self._known: list[tuple[NDArray[np.float64], int]] = []
        self.put(np.zeros((width, count) if by_columns else (count, width)))

    def put(self, values: NDArray[np.float64], address: int | None = None) -> None:
        """Write to `values` from now on; their address is asked for if it isn't given."""
        self.values = values
        if self._slots:
            address = address_of(values) if address is None else address
            for slot, offset in self._slots:
                slot.values = address + offset

    def renew(self) -> None:
        """Leave `values` to whoever has them, and write to an array that nobody else has.

        A new one, and asking for its address, take as long as ten operations of NumPy, so those
        that nobody has any more are used again. Views and tensors have the array, too.
        """
        counts = _num_references(self._known)
        if _HAS_GIL and _UNSHARED in counts:
            self.put(*self._known[counts.index(_UNSHARED)])
            return
        values = np.empty(self.values.shape)
        self._known = [*self._known[1 - _MOST_KNOWN :], (values, address_of(values))]
        self.put(*self._known[-1])

    def copy(self) -> None:
        """Leave `values` to whoever has them, and write to a copy."""
        self.put(self.values.copy())

    def read(self, ids: Any, fields: Mapping[str, NDArray[Any]]) -> None:
        """Write the parts of the simulations `ids`, whose fields ``[len(ids), ...]`` are given."""
        rows = self.values.T if self._by_columns else self.values
        first = 0
        for part in self.parts:
            found = part.of(fields[part.field])
            if part.kind == "also_within":
                first -= 1
                found = found & (rows[ids, first : first + 1] != 0)
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


def live_timestep(options: Any) -> ctypes.c_double:
    """Find the time step in the memory of an `mjOption`, where reading it takes less time.

    Raises:
        RuntimeError: another value is there than its binding says.
    """
    struct = _struct("mjOption")
    address = address_of(options.gravity) - struct.gravity.offset + struct.timestep.offset
    found = c_double.from_address(address)
    if found.value != options.timestep:
        raise RuntimeError("mjOption.timestep is not where this version of mujoco says")
    return found


def inline_offset_of(field: str) -> int:
    """Offset of a field of `mjData` that is no pointer."""
    return getattr(_struct("mjData"), field).offset


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
