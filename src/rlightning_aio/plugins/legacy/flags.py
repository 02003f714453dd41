"""`InternalFlag`: the environment variables of RLightning's launcher and shell scripts."""

from __future__ import annotations

import os

__all__ = ["InternalFlag"]

_NAMES = ("DEBUG", "VERBOSE", "REMOTE_TRAIN", "REMOTE_EVAL", "REMOTE_STORAGE", "REMOTE_ENV")


class _Flags(type):
    """Attributes that are read from ``RLIGHTNING_<name>`` (1 or 0) at each access."""

    def __getattr__(cls, name: str) -> bool:
        if name not in _NAMES:
            raise AttributeError(f"RLightning has no flag {name!r}; it has {', '.join(_NAMES)}")
        return os.environ.get(f"RLIGHTNING_{name}") == "1"


class InternalFlag(metaclass=_Flags):
    """RLightning's flags: ``InternalFlag.DEBUG`` and so on.

    With ``REMOTE_STORAGE``, envs return arrays instead of tensors. ``REMOTE_ENV`` has no effect:
    envs always live in worker processes.
    """

    @classmethod
    def get_env_vars(cls) -> dict[str, str]:
        """Return the variables with their present values."""
        return {f"RLIGHTNING_{name}": str(int(getattr(cls, name))) for name in _NAMES}
