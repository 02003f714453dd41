"""``client`` and ``keygen``: an env lent to a server, from two terminals."""

from __future__ import annotations

import json
import re
import shlex
import signal
import stat
import subprocess
from typing import TYPE_CHECKING

import pytest
from cli.command import COMMAND, TESTS, invoke, invoke_json, start, write_config
from patience import HANG

from rlightning_aio.remote.keys import read_client_keys, read_server_keys

if TYPE_CHECKING:
    from pathlib import Path

ROOT = TESTS.parent
SERVER = {"name": "robots", "backend": "env_server"}
NOBODY = "tcp://127.0.0.1:9"


def finishing(folder: Path, wanted_steps: int) -> str:
    """A config whose env is finished after so many steps, and touches folder/closed."""
    kwargs = {"wanted_steps": wanted_steps, "closed_file": str(folder / "closed")}
    entry = {"name": "arm", "backend": "finishing", "task": "any", "env_kwargs": kwargs}
    return write_config(folder, entry)


def server_config(folder: Path, **env_kwargs: object) -> str:
    (folder / "server").mkdir()
    return write_config(folder / "server", {**SERVER, "env_kwargs": env_kwargs})


def line_with(child: subprocess.Popen[str], words: str) -> str:
    """The next line on stderr that has `words`."""
    assert child.stderr is not None
    while words not in (line := child.stderr.readline()):
        assert line, "the command has ended"
    return line


def spawn(command: str) -> subprocess.Popen[str]:
    """A line of the README, in the repository's root."""
    words = [*COMMAND, *shlex.split(command)[1:]]
    pipe = subprocess.PIPE
    return subprocess.Popen(words, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def test_the_two_terminals_of_the_readme() -> None:
    """Its two commands find each other; the server ends with its table, the client on Ctrl-C."""
    readme = (ROOT / "README.md").read_text()
    server_line, client_line = re.findall(r"^\$ (rlightning-aio .*)$", readme, re.MULTILINE)
    configured = re.search(r"port: (\d+)", (ROOT / "configs/env_server.yaml").read_text())
    assert configured is not None
    where = f"tcp://127.0.0.1:{configured[1]}"
    assert where in client_line
    # The port may be taken, and the number of steps is only a matter of patience.
    with spawn(f"{server_line} --steps 500 envs.0.env_kwargs.port=0") as server:
        address = line_with(server, "listens at").split()[-1]
        with spawn(client_line.replace(where, address)) as client:
            stdout, stderr = server.communicate(timeout=HANG)
            client.send_signal(signal.SIGINT)
            client_stdout, client_stderr = client.communicate(timeout=HANG)
    assert server.returncode == 0, stderr
    assert stdout.startswith("500 steps in ")
    assert client.returncode == 130, client_stderr
    assert "Traceback" not in client_stderr
    steps = re.search(r": (\d+) steps in 1 session$", client_stdout, re.MULTILINE)
    assert steps is not None
    assert 500 <= int(steps[1]) <= 501


def test_keys_let_a_client_in_until_its_env_is_finished(tmp_path: Path) -> None:
    """What keygen made is what both sides need; a finished env ends the client with code 0."""
    keys = invoke_json("keygen", tmp_path / "keys", "left")
    config = server_config(tmp_path, keys=keys["server"])
    with start("rollout", config, "--steps", 5, "--json") as server:
        address = line_with(server, "listens at").split()[-1]
        words = ["--connect", address, "--keys", keys["clients"]["left"], "--name", "left"]
        with start("client", finishing(tmp_path, 5), *words, "--json") as client:
            stdout, stderr = client.communicate(timeout=HANG)
        server_stdout, server_stderr = server.communicate(timeout=HANG)
    assert client.returncode == 0, stderr
    expected = {"name": "left", "interrupted": False, "steps": 5, "sessions": 1}
    assert json.loads(stdout) == expected
    assert (tmp_path / "closed").exists()
    assert server.returncode == 0, server_stderr
    assert json.loads(server_stdout)["steps"] == 5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_an_interrupt_closes_the_env_while_nobody_answers(
    tmp_path: Path, number: signal.Signals
) -> None:
    """A client without a server waits for one; interrupted, by a person, by a service manager
    or by the end of a terminal's session, it leaves its env in order.
    """
    with start("client", finishing(tmp_path, 1), "--connect", NOBODY, "--json") as client:
        line_with(client, " dials ")
        client.send_signal(number)
        stdout, stderr = client.communicate(timeout=HANG)
    assert client.returncode == 130, stderr
    assert "Traceback" not in stderr
    document = json.loads(stdout)
    assert (document["interrupted"], document["steps"], document["sessions"]) == (True, 0, 0)
    assert (tmp_path / "closed").exists()


STUB = {"name": "stub", "backend": "stub", "task": "any"}


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ([STUB, {**STUB, "name": "other"}], ["envs", "stub, other"]),
        ([SERVER], ["envs.0 ('robots')", "backend"]),
        ([{**STUB, "env_vars": {"A": "1"}}], ["envs.0 ('stub')", "env_vars"]),
        ([{**STUB, "interpreter": "/bin/sh"}], ["envs.0 ('stub')", "interpreter"]),
        ([{**STUB, "num_workers": -1}], ["envs.0 ('stub')", "num_workers"]),
    ],
    ids=["two entries", "a server", "env_vars", "interpreter", "a bad field"],
)
def test_a_config_that_is_no_clients(
    tmp_path: Path, entries: list[dict[str, object]], named: list[str]
) -> None:
    """It is refused before anything is built, with file, entry and field."""
    config = write_config(tmp_path, *entries)
    done = invoke("client", config, "--connect", NOBODY)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"error: {config}: ")
    assert [words for words in named if words not in done.stderr] == []


