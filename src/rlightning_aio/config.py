"""`EnvConfig` and `load_config`: the only door for what users configure.

Rule: whatever is wrong is said here, in one message that names file, entry and
field, before any process starts. OmegaConf reads, pydantic checks.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["EnvConfig"]


class EnvConfig(BaseModel):
    """One entry of ``envs:``, which makes ``num_workers`` envs of one kind."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    """Name of the entry; its envs are called ``<name>-0``, ``<name>-1``, …"""
    backend: str
    """Simulator backend; see ``rlightning-aio backends``."""
    task: str
    """Task name within the backend."""
    num_workers: int = Field(default=1, ge=1)
    """Envs of this entry."""
    num_envs: int = Field(default=1, ge=1)
    """Vectorised sub-environments in each env, where the backend supports them."""
    max_episode_steps: int | None = Field(default=None, ge=1)
    """Step limit of an episode; None leaves it to the simulator."""
    num_cpus: float = Field(default=1, gt=0)
    """CPUs of each worker (``placement: ray`` only)."""
    num_gpus: float = Field(default=0.0, ge=0)
    """GPUs of each worker (``placement: ray`` only)."""
    env_kwargs: dict[str, Any] = Field(default_factory=dict)
    """Passed to the backend."""
    placement: Literal["process", "inline", "ray"] = "process"
    """Where the envs live: worker processes, this process, or Ray actors."""
    envs_per_process: int | Literal["auto"] = "auto"
    """Envs that share a worker."""
    step_timeout: float | None = Field(default=None, gt=0)
    """Seconds that one step may take before the env counts as hung."""
    reset_timeout: float | None = Field(default=None, gt=0)
    """Seconds that one reset may take."""
    start_timeout: float = Field(default=120.0, gt=0)
    """Seconds from the start of a worker until its envs are built."""
    on_worker_death: Literal["restart", "raise"] = "restart"
    """What to do when a worker dies or hangs."""
    max_restarts: int = Field(default=3, ge=0)
    """Restarts in a row, without a step in between, before giving up."""
    imports: tuple[str, ...] = ()
    """Modules imported in the worker before the env is built."""
    interpreter: str | None = None
    """Python of another virtual environment for this entry's workers."""
    env_vars: dict[str, str] = Field(default_factory=dict)
    """Environment variables of the worker, set before anything is imported."""
    cpu_affinity: bool = False
    """Pin worker k to the k-th core this process may use."""
