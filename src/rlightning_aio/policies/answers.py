"""`parts_by_policy` and `answers_of`: what each policy is given, and the one reading of its answer.

A policy is called with a batch of results. It returns actions, ``[n, *action]`` (a dict or tuple of
such arrays for Dict and Tuple spaces, or a list with one action for each result), or a dict of
columns with ``action``, or what `BatchedData.respond` returns. It may be a coroutine function;
its caller awaits it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import BadAction
from rlightning_aio.trees import is_dict

if TYPE_CHECKING:
    from collections.abc import Iterable

    import gymnasium as gym


def policies_of(given: Any) -> dict[str, Any]:
    """Return policies by the name of a config entry; one for all envs has the name ``""``."""
    return {**given} if isinstance(given, Mapping) else {"": given}


def check_policies(entries: Iterable[str], policies: Mapping[str, object]) -> None:
    """Check that each of some entries has a policy.

    Raises:
        ValueError: one has none.
    """
    for name in entries:
        if name not in policies and "" not in policies:
            raise ValueError(
                f"no policy was given for the envs of entry {name!r}; those given are for "
                f"{', '.join(policies)}"
            )


def parts_by_policy(
    batch: BatchedData, policies: Mapping[str, object]
) -> list[tuple[str, BatchedData]]:
    """Split a batch of results by policy, as `policies_of` has them.

    Raises:
        ValueError: an entry has no policy.
    """
    if "" in policies:
        return [("", batch)]
    parts = batch.by_entry()
    check_policies(parts, policies)
    return [*parts.items()]


def answers_of(batch: BatchedData, answer: Any, space: gym.Space[Any] | None) -> list[BatchedData]:
    """Convert what a policy has returned for `batch` to batches of responses, usually one.

    Args:
        batch: of results.
        answer: see the module; or a list of batches of responses, which together answer all
            results.
        space: of the actions of the batch's envs; None if it is unknown.

    Raises:
        BadAction: it doesn't answer all results, or it is a dict, but not of columns.
    """
    if isinstance(answer, BatchedData):
        parts = [answer]
    elif isinstance(answer, list) and _are_batches(cast("list[Any]", answer)):
        parts = cast("list[BatchedData]", answer)
    elif isinstance(answer, dict | Mapping):  # Most are dicts, for which this is cheap.
        named = cast("Mapping[Any, Any]", answer)
        return [batch.respond(**(named if _are_columns(named, space) else {"action": named}))]
    else:
        return [batch.respond(action=answer)]
    answered = sum(map(len, parts))
    if answered != len(batch):
        raise BadAction(f"the policy has answered {answered} of {len(batch)} results")
    return parts


def _are_batches(answer: list[Any]) -> bool:
    return bool(answer) and all(isinstance(one, BatchedData) for one in answer)


def _are_columns(answer: Mapping[Any, Any], space: gym.Space[Any] | None) -> bool:
    """Return True for a dict of columns, and False for one of the parts of Dict actions."""
    keys = cast("Any", space).spaces if space is not None and is_dict(space) else None
    if "action" in answer:
        if keys is not None and "action" in keys:
            raise BadAction(
                "the action space has a key 'action', so a dict with one may be actions or columns:"
                " return batch.respond(action=…), with further columns as further arguments"
            )
        return True
    if keys is None and space is not None:
        names = ", ".join(map(repr, answer)) or "nothing"
        raise BadAction(
            "a policy returns actions, a dict of columns with 'action', or batch.respond(action=…),"
            f" and not a dict of {names}"
        )
    return False
