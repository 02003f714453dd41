"""The Typer application with all commands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

import rlightning_aio
from rlightning_aio.cli.backends import backends
from rlightning_aio.cli.bench import bench
from rlightning_aio.cli.check import check
from rlightning_aio.cli.evaluating import evaluation
from rlightning_aio.cli.remote import client, keygen
from rlightning_aio.cli.rollout import rollout
from rlightning_aio.cli.terminal import guarded
from rlightning_aio.protocol import kernel

app = typer.Typer(
    rich_markup_mode="markdown",
    name="rlightning-aio",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{rlightning_aio.__version__} (hot path: {kernel.selected})")
        raise typer.Exit


@app.callback()
def prepare(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            help="Print the version, and whether the compiled kernel is used (c) or not (python).",
        ),
    ] = False,
) -> None:
    """Many reinforcement-learning environments in worker processes, used as one.

    A config is a YAML file with one entry for each kind of env. `key=value` arguments
    after it override its fields; envs.0.num_workers=8 means eight envs. A checkout has some
    in configs/. A whole config, as cartpole.yaml:

        envs: [{name: pole, backend: gymnasium, task: CartPole-v1, num_workers: 8}]

    Start here:

        rlightning-aio backends
        rlightning-aio check cartpole.yaml
        rlightning-aio rollout cartpole.yaml
    """
    del version  # Typer has called the option's callback.
    # Policies and `imports:` of a project are found where the command is run, as they are
    # by `python -m`; what is installed comes first.
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.append(here)


for command in (rollout, bench, check, backends, client, keygen):
    app.command()(guarded(command))
# Named after what Python has a function of that name for.
app.command("eval")(guarded(evaluation))
