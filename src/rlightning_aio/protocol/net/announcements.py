"""What a client announces, checked: `announced` reads a hello.

Rule: whatever a hello contains, reading it costs only its description and ends in an
`Announcement` or a `Rejection` with the reason.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.protocol.net.payload import ResultLayout, SpaceLayout
from rlightning_aio.protocol.net.space_description import describe, space_from
from rlightning_aio.protocol.net.wire import MAX_HELLO_BYTES, VERSION, WireError
from rlightning_aio.types import ClientTraits, EnvMeta

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.protocol.net.wire import ClientHello


class Rejection(Exception):
    """A reason to refuse a client; `retry` if the same hello may succeed later."""

    def __init__(self, text: str, *, retry: bool = False) -> None:
        super().__init__(text)
        self.retry = retry


class ClientKind(NamedTuple):
    """Properties that all clients of one server share, so that their results stack."""

    observation_space: dict[str, Any]
    action_space: dict[str, Any]
    agents: tuple[str, ...]


class Announcement(NamedTuple):
    """The contents of a valid hello, and the layouts that follow from it."""

    kind: ClientKind
    meta: EnvMeta
    traits: ClientTraits
    results: ResultLayout
    actions: SpaceLayout


def announced(
    hello: ClientHello,
    size: int,
    kind: ClientKind | None,
    num_envs: int,
    objection: Callable[[EnvMeta], str | None],
) -> Announcement:
    """Return the contents of a hello whose header has `size` bytes.

    Args:
        hello: of a client.
        size: see above.
        kind: of the first client that was let in; None before.
        num_envs: sub-environments of each client's env, by the configuration.
        objection: returns the trainer's reason to refuse an env, or None.

    Raises:
        Rejection: it is invalid, or does not fit the other clients or the trainer.
    """
    if hello.version != VERSION:
        raise Rejection(f"this server speaks version {VERSION}, not {hello.version}")
    if size > MAX_HELLO_BYTES:
        raise Rejection(f"a hello has {size} bytes; {MAX_HELLO_BYTES} are allowed")
    if not hello.name.isprintable() or "/" in hello.name:
        raise Rejection("a client's name must be printable and without '/'")
    try:
        # The trainer may let its own arithmetic raise; a client's bounds must not.
        with np.errstate(all="ignore"):
            return _announcement(hello, kind, num_envs, objection)
    except WireError as error:
        raise Rejection(str(error)) from None
    # Gymnasium, NumPy and pydantic raise their own errors for unexpected inputs.
    except Exception as error:  # noqa: BLE001  # A peer's mistake must not end the trainer.
        raise Rejection(f"{type(error).__name__}: {error}") from None


def _announcement(
    hello: ClientHello,
    known: ClientKind | None,
    num_envs: int,
    objection: Callable[[EnvMeta], str | None],
) -> Announcement:
    observation_space = space_from(hello.observation_space)
    action_space = space_from(hello.action_space)
    kind = ClientKind(
        describe(observation_space, "observation"),
        describe(action_space, "action"),
        tuple(hello.agents),
    )
    if hello.num_envs != num_envs:
        raise WireError(
            f"its env has {hello.num_envs} sub-environments, and num_envs of the entry is "
            f"{num_envs}"
        )
    if known is not None and kind != known:
        raise WireError(
            "its spaces or agents differ from those of this server's first client; give each "
            "kind of env an env_server entry of its own"
        )
    if hello.agents:
        _check_agents(hello.agents, observation_space, action_space)
    meta = EnvMeta(
        env_id=hello.name,
        observation_space=observation_space,
        action_space=action_space,
        num_envs=hello.num_envs,
        agents=kind.agents,
        max_episode_steps=hello.max_episode_steps,
        autoreset=hello.autoreset,
    )
    if (reason := objection(meta)) is not None:
        raise WireError(reason)
    return Announcement(
        kind,
        meta,
        ClientTraits(hello.free_actions, hello.reads_extras, hello.hardware),
        ResultLayout(observation_space, hello.num_envs, hello.agents, hello.compression),
        SpaceLayout(action_space, "action"),
    )


def _check_agents(agents: list[str], *spaces: gym.Space[Any]) -> None:
    for space in spaces:
        if (
            not isinstance(space, gym.spaces.Dict)
            or [*cast("gym.spaces.Dict[Any]", space).spaces] != agents
        ):
            raise WireError("the spaces of a multi-agent env must be Dicts by agent")
