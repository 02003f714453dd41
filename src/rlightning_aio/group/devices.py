"""GPUs of this machine, assigned to the workers whose entries ask for them.

Rule: they are assigned before anything starts, in the order of the workers. A worker has its
devices to itself, or shares one with workers whose shares add up to it. Only devices that the
trainer's own `CUDA_VISIBLE_DEVICES` leaves are assigned; a worker sees its own by that variable.
Absent on purpose: CUDA. Nothing here initialises a device.
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

__all__ = ["dealt_out", "visible_devices"]

_VISIBLE: Final = "CUDA_VISIBLE_DEVICES"
_ENOUGH: Final = 1e-9
"""Thirds add up to a whole."""
_LISTING_SECONDS: Final = 20.0


def visible_devices() -> tuple[list[str], str]:
    """The devices that this process may use, as CUDA calls them, and how that is known."""
    given = os.environ.get(_VISIBLE)
    if given is not None:
        names = [name.strip() for name in given.split(",")]
        # As CUDA has it: what follows an invalid name is not there.
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
    """The environment variables by which each worker sees its devices; none for one without.

    Args:
        workers: the entry of each, those that live elsewhere left out.

    Raises:
        ConfigError: a worker asks for what can't be, or all for more than there is.
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


def _chosen(config: EnvConfig, left: list[float]) -> list[int] | None:
    """The devices of one worker, taken off what is `left` of each; None if there are too few."""
    wished = config.num_gpus
    if wished > 1 and wished != int(wished):
        raise ConfigError(
            f"entry {config.name!r}, num_gpus: a worker has whole devices or a fraction of one, "
            "not "
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
        # EGL counts all devices of the machine, and knows none by CUDA's identifiers.
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
        f"entry {config.name!r}, num_gpus: there are too few GPUs: requested are {asked}; visible "
        f"here: {there}, by {known_by}; lower num_gpus, or put more envs into a worker "
        "(envs_per_process)"
    )
