"""``rlightning-aio backends``: lists the simulators and how to install them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from operator import attrgetter

from rich.text import Text

from rlightning_aio.cli.options import AsJson
from rlightning_aio.cli.terminal import named_columns, print_json, print_table
from rlightning_aio.registry import BACKENDS, Backend, plugins


@dataclass(frozen=True, slots=True)
class _Row:
    name: str
    installed: bool
    package: str
    version: str | None
    install: str


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
        print_json([asdict(row) for row in rows])
        return
    table = named_columns("Backends", "backend", "package", "install", texts=["package", "install"])
    for row in rows:
        # Texts, because Rich would take an extra's brackets for markup.
        table.add_row(
            row.name,
            Text(f"{row.package} {row.version or 'not installed'}", "" if row.version else "dim"),
            Text(row.install, "dim" if row.version else ""),
        )
    print_table(table)


def _row(backend: Backend) -> _Row:
    version = backend.installed_version()
    return _Row(backend.name, version is not None, backend.module, version, backend.install)


def _plugged_in() -> list[Backend]:
    points = sorted(plugins(), key=attrgetter("name"))
    return [point.load() for point in points if point.name not in BACKENDS]
