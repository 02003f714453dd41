"""The sections of an experiment's config: fields and defaults only.

A program that loads its experiment's file for ``env:`` reads the other sections, too. The engines,
policies and buffers that use them are RLightning's own.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from rlightning_aio.legacy.config import Config, EnvConfig

__all__ = [
    "BufferConfig",
    "ClusterConfig",
    "LogConfig",
    "MainConfig",
    "PolicyConfig",
    "ResourcePoolConfig",
    "TrainConfig",
    "WeightBufferConfig",
    "validate_config_for_placement",
]


class _SamplerConfig(Config):
    type: Literal["all", "batch", "uniform"]


class _StorageConfig(Config):
    mode: Literal["circular", "fixed"] = "circular"
    type: Literal["unified", "sharded"] = "unified"
    unit: Literal["transition", "episode"] = "transition"
    device: Literal["cpu", "cuda"] = "cpu"


class BufferConfig(Config):
    """``buffer:``."""

    type: Literal["ReplayBuffer", "RolloutBuffer"]
    capacity: int
    sampler: _SamplerConfig | None = None
    auto_truncate_episode: bool = False
    storage: _StorageConfig = Field(default_factory=_StorageConfig)
    node_affinity_env: bool = False
    node_affinity_train: bool = False

    @model_validator(mode="after")
    def _choose_sampler(self) -> Self:
        if self.sampler is None:
            kind = "uniform" if self.type == "ReplayBuffer" else "all"
            self.sampler = _SamplerConfig(type=kind)
        return self


class WeightBufferConfig(Config):
    """``policy.weight_buffer:``."""

    type: Literal["WeightBuffer", "CPUWeightBuffer", "ShardedWeightBuffer"] = "WeightBuffer"
    buffer_strategy: Literal["None", "Double", "Shared", "Sharded"] = "Double"

    @model_validator(mode="after")
    def _match(self) -> Self:
        owners = {"Shared": "CPUWeightBuffer", "Sharded": "ShardedWeightBuffer"}
        owner = owners.get(self.buffer_strategy, self.type)
        if self.type != owner:
            raise ValueError(f"{self.buffer_strategy} buffer strategy needs type {owner}")
        return self


class PolicyConfig(Config):
    """``policy:``."""

    type: str
    backend: Config | None = None
    train_num_gpus: float = 1.0
    eval_num_gpus: float = 1.0
    model_cfg: Config | None = None
    optim_cfg: Config | None = None
    rollout_mode: Literal["sync", "async"] = "sync"
    router_type: Literal["simple", "node_affinity"] = "simple"
    weight_buffer: WeightBufferConfig = Field(default_factory=WeightBufferConfig)
    policy_kwargs: Config | None = None


class TrainConfig(Config):
    """``train:``."""

    max_epochs: int
    batch_size: int = 64
    max_rollout_steps: int = -1
    max_eval_rollout_steps: int = -1
    lr: float = 0.0003
    parallel: Literal["ddp"] | None = None
    eval_interval: int = -1
    save_interval: int = -1
    save_dir: str | None = None

    @model_validator(mode="after")
    def _save_beside_the_log(self) -> Self:
        log_file = os.environ.get("RLIGHTNING_LOG_FILE")
        if self.save_dir is None and log_file:
            self.save_dir = str(Path(log_file).parent / "checkpoints")
        return self


class LogConfig(Config):
    """``log:``."""

    level: str = "DEBUG"
    backend: Literal["tensorboard", "wandb", "swanlab"] = "tensorboard"
    project: str = "default_project"
    name: str = "default_exp"
    log_dir: str = "./runs"
    mode: str | None = None

    @model_validator(mode="after")
    def _choose_mode(self) -> Self:
        if self.mode is None:
            self.mode = {"wandb": "offline", "swanlab": "local"}.get(self.backend)
        return self


class ResourcePoolConfig(Config):
    """One entry of ``cluster.resource_pool:``."""

    name: str
    num_node: int
    num_gpus: int | list[int]
    node_ids: list[str] | None = None


class _PlacementConfig(Config):
    mode: Literal["auto", "manual"] = "auto"
    strategy: Literal["default", "disaggregate", "colocate"] = "default"
    env_strategy: Literal["default", "device-colocate"] = "default"


class ClusterConfig(Config):
    """``cluster:``."""

    ray_address: str = "auto"
    train_worker_num: int = 1
    eval_worker_num: int = 1
    train_each_gpu_num: float = 1.0
    eval_each_gpu_num: float = 1.0
    buffer_worker_num: int | Literal["auto"] = 1
    remote_train: bool = True
    remote_eval: bool = True
    remote_storage: bool = True
    remote_env: bool = True
    is_colocated: bool = False
    enable_offload: bool = False
    rollout_env_interaction: Literal["batched", "streaming"] | None = None
    placement: _PlacementConfig = Field(default_factory=_PlacementConfig)
    resource_pool: list[ResourcePoolConfig] | None = None


class MainConfig(Config):
    """The config of a whole experiment."""

    engine: Literal["asyncrl", "async_rsl", "rsl", "syncrl", "eval"] | None = None
    env: list[EnvConfig] | EnvConfig
    buffer: BufferConfig
    policy: PolicyConfig
    train: TrainConfig
    cluster: ClusterConfig | None = None
    log: LogConfig = Field(default_factory=LogConfig)
    debug: bool = True
    verbose: bool = True

    @model_validator(mode="after")
    def _list_entries(self) -> Self:
        if isinstance(self.env, EnvConfig):
            self.env = [self.env]
        return self


def validate_config_for_placement(config: MainConfig) -> MainConfig:
    """Return `config`, with weights shared between policies that share their devices."""
    if config.cluster is not None and config.cluster.is_colocated:
        config.policy.weight_buffer.buffer_strategy = "None"
    return config
