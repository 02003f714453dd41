"""`InternalFlag`: what RLightning's launcher and shell scripts say by environment variables."""

from __future__ import annotations

import os

__all__ = ["InternalFlag"]

_NAMES = ("DEBUG", "VERBOSE", "REMOTE_TRAIN", "REMOTE_EVAL", "REMOTE_STORAGE", "REMOTE_ENV")


class _Flags(type):
    """Attributes that are read anew from ``RLIGHTNING_<name>``, which is 1 or 0."""

    def __getattr__(cls, name: str) -> bool:
        if name not in _NAMES:
            raise AttributeError(f"RLightning has no flag {name!r}; it has {', '.join(_NAMES)}")
        return os.environ.get(f"RLIGHTNING_{name}") == "1"


class InternalFlag(metaclass=_Flags):
    """RLightning's flags: ``InternalFlag.DEBUG`` and so on.

    ``REMOTE_STORAGE`` has envs return arrays in place of tensors. ``REMOTE_ENV`` changes nothing
    here: envs always live in processes of their own.
    """

    @classmethod
    def get_env_vars(cls) -> dict[str, str]:
        """The variables as they stand."""
        return {f"RLIGHTNING_{name}": str(int(getattr(cls, name))) for name in _NAMES}
