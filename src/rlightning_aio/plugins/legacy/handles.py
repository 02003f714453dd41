"""Handles on the envs of a group: their methods and attributes, wherever they live."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlightning_aio.plugins.legacy.translated_group import TranslatedGroup

__all__ = ["EnvHandle", "ServerHandle"]


class EnvHandle:
    """A handle on an env: its methods are called, and its attributes read, in its worker."""

    def __init__(self, group: TranslatedGroup, env_id: str) -> None:
        self._group = group
        self._env_id = env_id

    def __getattr__(self, name: str) -> Any:
        # `copy` and `pickle` look for special methods, which must not be found in the worker.
        if name.startswith("__") or "_group" not in vars(self):
            raise AttributeError(name)
        is_method, value = self._group.call_env(self._env_id, "look", name)
        if not is_method:
            return value

        def method(*args: Any, **kwargs: Any) -> Any:
            return self._group.call_env(self._env_id, "of_env", name, args, kwargs)

        return method


class ServerHandle:
    """A handle on an env_server, without access to its clients' envs."""

    def __init__(self, group: TranslatedGroup, env_id: str) -> None:
        self._group = group
        self.env_id = env_id

    def get_env_id(self) -> str:
        """Return the env_server's id."""
        return self.env_id

    def get_address_port(self) -> tuple[str, int]:
        """Return the host and port for clients."""
        return self._group.server_address(self.env_id)

    def get_env_stats(self, reset: bool = False) -> dict[str, list[float]]:
        """Return no statistics: clients keep their own."""
        del reset
        return {}

    def finish_rollout(self) -> None:
        """Do nothing."""

    def get_observation_space(self) -> None:
        """Return None: only its clients' envs have spaces."""

    def get_action_space(self) -> None:
        """Return None: only its clients' envs have spaces."""
