"""What worker processes need of this system, and what its accounts say of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig


def check_system(config: EnvConfig) -> None:
    """Check that worker processes can run on this system.

    Raises:
        ConfigError: it is not Linux.
    """
    if sys.platform != "linux":
        raise ConfigError(
            f"entry {config.name!r}: worker processes (placement: process) need Linux, and this is "
            f"{sys.platform}. Here, use placement: inline (the envs live in this process), "
            "placement: loop (awaitable envs, in the asynchronous group) or backend: env_server "
            "(envs elsewhere connect); make_vec steps MuJoCo's tasks in one batch in this process"
        )


def processor_ns(pid: int) -> int | None:
    """Return for how long the living threads of a process have run or waited for a core, in ns.

    None if the process has ended, or the kernel keeps no such accounts.
    """
    ran = 0
    try:
        for accounts in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            on_core, in_queue, _ = accounts.read_text().split()
            ran += int(on_core) + int(in_queue)
    except (OSError, ValueError):
        return None  # A thread has ended meanwhile, or the accounts have another form.
    return ran or None
