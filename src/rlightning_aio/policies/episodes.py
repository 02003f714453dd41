"""Where episodes begin in a batch, for policies that keep something for each."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.batch.parts import all_agents

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData


def begins(batch: BatchedData) -> NDArray[np.bool_]:
    """Return True where an episode begins; shaped like `BatchedData.is_reset`.

    The result that ends an episode of an env that resets itself counts, because the env may begin
    the next one in the same step.
    """
    return batch.is_reset | all_agents(batch.done)


def begins_of_envs(batch: BatchedData) -> NDArray[np.bool_]:
    """Return `begins`, one for each env.

    Raises:
        ValueError: an env has sub-environments, whose episodes begin at different times.
    """
    found = begins(batch)
    if found.ndim > 1:
        raise ValueError(
            f"{batch.env_ids()[0]} has sub-environments, and this policy keeps one episode for "
            "each env: num_envs: 1, and num_workers for the number of envs"
        )
    return found
