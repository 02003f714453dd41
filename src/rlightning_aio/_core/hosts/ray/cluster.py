"""Everything that we use of Ray: a connection, actors, calls, and the errors that report an end.

Rule: no other module of the package imports Ray, and only `ray.host` uses this one. A call doesn't
block: a thread of Ray passes its outcome to a function. Only connecting to a cluster blocks, once.
"""

from __future__ import annotations

import logging
import os
import re
import socket
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Final

from rlightning_aio._core.hosts.ray.actor import EnvActor
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio.config import EnvConfig

__all__ = ["RayConnection", "actor_class", "call", "concurrent", "ending", "kill", "shortage"]

# Untyped, because `make check` runs without Ray.
ray: Any = import_module("ray")

WATCH: Final = "watch"
"""Concurrency group of the method that runs concurrently with the envs."""

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
"""Options of an actor that users must not set, with the reasons."""

_log = logging.getLogger("rlightning_aio")


class RayConnection:
    """The connection of this process to a cluster; see `base.Shared`.

    A connection that the program made itself is used and left open. Otherwise one connection serves
    all groups and ends with the last of them, as does a cluster that was started for it.

    Args:
        address: of a cluster, as for `ray.init`. None means ``RAY_ADDRESS``, or else a cluster that
            runs on this machine, or else a cluster that is started here.
        seconds: limit for a machine to accept a connection.

    Raises:
        ConnectionError: no cluster answers there.
    """

    _users: ClassVar[int] = 0
    _is_ours: ClassVar[bool] = False

    @classmethod
    def share(cls, config: EnvConfig, wiring: Wiring) -> None:
        """Connect the group of `wiring`, with the options of one of its entries."""
        if cls not in wiring.resources:
            wiring.resources[cls] = cls(config.ray_options.get("address"), config.start_timeout)

    def __init__(self, address: str | None, seconds: float) -> None:
        if not ray.is_initialized():
            named = address or os.environ.get("RAY_ADDRESS")
            if named:
                _check_answers(named, seconds)
            else:
                _log.warning(
                    "no Ray cluster was named (ray_options.address, RAY_ADDRESS), and ray.init() "
                    "was not called: using the one that runs on this machine, or starting one"
                )
            ray.init(address=address)
            RayConnection._is_ours = True
        RayConnection._users += 1

    def release(self, seconds: float) -> None:
        del seconds
        RayConnection._users -= 1
        if RayConnection._is_ours and not RayConnection._users:
            RayConnection._is_ours = False
            ray.shutdown()

    def disown(self) -> None:
        """Do nothing: a forked process has no threads of Ray."""


def _check_answers(address: str, seconds: float) -> None:
    """Raise `ConnectionError` if nothing accepts a connection at ``[ray://]host:port``.

    Ray itself would try for minutes, and then end the process.
    """
    match = re.fullmatch(r"(?:ray://)?\[?([^\[\]/]+?)\]?:(\d+)", address)
    if match is None:
        return  # "auto", "local", or for Ray to refuse.
    try:
        socket.create_connection((match[1], int(match[2])), seconds).close()
    except OSError as error:
        raise ConnectionError(
            f"no Ray cluster answers at {address}: {error}; check ray_options.address or "
            "RAY_ADDRESS, and that `ray status` finds the cluster"
        ) from error


def actor_class(config: EnvConfig, *, watched: bool) -> Any:
    """Return the class of an entry's actors, whose ``.remote(...)`` makes one.

    Args:
        config: the entry.
        watched: a method may run concurrently with the others (see `concurrent`).

    Raises:
        ConfigError: `ray_options` has an option that is unknown, wrong, or not allowed.
    """
    options = {name: value for name, value in config.ray_options.items() if name != "address"}
    for name in options.keys() & _OURS.keys():
        raise ConfigError(
            f"entry {config.name!r}, ray_options.{name}: leave it out; it {_OURS[name]}"
        )
    if config.env_vars:
        runtime_env = dict(options.get("runtime_env") or {})
        env_vars = {**runtime_env.get("env_vars", {}), **config.env_vars}
        options["runtime_env"] = {**runtime_env, "env_vars": env_vars}
    # With a second thread the envs don't run in the main one, which some simulators need.
    groups = {"concurrency_groups": {WATCH: 1}} if watched else {}
    remote = ray.remote(max_restarts=0, **groups)(EnvActor)
    try:
        return remote.options(num_cpus=config.num_cpus, num_gpus=config.num_gpus, **options)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"entry {config.name!r}, ray_options: {error}") from error


def concurrent(method: Any) -> Any:
    """Return a method of a watched actor in the form that runs concurrently with its envs."""
    return method.options(concurrency_group=WATCH)


def call(method: Any, then: Callable[[Any], None], *arguments: Any) -> object:
    """Call a method of an actor.

    Args:
        method: of an actor.
        then: called once, on any thread, with the returned value or the error. It must not hold the
            last reference to the object that is returned here.
        arguments: of the method.

    Returns:
        An object to keep until `then` was called. A thread that isn't Ray's must drop it: one of
        Ray's threads would wait for a lock that it holds.
    """
    try:
        reference = method.remote(*arguments)
    except Exception as error:  # We are no longer connected to a cluster.
        then(error)
        return None
    # `ref.future()` uses this, too, but would add a lock and a condition.
    reference._on_completed(then)  # noqa: SLF001
    return reference


def kill(actor: Any) -> None:
    """Kill an actor, if it still runs."""
    if ray.is_initialized():
        with suppress(Exception):
            ray.kill(actor)


def shortage(config: EnvConfig) -> str:
    """Describe what an actor of an entry asks for, and how much the cluster has of it, and free."""
    own: dict[str, float] = config.ray_options.get("resources") or {}
    asked = {"CPU": config.num_cpus, "GPU": config.num_gpus, **own}
    asked = {name: amount for name, amount in asked.items() if amount}
    listed = " and ".join(f"{amount:g} {name}" for name, amount in asked.items()) or "no resources"
    try:
        free, there = ray.available_resources(), ray.cluster_resources()
    except Exception:
        return f"it asks for {listed}, and the cluster doesn't answer"
    found = ", ".join(f"{free.get(name, 0):g} of {there.get(name, 0):g} {name}" for name in asked)
    return f"it asks for {listed}; free in the cluster: {found or 'everything'}"


def ending(error: BaseException) -> tuple[str, int | None]:
    """Return a clause that says how an actor ended, and its exit code if that is known."""
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
    "unavailable": "can no longer be reached; its node may be gone",
    "ray.kill": "was killed by ray.kill",
    "connection error code": "was killed or crashed; Ray's log of it may say more (if you didn't, "
    "its node may have run out of memory)",
    "Failed to retrieve object": "is gone, and its last results with it",
    "has not been started": "was lost with Ray, which was shut down",
}
"""Clauses by a part of Ray's message."""
