"""The CURVE keys of an env_server and its clients: making them and reading them.

Rule: key files are ZeroMQ's certificates, so ZeroMQ's tools read them; a key has 40 characters of
Z85. ``make_keys(directory, names)`` makes one directory for each machine, so setting up a client
means copying one of them. ``server/`` has the server's secret key and, in ``clients/``, the public
key of every client that may connect; ``<name>/`` has one client's secret key and the server's
public key. Deleting a file in ``server/clients/``, or writing another key into it, shuts that
client out.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import zmq

from rlightning_aio.errors import ConfigError
from rlightning_aio.files import write_file

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

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
    with _locked(allowed):
        server = top / _SERVER / (_SERVER + _SECRET_SUFFIX)
        if not server.exists():
            _write_pair(top / _SERVER, _SERVER)
        server_keys = KeyPair(read_keys(server).public)
        for name in names:
            (top / name).mkdir()
            try:
                keys = _write_pair(top / name, _CLIENT)
                write_file(top / name / (_SERVER + _PUBLIC_SUFFIX), _render(server_keys))
                # Last: from now on the client may come in.
                write_file(allowed / (name + _PUBLIC_SUFFIX), _render(keys))
            except BaseException:
                shutil.rmtree(top / name)
                raise


@contextlib.contextmanager
def _locked(directory: Path) -> Generator[None]:
    """Have others who make keys here wait, so that the server gets one secret only."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _write_pair(directory: Path, name: str) -> KeyPair:
    """Make keys and write both files; the public half is returned."""
    public, secret = zmq.curve_keypair()
    write_file(directory / (name + _PUBLIC_SUFFIX), _render(KeyPair(public)))
    # After the other one: where there is a secret, the pair is complete.
    path = directory / (name + _SECRET_SUFFIX)
    write_file(path, _render(KeyPair(public, secret)), mode=0o600)
    return KeyPair(public)


def read_client_keys(directory: str | os.PathLike[str]) -> ClientKeys:
    """Return the keys in a client's directory, which `make_keys` made.

    Raises:
        ConfigError: a file is missing or holds no key; the message names it.
    """
    public, secret = _read_secret_keys(Path(directory) / (_CLIENT + _SECRET_SUFFIX))
    return ClientKeys(
        public, secret, read_keys(Path(directory) / (_SERVER + _PUBLIC_SUFFIX)).public
    )


def read_server_keys(directory: str | os.PathLike[str]) -> ServerKeys:
    """Return the keys in a server's directory, which `make_keys` made.

    Raises:
        ConfigError: a file is missing or holds no key; the message names it.
    """
    _, secret = _read_secret_keys(Path(directory) / (_SERVER + _SECRET_SUFFIX))
    clients = Path(directory) / _ALLOWED
    if not clients.is_dir():
        raise ConfigError(f"{clients} is not a directory; the public keys of clients belong there")
    return ServerKeys(secret, clients)


def _read_secret_keys(path: Path) -> tuple[bytes, bytes]:
    keys = read_keys(path)
    if keys.secret is None:
        raise ConfigError(f"{path} has no line secret-key; `rlightning-aio keygen` makes keys")
    return keys.public, keys.secret


def read_keys(path: Path) -> KeyPair:
    """Return the keys in one file.

    Raises:
        ConfigError: it can't be read, or holds no key; the message names it.
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
    """Properties of a file; at least one changes when it is written."""

    modified_ns: int
    size: int
    inode: int


_UNSETTLED: Final = _Stamp(-1, -1, -1)
_TICK_NS: Final = 1_000_000_000


class AllowedKeys:
    """The owners of the keys that are now in a directory.

    `owner` compares the stamps of all files (a few microseconds for each), and reads files that
    have changed. A file that holds no key is skipped with one warning.

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
        """Return the name of the client with the public key `key` (Z85 text); None if unknown."""
        stamps = self._stamps()
        if stamps != {name: stamp for name, (stamp, _) in self._read.items()}:
            self._refresh(stamps)
        return self._owners.get(key)

    def is_known(self, key: bytes) -> bool:
        """Return True if `key` was a client's when the files were read last."""
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
        """Return the key in the file `name`; None, with a warning, if there is none."""
        path = self.directory / name
        try:
            if not name.isprintable():
                raise ConfigError(f"{str(path)!a} has a name that can't name a client")
            if not path.is_file():
                raise ConfigError(f"{path} is not a file")
            key = read_keys(path).public
        except ConfigError as error:
            if name not in self._faulty:
                self._faulty.add(name)
                _log.warning("%s; its client is not let in", error)
            return None
        self._faulty.discard(name)
        return key


def _render(keys: KeyPair) -> bytes:
    lines = ["# A key of rlightning-aio.", "curve", f'    public-key = "{keys.public.decode()}"']
    if keys.secret is not None:
        lines[0] = "# A key of rlightning-aio. SECRET: leave no copy where others can read it."
        lines.append(f'    secret-key = "{keys.secret.decode()}"')
    return "\n".join([*lines, ""]).encode()
