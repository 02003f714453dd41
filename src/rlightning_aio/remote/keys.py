"""The CURVE keys of an env_server and its clients: making them and reading them.

Rule: key files are ZeroMQ's certificates, which `zmq.auth` writes and reads.
``make_keys(directory, names)`` makes one directory for each machine, so setting up a client means
copying one of them. ``server/`` has the server's secret key and, in ``clients/``, the public key of
every client that may connect; ``<name>/`` has one client's secret key and the server's public key.
Deleting a file in ``server/clients/``, or writing another key into it, shuts that client out.
"""

from __future__ import annotations

import contextlib
import logging
import re
import shutil
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

# The types of paths in pyzmq's signatures are incomplete.
from zmq.auth import (
    create_certificates,  # pyright: ignore[reportUnknownVariableType]
    load_certificate,  # pyright: ignore[reportUnknownVariableType]
)
from zmq.utils import z85

from rlightning_aio.errors import ConfigError
from rlightning_aio.files import write_file
from rlightning_aio.protocol.error_text import in_one_line

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

_PUBLIC_SUFFIX: Final = ".key"
_SERVER: Final = "server"
_CLIENT: Final = "client"
_ALLOWED: Final = "clients"
_KEY_BYTES: Final = 32
_TICK_NS: Final = 1_000_000_000

_log = logging.getLogger(__name__)


class ServerKeys(NamedTuple):
    """A server's own secret key, as Z85 text, and the directory of its clients' keys."""

    secret: bytes
    clients: Path


class ClientKeys(NamedTuple):
    """A client's own keys and its server's public key; Z85 text."""

    public: bytes
    secret: bytes
    server: bytes


def make_keys(directory: str | os.PathLike[str], names: Sequence[str]) -> list[Path]:
    """Make the server's keys, unless they exist, and those of the clients `names`.

    Args:
        directory: created if missing.
        names: of clients; letters, digits, ``.``, ``_`` and ``-``.

    Returns:
        The directories that belong on the clients' machines, in the order of `names`.

    Raises:
        ConfigError: a name can't be a file's, or has keys already, and nothing was written; or
            the directory can't be written into, and the client of the failure has no keys.
    """
    top = Path(directory)
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]*", name) or name == _SERVER:
            raise ConfigError(
                f"{name!r} can't name a client's keys: use letters, digits, '.', '_' and '-', "
                f"and not {_SERVER!r}"
            )
        if (top / name).exists():
            raise ConfigError(f"{top / name} exists; remove it to make new keys for {name!r}")
    try:
        _make_folder(top / _SERVER, _SERVER)
        for name in names:
            _make_client(top, name)
    except OSError as error:
        raise ConfigError(
            f"no keys can be written into {top}: {error.strerror}: {error.filename}; name a "
            "directory that you own"
        ) from error
    return [top / name for name in names]


def _make_client(top: Path, name: str) -> None:
    server, folder = top / _SERVER, top / name
    _make_folder(folder, _CLIENT, (server / (_SERVER + _PUBLIC_SUFFIX)).read_bytes())
    try:
        # Last: from now on the client may come in.
        public = (folder / (_CLIENT + _PUBLIC_SUFFIX)).read_bytes()
        write_file(server / _ALLOWED / (name + _PUBLIC_SUFFIX), public)
    except BaseException:
        shutil.rmtree(folder)
        raise


def _make_folder(folder: Path, name: str, server_key: bytes | None = None) -> None:
    """Make a folder with new keys called `name` in one step, unless it exists.

    A client's folder has the server's key, too, and a server's has a folder for those of clients.
    """
    if folder.exists():
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Others can't read this folder, so the secret was never readable.
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".keys-") as temporary:
        made = Path(temporary) / name
        made.mkdir()
        _, secret = create_certificates(made, name)
        Path(secret).chmod(0o600)
        if server_key is None:
            (made / _ALLOWED).mkdir()
        else:
            (made / (_SERVER + _PUBLIC_SUFFIX)).write_bytes(server_key)
        try:
            made.rename(folder)
        except OSError:
            if not folder.exists():  # Otherwise another call has made it meanwhile.
                raise


