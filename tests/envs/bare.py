"""Simulators stepped by hand, as `EnvContract.simulate` wants their outcomes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from kit.contract import Expected


def gymnasium_outcomes(
    env: Any, seed: Any, actions: Sequence[Any], *, resets_itself: bool = False
) -> Iterator[Expected]:
    """Of a `gymnasium.Env`, or of a vector environment that resets itself."""
    observation, _ = env.reset(seed=seed)
    yield as_numpy(observation), 0.0, False, False
    ended = False
    for action in actions:
        if ended:
            observation, _ = env.reset()
            outcome = observation, 0.0, False, False
        else:
            outcome = env.step(action)[:4]
        ended = not resets_itself and bool(outcome[2] or outcome[3])
        yield tuple(map(as_numpy, outcome))
    env.close()
