"""The CURVE keys of an env_server and its clients: making them and reading them.

Rule: key files are ZeroMQ's certificates, so that its tools read them; a key is 40
characters of Z85. ``make_keys(directory, names)`` lays out one directory for each machine, so that
setting up a client is copying one of them: ``server/`` has the server's secret and, in
``clients/``, the public key of every client that may come in; ``<name>/`` has one
client's secret and the server's public key. Deleting a file in ``server/clients/``, or
writing another key into it, shuts that client out.
"""

from __future__ import annotations

import logging
import os
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import zmq

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = [
    "AllowedKeys",
    "ClientKeys",
    "KeyPair",
    "ServerKeys",
    "make_keys",
    "read_client_keys",
    "read_keys",
    "read_server_keys",
]

_PUBLIC_SUFFIX: Final = ".key"
_SECRET_SUFFIX: Final = ".key_secret"  # noqa: S105  # The name of a file, not a secret.
_SERVER: Final = "server"
_CLIENT: Final = "client"
_ALLOWED: Final = "clients"
# Z85 spelt out, see https://rfc.zeromq.org/spec/32/
_KEY: Final = r'"([0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40})"'

_log = logging.getLogger(__name__)


class KeyPair(NamedTuple):
    """A public key and, where the file has it, the secret one; Z85 text."""

    public: bytes
    secret: bytes | None = None


class ServerKeys(NamedTuple):
    """What a server needs: its own secret, Z85 text, and where its clients' keys lie."""

    secret: bytes
    clients: Path


class ClientKeys(NamedTuple):
    """What a client needs to prove itself, and to know its server; Z85 text."""

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
            the directory can't be written into.
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
        _write_keys(top, names)
    except OSError as error:
        raise ConfigError(
            f"no keys can be written into {top}: {error.strerror}: {error.filename}; name a "
            "directory that you own"
        ) from error
    return [top / name for name in names]


def _write_keys(top: Path, names: Sequence[str]) -> None:
    allowed = top / _SERVER / _ALLOWED
    allowed.mkdir(parents=True, exist_ok=True)
    server = top / _SERVER / (_SERVER + _SECRET_SUFFIX)
    if not server.exists():
        _write_pair(top / _SERVER, _SERVER)
    server_keys = read_keys(server)
    for name in names:
        (top / name).mkdir()
        keys = _write_pair(top / name, _CLIENT)
        (top / name / (_SERVER + _PUBLIC_SUFFIX)).write_text(_render(KeyPair(server_keys.public)))
        (allowed / (name + _PUBLIC_SUFFIX)).write_text(_render(KeyPair(keys.public)))


def _write_pair(directory: Path, name: str) -> KeyPair:
    public, secret = zmq.curve_keypair()
    keys = KeyPair(public, secret)
    path = directory / (name + _SECRET_SUFFIX)
    with os.fdopen(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "w") as file:
        file.write(_render(keys))
    (directory / (name + _PUBLIC_SUFFIX)).write_text(_render(KeyPair(public)))
    return keys


def read_client_keys(directory: str | os.PathLike[str]) -> ClientKeys:
    """The keys in a client's directory, as `make_keys` lays it out.

    Raises:
        ConfigError: a file is missing or is no key; the message names it.
    """
    public, secret = _read_secret(Path(directory) / (_CLIENT + _SECRET_SUFFIX))
    return ClientKeys(
        public, secret, read_keys(Path(directory) / (_SERVER + _PUBLIC_SUFFIX)).public
    )


def read_server_keys(directory: str | os.PathLike[str]) -> ServerKeys:
    """The keys in a server's directory, as `make_keys` lays it out.

    Raises:
        ConfigError: a file is missing or is no key; the message names it.
    """
    _, secret = _read_secret(Path(directory) / (_SERVER + _SECRET_SUFFIX))
    clients = Path(directory) / _ALLOWED
    if not clients.is_dir():
        raise ConfigError(f"{clients} is not a directory; the public keys of clients belong there")
    return ServerKeys(secret, clients)


