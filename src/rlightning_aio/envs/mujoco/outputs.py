"""What MuJoCo's threads copy out of each simulation after a step or reset, into arrays of all.

Rule: the data of a simulation are in the cache of the thread that computed them, and contact forces
follow from them only until the thread continues. So the compiled function `_advance.c` resets or
steps a simulation, computes its forces and copies parts of its fields, before it goes on. Where it
was not built, `threads` has MuJoCo copy whole fields, and NumPy picks the parts; for contact
forces MuJoCo then keeps all data of each simulation. The compiled function draws the noise of
resets and computes rewards and ends, too, which other threads than the trainer's then do.
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
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

_MOST_PARTS: Final = 32
_MOST_KNOWN: Final = 6
# Without the GIL, another thread may be about to take a reference.
_HAS_GIL: Final[bool] = getattr(sys, "_is_gil_enabled", lambda: True)()
_KINDS: Final = ("copy", "squares", "within", "also_within", "centre")
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


class FieldPart(NamedTuple):
    """Values `first` to `stop` of a flattened field of a simulation.

    Attributes:
        kind: ``copy``, clipped; ``squares``, the sum of squares of the clipped values; ``within``,
            1 if all are between `low` and `high`, else 0; ``also_within``, the same, and to be
            joined to the part before, which is 0 then; ``centre``, of places of bodies in the
            plane, with their `weights`.
    """

    field: str
    first: int = 0
    stop: int | None = None
    low: float = -math.inf
    high: float = math.inf
    kind: Literal["copy", "squares", "within", "also_within", "centre"] = "copy"
    weights: NDArray[np.float64] | None = None

    def of(self, field: NDArray[Any]) -> NDArray[Any]:
        """Make the part of fields ``[n, ...]`` of n simulations."""
        if self.weights is not None:
            places = np.ascontiguousarray(field[..., :2].transpose(1, 2, 0))
            scaled = self.weights[:, np.newaxis, np.newaxis] * places
            return (np.add.reduce(scaled, axis=0) / np.add.reduce(self.weights)).T
        found = field.reshape(len(field), math.prod(field.shape[1:]))[:, self.first : self.stop]
        if self.kind.endswith("within"):
            return np.all((self.low < found) & (found < self.high), axis=1, keepdims=True)
        if self.low != -math.inf or self.high != math.inf:
            found = found.clip(self.low, self.high)
        if self.kind == "squares":
            return np.add.reduce(np.square(found), axis=1, keepdims=True)
        return found

    def width(self, template: Any) -> int:
        """The number of values that it adds to those before."""
        if self.kind == "copy":
            return self.size(template)
        return {"centre": 2, "also_within": 0}.get(self.kind, 1)

    def size(self, template: Any) -> int:
        return len(range(getattr(template, self.field).size)[self.first : self.stop])


class Terms(NamedTuple):
    """What a step of a robot is worth: ``forward + alive - (control + contact)``.

    The `..._at` are columns; the first ones are where the robot is.

    Attributes:
        num_places: number of coordinates, 1 or 2.
        forward: weight of the velocity along the first one.
        control: weight of the squares of the controls, or of a column.
        control_at: that column.
        healthy_at: whether the robot is healthy.
        alive: the reward for being so.
        ends: an unhealthy robot is terminated.
        contact_at: cost of contacts, with a weight and bounds.
    """

    num_places: int
    forward: float
    control: float
    control_at: int | None = None
    healthy_at: int | None = None
    alive: float = 0.0
    ends: bool = False
    contact_at: int | None = None
    contact: float = 0.0
    low: float = -math.inf
    high: float = math.inf

    @property
    def are_plain(self) -> bool:
        """True if NumPy computes with the weights as with numbers of C."""
        weights = (self.forward, self.control, self.alive, self.contact)
        are_finite = all(_is_number(value) and abs(value) <= 2**53 for value in weights)
        return are_finite and _is_number(self.low) and _is_number(self.high)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and not math.isnan(value)


class StepArrays(NamedTuple):
    """What a step of all writes.

    Attributes:
        observations: ``[n, width]``.
        columns: what rewards and infos are made of, ``[..., n]``.
        rewards, terminated, truncated: of all.
        ended: terminated or truncated.
    """

    observations: NDArray[np.float64]
    columns: NDArray[np.float64]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    ended: NDArray[np.bool_]


class _Frame(ctypes.Structure):
    _fields_ = tuple((name, c_void_p) for name in StepArrays._fields)


class _Part(ctypes.Structure):
    _fields_ = (
        ("kind", c_int64),
        ("field", c_int64),
        ("first", c_int64),
        ("count", c_int64),
        ("low", c_double),
        ("high", c_double),
        ("weights", c_void_p),
        ("is_column", c_int64),
        ("place", c_int64),
    )


class _Terms(ctypes.Structure):
    _fields_ = (
        ("num_places", c_int64),
        ("velocity", c_int64),
        ("healthy_at", c_int64),
        ("control_at", c_int64),
        ("contact_at", c_int64),
        ("ends", c_int64),
        ("forward", c_double),
        ("alive", c_double),
        ("control", c_double),
        ("contact", c_double),
        ("low", c_double),
        ("high", c_double),
        ("places", c_void_p),
        ("timestep", c_void_p),
    )


class Noise(ctypes.Structure):
    """How the compiled function draws positions and velocities; see `_advance.c`."""

    _fields_ = (
        ("generators", c_void_p),
        ("normal", c_void_p),
        ("scale", c_double),
        ("positions", c_void_p),
        ("velocities", c_void_p),
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
        ("num_simulations", c_int64),
        ("num_steps", c_void_p),
        ("starts", c_void_p),
        ("before", c_void_p),
        ("controls", c_void_p),
        ("squares", c_void_p),
        ("is_single", c_int64),
        ("warning", c_int64),
        ("unstable", c_int64 * 3),
        ("warned", c_int64),
        ("draws", c_int64),
        ("noise", Noise),
        ("judges", c_int64),
        ("terms", _Terms),
        ("clock", c_int64),
        ("limit", c_int64),
        ("began", c_void_p),
        ("any_ended", c_int64),
        ("frame", c_void_p),
        ("width", c_int64),
        ("num_parts", c_int64),
        ("parts", _Part * _MOST_PARTS),
    )


_PLAN_SIZE: Final = AdvancePlan.parts.offset + ctypes.sizeof(_Part)
"""As the compiled function has it: up to its first part, and of that."""


def _most_references(arrays: tuple[NDArray[Any], ...]) -> int:
    """Return the most references to one of the arrays, those of views and tensors included."""
    return max(map(sys.getrefcount, arrays))


_UNSHARED: Final = _most_references(tuple(map(np.empty, range(1, 7))))


class Outputs:
    """Parts of all simulations, after their last step or reset, and what follows from them.

    Args:
        observed: parts of observations, next to each other.
        watched: parts that become columns.
        num_further: number of columns after these, for what is computed.
        template: data of the model.
        count: the number of simulations.
        plan: of the compiled function, which is to make the copies; None if NumPy makes them.

    Attributes:
        frame: where they are written.
    """

    def __init__(
        self,
        observed: Sequence[FieldPart],
        watched: Sequence[FieldPart],
        num_further: int,
        template: Any,
        count: int,
        plan: AdvancePlan | None,
    ) -> None:
        self._parts, self._plan, self._count = (observed, watched), plan, count
        self.widths = [sum(part.width(template) for part in parts) for parts in self._parts]
        self._shapes = (count, self.widths[0]), (self.widths[1] + num_further, count)
        if plan is not None:
            plan.num_parts, plan.width = 0, self.widths[0]
            for is_column, parts in enumerate(self._parts):
                self._explain(plan, parts, is_column, template)
        self._known: list[tuple[StepArrays, _Frame | None]] = []
        self.frame: StepArrays
        self._use(self._made(np.zeros(self._shapes[0]), np.zeros(self._shapes[1])))

    def _explain(
        self, plan: AdvancePlan, parts: Sequence[FieldPart], is_column: int, template: Any
    ) -> None:
        place = 0
        for part in parts:
            slot = plan.parts[plan.num_parts]
            plan.num_parts += 1
            slot.kind, slot.field = _KINDS.index(part.kind), offset_of(part.field, template)
            slot.first, slot.count = part.first, part.size(template)
            slot.low, slot.high, slot.is_column = part.low, part.high, is_column
            slot.place = place - (part.kind == "also_within")
            if part.weights is not None:
                slot.weights = address_of(part.weights)
            place += part.width(template)

    def _made(
        self, observations: NDArray[np.float64], columns: NDArray[np.float64]
    ) -> tuple[StepArrays, _Frame | None]:
        flags = [np.zeros(self._count, np.bool_) for _ in range(3)]
        frame = StepArrays(observations, columns, np.zeros(self._count), *flags)
        return frame, None if self._plan is None else _Frame(*map(address_of, frame))

    def _use(self, made: tuple[StepArrays, _Frame | None]) -> None:
        self.frame, self._at = made
        if self._plan is not None and self._at is not None:
            self._plan.frame = ctypes.addressof(self._at)

    def renew(self) -> None:
        """Write to another frame, as a caller may have this one.

        Making arrays, and asking for their addresses, takes longer than a step's own Python, so
        those without further references are used again. New columns are zeros: infos are computed
        of all simulations, also of those that are reset instead of a step and leave theirs as is.
        """
        known = self._known
        for k, made in enumerate(known):
            if _HAS_GIL and _most_references(made[0]) <= _UNSHARED:
                del known[k]
                break
        else:
            del known[: 1 - _MOST_KNOWN]
            made = self._made(np.empty(self._shapes[0]), np.zeros(self._shapes[1]))
        known.append(made)
        self._use(made)

    def begin(self, observations: NDArray[np.float64]) -> None:
        """Write to `observations` and to a copy of the columns, as some simulations stay."""
        self._use(self._made(observations, self.frame.columns.copy()))

    def read(self, ids: Any, fields: Mapping[str, NDArray[Any]]) -> None:
        """Write the parts of the simulations `ids`, whose fields ``[len(ids), ...]`` are given."""
        self._write(self.frame.observations, self._parts[0], ids, fields)
        self.watch(ids, fields)

    def watch(self, ids: Any, fields: Mapping[str, NDArray[Any]]) -> None:
        """The same, without observations."""
        self._write(self.frame.columns.T, self._parts[1], ids, fields)

    def _write(
        self,
        rows: NDArray[np.float64],
        parts: Sequence[FieldPart],
        ids: Any,
        fields: Mapping[str, NDArray[Any]],
    ) -> None:
        first = 0
        for part in parts:
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
    """Address of the compiled function; None where this version was not built, or is not wanted."""
    if kernel.selected == "python":
        return None
    try:
        from rlightning_aio.envs.mujoco import _advance
    except ImportError:
        return None
    is_ours = getattr(_advance, "PLAN_SIZE", None) == _PLAN_SIZE
    return _advance.ADVANCE if is_ours else None


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
    """Find the time step in the memory of an `mjOption`, where the compiled function reads it.

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
