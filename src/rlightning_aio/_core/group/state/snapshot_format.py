"""The bytes of a snapshot: states of envs, and the identity of each env.

Rule: a snapshot is checked completely before anything is restored or unpickled: first its checksum,
then the identity of each env. Only workers unpickle.
Left out: a signature. A person who can write the file can make a worker execute any code.
"""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING, Final

import msgspec

from rlightning_aio.config import makers_of
from rlightning_aio.errors import SnapshotError
from rlightning_aio.registry import name_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.types import EnvMeta

_BEGINNING: Final = b"rlightning-aio snapshot 1\n"
_DIGEST: Final = hashlib.sha256
_START: Final = len(_BEGINNING) + _DIGEST().digest_size
_ADDRESS: Final = re.compile(r" at 0x[0-9a-f]+")


class EnvSnapshot(msgspec.Struct, array_like=True):
    """One env of a snapshot.

    Attributes:
        env_id: of the env when the snapshot was taken.
        identity: must be the same for the env that is restored, see `identity_of`.
        versions: of the libraries that it uses, which its worker compares.
        num_steps, is_cut: its `Position` in the episode.
        state: the pickled state of the env and its last result.
    """

    env_id: str
    identity: dict[str, str]
    versions: dict[str, str]
    num_steps: int
    is_cut: bool
    state: bytes


def identity_of(config: EnvConfig, meta: EnvMeta) -> dict[str, str]:
    """The properties, by name, that an env must share with one that it is restored from.

    Args:
        config: its entry.
        meta: of the env.
    """
    makers = makers_of(config)
    return {
        "backend": config.backend,
        "task": name_of(makers[0]) if makers else config.task_name,
        "env_kwargs": _ADDRESS.sub("", repr(sorted(config.env_kwargs.items()))),
        "num_envs": str(config.num_envs),
        "max_episode_steps": str(config.max_episode_steps),
        "observation space": _ADDRESS.sub("", str(meta.observation_space)),
        "action space": _ADDRESS.sub("", str(meta.action_space)),
    }


def check_same(snapshot: EnvSnapshot, identity: Mapping[str, str], described: str) -> None:
    """Raise `SnapshotError` if a snapshot's identity isn't `identity`, that of env `described`."""
    ours = snapshot.identity
    for name in {**ours, **identity}:
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
    """The inverse of `pack`.

    Raises:
        SnapshotError: `data` is not a snapshot, or was changed or truncated.
    """
    if not isinstance(data, bytes | bytearray | memoryview):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise SnapshotError(
            f"a snapshot is the bytes that snapshot() returned, not a {type(data).__name__}"
        )
    data, why = bytes(data), ""
    if not data.startswith(_BEGINNING):
        why = "doesn't start like one of this version of rlightning_aio"
    elif _DIGEST(data[_START:]).digest() != data[len(_BEGINNING) : _START]:
        why = "was changed or truncated since it was made: its checksum doesn't match"
    if why:
        raise SnapshotError(
            f"the snapshot {why}; read the file again, in binary; nothing was changed"
        )
    return msgspec.msgpack.decode(data[_START:], type=list[EnvSnapshot])
