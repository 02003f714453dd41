"""``rlightning-aio eval`` with a policy server, and with chunks of actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from cli.command import invoke, invoke_json, write_config
from policies.servers import OpenPiServer, serving

if TYPE_CHECKING:
    from pathlib import Path

ENTRY = {
    "name": "env", "task": "policies.counting:Counting", "placement": "inline", "num_workers": 2,
}  # fmt: skip


def check(document: Any) -> None:
    assert [row["seed"] for row in sorted(document["attempts"], key=lambda row: row["seed"])] == [
        *range(4)
    ]
    assert all(row["reward"] == row["length"] == row["seed"] + 4 for row in document["attempts"])


def test_all_actions_of_openpi_s_chunks_are_played_by_default(tmp_path: Path) -> None:
    """Its server always returns chunks."""
    config = write_config(tmp_path, {**ENTRY, "env_kwargs": {"period": 5}})
    with serving(OpenPiServer()) as url:
        policy = url.replace("ws", "openpi", 1)
        check(invoke_json("eval", config, "--policy", policy, "--seeds", "0:4"))


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--policy", "http://localhost:1"], 2, "should begin with openpi://"),
        (["--policy", "openpi://localhost:x"], 2, "should look like ws://localhost:8000"),
        (["--policy", "openpi://"], 2, "should look like ws://localhost:8000"),
    ],
)
def test_what_is_no_policy_server_is_refused(
    words: list[Any], code: int, message: str, tmp_path: Path
) -> None:
    """Before anything starts."""
    done = invoke("eval", write_config(tmp_path, ENTRY), *words, "--seeds", "0:4")
    assert done.exit_code == code
    assert message in done.stderr
