"""Backends: how a name becomes an env class, and what is imported on the way."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from typing import TYPE_CHECKING

import pytest

from rlightning_aio import registry
from rlightning_aio.envs.base import BaseEnv
from rlightning_aio.envs.gymnasium import GymnasiumEnv, MujocoEnv
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import BACKENDS, ENTRY_POINT_GROUP, Backend, Registry

if TYPE_CHECKING:
    from collections.abc import Callable

    Announce = Callable[[str, str], None]


class OwnEnv(GymnasiumEnv):
    """Stands for a user's class."""


@pytest.fixture
def announce(monkeypatch: pytest.MonkeyPatch) -> Announce:
    """Has an installed package announce a backend."""
    announced: list[EntryPoint] = []

    def entry_points(*, group: str, **wanted: str) -> EntryPoints:
        return EntryPoints(announced).select(group=group, **wanted)

    def announce(name: str, target: str) -> None:
        announced.append(EntryPoint(name, target, ENTRY_POINT_GROUP))

    monkeypatch.setattr(registry.importlib.metadata, "entry_points", entry_points)
    return announce


def test_a_registered_class_answers_to_its_name() -> None:
    """The decorator hands the class back unchanged and makes it known."""
    envs = Registry()
    assert envs.register("own")(OwnEnv) is OwnEnv
    assert envs.resolve("own") is envs.registered("own") is OwnEnv
    assert envs.knows("own")


def test_a_later_registration_wins() -> None:
    """A notebook cell that is run twice, or a reloaded module, is no error."""

    class Again(OwnEnv):
        pass

    envs = Registry()
    envs.register("own")(OwnEnv)
    envs.register("own")(Again)
    assert envs.resolve("own") is Again


def test_a_registration_says_whether_envs_may_share_a_worker() -> None:
    """What it leaves open is as the built-in backend of that name; the last one counts."""
    envs = Registry()
    assert (envs.is_cpu_bound("mujoco"), envs.is_cpu_bound("piper")) == (True, False)
    assert envs.is_cpu_bound("own") is False
    envs.register("own", cpu_bound=True)(OwnEnv)
    envs.register("mujoco")(OwnEnv)
    assert envs.is_cpu_bound("own") is envs.is_cpu_bound("mujoco") is True
    envs.register("own")(OwnEnv)
    envs.register("mujoco", cpu_bound=False)(OwnEnv)
    assert envs.is_cpu_bound("own") is envs.is_cpu_bound("mujoco") is False


def test_the_decorator_wants_a_name() -> None:
    """Used bare, it would silently replace the class with a function."""
    with pytest.raises(TypeError, match=r"@ENVS\.register\('my_backend'\)"):
        Registry().register(OwnEnv)  # type: ignore[arg-type]


def test_built_in_backends_are_there_without_registration() -> None:
    """Their classes are imported when they are asked for."""
    envs = Registry()
    assert envs.registered("mujoco") is None
    assert envs.resolve("mujoco") is MujocoEnv
    assert envs.resolve("gymnasium") is GymnasiumEnv


def test_a_registered_class_goes_before_a_built_in_one() -> None:
    """A user may replace a backend by their own."""
    envs = Registry()
    envs.register("mujoco")(OwnEnv)
    assert envs.resolve("mujoco") is OwnEnv


def test_installed_packages_announce_backends(announce: Announce) -> None:
    """An entry point of the group is enough; nothing needs to be imported by hand."""
    announce("theirs", f"{__name__}:OwnEnv")
    envs = Registry()
    assert envs.knows("theirs")
    assert issubclass(envs.resolve("theirs"), BaseEnv)


def test_an_announced_backend_can_t_shadow_a_built_in_one(announce: Announce) -> None:
    """Installing a package must not change what an existing config means."""
    announce("mujoco", f"{__name__}:OwnEnv")
    assert Registry().resolve("mujoco") is MujocoEnv


def test_naming_backends_imports_none_of_them(announce: Announce) -> None:
    """A broken package is no trouble until somebody wants its env."""
    announce("broken", "no_such_module:Env")
    assert Registry().knows("broken")
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        Registry().resolve("broken")
    code = (
        "import sys, rlightning_aio.registry as r; r.ENVS.names();"
        "[b.installed_version() for b in r.BACKENDS.values()];"
        "sys.exit(bool({'gymnasium', 'mujoco', 'rlightning_aio.envs'} & sys.modules.keys()))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_unknown_backend_is_met_with_the_nearest_name() -> None:
    """The message lists what there is."""
    envs = Registry()
    envs.register("own")(OwnEnv)
    with pytest.raises(ConfigError, match=r"unknown backend 'mujco'; did you mean 'mujoco'\?"):
        envs.resolve("mujco")
    with pytest.raises(ConfigError, match=r"known: .*gymnasium.*mujoco.*own"):
        envs.resolve("zzzzz")


@pytest.mark.parametrize("backend", BACKENDS.values(), ids=lambda backend: backend.name)
def test_every_built_in_backend_can_be_pointed_to(backend: Backend) -> None:
    """Its row names a class of this package, and the extra that brings its simulator."""
    module, _, name = backend.target.partition(":")
    assert module.startswith("rlightning_aio.")
    assert name.isidentifier()
    assert backend.install_command.startswith("pip install ")


def test_core_simulators_are_installed_and_a_missing_one_is_none() -> None:
    """The version shown is the distribution's, and looking never raises."""
    import mujoco

    assert BACKENDS["mujoco"].installed_version() == mujoco.__version__
    absent = Backend("absent", "nowhere:Env", "no_such_simulator", "no-such-simulator")
    assert absent.installed_version() is None
