"""The layout of a vector env's envs in the results of its group.

`Singles` has one env in each result; `Batches` has several sub-environments in each, the same
number everywhere. A user's ``[num_envs, ...]`` is a view of the group's ``[results, each, ...]``.
An env's place is its position among `num_envs`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.batch.contents import reported_info_list, reported_infos, reported_sub_env_infos
from rlightning_aio.batch.infos import listed
from rlightning_aio.batch.stacking import stacked_values
from rlightning_aio.calling import collect_calls, send_calls
from rlightning_aio.envs.sub_envs.sub_envs import SEEDS
from rlightning_aio.envs.wrappers import name_of
from rlightning_aio.protocol.columns import leaves
from rlightning_aio.trees import mapped

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.sync import EnvGroup
    from rlightning_aio.types import EnvMeta

__all__ = ["Batches", "Singles", "rows_of"]

Options = dict[str, Any]


class Singles:
    """One env in each result.

    Args:
        group: an initialised group.
        metas: of the group's envs.

    Attributes:
        num_envs: the number of envs that the user sees.
        spaces: observation and action space of each env.
    """

    def __init__(self, group: EnvGroup, metas: Sequence[EnvMeta]) -> None:
        self._group = group
        self.num_envs = len(metas)
        self.spaces: list[tuple[Any, Any]] = [
            (meta.observation_space, meta.action_space) for meta in metas
        ]

    # -- results ------------------------------------------------------------------------

    def observation(self, batch: BatchedData) -> Any:
        """Observations as columns ``[num_envs, ...]``."""
        return batch.observation

    def flat(self, column: NDArray[Any]) -> NDArray[Any]:
        """Reshape a column of rewards or flags to ``[num_envs]``."""
        return column

    def infos(self, batch: BatchedData) -> dict[str, Any]:
        """Infos as columns with masks."""
        return reported_infos(batch)

    def info_list(self, batch: BatchedData) -> list[dict[str, Any]]:
        """One info for each env."""
        return reported_info_list(batch)

    def of_mask(self, batch: BatchedData, mask: NDArray[np.bool_]) -> tuple[Any, dict[str, Any]]:
        """Observations and infos of the envs in `mask` only, from the results of their reset."""
        del mask
        return self.observation(batch), self.infos(batch)

    # -- results of lost workers ----------------------------------------------------------

    def whole(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of the results with all their envs in `mask`."""
        return mask

    def places(self, results: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of the envs in `results`, which is a mask of results."""
        return results

    def lost(self, restarted: NDArray[np.bool_], due: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of the envs that have lost an episode.

        Args:
            restarted: mask of the envs whose worker was replaced.
            due: mask of the envs whose next step is a reset anyway.
        """
        return restarted & ~due

    def with_valid(self, actions: Any, ignored: NDArray[np.bool_]) -> Any:
        """Replace ignored actions that would be executed by valid ones of the same batch."""
        del ignored
        return actions

    # -- requests -----------------------------------------------------------------------

    def actions(self, actions: Any) -> Any:
        """Reshape actions ``[num_envs, ...]`` for the group.

        Raises:
            ValueError, TypeError: the number of actions is wrong.
        """
        return actions

    def action_list(self, actions: Sequence[Any]) -> Sequence[Any]:
        """Arrange actions, one for each of `num_envs`, as one for each env of the group.

        Raises:
            ValueError: the number of actions is wrong, or they differ in structure.
        """
        if len(actions) != self.num_envs:
            raise ValueError(f"{len(actions)} actions for num_envs={self.num_envs}")
        return actions

    def send_resets(
        self, seeds: Sequence[int | None], options: Sequence[Options | None], chosen: Sequence[int]
    ) -> None:
        """Reset the envs at the places `chosen`, in order, each with its own seed and options."""
        env_ids = self._group.env_ids
        if all(options[k] is options[chosen[0]] for k in chosen):
            given = {env_ids[k]: int(seed) for k in chosen if (seed := seeds[k]) is not None}
            return self._group.reset_async(given, options[chosen[0]], [env_ids[k] for k in chosen])
        for k in chosen:
            self.send_resets(seeds, options, [k])
        return None

    def call(self, name: str, args: Any, kwargs: Any, chosen: Sequence[int] | None = None) -> None:
        """Send a call of a method to all envs, or to those at the places `chosen`."""
        env_ids = self._group.env_ids
        ids = None if chosen is None else [env_ids[k] for k in chosen]
        send_calls(self._group, "call_wrapped", name, *args, env_ids=ids, **kwargs)

    def look_up(self, name: str, place: int) -> None:
        """Ask an env for attribute `name`, or whether it is a method."""
        send_calls(self._group, "look_up", name, env_ids=[self._group.env_ids[place]])

    def values(self, collected: list[Any], chosen: Sequence[int] | None = None) -> list[Any]:
        """Order the values of calls: one for each env that was called."""
        del chosen
        return collected

    def are_wrapped(self, wrapper_class: type[Any], chosen: Sequence[int]) -> list[bool]:
        """Ask the envs at the places `chosen` whether they have a wrapper."""
        env_ids = [self._group.env_ids[k] for k in chosen]
        send_calls(self._group, "is_wrapped", name_of(wrapper_class), env_ids=env_ids)
        return collect_calls(self._group)

    def set_attr(self, name: str, each: Sequence[Any]) -> None:
        """Send each env its own value of an attribute."""
        call = ("call_wrapped", "set_wrapper_attr", name)
        for env_id, value in zip(self._group.env_ids, each, strict=True):
            send_calls(self._group, *call, value, env_ids=[env_id])

    def set_outermost(self, name: str, value: Any, chosen: Sequence[int]) -> None:
        """Set an attribute of the outermost wrapper of the envs at the places `chosen`."""
        self.call("__setattr__", (name, value), {}, chosen)
        collect_calls(self._group)


class Batches(Singles):
    """The same number of sub-environments in each result.

    Raises:
        RuntimeError: the numbers differ, or values of a space have no fixed size.
    """

    def __init__(self, group: EnvGroup, metas: Sequence[EnvMeta]) -> None:
        self._group = group
        self._each = metas[0].num_envs
        for meta in metas:
            if meta.num_envs != self._each:
                raise RuntimeError(
                    f"env {meta.env_id!r} holds {meta.num_envs} sub-environments, and "
                    f"{metas[0].env_id!r} {self._each}; the number must be the same everywhere"
                )
        self.num_envs = len(metas) * self._each
        names = ("single_observation_space", "single_action_space")
        found = [group.call("call_wrapped", name) for name in names]
        pairs = list(zip(*found, strict=True))
        for space in pairs[0]:
            if leaves(space) is None:
                raise RuntimeError(
                    f"values of {space} have no fixed size; make separate envs, each with its own "
                    "callable"
                )
        self.spaces = [pair for pair in pairs for _ in range(self._each)]
        self._takes_masks = all(group.call("call_wrapped", "takes_masks"))

    def observation(self, batch: BatchedData) -> Any:
        return mapped(_flat, batch.observation)

    def flat(self, column: NDArray[Any]) -> NDArray[Any]:
        return column.reshape(-1)

    def infos(self, batch: BatchedData) -> dict[str, Any]:
        return reported_sub_env_infos(batch, self._each)

    def info_list(self, batch: BatchedData) -> list[dict[str, Any]]:
        return listed(self.infos(batch), self.num_envs)

    def of_mask(self, batch: BatchedData, mask: NDArray[np.bool_]) -> tuple[Any, dict[str, Any]]:
        by_batch = mask.reshape(-1, self._each)
        wanted = by_batch[by_batch.any(axis=1)].reshape(-1)
        return (
            mapped(lambda column: column[wanted], self.observation(batch)),
            _picked(self.infos(batch), wanted),
        )

    def whole(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.logical_and.reduce(mask.reshape(-1, self._each), axis=1)

    def places(self, results: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return results.repeat(self._each)

    def lost(self, restarted: NDArray[np.bool_], due: NDArray[np.bool_]) -> NDArray[np.bool_]:
        lost = restarted & ~due
        if self._takes_masks:
            return lost
        # A batch without masks is reset as a whole, so envs that were due lose their step too.
        return lost.reshape(-1, self._each).any(axis=1).repeat(self._each)

    def with_valid(self, actions: Any, ignored: NDArray[np.bool_]) -> Any:
        by_batch = ignored.reshape(-1, self._each)
        # The first that isn't ignored, if any.
        first = np.asarray(by_batch.argmin(axis=1))
        return mapped(lambda column: _with_valid(column, by_batch, first), actions)

    def actions(self, actions: Any) -> Any:
        return mapped(self._folded, actions)

    def action_list(self, actions: Sequence[Any]) -> Sequence[Any]:
        each = super().action_list(actions)
        firsts = range(0, self.num_envs, self._each)
        return [stacked_values(list(each[k : k + self._each])) for k in firsts]

    def _folded(self, column: Any) -> NDArray[Any]:
        array = np.asarray(column)
        if not array.ndim:
            raise TypeError(f"there must be as many actions as envs, {self.num_envs}, not a scalar")
        if len(array) != self.num_envs:
            raise ValueError(f"{len(array)} actions for num_envs={self.num_envs}")
        return array.reshape(self.num_envs // self._each, self._each, *array.shape[1:])

    def send_resets(
        self, seeds: Sequence[int | None], options: Sequence[Options | None], chosen: Sequence[int]
    ) -> None:
        for number, which in self._by_batch(chosen):
            places = range(number * self._each, (number + 1) * self._each)
            self._send_reset(number, [seeds[k] for k in places], options, which)

    def _send_reset(
        self,
        number: int,
        seeds: list[int | None],
        options: Sequence[Options | None],
        which: list[int],
    ) -> None:
        env_id = self._group.env_ids[number]
        own = [options[number * self._each + k] for k in which]
        if any(one is not own[0] and one != own[0] for one in own):
            raise ValueError(
                "reset options differ between envs that are stepped together; make separate envs"
            )
        given = None if own[0] is None else dict(own[0])
        if len(which) < self._each:
            if not self._takes_masks:
                raise ValueError(
                    "the vector environments of this task reset all of their sub-environments "
                    "together; make separate envs (vectorization_mode='async') for reset_mask"
                )
            given = {**(given or {}), "reset_mask": np.isin(np.arange(self._each), which)}
        first = seeds[0]
        if first is not None and seeds == list(range(first, first + self._each)):
            return self._group.reset_async({env_id: int(first)}, given, [env_id])
        if any(seed is not None for seed in seeds):
            given = {**(given or {}), SEEDS: (seeds, given is None)}
        return self._group.reset_async(None, given, [env_id])

    def _by_batch(self, chosen: Sequence[int]) -> Iterator[tuple[int, list[int]]]:
        """Yield the number of each batch with places in `chosen`, and their positions inside it."""
        found: dict[int, list[int]] = {}
        for k in chosen:
            found.setdefault(k // self._each, []).append(k % self._each)
        yield from found.items()

    def call(self, name: str, args: Any, kwargs: Any, chosen: Sequence[int] | None = None) -> None:
        if chosen is None:
            send_calls(self._group, "call_sub_envs", name, args, kwargs, None)
            return
        for number, which in self._by_batch(chosen):
            env_ids = [self._group.env_ids[number]]
            send_calls(self._group, "call_sub_envs", name, args, kwargs, which, env_ids=env_ids)

    def look_up(self, name: str, place: int) -> None:
        number, own = divmod(place, self._each)
        env_ids = [self._group.env_ids[number]]
        send_calls(self._group, "look_up_sub_env", own, name, env_ids=env_ids)

    def values(self, collected: list[Any], chosen: Sequence[int] | None = None) -> list[Any]:
        if chosen is None:
            return [value for values in collected for value in values]
        parts = [number for number, _ in self._by_batch(chosen)]
        of_batch = {number: iter(values) for number, values in zip(parts, collected, strict=True)}
        return [next(of_batch[k // self._each]) for k in chosen]

    def are_wrapped(self, wrapper_class: type[Any], chosen: Sequence[int]) -> list[bool]:
        send_calls(self._group, "sub_envs_wrapped", name_of(wrapper_class))
        wrapped = collect_calls(self._group)
        return [wrapped[k // self._each] for k in chosen]

    def set_attr(self, name: str, each: Sequence[Any]) -> None:
        for k, env_id in enumerate(self._group.env_ids):
            own = list(each[k * self._each : (k + 1) * self._each])
            send_calls(self._group, "set_sub_envs", name, own, env_ids=[env_id])

    def set_outermost(self, name: str, value: Any, chosen: Sequence[int]) -> None:
        found = list(self._by_batch(chosen))
        if any(len(set(which)) < self._each for _, which in found):
            raise ValueError(
                f"{name} can't be set for only some of the envs that are stepped together; make "
                "separate envs, each with its own callable"
            )
        for number, _ in found:
            env_ids = [self._group.env_ids[number]]
            send_calls(self._group, "set_sub_envs", name, [value] * self._each, env_ids=env_ids)
        collect_calls(self._group)


def rows_of(group: EnvGroup, metas: Sequence[EnvMeta]) -> Singles:
    """The layout of a group's envs: `Batches` if any has sub-environments, else `Singles`."""
    several = any(meta.num_envs > 1 for meta in metas)
    return Batches(group, metas) if several else Singles(group, metas)


def _flat(column: NDArray[Any]) -> NDArray[Any]:
    batches, each, *shape = column.shape
    return column.reshape(batches * each, *shape)


def _with_valid(
    column: NDArray[Any], ignored: NDArray[np.bool_], first: NDArray[np.intp]
) -> NDArray[Any]:
    column = column.copy()
    for batch, place in np.argwhere(ignored).tolist():
        column[batch, place] = column[batch, first[batch]]
    return column


def _picked(infos: dict[str, Any], wanted: NDArray[np.bool_]) -> dict[str, Any]:
    """Select the rows `wanted` of each column."""
    return {
        key: _picked(cast("dict[str, Any]", column), wanted)
        if isinstance(column, dict)
        else column[wanted]
        for key, column in infos.items()
    }
