"""Result files: replacing files, refusing others, and failures."""

from __future__ import annotations

import errno
import os
import resource
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rlightning_aio.files import check_folder, check_writable, file_name, finish_file, write_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

BEFORE, AFTER = b"what was there", b"what is written"
MEBIBYTE = bytes(2**20)


def test_a_file_name_leads_to_no_other_folder_and_keeps_texts_apart() -> None:
    """Most are unchanged."""
    for text in ("env-0", "a b", "..", "ä-1.partial"):
        assert file_name(text) == text
    texts = ["../../home", ".._.._home", "/etc", "a/b", "a_b", "a\0b"]
    names = [file_name(text) for text in texts]
    assert len(set(names)) == len(texts)
    assert not any("/" in name or "\0" in name for name in names)
    assert names[3].startswith("a_b-")


def test_a_new_file_is_written_in_parts(tmp_path: Path) -> None:
    check_writable(tmp_path / "new")
    assert not list(tmp_path.iterdir())
    write_file(tmp_path / "new", iter((b"in ", b"parts")))
    assert (tmp_path / "new").read_bytes() == b"in parts"
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_new_file_has_the_requested_mode(tmp_path: Path) -> None:
    for name, mode in (("secret", 0o600), ("public", 0o666)):
        write_file(tmp_path / name, AFTER, mode=mode)
    (tmp_path / "ordinary").touch()
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()}
    assert modes["secret"] == 0o600
    assert modes["public"] == modes["ordinary"]


@pytest.mark.parametrize("dangling", [False, True])
def test_links_are_followed(tmp_path: Path, *, dangling: bool) -> None:
    """Also a link to a link in another folder, relative to that folder."""
    (tmp_path / "there").mkdir()
    target = tmp_path / "there" / "target"
    if not dangling:
        target.write_bytes(BEFORE)
    (tmp_path / "there" / "inner").symlink_to("target")
    link = tmp_path / "link"
    link.symlink_to("there/inner")
    check_writable(link)
    assert target.exists() is not dangling
    write_file(link, AFTER)
    assert target.read_bytes() == AFTER
    assert not target.is_symlink()
    assert os.readlink(link) == "there/inner"  # noqa: PTH115
    assert {path.name for path in target.parent.iterdir()} == {"inner", "target"}


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _loop(path: Path) -> None:
    path.symlink_to(path)


def _below_a_file(path: Path) -> None:
    path.parent.rmdir()
    path.parent.write_bytes(BEFORE)


IN_THE_WAY: dict[str, tuple[Callable[[Path], None], str]] = {
    "folder": (Path.mkdir, "it is no regular file"),
    "FIFO": (_fifo, "it is no regular file"),
    "loop": (_loop, "it is no regular file"),
    "no folder": (lambda path: path.parent.rmdir(), "there is no folder"),
    "below a file": (_below_a_file, "Not a directory"),
}


@pytest.mark.parametrize("behind_a_link", [False, True])
@pytest.mark.parametrize("case", IN_THE_WAY)
def test_anything_but_a_regular_file_is_refused(
    tmp_path: Path, case: str, *, behind_a_link: bool
) -> None:
    """By the early check and by the write; neither waits for a reader of a FIFO."""
    make, words = IN_THE_WAY[case]
    place = tmp_path / "in" / "the way"
    place.parent.mkdir()
    make(place)
    path = tmp_path / "link" if behind_a_link else place
    if behind_a_link:
        path.symlink_to(place)
    before = sorted(tmp_path.rglob("*"))
    kind = place.lstat().st_mode if os.path.lexists(place) else None
    for attempt in (lambda: check_writable(path), lambda: write_file(path, AFTER)):
        with pytest.raises(OSError, match=words) as caught:
            attempt()
        assert caught.value.filename == str(path)
    partial = tmp_path / "partial"
    partial.write_bytes(AFTER)
    with pytest.raises(OSError, match=None if case == "no folder" else words):
        finish_file(partial, path)
    assert partial.read_bytes() == AFTER
    partial.unlink()
    assert sorted(tmp_path.rglob("*")) == before
    if kind is not None:
        assert place.lstat().st_mode == kind


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_interrupted_write_leaves_the_old_file(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "file"
    path.write_bytes(BEFORE)

    def parts() -> Iterator[bytes]:
        yield MEBIBYTE
        raise error

    with pytest.raises(error):
        write_file(path, parts())
    assert path.read_bytes() == BEFORE
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_a_killed_writer_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(BEFORE)
    program = (
        "import os, sys; from rlightning_aio.files import write_file\n"
        "def parts():\n    yield bytes(2**20)\n    os.kill(os.getpid(), 9)\n"
        "write_file(sys.argv[1], parts())"
    )
    assert subprocess.run([sys.executable, "-c", program, path], check=False).returncode == -9
    assert path.read_bytes() == BEFORE


def test_a_write_beyond_the_size_limit_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(BEFORE)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**20, before[1]))
    try:
        with pytest.raises(OSError, match="too large") as caught:
            write_file(path, [MEBIBYTE, AFTER])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert path.read_bytes() == BEFORE
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_is_detected_early(small_disk: Path) -> None:
    path = small_disk / "file"
    path.write_bytes(BEFORE)
    check_writable(path)
    with pytest.raises(OSError, match="No space left on device"):
        write_file(path, [MEBIBYTE, AFTER])
    with pytest.raises(OSError, match="No space left"):
        (small_disk / "rest").write_bytes(MEBIBYTE)
    attempts: tuple[Callable[[], None], ...] = (
        lambda: check_writable(path),
        lambda: write_file(path, AFTER),
        lambda: check_folder(small_disk),
    )
    for attempt in attempts:
        with pytest.raises(OSError, match="No space left on device"):
            attempt()
    assert path.read_bytes() == BEFORE
    assert {one.name for one in small_disk.iterdir()} == {"file", "rest"}


def test_a_read_only_disk_is_detected_early(small_disk: Path) -> None:
    path = small_disk / "file"
    path.write_bytes(BEFORE)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for attempt in (check_writable, lambda path: write_file(path, AFTER)):
        for place in (path, small_disk / "new"):
            with pytest.raises(OSError, match=r"read-only|Read-only file system"):
                attempt(place)
    with pytest.raises(OSError, match="Read-only file system"):
        check_folder(small_disk / "folder")


def test_an_unwritable_folder_is_detected_early() -> None:
    """For users other than root, who may write everywhere."""
    program = (
        "import os, sys; from rlightning_aio.files import check_writable\n"
        "if os.geteuid() == 0: os.setuid(65534)\n"
        "check_writable(sys.argv[1])"
    )
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "file").write_bytes(BEFORE)
        (Path(name) / "file").chmod(0o666)
        Path(name).chmod(0o555)
        done = subprocess.run(
            [sys.executable, "-c", program, f"{name}/file"],
            check=False,
            capture_output=True,
            text=True,
        )
        Path(name).chmod(0o755)
    assert f"PermissionError: [Errno 13] Permission denied: '{name}/file'" in done.stderr
