"""Runs RLightning's envs in our workers and sends their results back.

Rule: a program gets exactly what its env returned, and an env what the program sent: both are
plain Python values to us, and pickled.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
import uuid
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio import ENVS, Anything, BaseEnv, EnvConfig, EnvRet
from rlightning_aio.plugins.legacy.names import make_importable, named
from rlightning_aio.trees import converted, holds_tensor, is_tensor

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio import PolicyResponse

ARGUMENTS: Final = "rlightning"
"""Key in a reset's options for the arguments of RLightning's `reset`."""
SERVER: Final = "env_server"
_PLACES: Final = 32
"""For clients of a server, as many as RLightning's has."""
_PASSED_ON: Final = (
    "placement", "envs_per_process", "step_timeout", "reset_timeout", "start_timeout",
    "close_timeout", "on_worker_death", "on_env_error", "max_restarts", "imports", "interpreter",
    "env_vars",
)  # fmt: skip
"""Fields of our entries that RLightning lacks and that its entries may have here, too."""

make_importable()  # Unpickling an `EnvMaker` imports this module before it needs those names.


@dataclasses.dataclass
class EnvMaker:
    """Makes an env of RLightning's.

    Attributes:
        kind: the env's class.
        config: the entry, an `EnvConfig` of RLightning's.
        worker_index: the env's position in its group.
        preprocess_fn: the preprocess function, or None.
        env_id: of the env, also after a restart.
        computes: its steps are known to keep a core busy.
        hardware: it moves something real, as its class or its backend says.
    """

    kind: Any
    config: Any
    worker_index: int
    preprocess_fn: Any
    env_id: str
    computes: bool = False
    hardware: bool = False

    def __call__(self) -> HostedEnv:
        """Make the env and wrap it as one of ours."""
        env = self.kind(
            self.config, worker_index=self.worker_index, preprocess_fn=self.preprocess_fn
        )
        env.env_id = self.env_id
        return HostedEnv(env)


class HostedEnv(BaseEnv):
    """An env of RLightning's as one of ours.

    Its observations are RLightning's whole results, its actions RLightning's whole responses.
    """

    transforms_actions = True

    def __init__(self, env: Any) -> None:
        super().__init__(EnvConfig(name="rlightning", backend="callable"))
        self.env = env

    def get_observation_space(self) -> Anything:
        return Anything()

    def get_action_space(self) -> Anything:
        return Anything()

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        del seed  # `options` contains all of RLightning's arguments.
        args, kwargs = (options or {}).get(ARGUMENTS, ((), {}))
        self.env.trainer_pid = self.trainer_pid
        return EnvRet(env_id=self.env_id, observation=self.env._reset(*args, **kwargs))  # noqa: SLF001

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        return EnvRet(env_id=self.env_id, observation=self.env._step(policy_resp.action))  # noqa: SLF001

    def look(self, name: str) -> tuple[bool, Any]:
        """Return (True, None) if RLightning's env has a method `name`, else (False, its value)."""
        value = getattr(self.env, name)
        return (True, None) if callable(value) else (False, value)

    def of_env(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Call method `name` of RLightning's env and return its value."""
        return getattr(self.env, name)(*args, **kwargs)

    def stop(self) -> None:
        """Call the method `stop` of RLightning's env, or its `on_disconnect`, if it has one."""
        call_first(self.env, "stop", "on_disconnect")

    def close(self) -> None:
        self.env.close()


def call_first(env: Any, *names: str) -> None:
    """Call the first of some methods that an env has, if it has any."""
    for name in names:
        if callable(method := getattr(env, name, None)):
            method()
            return


def off_device(response: Any) -> Any:
    """Return `response`, or a copy of it with its tensors on the CPU, where they can be pickled."""
    data: dict[str, Any] = response.__dict__
    if not holds_tensor(data):
        return response
    moved = copy.copy(response)
    for name, value in data.items():
        on_cpu = converted(lambda one: one.detach().cpu() if is_tensor(one) else one, value)
        setattr(moved, name, on_cpu)
    return moved


def entries_of(
    configs: Sequence[Any], preprocess_fns: Sequence[Any]
) -> list[tuple[EnvConfig, list[str]]]:
    """Turn RLightning's configs, one for each env, into entries of ours and ids of RLightning's.

    Local envs come first, then env_servers. Equal neighbours of one config are one entry.
    """
    registry, taken = named("ENVS"), set[str]()
    found: list[tuple[EnvConfig, list[str]]] = []
    makers = [
        EnvMaker(registry.get(config.backend), config, k, preprocess_fns[k], f"{uuid.uuid4()}-{k}")
        for k, config in enumerate(configs)
        if config.backend != SERVER
    ]
    # Replicas of an entry are one object in RLightning.
    for _, alike in itertools.groupby(makers, lambda maker: id(maker.config)):
        replicas = list(alike)
        entry = _local_entry(_new_name(replicas[0].config.name, taken), replicas)
        found.append((entry, [maker.env_id for maker in replicas]))
    for k, config in enumerate(config for config in configs if config.backend == SERVER):
        arguments: dict[str, Any] = config.env_kwargs.to_dict()
        port = config.get("zmq_port")
        if port is not None:
            arguments.setdefault("port", int(port))
        if not arguments.keys() & {"clients", "num_clients", "min_clients"}:
            arguments["clients"] = _PLACES
        arguments.setdefault("connect_timeout", math.inf)
        name, fields = _new_name(config.name, taken), _passed_on(config)
        entry = EnvConfig(name=name, backend=SERVER, env_kwargs=arguments, **fields)
        found.append((entry, [f"{uuid.uuid4()}-{len(makers) + k}"]))
    return found


def _local_entry(name: str, replicas: list[EnvMaker]) -> EnvConfig:
    backend = ENVS.described(replicas[0].config.backend)
    fields = _passed_on(replicas[0].config)
    for maker in replicas:
        maker.hardware = ENVS.is_hardware(maker.config.backend, maker.kind)
    if fields.get("placement") != "inline":
        if backend is None or not backend.cpu_bound:
            fields.setdefault("envs_per_process", 1)
        for maker in replicas:
            maker.computes = backend is not None and backend.cpu_bound
    return EnvConfig(name=name, backend="callable", task=tuple(replicas), **fields)


def _new_name(wanted: str, taken: set[str]) -> str:
    """Return an entry's name, made unique, because RLightning's entries may share one."""
    name = f"{wanted}~{len(taken) + 1}" if wanted in taken else wanted
    taken.add(name)
    return name


def _passed_on(config: Any) -> dict[str, Any]:
    given = {name: config.get(name) for name in _PASSED_ON}
    return {
        name: value.to_dict() if hasattr(value, "to_dict") else value
        for name, value in given.items()
        if value is not None
    }