@pytest.mark.parametrize(
    "address",
    ["robot", "tcp://robot", "tcp://:5555", "udp://robot:1", "tcp://robot:0", "tcp://robot:65536"],
)
def test_an_address_that_is_none(tmp_path: Path, address: str) -> None:
    """The message says what one looks like."""
    done = invoke("client", write_config(tmp_path, STUB), "--connect", address)
    assert done.exit_code == 2
    assert repr(address) in done.stderr
    assert "tcp://127.0.0.1:5555" in done.stderr


def test_an_env_that_can_not_be_built(tmp_path: Path) -> None:
    """One message with the env, its exception and the place in its code; exit code 1."""
    config = write_config(tmp_path, {**STUB, "backend": "unbuildable"})
    done = invoke("client", config, "--connect", NOBODY)
    assert (done.exit_code, done.stdout) == (1, "")
    assert "stub-0" in done.stderr
    assert "FileNotFoundError: no such robot" in done.stderr
    assert "stub_envs.py" in done.stderr


def test_keys_that_can_not_be_read_leave_no_env_behind(tmp_path: Path) -> None:
    """Their directory is named, and the env that was built is closed."""
    config, missing = finishing(tmp_path, 1), tmp_path / "missing"
    done = invoke("client", config, "--connect", NOBODY, "--keys", missing)
    assert done.exit_code == 2
    assert str(missing) in done.stderr
    assert (tmp_path / "closed").exists()


def test_a_name_that_no_server_would_read(tmp_path: Path) -> None:
    """It is refused here, where somebody sees it; the env is closed."""
    done = invoke("client", finishing(tmp_path, 1), "--connect", NOBODY, "--name", 129 * "n")
    assert done.exit_code == 2
    assert "128" in done.stderr
    assert (tmp_path / "closed").exists()


def test_keygen_says_what_goes_where(tmp_path: Path) -> None:
    """Each directory is named and holds keys that can be read; secrets are their owner's alone."""
    top = tmp_path / "keys"
    done = invoke("keygen", top, "left", "right")
    assert done.exit_code == 0
    told = [line.partition(":")[0] for line in done.stdout.splitlines()]
    assert told == [str(top / part) for part in ("server", "left", "right")]
    read_server_keys(top / "server")
    read_client_keys(top / "left")
    secrets = [*top.rglob("*_secret")]
    assert len(secrets) == 3
    assert {stat.S_IMODE(path.stat().st_mode) for path in secrets} == {0o600}


def test_keys_that_can_not_be_written_are_one_message(tmp_path: Path) -> None:
    """The folder is named, and what is in its way."""
    (tmp_path / "keys").write_text("a file")
    done = invoke("keygen", tmp_path / "keys", "left")
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.startswith(f"error: no keys can be written into {tmp_path / 'keys'}: ")


def test_keygen_replaces_no_keys(tmp_path: Path) -> None:
    """A second client is added beside the first, whose keys stay as they are."""
    top = tmp_path / "keys"
    invoke("keygen", top, "left")
    before = read_client_keys(top / "left")
    assert invoke("keygen", top, "left").exit_code == 2
    assert invoke("keygen", top, "right").exit_code == 0
    assert read_client_keys(top / "left") == before
    assert read_client_keys(top / "right").server == before.server
