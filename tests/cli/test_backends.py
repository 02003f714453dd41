"""``rlightning-aio backends``: what is here, and how to get the rest."""

from __future__ import annotations

import importlib.metadata
from typing import TYPE_CHECKING

import gymnasium
from cli.command import invoke, invoke_json, run

from rlightning_aio.registry import BACKENDS, ENTRY_POINT_GROUP, Backend

if TYPE_CHECKING:
    import pytest


def test_every_built_in_backend_has_its_line() -> None:
    """Name, version and the command that installs it, each in full."""
    lines = run("backends").stdout.splitlines()
    for backend in BACKENDS.values():
        (line,) = [line for line in lines if line.split()[:1] == [backend.name]]
        assert line.rstrip().endswith(backend.install_command)
        assert (backend.installed_version() or "not installed") in line


def test_json_says_the_same() -> None:
    """One object for each backend, in the registry's order."""
    rows = invoke_json("backends")
    assert [row["name"] for row in rows[: len(BACKENDS)]] == list(BACKENDS)
    (row,) = [row for row in rows if row["name"] == "gymnasium"]
    assert row["installed"] is True
    assert row["version"] == gymnasium.__version__
    assert row["install"] == BACKENDS["gymnasium"].install_command


def test_what_is_missing_is_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulator that is not installed has no version, and no error."""
    monkeypatch.setattr(Backend, "installed_version", lambda self: None)
    assert {row["installed"] for row in invoke_json("backends")[: len(BACKENDS)]} == {False}
    assert invoke("backends").stdout.count("not installed") == len(BACKENDS)


def test_backends_of_other_packages_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    """An entry point brings a line with its package's version."""
    distribution = importlib.metadata.distribution("gymnasium")
    point = importlib.metadata.EntryPoint("theirs", "their.module:Env", ENTRY_POINT_GROUP)
    vars(point)["dist"] = distribution
    found = importlib.metadata.entry_points
    monkeypatch.setattr(
        importlib.metadata,
        "entry_points",
        lambda **wanted: [point] if wanted == {"group": ENTRY_POINT_GROUP} else found(**wanted),
    )
    assert invoke_json("backends")[-1] == {
        "name": "theirs",
        "installed": True,
        "version": distribution.version,
        "install": "pip install gymnasium",
    }
