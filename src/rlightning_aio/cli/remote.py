"""``rlightning-aio client`` and ``keygen``: the client of an env_server, and its keys.

Rule: the env lives in this process and is closed however the command ends, so Ctrl-C also brings a
robot to its safe stop. A config for a client has exactly one entry.
"""

from __future__ import annotations

import contextlib
from pathlib import Path  # noqa: TC003 (Typer reads annotations)
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlightning_aio._core.hosts.running.build_env import build_env
from rlightning_aio.cli.terminal import (
    connections_logged,
    count,
    counted,
    interruptible,
    print_lines,
)
from rlightning_aio.config import check_installed, load_config
from rlightning_aio.errors import ConfigError, RemoteTraceback, RLightningError
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.remote import RemoteEnvClient
from rlightning_aio.remote.client import is_address
from rlightning_aio.remote.keys import make_keys

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.base import BaseEnv


def client(
    config: Annotated[Path, typer.Argument(help="YAML file with one entry", show_default=False)],
    overrides: Annotated[
        list[str] | None,
        typer.Argument(help="Dotted overrides, such as envs.0.task=Ant-v5", show_default=False),
    ] = None,
    *,
    connect: Annotated[
        str, typer.Option(metavar="tcp://HOST:PORT", help="Where the env_server listens.")
    ],
    keys: Annotated[
        Path | None,
        typer.Option(help="This client's directory, made by `keygen`.", show_default="no keys"),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(help="Name, unique at the server.", show_default="host name and process id"),
    ] = None,
    heartbeat: Annotated[
        float | None,
        typer.Option(
            help="Seconds of silence after which the server counts as gone.",
            show_default="as the server says",
        ),
    ] = None,
    compression: Annotated[
        str | None, typer.Option(help="Of images: zstd.", show_default="as they are")
    ] = None,
) -> None:
    """Lend an env of this machine to the env_server of a trainer elsewhere.

    The command builds the first env of the config's entry in this process, and serves it until
    the env is finished or you press Ctrl-C. If the server is not there, or goes away, the client
    dials again with growing pauses. Nothing moves before the trainer asks for a reset.

    For example:

        rlightning-aio client configs/cartpole.yaml --connect tcp://127.0.0.1:5555
        rlightning-aio client configs/piper.yaml --connect tcp://10.0.0.2:5555 --keys keys/left
    """
    if not is_address(connect):
        raise ConfigError(f"--connect {connect!r}: should look like tcp://127.0.0.1:5555")
    entry = _the_entry(config, load_config(config, overrides or ()))
    served: RemoteEnvClient | None = None
    try:
        with interruptible(), _faults_of(entry):
            env = build_env(entry, is_hardware=entry.is_hardware)
            options: dict[str, Any] = {"heartbeat": heartbeat, "compression": compression}
            served = _client_of(env, connect, keys=keys, name=name, **options)
            with served, connections_logged():
                typer.echo(f"{served.name} connects to {connect}", err=True)
                served.run()
    finally:
        if served is not None:
            steps, sessions = count(served.num_steps), counted(served.num_sessions, "session")
            print_lines([f"{served.name}: {steps} steps in {sessions}"])


def _the_entry(path: Path, configs: Sequence[EnvConfig]) -> EnvConfig:
    """Return the only entry.

    Raises:
        ConfigError: this process can't run it, or there are several; the message names file,
            entry and field.
    """
    if len(configs) > 1:
        names = ", ".join(config.name for config in configs)
        raise ConfigError(f"{path}: envs: a client has one env, so keep one of the entries {names}")
    entry = configs[0]
    place = f"{path}: envs.0 ({entry.name!r})"
    if entry.backend == "env_server":
        raise ConfigError(
            f"{place}, backend: clients connect to an env_server; name the env's own backend"
        )
    for field in ("interpreter", "env_vars"):
        if getattr(entry, field):
            raise ConfigError(
                f"{place}, {field}: a client's env runs in the command's own process; start "
                "the command that way instead"
            )
    check_installed(configs)
    return entry


def _client_of(env: BaseEnv, address: str, **options: Any) -> RemoteEnvClient:
    try:
        return RemoteEnvClient(env, address, **options)
    except BaseException:
        env.close()
        raise


@contextlib.contextmanager
def _faults_of(entry: EnvConfig) -> Generator[None]:
    """Turn an exception of the env into one message that names the env."""
    try:
        yield
    except RLightningError:
        raise
    except Exception as error:  # noqa: BLE001  # It is the env author's code.
        words = ErrorText.of(error)
        raise RLightningError(
            f"{entry.name}-0 (backend {entry.backend!r}, task {entry.task_name!r}) raised "
            f"{words.summary}; its __cause__ is the remote traceback"
        ) from RemoteTraceback(words.traceback)


def keygen(
    directory: Annotated[Path, typer.Argument(help="Created if missing.", show_default=False)],
    names: Annotated[list[str], typer.Argument(help="Names of the clients.", show_default=False)],
) -> None:
    """Make the CURVE keys of an env_server and of the clients that it lets in.

    The server's keys are made the first time and then kept, so you can add clients
    later. Each client gets a directory of its own, which holds a secret: copy it to that
    client's machine over a channel that you trust. Deleting server/clients/NAME.key shuts
    a client out.

    For example:

        rlightning-aio keygen keys left_arm right_arm
    """
    made = make_keys(directory, names)
    server = directory / "server"
    lines = [
        f"{server}: stays with the trainer; name it in the env_server's env_kwargs.keys",
        *(
            f"{path}: move to the machine of client {name!r}; there, "
            f"rlightning-aio client CONFIG --connect tcp://HOST:PORT --keys {path.name} "
            f"--name {name}"
            for name, path in zip(names, made, strict=True)
        ),
    ]
    print_lines(lines)
