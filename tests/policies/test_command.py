"""``rlightning-aio eval`` with a policy server, and with chunks of actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from cli.command import invoke, invoke_json, write_config
from policies.counting import chunk_of
from policies.servers import OpenPiServer, serving

from rlightning_aio.policies import ActionChunks

if TYPE_CHECKING:
    from pathlib import Path

ENTRY = {
    "name": "env", "task": "policies.counting:Counting", "placement": "inline", "num_workers": 2,
}  # fmt: skip


def _chunks(batch: Any) -> Any:
    return np.stack([chunk_of(observation) for observation in batch.observation])


three_of_each = ActionChunks(_chunks, 3)
"""A policy that the command names."""


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


def test_a_policy_of_a_module_may_return_chunks(tmp_path: Path) -> None:
    """If it plays them by itself."""
    config, file = write_config(tmp_path, ENTRY), tmp_path / "results.jsonl"
    words = ("eval", config, "--policy", "policies.test_command:three_of_each", "--resume", file)
    check(invoke_json(*words, "--seeds", "0:4"))


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


def test_an_error_of_the_server_is_shown_in_words(tmp_path: Path) -> None:
    """The command ends with it, without a traceback of its own."""

    class Server(OpenPiServer):
        def answer(self, connection: Any, observation: dict[str, Any]) -> None:
            connection.send("KeyError: 'observation/image'")

    config = write_config(tmp_path, ENTRY)
    with serving(Server()) as url:
        done = invoke("eval", config, "--policy", url.replace("ws", "openpi", 1), "--seeds", "0:4")
    assert done.exit_code == 1
    assert "reports an error:\nKeyError: 'observation/image'" in done.stderr
    assert "Traceback" not in done.stderr
