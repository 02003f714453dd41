"""Writes result files: completely, or not at all.

Rule: each file that the library saves for a user is written by `write_file`, or renamed by
`finish_file` if another program writes it. Links are followed, and anything but a regular file is
refused. Each `OSError` raised here names the user's path.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable


def file_name(text: str) -> str:
    """Return `text` as the beginning of a file name, unchanged unless it holds a slash or NUL.

    Those are replaced, and a checksum keeps different texts apart.
    """
    plain = re.sub("[/\0]", "_", text)
    return text if plain == text else f"{plain}-{zlib.crc32(text.encode()):08x}"


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check that `write_file` could succeed, by writing a temporary block to the same folder.

    Raises:
        OSError: it would fail; the message says why.
    """
    with _partial_file(path) as file:
        file.write(bytes(4096))  # One block, because an empty file fits even a full disk.


def check_folder(folder: str | os.PathLike[str]) -> None:
    """Create `folder` if missing, and check that files can be written to it.

    Raises:
        OSError: they can't; the message says why.
    """
    with _naming(folder):
        Path(folder).mkdir(parents=True, exist_ok=True)
        check_writable(Path(folder) / "any")


def write_file(
    path: str | os.PathLike[str], content: bytes | Iterable[bytes], *, mode: int = 0o666
) -> None:
    """Write a file, replacing an existing one once the new one is complete.

    Args:
        path: a link is followed, and its target replaced.
        content: the bytes, or parts of them in order.
        mode: of the file, before the umask.

    Raises:
        OSError: it can't be written; an existing file is unchanged.
    """
    with _partial_file(path, mode) as file:
        file.writelines((content,) if isinstance(content, bytes) else content)
        file.flush()
        finish_file(file.name, path)


def finish_file(partial: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Give the complete file `partial` the name `path`, replacing an existing file.

    Raises:
        OSError: it can't be renamed; both files are unchanged.
    """
    with _naming(path), open(partial, "rb") as file:  # noqa: PTH123
        target = check_regular(path)
        os.fsync(file.fileno())  # Some file systems report a full disk only here.
        os.replace(partial, target)  # noqa: PTH105


def check_regular(path: str | os.PathLike[str]) -> Path:
    """Resolve `path` to that of a regular file, which may be missing.

    Raises:
        OSError: it is something else.
    """
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not target.is_file():
        raise FileExistsError(errno.EEXIST, "it is no regular file", os.fspath(path))
    return target


@contextlib.contextmanager
def _partial_file(path: str | os.PathLike[str], mode: int = 0o666) -> Generator[BinaryIO]:
    """Open a new file beside `path`, which is removed at the end unless it was renamed."""
    with _naming(path):
        partial = check_regular(path).parent / f".rlightning-aio-{secrets.token_hex(8)}.part"
        if not partial.parent.exists():
            raise FileNotFoundError(errno.ENOENT, f"there is no folder {partial.parent}")
        try:
            # Only an opener can set the mode before a secret is written.
            with open(partial, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
                yield file
        finally:
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _naming(path: str | os.PathLike[str]) -> Generator[None]:
    """Make each `OSError` name `path`."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error
