"""How a backend's name is resolved to an env class, and which modules that imports."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints
from typing import TYPE_CHECKING
from unittest import mock

import pytest

from rlightning_aio import registry
from rlightning_aio.config import parse_configs
from rlightning_aio.config.checks import check_installed
from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv, MujocoEnv
from rlightning_aio.registry import BACKENDS, Backend, Registry

if TYPE_CHECKING:
    from collections.abc import Callable

    Announce = Callable[..., None]


class OwnEnv(GymnasiumEnv):
    """A user's class."""


ROW = Backend("arm", f"{__name__}:OwnEnv", "no_such_sdk", hardware=True)


@pytest.fixture
def announce(monkeypatch: pytest.MonkeyPatch) -> Announce:
    """Return a function that adds an entry point, as an installed package does."""
    announced: list[EntryPoint] = []

    def entry_points(*, group: str, **wanted: str) -> EntryPoints:
        return EntryPoints(announced).select(group=group, **wanted)

    def announce(name: str, target: str) -> None:
        announced.append(EntryPoint(name, target, "rlightning_aio.backends"))

    monkeypatch.setattr("importlib.metadata.entry_points", entry_points)
    monkeypatch.setattr(registry, "_plugged_in", cache(registry._plugged_in.__wrapped__))
    return announce


def test_a_registered_class_replaces_what_had_its_name() -> None:
    """Such as a built-in backend, or itself, as a notebook cell is run twice; it is unchanged."""

    class Again(OwnEnv):
        pass

    envs = Registry()
    assert envs.registered("mujoco") is None
    assert envs.resolve("mujoco") is MujocoEnv
    for kind in (OwnEnv, Again):
        for name in ("own", "mujoco"):
            assert envs.register(name)(kind) is kind
            assert envs.resolve(name) is envs.registered(name) is kind
            assert envs.knows(name)


def test_a_registration_may_declare_an_env_cpu_bound() -> None:
    """Its default is that of the built-in backend of the same name."""
    envs = Registry()
    assert (envs.is_cpu_bound("mujoco"), envs.is_cpu_bound("piper")) == (True, False)
    assert envs.is_cpu_bound("own") is False
    envs.register("own", cpu_bound=True)(OwnEnv)
    envs.register("mujoco")(OwnEnv)
    assert envs.is_cpu_bound("own") is envs.is_cpu_bound("mujoco") is True
    envs.register("own")(OwnEnv)
    envs.register("mujoco", cpu_bound=False)(OwnEnv)
    assert envs.is_cpu_bound("own") is envs.is_cpu_bound("mujoco") is False


def test_the_decorator_requires_a_name() -> None:
    """Used bare, it would silently replace the class with a function."""
    with pytest.raises(TypeError, match=r"@ENVS\.register\('my_backend'\)"):
        Registry().register(OwnEnv)  # type: ignore[arg-type]


def test_an_entry_point_never_replaces_a_built_in_backend(announce: Announce) -> None:
    """Installing a package must not change the meaning of a config."""
    announce("mujoco", f"{__name__}:ROW")
    assert Registry().resolve("mujoco") is MujocoEnv


def test_an_entry_point_describes_a_backend(announce: Announce) -> None:
    """The trainer knows that it is hardware before its class is imported."""
    announce("arm", f"{__name__}:ROW")
    envs = Registry()
    assert envs.described("arm") is not None
    assert envs.is_hardware("arm")
    assert not envs.is_cpu_bound("arm")
    assert envs.names() == sorted({*BACKENDS, "arm"})
    assert issubclass(envs.resolve("arm"), BaseEnv)


def test_naming_a_backend_imports_nothing(announce: Announce) -> None:
    """A broken package raises an error only when its env is resolved."""
    announce("broken", "no_such_module:ROW")
    assert Registry().knows("broken")
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        Registry().resolve("broken")
    code = (
        "import sys, rlightning_aio.registry as r; r.ENVS.names(); r.ENVS.described('piper');"
        "[b.installed_version() for b in r.BACKENDS.values()];"
        "heavy = {'gymnasium', 'mujoco', 'piper_sdk', 'rlightning_aio.envs'};"
        "sys.exit(bool(heavy & sys.modules.keys()))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("backend", BACKENDS.values(), ids=lambda backend: backend.name)
def test_each_built_in_backend_has_a_class_and_an_install_command(backend: Backend) -> None:
    """The class belongs to this package."""
    module, _, name = backend.target.partition(":")
    assert module.startswith("rlightning_aio.")
    assert name.isidentifier()
    assert backend.install.startswith("pip install ")


def test_an_entry_with_a_server_reads_no_lists_of_installed_files(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """That would take up to half a second for each group."""
    listed = mock.Mock()
    monkeypatch.setattr(importlib.metadata, "packages_distributions", listed)
    check_installed(parse_configs({"name": "e", "backend": "env_server"}))
    listed.assert_not_called()


def test_the_version_of_a_missing_simulator_is_none() -> None:
    """The version of an installed one is that of its distribution."""
    import mujoco

    assert BACKENDS["mujoco"].installed_version() == mujoco.__version__
    absent = Backend("absent", "nowhere:Env", "no_such_simulator")
    assert absent.installed_version() is None
