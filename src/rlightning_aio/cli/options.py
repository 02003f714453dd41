"""Arguments and options that several commands share, each with its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final, TypeAlias

import typer

from rlightning_aio.errors import ConfigError

_LAST_SEED: Final = 2**61
"""Further seeds count up from a given one, and all must be below 2**62."""

Config: TypeAlias = Annotated[Path, typer.Argument(help="YAML file with envs:", show_default=False)]
Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Argument(help="Dotted overrides: envs.0.num_workers=8 (envs)", show_default=False),
]
PolicyName: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="MODULE:NAME",
        help="A callable that takes a batch and returns actions, or a model with predict(), or a "
        "dict with one for each entry.",
        show_default="random actions",
    ),
]
PlotFile: TypeAlias = Annotated[
    Path | None, typer.Option(help="Also draw the figures (PNG, SVG or PDF; needs matplotlib).")
]
Seed: TypeAlias = Annotated[
    int | None, typer.Option(min=0, help="Seed of the first resets and of random actions.")
]
AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="Print one JSON document instead of the table.")
]


def check_seed(seed: int | None) -> None:
    """Raise `ConfigError` if `seed` leaves no room to count further seeds."""
    if seed is not None and seed > _LAST_SEED:
        raise ConfigError(f"--seed {seed}: should be from 0 to 2**61")
