"""The page about simulators, followed in the environments where they are installed."""

from __future__ import annotations

import shlex
import shutil
from typing import TYPE_CHECKING

import pytest
from cli.command import TESTS, run
from run_python import blocks, output_of

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.simulators

PAGE = (TESTS.parent / "docs" / "simulators.md").read_text()
EXAMPLES = TESTS.parent / "examples"


def blocks_of(language: str, section: str) -> list[str]:
    return blocks(language, PAGE.partition(f"\n## {section}\n")[2].partition("\n## ")[0])


def test_pusht_and_aloha_run(tmp_path: Path) -> None:
    """The program runs unchanged."""
    pytest.importorskip("gym_pusht")
    pytest.importorskip("gym_aloha")
    (tmp_path / "program.py").write_text(*blocks_of("python", "PushT and ALOHA"))
    output_of(tmp_path / "program.py", folder=tmp_path, asyncio_debug=False)


def test_envpool_runs(tmp_path: Path) -> None:
    """The example runs unchanged."""
    pytest.importorskip("envpool")
    output_of(EXAMPLES / "envpool_env.py", folder=tmp_path, asyncio_debug=False)


def test_metaworld_ends_in_a_table_of_success(tmp_path: Path) -> None:
    """With the example's env and the page's command, on fewer seeds, and without the plot."""
    pytest.importorskip("metaworld")
    shutil.copy(EXAMPLES / "metaworld_env.py", tmp_path)
    (tmp_path / "arm.yaml").write_text(*blocks_of("yaml", "MetaWorld"))
    (command,) = blocks_of("console", "MetaWorld")
    line = command.replace("\\\n", "").strip().replace(" --plot success.png", "")
    words = shlex.split(line.removeprefix("$ rlightning-aio "))
    done = run(*words, "--seeds", "0:2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = {words[0]: words[1:3] for words in map(str.split, done.stdout.splitlines()) if words}
    for task in ("reach-v3", "push-v3", "door-open-v3"):
        assert table[task] == ["2", "1.00"]
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 1 + 6


def test_a_seed_of_metaworld_decides_an_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the env has played before."""
    pytest.importorskip("metaworld")
    monkeypatch.syspath_prepend(EXAMPLES)
    from metaworld_env import MetaWorld  # type: ignore[import-not-found]

    one, other = MetaWorld(), MetaWorld()
    other.reset(seed=9, options={"task": "push-v3"})
    first = [env.reset(seed=4, options={"task": "reach-v3"})[0] for env in (one, other)]
    then = [env.step(env.action_space.low)[0] for env in (one, other)]
    assert (first[0] == first[1]).all()
    assert (then[0] == then[1]).all()
    assert (one.reset(seed=5)[0] != first[0]).any()
    one.close()
    other.close()
