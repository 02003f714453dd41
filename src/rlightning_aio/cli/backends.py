"""``rlightning-aio backends``: lists the simulators and how to install them."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

from rich.text import Text

from rlightning_aio.cli.options import AsJson
from rlightning_aio.cli.terminal import named_columns, print_json, print_table
from rlightning_aio.registry import BACKENDS, Backend, plugins


def backends(as_json: AsJson = False) -> None:
    """List all backends: whether the package they need is installed here, and how to install it.

    Backends of plug-ins (entry points of the group rlightning_aio.backends) are listed after
    the built-in ones. Simulators that exclude each other need separate virtual environments;
    run this command there, and name that Python in an entry's `interpreter`.

    For example:

        rlightning-aio backends
        rlightning-aio backends --json
    """
    rows = [_row(backend) for backend in (*BACKENDS.values(), *_plugged_in())]
    if as_json:
        print_json(rows)
        return
    table = named_columns("Backends", "backend", "package", "install", texts=["package", "install"])
    for row in rows:
        # Texts, because Rich would take an extra's brackets for markup.
        found = row["version"]
        table.add_row(
            row["name"],
            Text(f"{row['package']} {found or 'not installed'}", "" if found else "dim"),
            Text(row["install"], "dim" if found else ""),
        )
    print_table(table)


def _row(backend: Backend) -> dict[str, Any]:
    version = backend.installed_version()
    return {
        "name": backend.name,
        "installed": version is not None,
        "package": backend.module,
        "version": version,
        "install": backend.install,
    }


def _plugged_in() -> list[Backend]:
    points = sorted(plugins(), key=attrgetter("name"))
    return [point.load() for point in points if point.name not in BACKENDS]
