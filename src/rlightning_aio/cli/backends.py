"""``rlightning-aio backends``: which simulators are here, and how to get the others."""

from __future__ import annotations

import importlib.metadata
from dataclasses import asdict, dataclass

from rich.text import Text

from rlightning_aio.cli.options import AsJson
from rlightning_aio.cli.terminal import named_columns, out, print_json, print_table
from rlightning_aio.registry import BACKENDS, ENTRY_POINT_GROUP

__all__ = ["backends"]


@dataclass(frozen=True, slots=True)
class _Row:
    name: str
    installed: bool
    version: str | None
    install: str


def backends(
    as_json: AsJson = False,
) -> None:
    """List all backends: whether the simulator is installed here, and how to install it.

    Backends of other packages (entry points of the group rlightning_aio.envs) are listed
    after the built-in ones. Simulators that exclude each other need separate virtual
    environments; run this command there, and name that Python in an entry's `interpreter`.

    For example:

        rlightning-aio backends
        rlightning-aio backends --json
    """
    rows = _built_in() + _third_party()
    if as_json:
        print_json([asdict(row) for row in rows])
        return
    table = named_columns("Backends", "backend", "version", "install")
    table.columns[1].justify = table.columns[2].justify = "left"
    for row in rows:
        # As texts: an extra's brackets are no markup.
        table.add_row(
            row.name,
            Text(row.version or "not installed", "" if row.version else "dim"),
            Text(row.install, "dim" if row.version else ""),
        )
    print_table(out(), table)


def _built_in() -> list[_Row]:
    found = ((backend, backend.installed_version()) for backend in BACKENDS.values())
    return [
        _Row(backend.name, version is not None, version, backend.install_command)
        for backend, version in found
    ]


def _third_party() -> list[_Row]:
    entry_points = importlib.metadata.entry_points(group=ENTRY_POINT_GROUP)
    return [
        _Row(point.name, True, point.dist.version, f"pip install {point.dist.name}")
        for point in sorted(entry_points, key=lambda point: point.name)
        if point.dist is not None and point.name not in BACKENDS
    ]
