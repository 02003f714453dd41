"""Run other projects' own tests against this library, in place of the classes they are about.

    python tests/peers/run.py SOURCES [--only PEER] [arguments of pytest]

SOURCES is a folder that holds one folder with the sources of each project, its `tests` among them:
a clone of Gymnasium's repository, Stable-Baselines3's source package, a clone of RLightning's
repository. The first two must be of the versions that are installed. A project whose sources are
not there is not run, and the summary says so. Further arguments, such as `-k PART`, are pytest's.

Tests of an interface get our class for the one with worker processes; tests of wrappers get it for
the one without workers, too. `PEERS` names the tests that can't apply, with the reason.
RLightning's tests meet the names of `rlightning_aio.legacy`; `rlightning-builder` imports
RLightning's own source instead (which needs its dependencies), and its builder makes our groups.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Part:
    """Some of a peer's test files, and the names in the peer's module that our class replaces."""

    title: str
    files: tuple[str, ...]
    replaced: tuple[str, ...] = ()


@dataclass(frozen=True)
class Adapted:
    """A test that is run without its assertions on a variable, if any, and with a part replaced."""

    file: str
    test: str
    variable: str
    argument: str
    replacement: str

    def rewrite(self, tests: Path) -> None:
        """Rewrite the test in the folder `tests`."""
        file = tests / self.file
        if not file.exists():
            return
        tree = ast.parse(file.read_text())
        (function,) = (node for node in ast.walk(tree) if getattr(node, "name", "") == self.test)
        assert isinstance(function, ast.FunctionDef)
        function.body = [node for node in function.body if not self._is_left_out(node)]
        text = ast.unparse(function)
        assert self.argument in text
        (rewritten,) = ast.parse(text.replace(self.argument, self.replacement)).body
        tree.body[tree.body.index(function)] = rewritten
        file.write_text(ast.unparse(tree))

    def _is_left_out(self, node: ast.stmt) -> bool:
        names = {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
        return isinstance(node, ast.Assert) and self.variable in names


@dataclass(frozen=True)
class Peer:
    """A project whose tests are run.

    Attributes:
        folder: the start of the name of its folder, in lower case with hyphens.
        home: the module where tests find the classes that are replaced.
        ours: the class in their place, as ``module:name``.
        left_out: parts of tests' ids, and why these tests can't apply.
        adapted: tests of which a part can't apply.
        prepare: called with the folder of the sources, before any test is imported.
    """

    folder: str
    home: str
    ours: str
    parts: tuple[Part, ...]
    left_out: dict[str, str]
    adapted: tuple[Adapted, ...] = ()
    prepare: Callable[[Path], None] = lambda _source: None


def use_names_of_legacy(_source: Path) -> None:
    """Let tests import RLightning's names from us, without Ray."""
    ray: Any = ModuleType("ray")
    ray.ObjectRef = type("ObjectRef", (), {})
    ray.init = ray.shutdown = lambda **_: None
    ray.is_initialized = lambda: False
    sys.modules["ray"] = ray
    # Its tests clear this table before each one.
    manager: Any = ModuleType("rlightning.utils.placement.placement_manager")
    manager.GlobalResourceManager = type("GlobalResourceManager", (), {"reset": lambda: None})
    sys.modules[manager.__name__] = manager
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("rlightning_aio.legacy").install()


def use_own_source(source: Path) -> None:
    """Let tests import RLightning's own source, whose builder then makes our groups."""
    if not (source / "rlightning").is_dir():
        raise ModuleNotFoundError("these sources have no folder 'rlightning'")
    sys.path.insert(0, str(source))
    importlib.import_module("rlightning_aio.legacy").install()


NOT_RUN = 3
VERDICTS = {0: "passed", 1: "failed", NOT_RUN: "not run, for the reason above"}
OF_RLIGHTNING = (
    "integration/env/test_env_group.py", "integration/env/test_basic_mujoco.py",
    "integration/env/test_basic_ale.py", "unit/test_env_group_stats.py", "unit/test_config.py",
    "unit/test_registry.py",
)  # fmt: skip
OF_RAY = "it expects Ray's references, and results here are values"

