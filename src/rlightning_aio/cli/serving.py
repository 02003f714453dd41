"""``rlightning-aio serve``: the envs of a config as an OpenEnv server."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

import rlightning_aio
from rlightning_aio.cli.options import Config, Overrides
from rlightning_aio.cli.terminal import counted, out, run_interruptible
from rlightning_aio.config import check_installed, load_config
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import plugins

if TYPE_CHECKING:
    from rlightning_aio.config import EnvConfig

__all__ = ["serve"]

_MAX_PORT: Final = 65535


def serve(
    config: Config,
    overrides: Overrides = None,
    *,
    port: Annotated[int, typer.Option(min=0, max=_MAX_PORT, help="0 picks a free one.")] = 8000,
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1",
    session_timeout: Annotated[
        float, typer.Option(min=0, help="Seconds until a session without a connection ends.")
    ] = 300.0,
) -> None:
    """Serve the envs of a config with one entry as sessions of an OpenEnv server.

    OpenEnv's clients connect to it, as many at once as the entry has envs (num_workers).
    It ends with Ctrl-C.

    For example:

        rlightning-aio serve configs/cartpole.yaml --port 8000
    """
    configs = load_config(config, overrides or ())
    if len(configs) != 1 or configs[0].num_envs != 1 or configs[0].backend == "env_server":
        raise ConfigError(
            f"{config}: a server has the envs of one entry, without sub-environments and not an "
            "env_server's; serve other entries at other ports"
        )
    check_installed(configs)
    run_interruptible(_serve(configs[0], host, port, session_timeout))


async def _serve(config: EnvConfig, host: str, port: int, session_timeout: float) -> None:
    try:
        server_of: Any = plugins("servers")["openenv"].load()
    except ImportError as error:
        raise ConfigError(f"{error}: pip install 'rlightning-aio[websockets]'") from error
    async with (
        rlightning_aio.build_env_group(config) as group,
        server_of(group, host, port, session_timeout=session_timeout) as server,
    ):
        sessions = counted(len(group), "session")
        out().print(f"{config.name}: {sessions} at {server.url}", soft_wrap=True, markup=False)
        await asyncio.Event().wait()
