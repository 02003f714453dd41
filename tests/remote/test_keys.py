"""The allowed keys are those in the directory now."""

from __future__ import annotations

import os
import shutil
import stat
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest

from rlightning_aio.errors import ConfigError
from rlightning_aio.remote.keys import ListedKeys, make_keys, read_client_keys, read_public_key

if TYPE_CHECKING:
    from pathlib import Path


def laid_out(tmp_path: Path) -> tuple[ListedKeys, Path, bytes, bytes]:
    """Return the allowed keys, their directory, and the public keys of arm and leg."""
    arm, leg = make_keys(tmp_path, ["arm", "leg"])
    allowed = tmp_path / "server" / "clients"
    return (
        ListedKeys(allowed),
        allowed,
        read_client_keys(arm).public,
        read_client_keys(leg).public,
    )


def test_keys_that_cannot_be_written_leave_nothing(tmp_path: Path) -> None:
    """A client has all of its files, or none; those who already had keys keep them."""
    make_keys(tmp_path, ["arm"])
    secret = tmp_path / "server" / "server.key_secret"
    before = secret.read_bytes()
    os.mkfifo(tmp_path / "server" / "clients" / "leg.key")
    with pytest.raises(ConfigError, match=r"it is no regular file: .*leg\.key"):
        make_keys(tmp_path, ["leg"])
    assert not (tmp_path / "leg").exists()
    assert secret.read_bytes() == before
    assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "arm" / "client.key_secret").stat().st_mode) == 0o600


def test_keys_made_at_once_are_of_one_server(tmp_path: Path) -> None:
    names = [f"arm-{index}" for index in range(8)]
    together = threading.Barrier(len(names))

    def make(name: str) -> Path:
        together.wait()
        return make_keys(tmp_path, [name])[0]

    with ThreadPoolExecutor(len(names)) as pool:
        made = [read_client_keys(folder) for folder in pool.map(make, names)]
    server = read_public_key(tmp_path / "server" / "server.key_secret")
    assert {keys.server for keys in made} == {server}


def test_each_change_of_a_file_counts_at_once(tmp_path: Path) -> None:
    """Deleted, added, replaced, and written over in place."""
    keys, directory, arm, leg = laid_out(tmp_path)
    assert (keys.callback("", arm), keys.callback("", leg), keys.callback("", b"")) == (
        True,
        True,
        False,
    )
    (directory / "arm.key").unlink()
    assert not keys.callback("", arm)
    shutil.copy(tmp_path / "arm" / "client.key", directory / "hand.key")
    assert keys.callback("", arm)
    (directory / "hand.key").write_text((directory / "leg.key").read_text())
    assert not keys.callback("", arm)
    (directory / "leg.key").replace(directory / "hand.key")
    assert (keys.callback("", arm), keys.callback("", leg)) == (False, True)


def test_a_file_that_is_written_over_within_one_tick_of_the_clock_counts(
    tmp_path: Path,
) -> None:
    """Although the time of its last change is the same."""
    keys, directory, arm, leg = laid_out(tmp_path)
    (directory / "leg.key").unlink()
    path = directory / "arm.key"
    path.touch()
    times = path.stat().st_mtime_ns
    assert keys.callback("", arm)
    path.write_text(path.read_text().replace(arm.decode(), leg.decode()))
    os.utime(path, ns=(times, times))
    assert (keys.callback("", arm), keys.callback("", leg)) == (False, True)


def test_a_file_without_a_key_is_skipped_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A bad name, a bad content, a directory, a pipe, a link to nowhere."""
    keys, directory, arm, _ = laid_out(tmp_path)
    (directory / os.fsdecode(b"\xff.key")).write_text("x")
    (directory / "red\x1b[31m\n.key").write_text("x")
    (directory / "empty.key").write_text("")
    (directory / "bytes.key").write_bytes(b"\xff")
    (directory / "folder.key").mkdir()
    os.mkfifo(directory / "pipe.key")
    (directory / "nowhere.key").symlink_to(directory / "nothing")
    for _ in range(3):
        assert keys.callback("", arm)
        (directory / "other").touch()
        (directory / "other").unlink()
    messages = [record.getMessage() for record in caplog.records]
    assert all(message.isprintable() for message in messages)
    for name in ("\\udcff", "red\\x1b", "empty", "bytes"):
        assert len([message for message in messages if name in message]) == 1
    assert len(messages) == 4


def test_a_directory_that_cannot_be_read_admits_no_client(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One warning; a directory that comes back counts again."""
    keys, directory, arm, _ = laid_out(tmp_path)
    away = directory.rename(tmp_path / "away")
    assert [keys.callback("", arm), keys.callback("", arm)] == [False, False]
    assert caplog.text.count("no client is let in") == 1
    away.rename(directory)
    assert keys.callback("", arm)
    assert read_public_key(directory / "arm.key") == arm
