"""Many MuJoCo simulations of one model, stepped by MuJoCo's own C++ threads.

This is the C interface of `mujoco.batch` (mjbatch.h, MuJoCo 3.17 and later), called through ctypes:
its Python class lacks `mjb_apply`, which `outputs` needs. Calls release the GIL.
Rule: a simulation is a row of numbers, the integration state; everything else is an output that is
valid after a call. Left out: which numbers a task observes (`tasks`).
"""

from __future__ import annotations

import ctypes
import os
import weakref
from ctypes import POINTER, byref, c_bool, c_char_p, c_int, c_int64, c_void_p
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.envs.mujoco.outputs import (
    AdvancePlan,
    FieldPart,
    Noise,
    Outputs,
    Terms,
    address_of,
    compiled,
    inline_offset_of,
    offset_of,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Its stubs are incomplete.
mujoco: Any = import_module("mujoco")

_INTEGRATION: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_ALL_STAGES: Final = int(mujoco.mjtStage.mjSTAGE_ACC)
_STATE_FIELDS: Final = ("qpos", "qvel", "ctrl")
_UNSTABLE: Final = {
    int(warning): name
    for warning, name in (
        (mujoco.mjtWarning.mjWARN_BADQPOS, "position"),
        (mujoco.mjtWarning.mjWARN_BADQVEL, "velocity"),
        (mujoco.mjtWarning.mjWARN_BADQACC, "acceleration"),
    )
}
"""Warnings upon which MuJoCo resets a simulation to the defaults of its model."""
_CONTROLS: Final = (np.float32, np.float64)
"""Types of actions whose squares the compiled function sums up."""
_DTYPES: Final = {8: np.float64, 4: np.int32, 1: np.uint8}


class _Config(ctypes.Structure):
    _fields_ = (("nthread", c_int), ("persistent", c_bool))


@cache
def _library() -> Any:
    """MuJoCo's library.

    Raises:
        NotImplementedError: this version has no batches.
    """
    folder = Path(mujoco.__file__).parent
    (path,) = [*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib")][:1]
    library: Any = ctypes.CDLL(os.fspath(path))
    try:
        library.mjb_apply  # noqa: B018
    except AttributeError:
        raise NotImplementedError(
            f"mujoco {mujoco.__version__} has no batches; install mujoco 3.17 or later"
        ) from None
    for name, result in (
        ("makeBatch", c_void_p),
        ("state", c_void_p),
        ("stateComponent", c_void_p),
        ("output", c_void_p),
        ("warning", c_void_p),
        ("status", c_void_p),
        ("error", c_char_p),
    ):
        getattr(library, f"mjb_{name}").restype = result
    library.mjb_deleteBatch.argtypes = [c_void_p]
    return library


def _state_of(model: Any, data: Any, row: NDArray[np.float64]) -> None:
    """Write the integration state of `data` to `row`."""
    mujoco.mj_getState(model, data, row, _INTEGRATION)


class Simulations:
    """Simulations of one model.

    Args:
        model: shared by all simulations, so changes of it take effect.
        count: the number of simulations.
        num_threads: number of threads for steps, including the caller's.
        forces: compute contact forces (``cfrc_ext``) after each step.

    Attributes:
        rows: states of the simulations, ``[count, ...]`` float64.
        moving: the part of `rows` that a step reads and changes; controls are only read.
        num_steps: of MuJoCo, for each simulation in the next `advance`; 0 for a reset.
        starts: positions and velocities after a reset, ``[count, nq + nv]``.
        squares: of the controls of the last steps, summed up, ``[count]``.
        before: `moving` before the last steps, or after the last reset.
        outputs: what the task reads of them, after `watch`.
        began: the clock at the last reset of each.
        has_judged: the last `advance` wrote rewards and ends.
        any_ended: if so, whether an episode has ended.

    Raises:
        NotImplementedError: MuJoCo is older than 3.17.
    """

    def __init__(self, model: Any, count: int, num_threads: int, *, forces: bool) -> None:
        self._library = library = _library()
        self.count, self._model = count, model
        self._template = mujoco.MjData(model)
        function = compiled()
        # Without the compiled function, MuJoCo must keep what forces are computed from.
        self._keeps_data, self._has_forces = forces and function is None, forces
        config = _Config(min(num_threads, count), self._keeps_data)
        error = ctypes.create_string_buffer(1000)
        address = library.mjb_makeBatch(
            c_void_p(model._address),  # noqa: SLF001  # Intended for this use.
            count,
            byref(config),
            error,
            len(error),
        )
        if not address:
            raise RuntimeError(f"MuJoCo can't make {count} simulations: {error.value.decode()}")
        self._batch = c_void_p(address)
        self.close = weakref.finalize(self, library.mjb_deleteBatch, c_void_p(address))
        models = (c_void_p * count)(*[model._address] * count)  # noqa: SLF001
        library.mjb_setModels(self._batch, models)
        size = library.mjb_nstate(self._batch)
        self.rows = _array(library.mjb_state(self._batch), np.float64, (count, size))
        self._signature = _moving(model)
        self.moving = self.rows[:, : mujoco.mj_stateSize(model, self._signature)]
        self.num_steps = np.zeros(count, np.int64)
        self.starts = np.zeros((count, model.nq + model.nv))
        self._even_steps = 0  # The number of steps of all, if it is the same.
        self.before = self.moving.copy()
        self.began = np.zeros(count, np.int64)
        self.outputs: Outputs
        self._parts: list[FieldPart] = []
        self._kept: Any = None
        self._has_terms = self._can_judge = self.has_judged = self.any_ended = False
        self._fields: dict[str, NDArray[Any]] = {}
        self._plan = None if function is None else self._planned()
        self._kind: Any
        self._controls: NDArray[Any]
        self.squares: NDArray[Any]
        self._use(np.float64)
        self._function, self._plan_at = c_void_p(function), self._plan and byref(self._plan)
        num_warnings = int(mujoco.mjtWarning.mjNWARNING)
        # Pairs of the last details and a number.
        warnings = _array(library.mjb_warning(self._batch), np.int32, (count, num_warnings, 2))
        self._warned, self._warnings = warnings.view(np.int64).reshape(-1), warnings[..., 1]
        self._status = _array(library.mjb_status(self._batch), np.int32, (count,))

    def _planned(self) -> AdvancePlan:
        """Return what the compiled function is to do for each simulation."""
        library, template, model = self._library, self._template, self._model
        names = ["mj_resetData", "mj_forward", "mj_step", "mj_rnePostConstraint", "mj_getState"]
        functions = [ctypes.cast(getattr(library, name), c_void_p) for name in names]
        if not self._has_forces:
            functions[3] = c_void_p()
        fields = [offset_of(name, template) for name in ("qpos", "qvel", "ctrl")]
        arrays = (self.num_steps, self.starts, self.before)
        return AdvancePlan(
            *functions,
            self._signature,
            self.moving.shape[1],
            (c_int64 * 3)(*fields),
            (c_int64 * 3)(model.nq, model.nv, model.nu),
            self.count,
            *map(address_of, arrays),
            began=address_of(self.began),
            warning=inline_offset_of("warning"),
            unstable=(c_int64 * 3)(*_UNSTABLE),
        )

    def watch(
        self, observed: list[FieldPart], watched: list[FieldPart], num_further: int = 0
    ) -> Outputs:
        """Copy parts of each simulation after its steps or resets; see `Outputs`."""
        self._parts = [*observed, *watched]
        plan = self._plan
        self.outputs = Outputs(observed, watched, num_further, self._template, self.count, plan)
        if plan is None:
            for part in self._parts:
                self._field(part.field)  # MuJoCo copies it from now on.
        else:
            plan.terms.num_places = 0
        self._has_terms = self._can_judge = False
        return self.outputs

    def judge(
        self, terms: Terms, velocity: int, places: NDArray[np.float64], timestep: Any
    ) -> None:
        """Compute rewards and ends by the compiled function, if that is possible.

        Args:
            terms: of rewards.
            velocity: the first of the columns that are computed.
            places: before a step, ``[terms.num_places, count]``; written to.
            timestep: of MuJoCo, in its memory.
        """
        if self._plan is None or not terms.are_plain:
            return
        at, given = self._plan.terms, terms._asdict()
        for name in ("healthy_at", "control_at", "contact_at"):
            given[name] = -1 if given[name] is None else given[name]
        for name, value in given.items():
            setattr(at, name, value)
        at.velocity, at.places = velocity, address_of(places)
        at.timestep = ctypes.addressof(timestep)
        self._kept, self._has_terms = (places, timestep), True
        self._use(self._kind)

    def draw(self, noise: Noise | None) -> None:
        """Draw the noise of resets in MuJoCo's threads; None if `starts` has the first states."""
        if self._plan is not None:
            self._plan.draws = noise is not None
            if noise is not None:
                self._plan.noise = noise

    def limit(self, num_steps: int) -> None:
        """Truncate episodes after some steps."""
        if self._plan is not None:
            self._plan.limit = num_steps

    def _field(self, name: str) -> NDArray[Any]:
        """A field of all simulations, ``[count, ...]``, where no function was compiled."""
        found = self._fields.get(name)
        if found is None:
            found = self._fields[name] = self._found(name)
        return found

    def _found(self, name: str) -> NDArray[Any]:
        shape = getattr(self._template, name).shape
        size, width = c_int(), c_int()
        if name in _STATE_FIELDS:
            bit = getattr(mujoco.mjtState, f"mjSTATE_{name.upper()}")
            address = self._library.mjb_stateComponent(self._batch, int(bit), byref(size))
            first = (address - self.rows.ctypes.data) // self.rows.itemsize
            return self.rows[:, first : first + size.value]
        address = self._library.mjb_output(self._batch, name.encode(), byref(size), byref(width))
        return _array(address, _DTYPES[width.value], (self.count, *shape))

    # -- steps --------------------------------------------------------------------------

    def advance(
        self, ids: NDArray[np.int32] | None = None, clock: int | None = None
    ) -> dict[int, str]:
        """Step or reset the simulations `ids`, or all, each as its element of `num_steps` says.

        Contact forces are 0 after a reset.

        Args:
            ids: None for all.
            clock: count of steps, after this one, to compute rewards and ends if that is possible,
                and to note when episodes began; see `has_judged`.

        Returns:
            Reasons of failures by simulation. After an error of MuJoCo the simulation is in its
            previous state; if it became unstable, MuJoCo resets it to the defaults of the model.

        Raises:
            RuntimeError: MuJoCo can't reset a simulation.
        """
        plan = self._plan
        if plan is None:
            failures = self._advance_by_numpy(ids)
        else:
            chosen, count = _chosen(ids)
            self.has_judged = judges = clock is not None and self._can_judge
            plan.judges, plan.any_ended, plan.clock = judges, 0, clock or 0
            num_failed = self._library.mjb_apply(
                self._batch, chosen, count, self._function, self._plan_at, True
            )
            failures = self._failures() if num_failed or plan.warned else {}
            self.any_ended, plan.warned = bool(plan.any_ended), 0
        for k, cause in failures.items():
            if not self.num_steps[k]:
                raise RuntimeError(f"MuJoCo can't reset: {cause}")
            self.before[k] = self.moving[k]
            self.begin(k)
        return failures

    def begin(self, ids: Any) -> None:
        """Have the next `advance` reset the simulations `ids`; or note that they were moved."""
        self.num_steps[ids], self._even_steps = 0, 0

    def control(self, actions: NDArray[Any], num_steps: int) -> None:
        """Have the next `advance` take so many steps of MuJoCo with these controls, in all.

        Args:
            actions: ``[count, nu]``.
            num_steps: of MuJoCo.
        """
        if self._even_steps != num_steps:
            self.num_steps[:], self._even_steps = num_steps, num_steps
        kind = actions.dtype.type
        if kind is not self._kind:
            self._use(kind)
        # Their own address is not asked for, as that takes as long as several copies.
        self._controls[...] = actions
        if self._plan is None or kind not in _CONTROLS:
            self.squares = np.add.reduce(np.square(actions), axis=1)

    def _use(self, kind: type[Any]) -> None:
        """Take controls of a type from now on."""
        self._kind, plan = kind, self._plan
        self._can_judge = self._has_terms and kind in _CONTROLS
        kind = kind if kind in _CONTROLS else np.float64
        self._controls = np.zeros((self.count, self._model.nu), kind)
        self.squares = self._summed = np.zeros(self.count, kind)
        if plan is not None:
            plan.controls, plan.squares = map(address_of, (self._controls, self._summed))
            plan.is_single = kind is np.float32

    def _advance_by_numpy(self, ids: NDArray[np.int32] | None) -> dict[int, str]:
        """The twin of the compiled function, for several simulations. Return failures."""
        library, batch = self._library, self._batch
        all_ids = np.arange(self.count, dtype=np.int32) if ids is None else ids
        is_reset = self.num_steps[all_ids] == 0
        begun, stepped = all_ids[is_reset], all_ids[~is_reset]
        failures: dict[int, str] = {}
        if len(begun):
            mujoco.mj_resetData(self._model, self._template)
            _state_of(self._model, self._template, first := np.empty_like(self.rows[0]))
            self.rows[begun], nq = first, self._model.nq
            self._field("qpos")[begun] = self.starts[begun, :nq]
            self._field("qvel")[begun] = self.starts[begun, nq:]
            if library.mjb_forward(batch, *_chosen(begun), _ALL_STAGES):
                failures = self._failures()
            self.before[begun] = self.moving[begun]
            if self._has_forces:
                self._field("cfrc_ext")[begun] = 0.0
        if len(stepped):
            self._field("ctrl")[stepped] = self._controls[stepped]
            self.before[stepped] = self.moving[stepped]
            chosen, num_steps = _chosen(stepped), int(self.num_steps[stepped[0]])
            num_failed = library.mjb_step(batch, *chosen, num_steps, 0)
            if num_failed or np.count_nonzero(self._warned):
                failures |= self._failures()
            if self._keeps_data:
                forces = library.mj_rnePostConstraint  # It ignores the further arguments.
                library.mjb_apply(batch, *chosen, forces, None, False)
                # Computes nothing, but copies the outputs.
                library.mjb_forward(batch, *chosen, 0)
        self.outputs.read(
            all_ids, {part.field: self._field(part.field)[all_ids] for part in self._parts}
        )
        return failures

    def _failures(self) -> dict[int, str]:
        failures: dict[int, str] = {}
        for warning, name in _UNSTABLE.items():
            for k in np.flatnonzero(self._warnings[:, warning]).tolist():
                failures[k] = f"NaN, infinite or huge {name}: the simulation is unstable"
        self._warned[:] = 0
        for k in np.flatnonzero(self._status).tolist():
            failures[k] = " ".join(self._library.mjb_error(self._batch, k).decode().split())
        return failures

    def save_state(self) -> list[NDArray[Any]]:
        """Return the state of all simulations."""
        return [each.copy() for each in (self.rows, self.before, self.num_steps)]

    def load_state(self, state: list[NDArray[Any]]) -> None:
        """Restore what `save_state` returned."""
        self.rows[:], self.before[:], self.num_steps[:] = state
        self._even_steps = 0

    def put(self, k: int, data: Any) -> None:
        """Continue simulation `k` from `data`, and copy its parts to the columns."""
        _state_of(self._model, data, self.rows[k])
        self.before[k] = self.moving[k]
        self.begin(k)
        fields = {part.field: getattr(data, part.field)[np.newaxis] for part in self._parts}
        self.outputs.watch([k], fields)

    def data_of(self, k: int) -> Any:
        """All data of simulation `k` after its last step, by repeating that step."""
        data, num_steps = mujoco.MjData(self._model), int(self.num_steps[k])
        state, before = self.rows[k].copy(), self.before[k]
        state[: len(before)] = before
        mujoco.mj_setState(self._model, data, state, _INTEGRATION)
        if not num_steps:
            warmstart = data.qacc_warmstart.copy()
            data.qacc_warmstart[:] = 0  # As in the reset.
            mujoco.mj_forward(self._model, data)
            data.qacc_warmstart[:] = warmstart  # The state itself stays as it is.
            return data
        mujoco.mj_step(self._model, data, num_steps)
        mujoco.mj_rnePostConstraint(self._model, data)
        return data


def _chosen(ids: NDArray[np.int32] | None) -> tuple[Any, int]:
    """Convert ids of simulations to C arguments."""
    if ids is None:
        return None, 0
    return ids.ctypes.data_as(POINTER(c_int)), len(ids)


def _moving(model: Any) -> int:
    """Signature of the leading values of a state that steps change; of all, if others change."""
    states = mujoco.mjtState
    leading = int(states.mjSTATE_CTRL) - 1  # Up to the warm start.
    changing = int(states.mjSTATE_FULLPHYSICS) | int(states.mjSTATE_USERDATA)
    return _INTEGRATION if mujoco.mj_stateSize(model, changing & ~leading) else leading


def _array(address: int, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """MuJoCo's memory as an array."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if not size:
        return np.empty(shape, dtype)
    memory: Any = (ctypes.c_char * size).from_address(address)
    return np.frombuffer(memory, dtype).reshape(shape)
