"""Files that options name: refused before anything starts where they can't be written."""

from __future__ import annotations

import os
import resource
from typing import TYPE_CHECKING, Any

import pytest
from cli.command import invoke, run, write_config

if TYPE_CHECKING:
    from pathlib import Path

STUB = {"name": "stub", "backend": "stub", "task": "-", "placement": "inline"}
OPTIONS = [
    *(("rollout", "--trace"), ("rollout", "--plot")),
    *(("eval", "--trace"), ("eval", "--plot"), ("eval", "--resume")),
    *(("bench", "--trace"), ("bench", "--plot"), ("bench", "--best")),
]


def refused(*words: Any) -> str:
    """The one line that a command says; it has started nothing."""
    done = invoke(*words)
    assert done.exit_code == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    return str(line)


def asked(command: str, option: str, folder: Path) -> tuple[Any, Path]:
    """The command's words, and the file that it would write."""
    config = write_config(folder, STUB)
    path = folder / "file.png"
    return (command, config, option, path), path


@pytest.mark.parametrize(("command", "option"), OPTIONS)
def test_a_fifo_is_refused_and_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, option: str
) -> None:
    monkeypatch.chdir(tmp_path)
    words, path = asked(command, option, tmp_path)
    os.mkfifo(path)
    line = refused(*words)
    assert path.name in line
    assert "it is no regular file" in line
    assert path.is_fifo()


@pytest.mark.parametrize(("command", "option"), OPTIONS)
def test_a_full_disk_is_known_before_anything_starts(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch, command: str, option: str
) -> None:
    monkeypatch.chdir(small_disk)
    words, path = asked(command, option, small_disk)
    free = os.statvfs(small_disk)
    (small_disk / "rest").write_bytes(bytes(free.f_bavail * free.f_bsize))
    assert "No space left on device" in refused(*words)
    assert not path.is_file()


def test_a_disk_that_fills_up_meanwhile_costs_the_file_alone(tmp_path: Path) -> None:
    """The figures are printed all the same; the file is as it was before."""
    config, path = write_config(tmp_path, STUB), tmp_path / "run.json"
    path.write_text("before")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, before[1]))
    try:
        done = invoke("rollout", config, "--steps", 600, "--trace", path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert done.exit_code == 2
    assert (
        done.stderr.splitlines()[-1] == f"error: --trace {path}: can't be written: File too large"
    )
    assert "600 steps" in done.stdout
    assert path.read_text() == "before"


def test_links_are_followed(tmp_path: Path) -> None:
    """Of files that are there, and of others that are not."""
    config = write_config(tmp_path, STUB)
    plot, trace = tmp_path / "plot.svg", tmp_path / "run.json"
    (tmp_path / "there").mkdir()
    for link in (plot, trace):
        link.symlink_to(tmp_path / "there" / link.name)
    (tmp_path / "there" / "run.json").write_text("before")
    done = run("rollout", config, "--steps", 20, "--plot", plot, "--trace", trace)
    assert done.returncode == 0, done.stderr
    assert plot.is_symlink()
    assert trace.is_symlink()
    assert "</svg>" in plot.read_text()
    assert trace.read_text().startswith('{"otherData"')
    assert {path.name for path in (tmp_path / "there").iterdir()} == {"plot.svg", "run.json"}