PEERS = {
    "gymnasium": Peer(
        "gymnasium",
        "gymnasium.vector",
        "rlightning_aio.vector:VectorEnv",
        (
            Part(
                "the interface",
                (
                    "vector/test_async_vector_env.py", "vector/test_autoreset_mode.py",
                    "vector/test_observation_mode.py", "vector/test_vector_env.py",
                    "vector/test_vector_env_info.py", "vector/test_vector_wrapper.py",
                    "envs/registration/test_make_vec.py",
                ),
                ("AsyncVectorEnv",),
            ),
            Part(
                "its wrappers",
                ("wrappers/vector", "wrappers/test_normalize_observation.py"),
                ("AsyncVectorEnv", "SyncVectorEnv"),
            ),
        ),
        {
            "test_custom_space_async_vector_env_shared_memory": "spaces of one's own are no reason "
            "to refuse shared memory; they travel pickled",
            "test_step_timeout_async_vector_env": "it sleeps for an action that is no element of "
            "its space, and Python can't sleep for one that is; ours are cast to its dtype",
        },
        (
            # Theirs warns that a worker is shut down; ours stays. Ours checks the shape of actions.
            Adapted(
                "vector/test_async_vector_env.py", "test_async_vector_subenv_error",
                "caught_warnings", "step([0, 1, 2])", "step([[0], [1], [2]])",
            ),
            # A SyncVectorEnv has its envs at hand; ours are in workers.
            Adapted(
                "wrappers/vector/test_normalize_reward.py", "test_equivalence_with_wrapper",
                "", "per_env.envs[0].return_rms", "per_env.get_attr('return_rms')[0]",
            ),
        ),
    ),
    "sb3": Peer(
        "stable-baselines3",
        "stable_baselines3.common.vec_env",
        "rlightning_aio.sb3:VecEnv",
        (
            Part("the interface", ("test_vec_envs.py",), ("SubprocVecEnv",)),
            Part(
                "its wrappers",
                (
                    "test_vec_check_nan.py", "test_vec_extract_dict_obs.py",
                    "test_vec_monitor.py", "test_vec_normalize.py", "test_vec_stacked_obs.py",
                ),
                ("SubprocVecEnv", "DummyVecEnv"),
            ),
        ),
        {
            "test_subproc_start_method": "workers have no start method",
            "test_check_nan": "it sends more actions than there are envs, which are refused here",
            "test_get_original": "DummyVecEnv's rewards are float32; SubprocVecEnv's and ours "
            "are float64",
            "test_vec_normalize.py::test_discrete_obs": "Gymnasium no longer has CliffWalking-v0",
        },
    ),
    "rlightning": Peer(
        "rlightning",
        "rlightning",
        "rlightning_aio.plugins.legacy.group:EnvGroup",
        (Part("names of ours", tuple(set(OF_RLIGHTNING) - {"unit/test_config.py"})),),
        {
            "test_feed_into_env_client[True": OF_RAY,
            "test_feed_into_env_group[True": OF_RAY,
        },
        prepare=use_names_of_legacy,
    ),
    "rlightning-builder": Peer(
        "rlightning",
        "rlightning",
        "rlightning_aio.plugins.legacy.group:EnvGroup",
        (
            Part(
                "its own builder",
                (*OF_RLIGHTNING, "integration/env/test_env_group_performance.py"),
            ),
        ),
        {
            "test_feed_into_env_client[True": OF_RAY,
            "test_feed_into_env_group[True": OF_RAY,
        },
        prepare=use_own_source,
    ),
}  # fmt: skip


@dataclass(eq=False)  # pytest keeps its plugins in sets.
class Watch:
    """A plugin of pytest that leaves out what can't apply and counts the rest."""

    left_out: dict[str, str]
    made: list[int]
    used: set[str] = field(default_factory=set)
    outcomes: dict[str, str] = field(default_factory=dict)

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        out = [item for item in items if any(part in item.nodeid for part in self.left_out)]
        items[:] = [item for item in items if item not in out]
        config.hook.pytest_deselected(items=out)

    def pytest_collectreport(self, report: Any) -> None:
        if report.outcome != "passed":
            self.outcomes[report.nodeid] = report.outcome

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.when == "call" or report.outcome != "passed":
            self.outcomes[report.nodeid] = report.outcome

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: Any) -> Any:
        before = self.made[0]
        try:
            return (yield)
        finally:
            if self.made[0] > before:
                self.used.add(item.nodeid)

    def count(self, outcome: str) -> int:
        return sum(found == outcome for found in self.outcomes.values())


