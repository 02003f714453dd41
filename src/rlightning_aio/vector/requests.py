"""Requests of vector interfaces to a group's envs, which they address by place.

A place is an env's position in the group. Each function sends and does not wait.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rlightning_aio.calling import send_calls
from rlightning_aio.envs.wrappers import name_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.sync import EnvGroup

__all__ = ["send_call", "send_look_up", "send_resets", "send_values", "send_wrapper_question"]

Options = dict[str, Any]


def send_resets(
    group: EnvGroup,
    seeds: Sequence[int | None],
    options: Sequence[Options | None],
    places: Sequence[int],
) -> None:
    """Reset the envs at `places`; `seeds` and `options` are those of all envs."""
    env_ids = group.env_ids
    if all(options[k] is options[places[0]] for k in places):
        given = {env_ids[k]: int(seed) for k in places if (seed := seeds[k]) is not None}
        group.reset_async(given, options[places[0]], [env_ids[k] for k in places])
        return
    for k in places:
        send_resets(group, seeds, options, [k])


def send_call(
    group: EnvGroup, name: str, args: Any, kwargs: Any, places: Sequence[int] | None = None
) -> None:
    """Call a method, found through wrappers, or get an attribute, of all envs or at `places`."""
    ids = None if places is None else _ids(group, places)
    send_calls(group, "call_wrapped", name, *args, env_ids=ids, **kwargs)


def send_look_up(group: EnvGroup, name: str, place: int) -> None:
    """Ask an env for attribute `name`, or whether it is a method."""
    send_calls(group, "look_up", name, env_ids=_ids(group, [place]))


def send_wrapper_question(group: EnvGroup, wrapper: type[Any], places: Sequence[int]) -> None:
    """Ask the envs at `places` whether they have a wrapper of that class."""
    send_calls(group, "is_wrapped", name_of(wrapper), env_ids=_ids(group, places))


def send_values(group: EnvGroup, name: str, each: Sequence[Any]) -> None:
    """Set attribute `name` of each env to its own value."""
    for env_id, value in zip(group.env_ids, each, strict=True):
        send_calls(group, "call_wrapped", "set_wrapper_attr", name, value, env_ids=[env_id])


def _ids(group: EnvGroup, places: Sequence[int]) -> list[str]:
    env_ids = group.env_ids  # Each look makes a list.
    return [env_ids[k] for k in places]
