"""Policies named by the address of a policy server, such as ``openpi://localhost:8000``."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    import contextlib

    from rlightning_aio.cli.policies import Policy

__all__ = ["served_policy"]

_CLIENTS: Final = {"openpi": "OpenPiPolicy", "vla-eval": "VlaEvalPolicy"}


def served_policy(name: str, stack: contextlib.ExitStack) -> Policy:
    """Return a client of the server at an address; `stack` closes it.

    Raises:
        ConfigError: it is no such address, or a package is missing.
    """
    scheme, _, place = name.partition("://")
    if scheme not in _CLIENTS:
        raise ConfigError(f"--policy {name}: should begin with openpi:// or vla-eval://")
    try:
        clients: Any = importlib.import_module("rlightning_aio.policy_servers")
        client = getattr(clients, _CLIENTS[scheme])(f"ws://{place}")
    except (ImportError, ConfigError) as error:
        raise ConfigError(f"--policy {name}: {error}") from error
    return stack.enter_context(client)
