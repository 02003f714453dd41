"""What a snapshot is: the standings of some envs, with what must be the same where they go.

Rule: it is checked as a whole before anything is put back, and before anything in it is
unpickled: first its checksum, then, env by env, what the env is. Only workers unpickle.
Absent on purpose: a signature. Whoever can write the file can have a worker execute anything.
"""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec

from rlightning_aio.errors import SnapshotError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.types import EnvMeta

__all__ = ["EnvSnapshot", "check_same", "identity_of", "pack", "unpack"]

_BEGINNING: Final = b"rlightning-aio snapshot 1\n"
_DIGEST: Final = hashlib.sha256
_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")
_VERSION: Final = "version of "


class EnvSnapshot(msgspec.Struct, array_like=True):
    """One env of a snapshot.

    Attributes:
        env_id: of the env that it was taken of.
        identity: what must be the same where it goes, see `identity_of`.
        count, cut: of `auto_reset`: steps since the last reset, and whether its limit was
            reached by the last one.
        standing: where the env stands, a pickle.
    """

    env_id: str
    identity: dict[str, str]
    count: int
    cut: bool
    standing: bytes


def identity_of(config: EnvConfig, meta: EnvMeta, versions: Mapping[str, str]) -> dict[str, str]:
    """What tells an env from those that can't stand where it does, in words.

    Args:
        config: its entry.
        meta: what it told of itself.
        versions: of the libraries that it consists of, where it lives.
    """
    maker: Any = config.make_env
    maker = cast("tuple[Any, ...]", maker)[0] if isinstance(maker, tuple) else maker
    made_by = getattr(maker, "__qualname__", type(maker).__name__) if maker else config.task
    return {
        "backend": config.backend,
        "task": made_by,
        "env_kwargs": _ADDRESS.sub("", repr(sorted(config.env_kwargs.items()))),
        "num_envs": str(config.num_envs),
        "max_episode_steps": str(config.max_episode_steps),
        "observation space": _ADDRESS.sub("", str(meta.observation_space)),
        "action space": _ADDRESS.sub("", str(meta.action_space)),
        **{f"{_VERSION}{name}": version for name, version in versions.items()},
    }


def check_same(snapshot: EnvSnapshot, identity: Mapping[str, str], described: str) -> None:
    """Raise `SnapshotError` if a snapshot is of another env than the one that is `described`."""
    ours = snapshot.identity
    for name in {**ours, **identity}:
        if name.startswith(_VERSION) and not (name in ours and name in identity):
            continue  # One of them holds nothing of that library yet, as before its first reset.
        if ours.get(name) != identity.get(name):
            raise SnapshotError(
                f"the snapshot of {snapshot.env_id!r} can't be put into {described}: its {name} is "
                f"{ours.get(name, 'unknown')}, and here it is {identity.get(name, 'unknown')}; "
                "nothing was changed"
            )


def pack(snapshots: Sequence[EnvSnapshot]) -> bytes:
    """The bytes that `EnvGroup.snapshot` returns."""
    content = msgspec.msgpack.encode(snapshots)
    return b"".join((_BEGINNING, _DIGEST(content).digest(), content))


def unpack(data: bytes) -> list[EnvSnapshot]:
    """What was packed.

    Raises:
        SnapshotError: it is no snapshot, or was changed or cut since.
    """
    if not isinstance(data, bytes | bytearray | memoryview):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SnapshotError(
            f"a snapshot is the bytes that snapshot() returned, not a {type(data).__name__}"
        )
    data = bytes(data)
    start = len(_BEGINNING) + _DIGEST().digest_size
    if not data.startswith(_BEGINNING):
        raise SnapshotError(
            "these bytes are not a snapshot of this version of rlightning_aio: they don't start "
            "like one; nothing was changed"
        )
    if _DIGEST(data[start:]).digest() != data[len(_BEGINNING) : start]:
        raise SnapshotError(
            "the snapshot was changed or truncated since it was taken: its checksum doesn't "
            "match; read "
            "the file again, in binary; nothing was changed"
        )
    return msgspec.msgpack.decode(data[start:], type=list[EnvSnapshot])
