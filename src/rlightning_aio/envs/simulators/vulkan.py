"""Find out if SAPIEN, ManiSkill's engine, can render here, and work without a renderer.

Rule: another process tries it, once. Vulkan must not be used in a process that forks
workers, and a broken driver may crash the process that tries.
"""

from __future__ import annotations

import functools
import subprocess
import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

PROBE = "import sapien.render; sapien.render.RenderMaterial()"
PROBE_TIMEOUT = 60.0


@functools.cache
def render_device_is_usable() -> bool:
    """Return True if SAPIEN finds a Vulkan device that is new enough."""
    try:
        probe = subprocess.run(  # noqa: S603 - this very interpreter and a constant
            [sys.executable, "-c", PROBE], capture_output=True, timeout=PROBE_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0


class UnseenMaterial:
    """Replace SAPIEN's `RenderMaterial` where there is no renderer.

    ManiSkill gives its objects materials even if nothing is rendered.
    """

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def __getattr__(self, name: str) -> Callable[..., None]:
        if name.startswith("set_"):
            return _accept
        raise AttributeError(name)


def _accept(*_: Any, **__: Any) -> None: ...


def do_without_materials() -> None:
    """Build objects without a render device; call this before `mani_skill` is imported."""
    for name in ("sapien.render", "sapien.pysapien.render"):
        module: Any = import_module(name)
        module.RenderMaterial = UnseenMaterial
