"""Steps and contact forces of many MuJoCo simulations in one call.

MuJoCo's `mjb_step` leaves contact forces out. They follow from the data of the last step, which a
thread drops when it goes on to its next simulation. So the compiled function `_mujoco_forces.c`
steps a simulation, computes its forces and copies its fields, before MuJoCo goes on. Where it was
not built, `mujoco_threads` has MuJoCo keep all data of each simulation, which takes more memory
and some 3 % more time.
"""

from __future__ import annotations

import ctypes
from ctypes import c_int64, c_void_p
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.protocol import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["StepsWithForces", "compiled"]

_MOST_OUTPUTS: Final = 16
_WORDS: Final = 512
"""Of 8 bytes, in the smallest page of memory."""


class _Output(ctypes.Structure):
    _fields_ = (("offset", c_int64), ("values", c_void_p), ("size", c_int64))


class _Plan(ctypes.Structure):
    _fields_ = (
        ("step", c_void_p),
        ("finish", c_void_p),
        ("num_steps", c_int64),
        ("num_outputs", c_int64),
        ("outputs", _Output * _MOST_OUTPUTS),
    )


def compiled() -> int | None:
    """Address of the compiled function; None where it was not built, or is not wanted."""
    if kernel.selected == "python":
        return None
    try:
        from rlightning_aio.envs.mujoco import _mujoco_forces
    except ImportError:
        return None
    return _mujoco_forces.STEP_AND_FINISH


class StepsWithForces:
    """Steps simulations, computes their contact forces and copies fields.

    Args:
        library: MuJoCo's.
        function: the compiled one.
        count: the number of simulations.
        template: data of the model.
    """

    def __init__(self, library: Any, function: int, count: int, template: Any) -> None:
        self._library, self._function = library, c_void_p(function)
        self._count, self._template = count, template
        step, finish = (
            ctypes.cast(each, c_void_p) for each in (library.mj_step, library.mj_rnePostConstraint)
        )
        self._plan = _Plan(step, finish)
        self._finish = finish
        self._forward = ctypes.cast(library.mj_forward, c_void_p)

    def output(self, name: str) -> NDArray[Any]:
        """Copy field `name` after each step, to the array ``[count, ...]`` that this returns."""
        field: NDArray[Any] = getattr(self._template, name)
        values = np.zeros((self._count, *field.shape), field.dtype)
        if field.size:
            offset = _offset_of(field.ctypes.data, self._template._address)  # noqa: SLF001
            plan = self._plan
            plan.outputs[plan.num_outputs] = _Output(offset, values.ctypes.data, field.nbytes)
            plan.num_outputs += 1
        return values

    def forward(self, batch: c_void_p, chosen: Any, count: int) -> int:
        """Compute what follows from the states; return the number of failed simulations."""
        plan = self._plan
        plan.num_steps, plan.finish = 0, self._forward
        return self._library.mjb_apply(
            batch, chosen, count, self._function, ctypes.byref(plan), True
        )

    def step(self, batch: c_void_p, chosen: Any, count: int, num_steps: int) -> int:
        """Do as `mjb_step`; return the number of failed simulations."""
        plan = self._plan
        plan.num_steps, plan.finish = num_steps, self._finish
        return self._library.mjb_apply(
            batch, chosen, count, self._function, ctypes.byref(plan), True
        )


def _offset_of(pointer: int, data: int) -> int:
    """Find the pointer to a field in the struct `mjData` at address `data`.

    The layout of the struct differs between versions of MuJoCo, and its fields lie elsewhere, each
    in a place of its own. Reads whole pages, none of them after the one with the pointer.
    """
    address = data
    while True:
        num_words = _WORDS - address // 8 % _WORDS
        words: Any = (c_int64 * num_words).from_address(address)
        found = np.flatnonzero(np.frombuffer(words, np.int64) == pointer)
        if len(found):
            return address - data + 8 * int(found[0])
        address += 8 * num_words
