"""``serve`` and what ``check`` says of a server."""

from __future__ import annotations

import json
import socket
from typing import TYPE_CHECKING

import pytest
from cli.command import CARTPOLE, invoke, start, write_config
from cli.test_interrupt import interrupt

from rlightning_aio.plugins.openenv.session import get_json

if TYPE_CHECKING:
    from pathlib import Path

ROBOTS = {"name": "robots", "backend": "env_server"}


def test_serve_runs_until_ctrl_c(tmp_path: Path) -> None:
    """It prints its address, and `check` shows what it offers there."""
    config = write_config(tmp_path, {**CARTPOLE, "num_workers": 2, "placement": "inline"})
    with start("serve", config, "--port", 0) as child:
        assert child.stdout is not None
        line = child.stdout.readline()
        assert line.startswith("pole: 2 sessions at http://127.0.0.1:")
        url = line.split()[-1]
        assert get_json(url, "/health") == {"status": "healthy"}
        far = write_config(tmp_path, {"name": "far", "backend": "openenv", "task": url})
        (found,) = json.loads(invoke("check", far, "--json").stdout)["entries"]
        assert found["offers"]["metadata"]["name"] == "pole"
        assert "action" in found["offers"]["schema"]
        interrupt(child)


def test_a_port_in_use_is_one_line(tmp_path: Path) -> None:
    config = write_config(tmp_path, {**CARTPOLE, "placement": "inline"})
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = invoke("serve", config, "--port", taken.getsockname()[1])
    assert done.exit_code == 2
    assert done.stderr.startswith("error: can't listen at 127.0.0.1:")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("entries", [[ROBOTS], [CARTPOLE, {**CARTPOLE, "name": "other"}]], ids=len)
def test_what_can_not_be_served_is_refused(tmp_path: Path, entries: list[dict[str, str]]) -> None:
    done = invoke("serve", write_config(tmp_path, *entries))
    assert done.exit_code == 2
    assert "a server has the envs of one entry" in done.stderr


def test_a_server_that_is_not_there_is_named(tmp_path: Path) -> None:
    url = "http://127.0.0.1:1"
    done = invoke(
        "check", write_config(tmp_path, {"name": "far", "backend": "openenv", "task": url})
    )
    assert done.exit_code == 2
    assert url in done.stderr
