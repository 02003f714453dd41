"""GPUs of this machine, assigned to the workers whose entries ask for them.

Rule: devices are assigned before any worker starts, in the order of the workers. A worker has whole
devices, or shares one with workers whose fractions add up to at most 1. Only devices in this
process's `CUDA_VISIBLE_DEVICES` are assigned, and each worker gets its own value of that variable.
Left out: CUDA. Nothing here initialises a device.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.config import EnvConfig

__all__ = ["check_own_devices", "dealt_out", "visible_devices"]

_VISIBLE: Final = "CUDA_VISIBLE_DEVICES"
_ENOUGH: Final = 1e-9
"""Tolerance for rounding: three thirds make a whole device."""
_LISTING_SECONDS: Final = 20.0


def visible_devices() -> tuple[list[str], str]:
    """CUDA's names of the devices that this process may use, and the source of that knowledge."""
    given = os.environ.get(_VISIBLE)
    if given is not None:
        names = [name.strip() for name in given.split(",")]
        # CUDA ignores an invalid name and all that follow it.
        invalid = next((k for k, name in enumerate(names) if name in ("", "-1")), len(names))
        return names[:invalid], f"{_VISIBLE}={given}"
    nodes = [node for node in Path("/dev").glob("nvidia*") if node.name[6:].isdigit()]
    if nodes:
        return [str(k) for k in range(len(nodes))], "/dev/nvidia*"
    program = shutil.which("nvidia-smi")
    if program is None:
        return [], "no /dev/nvidia*, no nvidia-smi"
    try:
        listed = subprocess.run(
            [program, "-L"], capture_output=True, text=True, timeout=_LISTING_SECONDS, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        return [], f"nvidia-smi -L: {error}"
    lines = [line for line in listed.stdout.splitlines() if line.startswith("GPU ")]
    return [str(k) for k in range(len(lines))], "nvidia-smi -L"


def dealt_out(workers: Sequence[EnvConfig]) -> list[dict[str, str]]:
    """The environment variables that assign devices to each worker; empty without devices.

    Args:
        workers: the entry of each worker on this machine.

    Raises:
        ConfigError: a worker asks for 1.5 devices, say, or all workers for more than there are.
    """
    if not any(config.num_gpus for config in workers):
        return [{} for _ in workers]
    names, known_by = visible_devices()
    left = [1.0] * len(names)
    dealt: list[dict[str, str]] = []
    for config in workers:
        chosen = _chosen(config, left) if config.num_gpus else []
        if chosen is None:
            raise ConfigError(_shortage(config, workers, names, known_by))
        dealt.append(_variables([names[k] for k in chosen]))
    return dealt


def check_own_devices(config: EnvConfig) -> None:
    """Raise `ConfigError` if an inline entry asks for GPUs and this process sees none."""
    if config.num_gpus and not (known := visible_devices())[0]:
        raise ConfigError(
            f"entry {config.name!r}, num_gpus: with placement: {config.placement} its envs share "
            f"this process's GPUs, and none is visible here ({known[1]}); leave num_gpus out"
        )


def _chosen(config: EnvConfig, left: list[float]) -> list[int] | None:
    """Choose the devices of one worker and subtract its share from `left`; None if too few."""
    wished = config.num_gpus
    if wished > 1 and wished != int(wished):
        raise ConfigError(
            f"entry {config.name!r}, num_gpus: must be a whole number or less than 1, not "
            f"{wished:g}"
        )
    count, share = (1, wished) if wished < 1 else (int(wished), 1.0)
    chosen = [k for k, free in enumerate(left) if free + _ENOUGH >= share][:count]
    if len(chosen) < count:
        return None
    for k in chosen:
        left[k] -= share
    return chosen


def _variables(names: list[str]) -> dict[str, str]:
    if not names:
        return {}
    variables = {_VISIBLE: ",".join(names)}
    if names[0].isdigit():
        # EGL numbers all devices of the machine, and doesn't accept CUDA's UUIDs.
        variables["MUJOCO_EGL_DEVICE_ID"] = names[0]
    return variables


def _shortage(
    config: EnvConfig, workers: Sequence[EnvConfig], names: list[str], known_by: str
) -> str:
    wishes: dict[str, tuple[int, float]] = {}
    for other in workers:
        if other.num_gpus:
            wishes[other.name] = wishes.get(other.name, (0, 0))[0] + 1, other.num_gpus
    asked = ", ".join(
        f"{count} workers of entry {name!r} with {share:g} each"
        for name, (count, share) in wishes.items()
    )
    there = f"{len(names)} ({', '.join(names)})" if names else "none"
    return (
        f"entry {config.name!r}, num_gpus: too few GPUs: requested: {asked}; visible here "
        f"({known_by}): {there}; lower num_gpus, or put more envs into a worker (envs_per_process)"
    )
