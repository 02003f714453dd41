"""Seeds of the envs, from the `seed` argument of a reset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from rlightning_aio._core.group.episodes.episodes import as_int
from rlightning_aio.protocol.slab import NO_SEED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable

__all__ = ["Seeds", "checked_seed", "seeds_for"]

Seeds: TypeAlias = "int | Sequence[int] | Mapping[str, int] | None"


def seeds_for(envs: EnvTable, seed: Seeds, slots: NDArray[np.intp]) -> NDArray[np.int64]:
    """The seed of each slot, ``[n]``; `NO_SEED` for none.

    From an int, sub-environment k of the group gets ``seed + k``.

    Raises:
        ValueError: a seed is out of range, or of an env that is not being reset, or there isn't one
            for each slot.
    """
    if seed is None:
        return np.full(len(slots), NO_SEED)
    if isinstance(seed, Mapping):
        given = {envs.find_one(env_id): checked_seed(one) for env_id, one in seed.items()}
        chosen = [given.pop(slot, NO_SEED) for slot in slots.tolist()]
        if given:
            names = ", ".join(repr(envs.env_ids[slot]) for slot in given)
            raise ValueError(
                f"there are seeds for {names}, which this call doesn't reset; leave them out, or "
                "name these envs in env_ids, too"
            )
    elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
        if len(seed) != len(slots):
            raise ValueError(f"{len(seed)} seeds for {len(slots)} envs; give one for each")
        chosen = [checked_seed(one) for one in seed]
    else:
        return envs.seed_offset[slots] + checked_seed(seed)
    return np.array(chosen, np.int64)


def checked_seed(seed: Any, whose: str = "") -> int:
    """`seed` as an int, small enough that adding an offset can't overflow an int64.

    Raises:
        ValueError: it isn't an int from 0 to 2**62 - 1; `whose` ends its name in the message.
    """
    value = as_int(seed)
    if value is None or not 0 <= value < 1 << 62:
        raise ValueError(f"the seed{whose} must be an int from 0 to 2**62 - 1, not {seed!r}")
    return value
