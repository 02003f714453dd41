"""What is asked of Ray: a connection, actors, calls, and what it says of an end.

Rule: nothing else in the package imports Ray, and nothing of it goes further than
`ray_host`. A call waits for nothing; what comes of it is told to a function, on a thread of
Ray's. Only the connection to a cluster is waited for, once.
"""

from __future__ import annotations

import logging
import os
import re
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rlightning_aio.errors import ConfigError
from rlightning_aio.hosts.actor import EnvActor

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.hosts.base import Wiring

__all__ = ["Connection", "actor_class", "beside", "call", "ending", "kill", "shortage"]

# Untyped to `make check`, which does without it.
ray: Any = import_module("ray")

WATCH: Final = "watch"
"""Concurrency group of what runs beside the envs."""

_OURS: Final = {
    "num_cpus": "is a field of the entry",
    "num_gpus": "is a field of the entry",
    "max_restarts": "is a field of the entry, and Ray itself restarts nothing",
    "max_task_retries": "would execute a step twice",
    "lifetime": "would let actors outlive the trainer",
    "name": "belongs to one actor, and an entry may have several",
    "get_if_exists": "would share an actor with others",
    "max_concurrency": "would execute several requests at a time",
    "concurrency_groups": "would execute several requests at a time",
    "allow_out_of_order_execution": "would execute requests in another order",
}
"""Options of an actor that are not to be set, and why."""

_log = logging.getLogger("rlightning_aio")


class Connection:
    """This process's connection to a cluster; see `base.Shared`.

    One that the program has made itself is used as it is, and left alone. Ours is for all
    groups, and ends with the last of them; so does a cluster that was started with it.

    Args:
        address: of a cluster, as `ray.init` takes it; None for that of ``RAY_ADDRESS``, or one
            that runs on this machine; where there is none either, one is started here.

    Raises:
        ConnectionError: no cluster answers there.
    """

    _users: ClassVar[int] = 0
    _is_ours: ClassVar[bool] = False

    @classmethod
    def share(cls, config: EnvConfig, wiring: Wiring) -> None:
        """Have the group of `wiring` connected, as an entry of it asks for."""
        if cls not in wiring.resources:
            wiring.resources[cls] = cls(config.ray_options.get("address"))

    def __init__(self, address: str | None) -> None:
        if not ray.is_initialized():
            if address is None and not os.environ.get("RAY_ADDRESS"):
                _log.warning(
                    "no Ray cluster was named (ray_options.address, RAY_ADDRESS), and ray.init() "
                    "was not called: using the one that runs on this machine, or starting one"
                )
            ray.init(address=address)
            Connection._is_ours = True
        Connection._users += 1

    def release(self, seconds: float) -> None:
        """See `base.Shared.release`."""
        del seconds
        Connection._users -= 1
        if Connection._is_ours and not Connection._users:
            Connection._is_ours = False
            ray.shutdown()

    def disown(self) -> None:
        """See `base.Shared.disown`. A forked process has none of Ray's threads."""


def actor_class(config: EnvConfig, *, watched: bool) -> Any:
    """What makes the actors of an entry, by ``.remote(...)``.

    Args:
        config: the entry.
        watched: a method may be called beside the others (see `beside`).

    Raises:
        ConfigError: `ray_options` has an option that is unknown, wrong, or not the user's.
    """
    options = {name: value for name, value in config.ray_options.items() if name != "address"}
    for name in options.keys() & _OURS.keys():
        raise ConfigError(
            f"entry {config.name!r}, ray_options.{name}: leave it out; it {_OURS[name]}"
        )
    if config.env_vars:
        environment = dict(options.get("runtime_env") or {})
        env_vars = {**environment.get("env_vars", {}), **config.env_vars}
        options["runtime_env"] = {**environment, "env_vars": env_vars}
    # Beside another thread the envs lose the main one, which some simulators insist on.
    groups = {"concurrency_groups": {WATCH: 1}} if watched else {}
    remote = ray.remote(max_restarts=0, **groups)(EnvActor)
    try:
        return remote.options(num_cpus=config.num_cpus, num_gpus=config.num_gpus, **options)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"entry {config.name!r}, ray_options: {error}") from error


def beside(method: Any) -> Any:
    """A method of an actor that is watched, to be called while its envs are at work."""
    return method.options(concurrency_group=WATCH)


def call(method: Any, then: Callable[[Any], None], *arguments: Any) -> object:
    """Call a method of an actor.

    Args:
        method: of it.
        then: called once, on any thread, with what was returned, or with the error. It must not
            hold the last trace of what is returned here.
        arguments: of the method.

    Returns:
        What is to be kept until `then` is called, and let go of by a thread of one's own: one of
        Ray's might wait for itself then, with a lock in its hands.
    """
    try:
        reference = method.remote(*arguments)
    except Exception as error:  # Nothing connects us to a cluster any more.
        then(error)
        return None
    # What `ref.future()` stands on; a future would bring a lock and a condition along.
    reference._on_completed(then)  # noqa: SLF001
    return reference


def kill(actor: Any) -> None:
    """End an actor, whatever it does, if it is still there."""
    if ray.is_initialized():
        with suppress(Exception):
            ray.kill(actor)


def shortage(config: EnvConfig) -> str:
    """What an actor of an entry asks for, and what of it the cluster has and has free."""
    own: dict[str, float] = config.ray_options.get("resources") or {}
    asked = {"CPU": config.num_cpus, "GPU": config.num_gpus, **own}
    asked = {name: amount for name, amount in asked.items() if amount}
    listed = " and ".join(f"{amount:g} {name}" for name, amount in asked.items()) or "no resources"
    try:
        free, there = ray.available_resources(), ray.cluster_resources()
    except Exception:
        return f"it asks for {listed}, and the cluster doesn't answer"
    shown = ", ".join(f"{free.get(name, 0):g} of {there.get(name, 0):g} {name}" for name in asked)
    return f"it asks for {listed}; free in the cluster: {shown or 'whatever it asks for'}"


def ending(error: BaseException) -> tuple[str, int | None]:
    """What has become of an actor, in a clause, and its exit code as far as that is known."""
    text = " ".join(str(error).split())
    for sign, clause in _ENDINGS.items():
        if sign in text:
            return clause, None
    if found := re.search(r"exit code (-?\d+)", text):
        return f"exited with code {found[1]}", int(found[1])
    return f"was lost: {text[:300]}", None


_ENDINGS: Final = {
    "failed to import on the worker": "could not be made: its node can't import this package; "
    "install it, in this version, on every node of the cluster, or name it in "
    "ray_options.runtime_env.pip",
    "its node has died": "ended with its node",
    "unavailable": "can't be reached any more; its node may be gone",
    "ray.kill": "was killed by ray.kill",
    "connection error code": "was killed or crashed; Ray's log of it may say more (if you didn't, "
    "its node may have run out of memory)",
    "Failed to retrieve object": "is gone, and its last results with it",
    "has not been started": "was lost with Ray, which was shut down",
}
"""What Ray says of an end, by a part of its message."""
