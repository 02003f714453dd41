"""``rlightning-aio backends`` lists backends and how to install them."""

from __future__ import annotations

import importlib.metadata
from dataclasses import replace
from typing import TYPE_CHECKING
from unittest import mock

import gymnasium
from cli.command import invoke, invoke_json, run

from rlightning_aio.registry import BACKENDS, ENVS, Backend

if TYPE_CHECKING:
    import pytest

PLUGINS = [ENVS.described("openenv"), ENVS.described("piper")]
ROWS = [*BACKENDS.values(), *(row for row in PLUGINS if row is not None)]


def test_each_backend_has_a_line() -> None:
    """The line has its name, package, version and install command in full."""
    lines = run("backends").stdout.splitlines()
    for backend in ROWS:
        (line,) = [line for line in lines if line.split()[:1] == [backend.name]]
        assert line.rstrip().endswith(backend.install)
        version = backend.installed_version() or "not installed"
        assert f" {backend.module} {version} " in line


def test_json_has_one_object_for_each_backend() -> None:
    """Built-in ones come first, then plug-ins."""
    rows = invoke_json("backends")
    assert [row["name"] for row in rows[: len(ROWS)]] == [backend.name for backend in ROWS]
    (row,) = [row for row in rows if row["name"] == "gymnasium"]
    assert row["installed"] is True
    assert row["version"] == gymnasium.__version__
    assert row["install"] == BACKENDS["gymnasium"].install


def test_a_missing_simulator_is_listed_as_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has no version, and is no error."""
    monkeypatch.setattr(Backend, "is_installed", lambda self: False)
    assert {row["installed"] for row in invoke_json("backends")[: len(ROWS)]} == {False}
    assert invoke("backends").stdout.count("not installed") == len(ROWS)


def test_backends_of_other_packages_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their lines have the package that they need, and its version."""
    point = mock.Mock(load=lambda: replace(BACKENDS["gymnasium"], name="theirs"))
    point.name = "theirs"
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda *, group: [point])
    assert invoke_json("backends")[-1] == {
        "name": "theirs",
        "installed": True,
        "package": "gymnasium",
        "version": gymnasium.__version__,
        "install": "pip install rlightning-aio",
    }
