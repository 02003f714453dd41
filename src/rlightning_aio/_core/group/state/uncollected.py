"""`UncollectedErrors`: the errors that wait for the collector.

An env is busy until its error has been raised, whatever the trainer has read.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio._core.group.state.conditions import FAULT
from rlightning_aio._core.group.state.request_states import State

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.conditions import Conditions
    from rlightning_aio.errors import EnvFault

# Plain ints: NumPy takes several times as long over members of an enum.
_IDLE_CODE: Final = int(State.IDLE)
_SPENT_CODE: Final = int(State.SPENT)


class UncollectedErrors:
    """See the module.

    Args:
        conditions: of the group.
        state: `State`, by slot.

    Attributes:
        faults: errors, in the order of their arrival.
        errors: by slot, the error that its request ended in; the env is busy until that is raised.
    """

    def __init__(self, conditions: Conditions, state: NDArray[np.int8]) -> None:
        self._conditions = conditions
        self._state = state
        self.faults: deque[EnvFault] = deque()
        self.errors: dict[int, EnvFault] = {}

    def keep(self, slots: NDArray[np.intp], fault: EnvFault) -> None:
        """Keep an error for the collector; the envs of `slots` are busy until it is raised."""
        self._state[slots] = _SPENT_CODE
        self.errors |= dict.fromkeys(slots.tolist(), fault)
        self.note_faults([fault])

    def note_faults(self, faults: Sequence[EnvFault]) -> None:
        """Keep errors for the collector that no env is busy with."""
        self.faults.extend(faults)
        self._conditions.note(FAULT, bool(self.faults))

    def take_fault(self, fault: EnvFault) -> NDArray[np.intp]:
        """Remove an error that the collector raises; return the slots that it frees."""
        self.faults.remove(fault)
        self._conditions.note(FAULT, bool(self.faults))
        return self.free([slot for slot, own in self.errors.items() if own is fault])

    def with_errors(self, slots: Sequence[int]) -> NDArray[np.intp]:
        """Return those of `slots` whose errors wait."""
        return np.array([slot for slot in slots if slot in self.errors], np.intp)

    def free(self, slots: Sequence[int]) -> NDArray[np.intp]:
        """Free those of `slots` whose errors wait, and return them; the errors stay."""
        free = self.with_errors(slots)
        self._state[free] = _IDLE_CODE
        for slot in free.tolist():
            del self.errors[slot]
        return free