def read_client_keys(directory: str | os.PathLike[str]) -> ClientKeys:
    """Return the keys in a client's directory, which `make_keys` made.

    Raises:
        ConfigError: a file is missing or holds no key; the message names it.
    """
    folder = Path(directory)
    public, secret = _read_pair(folder, _CLIENT)
    return ClientKeys(public, secret, read_public_key(folder / (_SERVER + _PUBLIC_SUFFIX)))


def read_server_keys(directory: str | os.PathLike[str]) -> ServerKeys:
    """Return the keys in a server's directory, which `make_keys` made.

    Raises:
        ConfigError: a file is missing or holds no key; the message names it.
    """
    _, secret = _read_pair(Path(directory), _SERVER)
    clients = Path(directory) / _ALLOWED
    if not clients.is_dir():
        raise ConfigError(f"{clients} is not a directory; the public keys of clients belong there")
    return ServerKeys(secret, clients)


def _read_pair(directory: Path, name: str) -> tuple[bytes, bytes]:
    path = directory / f"{name}.key_secret"
    public, secret = _read(path)
    if secret is None:
        raise ConfigError(f"{path} has no line secret-key; `rlightning-aio keygen` makes keys")
    return public, secret


def read_public_key(path: Path) -> bytes:
    """Return the public key in a file, as Z85 text.

    Raises:
        ConfigError: it can't be read, or holds no key; the message names it.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[bytes, bytes | None]:
    try:
        public, secret = load_certificate(path)
    except OSError as error:
        raise ConfigError(
            f"can't read the key {path}: {error}; `rlightning-aio keygen` makes keys"
        ) from None
    except ValueError:
        raise ConfigError(f"{path} has no line public-key with a key") from None
    for key in (public, secret):
        if key is not None and not _is_key(key):
            raise ConfigError(f"{path} has a line that is no key of 40 characters")
    return public, secret


def _is_key(text: bytes) -> bool:
    try:
        return len(z85.decode(text)) == _KEY_BYTES
    # What `z85.decode` raises depends on what is wrong.
    except Exception:  # noqa: BLE001
        return False


class ListedKeys:
    """The keys that are in a directory, read again when it or one of its files has changed.

    A file that holds no key is skipped with a warning. `zmq.auth` calls it a credentials provider.

    Args:
        directory: of public keys, ``<name>.key`` each.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._changed_ns: dict[Path, int] = {}
        self._names: dict[bytes, set[str]] = {}
        self._warned: set[str] = set()

    def callback(self, domain: str, key: bytes) -> bool:
        """Return True if there is a file with the public key `key` (Z85 text)."""
        del domain
        if self.names(key):
            return True
        _log.warning("the key %r of a client is not in %s", key.decode(), self._directory)
        return False

    def names(self, key: bytes) -> set[str]:
        """Return the names of the clients that a key was made for."""
        changed_ns = self._times()
        # What was written a moment ago may be written again within one tick of the file system.
        is_settled = time.time_ns() - max(changed_ns.values(), default=0) > _TICK_NS
        if changed_ns != self._changed_ns or not is_settled:
            self._changed_ns, self._names = changed_ns, {}
            for path in changed_ns.keys() - {self._directory}:
                try:
                    self._names.setdefault(read_public_key(path), set()).add(path.stem)
                except ConfigError as error:
                    self._warn(f"{error}; its client is not let in")
        return self._names.get(key, set())

    def _times(self) -> dict[Path, int]:
        """Return when the directory and each file in it were last changed."""
        try:
            times = {self._directory: self._directory.stat().st_mtime_ns}
        except OSError as error:
            self._warn(f"can't read {self._directory}: {error}; no client is let in")
            return {}
        for path in self._directory.glob(f"[!.]*{_PUBLIC_SUFFIX}"):
            with contextlib.suppress(OSError):  # Deleted since it was listed.
                if path.is_file():
                    times[path] = path.stat().st_mtime_ns
        return times

    def _warn(self, text: str) -> None:
        """Log a warning once."""
        if text not in self._warned:
            self._warned.add(text)
            _log.warning("%s", in_one_line(text))
