"""Arguments and options that several commands share, each with its help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

__all__ = ["AsJson", "Config", "Overrides", "TraceFile"]

Config: TypeAlias = Annotated[Path, typer.Argument(help="YAML file with envs:", show_default=False)]
Overrides: TypeAlias = Annotated[
    list[str] | None,
    typer.Argument(help="Dotted overrides, such as envs.0.num_workers=8", show_default=False),
]
TraceFile: TypeAlias = Annotated[
    Path | None,
    typer.Option("--trace", metavar="FILE", help="Write a timeline for https://ui.perfetto.dev."),
]
AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="Print one JSON document instead of the table.")
]
