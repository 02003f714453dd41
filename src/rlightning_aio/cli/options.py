"""Arguments and options that several commands share, each with its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

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
    int | None,
    # Others count up from it, and all must be below 2**62.
    typer.Option(min=0, max=2**61, help="Seed of the first resets and of random actions."),
]
AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="Print one JSON document instead of the table.")
]
