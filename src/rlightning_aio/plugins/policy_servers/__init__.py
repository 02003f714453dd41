"""Clients of policy servers, for `evaluate`: openpi's protocol, and that of vla-eval.

Rule: each env has a connection of its own, with at most one request in flight. Frames are limited
in size, and nothing that arrives is unpickled. Needs ``rlightning-aio[websockets]``.
"""

from __future__ import annotations

try:
    from rlightning_aio.plugins.policy_servers.openpi import OpenPiPolicy
    from rlightning_aio.plugins.policy_servers.vla_eval import VlaEvalPolicy
except ModuleNotFoundError as error:
    raise ImportError(f"{error}: pip install 'rlightning-aio[websockets]'") from error

__all__ = ["OpenPiPolicy", "VlaEvalPolicy"]
