"""The CURVE keys of an env_server and its clients: making them and reading them.

Rule: key files are ZeroMQ's certificates, which `zmq.auth` writes and reads.
``make_keys(directory, names)`` makes one directory for each machine, so setting up a client means
copying one of them. ``server/`` has the server's secret key and, in ``clients/``, the public key of
every client that may connect; ``<name>/`` has one client's secret key and the server's public key.
Deleting a file in ``server/clients/``, or writing another key into it, shuts that client out.
"""

from __future__ import annotations

import logging
import os
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

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = [
    "AllowedKeys",
    "ClientKeys",
    "ServerKeys",
    "make_keys",
    "read_client_keys",
    "read_public_key",
    "read_server_keys",
]

_PUBLIC_SUFFIX: Final = ".key"
_SERVER: Final = "server"
_CLIENT: Final = "client"
_ALLOWED: Final = "clients"
_KEY_BYTES: Final = 32

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


class _Stamp(NamedTuple):
    """Properties of a file; at least one changes when it is written.

    Unlike the time of its contents, that of its last change can't be set, and access rights change
    it.
    """

    changed_ns: int
    size: int
    inode: int


_UNSETTLED: Final = _Stamp(-1, -1, -1)
_TICK_NS: Final = 1_000_000_000


class AllowedKeys:
    """The keys that are now in a directory.

    `holds` compares the stamps of all files (a few microseconds for each), and reads files that
    have changed. A file that holds no key is skipped with one warning.

    Args:
        directory: of public keys, ``<name>.key`` each.

    Attributes:
        directory: as given.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._read: dict[str, tuple[_Stamp, bytes | None]] = {}
        self._keys: set[bytes] = set()
        self._faulty: set[str] = set()
        self._is_unreadable = False

    def holds(self, key: bytes) -> bool:
        """Return True if there is a file with the public key `key` (Z85 text)."""
        stamps = self._stamps()
        if stamps != {name: stamp for name, (stamp, _) in self._read.items()}:
            self._refresh(stamps)
        return key in self._keys

    def is_known(self, key: bytes) -> bool:
        """Return True if `key` was a client's when the files were read last."""
        return key in self._keys

    def _stamps(self) -> dict[str, _Stamp]:
        stamps: dict[str, _Stamp] = {}
        try:
            with os.scandir(self.directory) as files:
                for file in files:
                    if file.name.endswith(_PUBLIC_SUFFIX) and not file.name.startswith("."):
                        try:
                            said = file.stat()
                        except OSError:
                            continue  # Deleted since it was listed, or a link to nowhere.
                        stamps[file.name] = _Stamp(said.st_ctime_ns, said.st_size, said.st_ino)
        except OSError as error:
            # A directory that can't be read admits no client.
            if not self._is_unreadable:
                self._is_unreadable = True
                _log.warning("can't read %s: %s; no client is let in", self.directory, error)
            return {}
        self._is_unreadable = False
        return stamps

    def _refresh(self, stamps: dict[str, _Stamp]) -> None:
        read: dict[str, tuple[_Stamp, bytes | None]] = {}
        for name, stamp in sorted(stamps.items()):
            known = self._read.get(name)
            if known is not None and known[0] == stamp:
                read[name] = known
                continue
            # A second write within one tick of the file system's clock does not change the stamp.
            is_settled = time.time_ns() - stamp.changed_ns > _TICK_NS
            read[name] = stamp if is_settled else _UNSETTLED, self._key_in(name)
        self._read = read
        self._faulty &= read.keys()
        self._keys = {key for _, key in read.values() if key is not None}

    def _key_in(self, name: str) -> bytes | None:
        """Return the key in the file `name`; None, with a warning, if there is none."""
        path = self.directory / name
        try:
            if not name.isprintable():
                raise ConfigError(f"{str(path)!a} has a name that can't name a client")
            if not path.is_file():
                raise ConfigError(f"{path} is not a file")
            key = read_public_key(path)
        except ConfigError as error:
            if name not in self._faulty:
                self._faulty.add(name)
                _log.warning("%s; its client is not let in", error)
            return None
        self._faulty.discard(name)
        return key
