"""Gymnasium's and Stable-Baselines3's own tests, run against this library's classes in their place.

    python tests/peers/run.py gymnasium SOURCE
    python tests/peers/run.py sb3 SOURCE

SOURCE is a folder with the peer's sources, `tests` among them, of the version that is installed
(a clone for Gymnasium, whose source package has no tests; `pip download --no-binary :all:` for
Stable-Baselines3). Their tests need further packages, without which some fail: box2d, moviepy,
pandas, pygame-ce and a library of OpenGL, as with `MUJOCO_GL=osmesa`. Further arguments, as
`-k PART`, are pytest's.

The tests of the interface get our class for the one with worker processes, those of the wrappers
for the one without, too. What can't apply is named in `PEERS` with the reason, and left out.
"""

from __future__ import annotations

import argparse
import importlib
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest


@dataclass(frozen=True)
class Part:
    """Some of a peer's test files, and the classes that ours stands in for there."""

    title: str
    files: tuple[str, ...]
    replaced: tuple[str, ...]


@dataclass(frozen=True)
class Peer:
    """A library whose tests are run.

    Attributes:
        home: the module where tests find the classes that are replaced.
        ours: the class in their place, as ``module:name``.
        left_out: parts of tests' names, and why they can't apply.
    """

    home: str
    ours: str
    parts: tuple[Part, ...]
    left_out: dict[str, str]


PEERS = {
    "gymnasium": Peer(
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
            "test_async_vector_subenv_error": "what an env raises comes as EnvRaised, and the env "
            "stays; theirs is the class itself, and warnings in colour",
            "test_custom_space_async_vector_env_shared_memory": "spaces of one's own are no reason "
            "to refuse shared memory; they travel pickled",
            "test_step_timeout_async_vector_env": "it sleeps for an action that is no element of "
            "its space, and Python can't sleep for one that is; ours are cast to its dtype",
            "test_normalize_reward.py::test_equivalence_with_wrapper": "it looks into `envs`, "
            "which AsyncVectorEnv doesn't have either",
            "test_normalize_observation.py::test_normalize_obs_with_vector": "likewise",
        },
    ),
    "sb3": Peer(
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
            "test_vec_normalize.py::test_discrete_obs": "its task, CliffWalking-v0, is no more",
        },
    ),
}  # fmt: skip


@dataclass
class Watch:
    """A plugin of pytest: leaves out what can't apply, and counts the rest."""

    left_out: dict[str, str]
    made: list[int]
    used: set[str] = field(default_factory=set)
    outcomes: dict[str, str] = field(default_factory=dict)

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        out = [item for item in items if any(part in item.nodeid for part in self.left_out)]
        items[:] = [item for item in items if item not in out]
        config.hook.pytest_deselected(items=out)

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
    """Put our class in the place of theirs; the number of its instances is returned in a list."""
    module, _, name = peer.ours.partition(":")
    ours = getattr(importlib.import_module(module), name)
    home, made = importlib.import_module(peer.home), [0]
    make = ours.__init__

    def counted(self: Any, *args: Any, **kwargs: Any) -> None:
        made[0] += 1
        make(self, *args, **kwargs)

    ours.__init__ = counted
    for replaced in names:
        setattr(home, replaced, ours)
    return made


def run(peer: Peer, part: Part, more: list[str]) -> bool:
    """Run a part; whether all that applies has passed."""
    watch = Watch(peer.left_out, replace(peer, part.replaced))
    files = [f"tests/{name}" for name in part.files]
    pytest.main(["-q", "-p", "no:cacheprovider", "--tb=short", *more, *files], plugins=[watch])
    passed, failed = watch.count("passed"), watch.count("failed")
    print(
        f"{part.title}: {passed} passed, {failed} failed, {watch.count('skipped')} skipped; "
        f"{len(watch.used)} of them made our class",
        flush=True,
    )
    return passed > 0 and not failed


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("source", type=Path, metavar="SOURCE")
    given, more = parser.parse_known_args()
    peer = PEERS[given.peer]
    if not (given.source / "tests").is_dir():
        parser.error(f"{given.source} has no folder 'tests'")
    # Away from the sources, or they would be imported in place of what is installed.
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(given.source / "tests", Path(folder, "tests"))
        Path(folder, "pytest.ini").write_text("[pytest]\n")
        os.chdir(folder)
        sys.path.insert(0, folder)
        well = [run(peer, part, more) for part in peer.parts]
    for part, reason in peer.left_out.items():
        print(f"left out: {part}: {reason}")
    return 0 if all(well) else 1


if __name__ == "__main__":
    sys.exit(main())
