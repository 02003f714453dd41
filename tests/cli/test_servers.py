"""``rollout`` with clients, whose envs are known only once they have connected."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from cli.command import CARTPOLE, start, write_config
from kit.counting import ClientThread, served
from patience import HANG

if TYPE_CHECKING:
    import subprocess
    from pathlib import Path

SERVER = served(min_clients=2)


def address(child: subprocess.Popen[str]) -> str:
    """Return the address that the command prints."""
    assert child.stderr is not None
    while not (line := child.stderr.readline()).startswith("robots-0 listens at "):
        assert line, "the command has ended"
    return line.split()[-1]


def finish(child: subprocess.Popen[str]) -> Any:
    stdout, stderr = child.communicate(timeout=HANG)
    assert child.returncode == 0, stderr
    return json.loads(stdout)


def test_rollout_collects_from_clients_and_local_envs_together(tmp_path: Path) -> None:
    """Each gets actions of its own space."""
    local = {**CARTPOLE, "num_workers": 2}
    config = write_config(tmp_path, local, SERVER)
    with start("rollout", config, "--steps", 400, "--min-results", 4, "--json") as child:
        where = address(child)
        clients = [ClientThread(where, name) for name in ("left", "right")]
        document = finish(child)
        for client in clients:
            client.join()
    steps = [document["metrics"][f"envs/{name}/steps"] for name in ("pole", "robots")]
    assert sum(steps) == 400
    assert min(steps) > 0
