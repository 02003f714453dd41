"""Turns RLightning's configs into entries of ours."""

from __future__ import annotations

import copy
import itertools
import uuid
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, cast

from rlightning_aio import ENVS, EnvConfig
from rlightning_aio.plugins.legacy.hosted import EnvMaker
from rlightning_aio.plugins.legacy.names import names_in_use

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

__all__ = ["Plan", "define_env_instance_cfgs", "listed_configs", "repeated"]

_SERVER: Final = "env_server"
_PASSED_ON: Final = (
    "placement", "envs_per_process", "step_timeout", "reset_timeout", "start_timeout",
    "close_timeout", "on_worker_death", "on_env_error", "max_restarts", "imports",
    "interpreter", "env_vars",
)  # fmt: skip
"""Fields of our entries that RLightning lacks and that its entries may have here, too."""


def listed_configs(env_cfgs: Any) -> list[Any]:
    """Return a list of RLightning's configs, made from one or several configs or mappings."""
    kind = names_in_use().EnvConfig
    return [
        kind.from_dict(dict(cast("Mapping[str, Any]", one))) if isinstance(one, Mapping) else one
        for one in repeated(env_cfgs, 1)
    ]


def repeated(value: Any, count: int) -> list[Any]:
    """Return `value` if it is a list, else a list that repeats it."""
    return cast("list[Any]", value) if isinstance(value, list) else [value] * count


def define_env_instance_cfgs(env_cfg: Any, num_workers: int = 1) -> list[Any]:
    """Return a list that repeats one copy of a config."""
    return [copy.deepcopy(env_cfg)] * num_workers


class Plan:
    """The entries and ids for a group of RLightning's configs, one for each env.

    Attributes:
        entries: the entries of our group: local envs, then env_servers.
        local, servers: the configs of each kind.
        ids: RLightning's ids of the local envs and the servers.
        core_ids: our ids, in the same order.
    """

    def __init__(self, configs: Sequence[Any], preprocess_fns: Sequence[Any]) -> None:
        registry = names_in_use().ENVS
        places = [(k, config) for k, config in enumerate(configs) if config.backend != _SERVER]
        self.local = [config for _, config in places]
        self.servers = [config for config in configs if config.backend == _SERVER]
        self.entries: list[EnvConfig] = []
        self.ids: list[str] = []
        self.core_ids: list[str] = []
        self._taken: set[str] = set()
        makers = [
            EnvMaker(registry.get(config.backend), config, k, preprocess_fns[k], _new_id(k))
            for k, config in places
        ]
        # Replicas of an entry are one object in RLightning.
        for _, alike in itertools.groupby(makers, lambda maker: id(maker.config)):
            replicas = list(alike)
            self._add(self._local_entry(replicas), [maker.env_id for maker in replicas])
        for k, config in enumerate(self.servers, start=len(places)):
            self._add(self._server_entry(config), [_new_id(k)])

    def _add(self, entry: EnvConfig, ids: list[str]) -> None:
        self.entries.append(entry)
        self.ids += ids
        self.core_ids += [f"{entry.name}-{k}" for k in range(len(ids))]

    def _local_entry(self, replicas: list[EnvMaker]) -> EnvConfig:
        config = replicas[0].config
        backend = ENVS.described(config.backend)
        fields = _passed_on(config)
        if fields.get("placement") != "inline":
            if backend is None or not backend.cpu_bound:
                fields.setdefault("envs_per_process", 1)
            for maker in replicas:
                maker.computes = backend is not None and backend.cpu_bound
            if backend is not None and backend.hardware:
                fields.setdefault("on_worker_death", "raise")
        return EnvConfig(
            name=self._name(config.name),
            backend="callable",
            task=tuple(replicas),
            **fields,
        )

    def _server_entry(self, config: Any) -> EnvConfig:
        arguments: dict[str, Any] = config.env_kwargs.to_dict()
        port = config.get("zmq_port")
        if port is not None:
            arguments.setdefault("port", int(port))
        fields = _passed_on(config)
        name = self._name(config.name)
        return EnvConfig(name=name, backend=_SERVER, env_kwargs=arguments, **fields)

    def _name(self, wanted: str) -> str:
        """Return the entry's name, made unique, because RLightning's entries may share one."""
        name = next(name for name in _variants(wanted) if name not in self._taken)
        self._taken.add(name)
        return name


def _new_id(place: int) -> str:
    return f"{uuid.uuid4()}-{place}"


def _variants(name: str) -> Iterator[str]:
    yield name
    yield from (f"{name}~{k}" for k in itertools.count(2))


def _passed_on(config: Any) -> dict[str, Any]:
    given = {name: config.get(name) for name in _PASSED_ON}
    return {
        name: value.to_dict() if hasattr(value, "to_dict") else value
        for name, value in given.items()
        if value is not None
    }
