"""Runs RLightning's own tests of env groups on this runtime.

    python tests/peers/run_rlightning.py FOLDER [--with-source] [arguments of pytest …]

FOLDER is a checkout of RLightning with its ``tests``. Without its source these meet the names of
`rlightning_aio.legacy`; ``--with-source`` puts the source on the path of Python (it needs what it
depends on), and its own builder makes our groups. Ray is left out: what asks for its actors or
references is not run. Needs torch and hydra-core, and ale-py for the Atari games.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import warnings
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from rlightning_aio.legacy import install

FILES = (
    "integration/env/test_env_group.py",
    "integration/env/test_basic_mujoco.py",
    "integration/env/test_basic_ale.py",
    "unit/test_env_group_stats.py",
    "unit/test_config.py",
    "unit/test_registry.py",
)
WITH_SOURCE = ("integration/env/test_env_group_performance.py",)


class WithoutRay:
    """Leaves out what is about Ray, and its clusters out of the rest."""

    def __init__(self, *, with_source: bool) -> None:
        self._with_source = with_source

    def pytest_configure(self, config: pytest.Config) -> None:
        for mark in ("integration", "slow"):
            config.addinivalue_line("markers", f"{mark}: RLightning's own")

    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        import tests.test_utils as utils  # pyright: ignore[reportMissingImports]

        utils.setup_ray_cluster = lambda **_: None
        utils.teardown_ray_cluster = lambda: None
        left_out = [item for item in items if self._is_about_ray(item)]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]

    def _is_about_ray(self, item: Any) -> bool:
        # The ones hold results against `ray.ObjectRef`; the other is about placement on its nodes.
        params = getattr(getattr(item, "callspec", None), "params", {})
        return params.get("env_as_remote", False) or (
            "validate_config_for_placement" in item.name and not self._with_source
        )


def main() -> int:
    folder, *rest = sys.argv[1:]
    source = Path(folder).resolve()
    with_source = "--with-source" in rest
    arguments = [argument for argument in rest if argument != "--with-source"]
    with tempfile.TemporaryDirectory() as scratch:
        root = source
        if with_source:
            sys.path.insert(0, str(source))
        else:
            # Beside the source they would find it.
            root = Path(scratch)
            shutil.copytree(source / "tests", root / "tests")
            sys.path.insert(0, str(root))
        if find_spec("ray") is None:
            ray: Any = ModuleType("ray")
            ray.ObjectRef = type("ObjectRef", (), {})
            sys.modules["ray"] = ray
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            install()
        os.chdir(root)
        files = [f"tests/{name}" for name in (*FILES, *(WITH_SOURCE if with_source else ()))]
        there = [name for name in files if Path(name).is_file()]
        options = ["-c", os.devnull, "--rootdir", str(root), "-p", "no:cacheprovider", "-q"]
        plugin = WithoutRay(with_source=with_source)
        return int(pytest.main([*options, *there, *arguments], plugins=[plugin]))


if __name__ == "__main__":
    sys.exit(main())
