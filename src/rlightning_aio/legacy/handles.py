"""The envs of a group as objects: their methods and attributes, wherever they live."""

from __future__ import annotations

from typing import Any, Protocol

__all__ = ["EnvHandle", "ServerHandle"]


class _Owner(Protocol):
    """The group, as far as handles use it."""

    def call_env(self, core_id: str, name: str, *args: Any) -> Any: ...

    def server_address(self, core_id: str) -> tuple[str, int]: ...


class EnvHandle:
    """An env of a group: any method of it is called where it lives, any attribute read there."""

    def __init__(self, group: _Owner, core_id: str) -> None:
        self._group = group
        self._core_id = core_id

    def __getattr__(self, name: str) -> Any:
        # Whoever copies or pickles asks for these, and an env that has none means no.
        if name.startswith("__") or "_group" not in vars(self):
            raise AttributeError(name)
        is_method, value = self._group.call_env(self._core_id, "look", name)
        if not is_method:
            return value

        def method(*args: Any, **kwargs: Any) -> Any:
            return self._group.call_env(self._core_id, "of_env", name, args, kwargs)

        return method


class ServerHandle:
    """An env_server of a group; its clients' envs are their own affair."""

    def __init__(self, group: _Owner, env_id: str, core_id: str) -> None:
        self._group = group
        self._core_id = core_id
        self.env_id = env_id

    def get_env_id(self) -> str:
        """Its id."""
        return self.env_id

    def get_address_port(self) -> tuple[str, int]:
        """Where clients connect to."""
        return self._group.server_address(self._core_id)

    def get_env_stats(self, reset: bool = False) -> dict[str, list[float]]:
        """Nothing: clients keep what they count."""
        del reset
        return {}

    def finish_rollout(self) -> None:
        """Nothing is done."""

    def get_observation_space(self) -> None:
        """It has none of its own."""

    def get_action_space(self) -> None:
        """It has none of its own."""
