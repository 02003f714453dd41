"""``client`` and ``keygen`` connect an env to a server in another process."""

from __future__ import annotations

import re
import shlex
import signal
import socket
import stat
import subprocess
from typing import TYPE_CHECKING

import pytest
from cli.command import COMMAND, TESTS, invoke, line_with, start, write_config
from patience import HANG
from run_python import output_of

from rlightning_aio.remote.keys import make_keys, read_client_keys, read_server_keys

if TYPE_CHECKING:
    from pathlib import Path

ROOT = TESTS.parent
SERVER = {"name": "robots", "backend": "env_server"}
NOBODY = "tcp://127.0.0.1:9"


def finishing(folder: Path, wanted_steps: int) -> str:
    """Write a config whose env finishes after some steps and creates folder/closed."""
    kwargs = {"wanted_steps": wanted_steps, "closed_file": str(folder / "closed")}
    entry = {"name": "arm", "backend": "finishing", "task": "any", "env_kwargs": kwargs}
    return write_config(folder, entry)


def server_config(folder: Path, **env_kwargs: object) -> str:
    (folder / "server").mkdir()
    return write_config(folder / "server", {**SERVER, "env_kwargs": env_kwargs})


def spawn(command: str) -> subprocess.Popen[str]:
    """Start a command of a page, in the repository's root."""
    words = [*COMMAND, *shlex.split(command)[1:]]
    pipe = subprocess.PIPE
    return subprocess.Popen(words, cwd=ROOT, stdout=pipe, stderr=pipe, text=True)


def test_the_two_commands_of_the_page_connect() -> None:
    """The server ends with its table, the client on Ctrl-C."""
    page = (ROOT / "docs" / "remote.md").read_text()
    server_line, client_line = re.findall(r"^\$ (rlightning-aio .*)$", page, re.MULTILINE)
    configured = re.search(r"port: (\d+)", (ROOT / "configs/env_server.yaml").read_text())
    assert configured is not None
    where = f"tcp://127.0.0.1:{configured[1]}"
    assert where in client_line
    # The port may be in use, and fewer steps save time.
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


def test_the_program_of_the_page_moves_a_client(tmp_path: Path) -> None:
    """It runs as written, but for the port, which may be in use; its keys are keygen's."""
    page = (ROOT / "docs" / "remote.md").read_text()
    (program,) = re.findall(r"(?ms)^```python\n(# On the robot.*?)^```", page)
    assert "rlightning-aio client arm.yaml --connect tcp://trainer:5555 --keys keys/arm" in program
    assert invoke("keygen", tmp_path / "keys", "arm").exit_code == 0
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    (tmp_path / "trainer.py").write_text(program.replace("5555", str(port)))
    address, keys = f"tcp://127.0.0.1:{port}", tmp_path / "keys" / "arm"
    client_words = ["--connect", address, "--keys", keys]
    with start("client", ROOT / "configs" / "cartpole.yaml", *client_words) as client:
        trained = output_of("trainer.py", folder=tmp_path, asyncio_debug=False)
        client.send_signal(signal.SIGINT)
        stdout, stderr = client.communicate(timeout=HANG)
    assert trained == ""
    assert client.returncode == 130, stderr
    assert re.search(r": [1-9]\d+ steps in 1 session$", stdout, re.MULTILINE)


def test_each_change_of_a_connection_is_one_line_on_both_sides(tmp_path: Path) -> None:
    """A client without a valid key logs it once for all attempts, then connects with one. A
    finished env ends it with code 0.
    """
    keys = tmp_path / "keys"
    make_keys(keys, ["left"])
    allowed = keys / "server" / "clients" / "left.key"
    withheld = allowed.rename(tmp_path / "left.key")
    config = server_config(tmp_path, keys=str(keys / "server"), connect_timeout=HANG)
    with start("rollout", config, "--steps", "5") as server:
        address = line_with(server, "listens at").split()[-1]
        words = ["--connect", address, "--keys", str(keys / "left"), "--name", "left"]
        with start("client", finishing(tmp_path, 5), *words) as client:
            assert line_with(client, "left: ") == (
                "left: not connected (the server does not know this client's key)\n"
            )
            withheld.rename(allowed)
            assert line_with(client, "left: ") == "left: serving\n"
            line_with(server, "robots-0: the client 'left' has taken robots-0/0")
            stdout, _ = client.communicate(timeout=HANG)
            server.communicate(timeout=HANG)
    assert client.returncode == server.returncode == 0
    assert stdout == "left: 5 steps in 1 session\n"
    assert (tmp_path / "closed").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_an_interrupt_closes_the_env_while_nobody_answers(
    tmp_path: Path, number: signal.Signals
) -> None:
    """A client without a server waits for one; interrupted, by a person, by a service manager
    or by the end of a terminal's session, it leaves its env in order.
    """
    with start("client", finishing(tmp_path, 1), "--connect", NOBODY) as client:
        line_with(client, " connects to ")
        client.send_signal(number)
        stdout, stderr = client.communicate(timeout=HANG)
    assert client.returncode == 130, stderr
    assert "Traceback" not in stderr
    assert stdout.endswith(": 0 steps in 0 sessions\n")
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
def test_a_config_that_a_client_cannot_use_is_refused(
    tmp_path: Path, entries: list[dict[str, object]], named: list[str]
) -> None:
    """The message has file, entry and field, before anything is built."""
    config = write_config(tmp_path, *entries)
    done = invoke("client", config, "--connect", NOBODY)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"error: {config}: ")
    assert [words for words in named if words not in done.stderr] == []


@pytest.mark.parametrize(
    ("words", "said"), [(("--keys", "/missing"), "/missing"), (("--name", 129 * "n"), "128")]
)
def test_what_a_server_could_not_accept_is_refused_at_once(
    words: tuple[str, str], said: str, tmp_path: Path
) -> None:
    """Keys that can't be read, and a name that is too long; the env is closed."""
    done = invoke("client", finishing(tmp_path, 1), "--connect", NOBODY, *words)
    assert done.exit_code == 2
    assert said in done.stderr
    assert (tmp_path / "closed").exists()


def test_keygen_explains_the_directories(tmp_path: Path) -> None:
    """Each holds readable keys, and only the owner can read secrets."""
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


def test_keys_that_cannot_be_written_are_one_message(tmp_path: Path) -> None:
    """It names the folder and the cause."""
    (tmp_path / "keys").write_text("a file")
    done = invoke("keygen", tmp_path / "keys", "left")
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.startswith(f"error: no keys can be written into {tmp_path / 'keys'}: ")