def _read_secret(path: Path) -> tuple[bytes, bytes]:
    keys = read_keys(path)
    if keys.secret is None:
        raise ConfigError(f"{path} has no line secret-key; `rlightning-aio keygen` makes keys")
    return keys.public, keys.secret


def read_keys(path: Path) -> KeyPair:
    """The keys in one file.

    Raises:
        ConfigError: it can't be read, or is no key; the message names it.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"can't read the key {path}: {error}; `rlightning-aio keygen` makes keys"
        ) from None
    public = re.search(rf"^\s*public-key\s*=\s*{_KEY}\s*$", text, re.MULTILINE)
    secret = re.search(rf"^\s*secret-key\s*=\s*{_KEY}\s*$", text, re.MULTILINE)
    if public is None:
        raise ConfigError(f"{path} has no line public-key with a key of 40 characters")
    return KeyPair(public[1].encode(), secret[1].encode() if secret else None)


class _Stamp(NamedTuple):
    """What changes when a file does, however it was written."""

    modified_ns: int
    size: int
    inode: int


_UNSETTLED: Final = _Stamp(-1, -1, -1)
_TICK_NS: Final = 1_000_000_000


class AllowedKeys:
    """Whose keys lie in a directory, as it is now.

    Each question looks at the stamps of all files (some microseconds for each), and reads
    those anew that have changed. A file that holds no key is left out with one warning.

    Args:
        directory: of public keys, ``<name>.key`` each.

    Attributes:
        directory: as given.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._read: dict[str, tuple[_Stamp, bytes | None]] = {}
        self._owners: dict[bytes, str] = {}
        self._faulty: set[str] = set()
        self._is_unreadable = False

    def owner(self, key: bytes) -> str | None:
        """The name of the client whose public key, as Z85 text, is `key`; None if nobody's."""
        stamps = self._stamps()
        if stamps != {name: stamp for name, (stamp, _) in self._read.items()}:
            self._refresh(stamps)
        return self._owners.get(key)

    def knew(self, key: bytes) -> bool:
        """Whether `key` was somebody's when the files were looked at last."""
        return key in self._owners

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
                        stamps[file.name] = _Stamp(said.st_mtime_ns, said.st_size, said.st_ino)
        except OSError as error:
            # A list that can't be read allows nobody.
            if not self._is_unreadable:
                self._is_unreadable = True
                _log.warning("can't read %s: %s; no client gets in", self.directory, error)
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
            # What is written within the same tick of the file system's clock leaves no trace.
            is_settled = time.time_ns() - stamp.modified_ns > _TICK_NS
            read[name] = stamp if is_settled else _UNSETTLED, self._key_in(name)
        self._read = read
        self._faulty &= read.keys()
        self._owners = {
            key: name.removesuffix(_PUBLIC_SUFFIX)
            for name, (_, key) in read.items()
            if key is not None
        }

    def _key_in(self, name: str) -> bytes | None:
        """The key in the file `name`; None, with a warning, if there is none."""
        path = self.directory / name
        try:
            if not name.isprintable():
                raise ConfigError(f"{str(path)!a} has a name that can't be a client's")
            if not path.is_file():
                raise ConfigError(f"{path} is no file")
            key = read_keys(path).public
        except ConfigError as error:
            if name not in self._faulty:
                self._faulty.add(name)
                _log.warning("%s; its client stays out", error)
            return None
        self._faulty.discard(name)
        return key


def _render(keys: KeyPair) -> str:
    lines = ["# A key of rlightning-aio.", "curve", f'    public-key = "{keys.public.decode()}"']
    if keys.secret is not None:
        lines[0] = "# A key of rlightning-aio. SECRET: leave no copy where others can read it."
        lines.append(f'    secret-key = "{keys.secret.decode()}"')
    return "\n".join([*lines, ""])