def replace(peer: Peer, names: tuple[str, ...]) -> list[int]:
    """Put our class in the place of theirs. Return a list whose one item counts its instances."""
    module, _, name = peer.ours.partition(":")
    ours = getattr(importlib.import_module(module), name)
    made = [0]
    make = ours.__init__

    def counted(self: Any, *args: Any, **kwargs: Any) -> None:
        made[0] += 1
        make(self, *args, **kwargs)

    ours.__init__ = counted
    for replaced in names:
        setattr(importlib.import_module(peer.home), replaced, ours)
    return made


def run_part(peer: Peer, part: Part, more: list[str]) -> bool:
    """Run a part, print its counts, and return True if all that applies has passed."""
    files = [f"tests/{name}" for name in part.files]
    present = [name for name in files if Path(name).exists()]
    for name in files:
        if name not in present:
            print(f"{part.title}: {name} is missing from these sources")
    if not present:
        return False
    watch = Watch(peer.left_out, replace(peer, part.replaced))
    options = ["-q", "-p", "no:cacheprovider", "--tb=short", "--continue-on-collection-errors"]
    pytest.main([*options, *more, *present], plugins=[watch])
    passed, failed = watch.count("passed"), watch.count("failed")
    print(
        f"{part.title}: {passed} passed, {failed} failed, {watch.count('skipped')} skipped; "
        f"{len(watch.used)} of them made our class",
        flush=True,
    )
    return passed > 0 and not failed


def run_peer(peer: Peer, source: Path, more: list[str]) -> int:
    """Run all parts of a peer in this process, and return its exit code."""
    if "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        peer.prepare(source)
    except ModuleNotFoundError as missing:
        print(f"{source} can't be imported here: {missing}")
        return NOT_RUN
    # Away from the sources, or they would be imported in place of what is installed.
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(source / "tests", Path(folder, "tests"))
        if (source / "examples").is_dir():  # RLightning's tests read configs there.
            Path(folder, "examples").symlink_to(source / "examples")
        Path(folder, "pytest.ini").write_text("[pytest]\n")
        for adapted in peer.adapted:
            adapted.rewrite(Path(folder, "tests"))
        os.chdir(folder)
        sys.path.insert(0, folder)
        well = [run_part(peer, part, more) for part in peer.parts]
        os.chdir(source)
    for part, reason in peer.left_out.items():
        print(f"left out: {part}: {reason}")
    return 0 if all(well) else 1


def source_of(peer: Peer, sources: Path) -> Path | None:
    """Return the folder in `sources` that holds the peer's tests, or None."""
    for folder in sorted(sources.iterdir()):
        name = folder.name.lower().replace("_", "-")
        if re.fullmatch(rf"{peer.folder}(-v?[0-9].*)?", name) and (folder / "tests").is_dir():
            return folder
    return None


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sources", type=Path, metavar="SOURCES")
    parser.add_argument("--only", choices=PEERS, help="run one project's tests")
    given, more = parser.parse_known_args()
    if not given.sources.is_dir():
        parser.error(f"there is no folder {given.sources}")
    if given.only is not None:
        peer = PEERS[given.only]
        source = source_of(peer, given.sources.resolve())
        if source is None:
            print(f"no folder of {given.sources} is named {peer.folder} and has a folder 'tests'")
            return NOT_RUN
        return run_peer(peer, source, more)
    # Each peer gets a process of its own: what one replaces, the next would import.
    codes = {
        name: subprocess.run(
            [sys.executable, __file__, str(given.sources), "--only", name, *more], check=False
        ).returncode
        for name in PEERS
    }
    for name, code in codes.items():
        print(f"{name}: {VERDICTS.get(code, 'failed')}")
    ran = [code for code in codes.values() if code != NOT_RUN]
    return 1 if any(ran) or not ran else 0


if __name__ == "__main__":
    sys.exit(main())
