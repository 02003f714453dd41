"""Clients of an env_server: what they lend, and what happens to them.

A client has a place of its own name, and lives in processes of the world, one after the other. To
the model it is a worker that starts itself: whatever may end its session counts as a death of its
host, and what a result may show then is what it may show after a death.
"""

from __future__ import annotations

import contextlib
from collections import deque
from typing import TYPE_CHECKING, Any

from simulator.model import Env, Host, State, require
from simulator.scripted import ScriptedBase

from rlightning_aio import EnvConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from simulator.model import Entry
    from simulator.network import ClientProcess
    from simulator.world import World

    from rlightning_aio import EnvRet, PolicyResponse

__all__ = ["Client"]


class Lent(ScriptedBase):
    """The env that a client lends, which notes what is done to it."""

    def __init__(self, client: Client) -> None:
        entry, code = client.env.entry, client.env.codes[0]
        kwargs = {"first_code": code, "layout": entry.layout, "controls": entry.controls}
        config = EnvConfig(name="lent", backend="simulated", task="-", env_kwargs=kwargs)
        super().__init__(config)
        self.is_finished = self.is_over = False
        self._client = client

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> EnvRet:
        before = State(self._client.env.codes, self._client.env.entry)
        before.scripts.subs = [self.env.scripts.subs[0]]
        self._client.befores.append(before.copy())
        self.is_over = False
        with self._ending():
            return super().reset(seed=seed, options=options)

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        act = self.act_of(policy_resp)
        if self.is_over:
            self._client.note_wrong("is stepped though its session is over")
        self._client.done.append(act)
        if act[0] == "hang":
            self._client.note_hang()
        with self._ending():
            return super().step(policy_resp)

    def on_disconnect(self) -> None:
        self.is_over = True

    @contextlib.contextmanager
    def _ending(self) -> Iterator[None]:
        """Note what ends the client: the server may hear of it before its process has ended."""
        try:
            yield
        except Exception:
            raise
        except BaseException:
            self._client.note_trouble()
            raise

    def is_finish(self) -> bool:
        return self.is_finished


class Client:
    """One client, by its name at the server.

    Args:
        number: among the clients of its server.
        entry: of that server.
        codes, first: of its env, as of any other.

    Attributes:
        name: at the server.
        env: what the model knows of its env.
        troubles: what has happened to it that may end a session.
        hangs: its env does not return any more.
        is_shown: it has shown a result, so it can be stepped.
        befores: the states in which it was reset since its last result was shown: a client that
            is lost goes on with its env, in another session.
        asked, done: steps that were sent, and that were executed, in order.
    """

    def __init__(
        self, world: World, number: int, entry: Entry, codes: list[int], first: int
    ) -> None:
        self.name = f"c{number}"
        self.troubles = 0
        host = Host(mortal=True, count=lambda: self.troubles, knows=False)
        env_id = f"{entry.name}-0/{self.name}"
        self.env = Env(env_id, entry, codes, first, host, State(codes, entry), client=self)
        self.asked: deque[tuple[str, int]] = deque()
        self.done: list[tuple[str, int]] = []
        self.befores: list[State] = []
        self.process: ClientProcess | None = None
        self.hangs = self.is_shown = False
        self._world = world
        self._lent: Lent | None = None

    @property
    def is_alive(self) -> bool:
        return self.process is not None and self.process.alive

    @property
    def is_leaving(self) -> bool:
        """It ends in order after the next request, at the latest."""
        return self.is_alive and self._lent is not None and self._lent.is_finished

    def start(self, address: str) -> None:
        """Start another process of it."""
        self._lent = lent = Lent(self)
        self.hangs = False
        self.process = self._world.network.client(
            lambda: lent, address, self.name, self.note_trouble
        )

    def revive(self, address: str) -> None:
        """Have it be there, and able to answer."""
        if (self.hangs or self.is_leaving) and self.process is not None:
            self.process.end(-9)
        if not self.is_alive:
            self.start(address)

    def leave(self) -> None:
        """Have it end in order, soon."""
        assert self._lent is not None
        self.note_trouble()
        self._lent.is_finished = True

    def note_trouble(self) -> None:
        """Note what may end a session."""
        self.troubles += 1

    def note_wrong(self, what: str) -> None:
        """Note what its env should not have been asked."""
        self._world.wrongs.append(f"client {self.name} {what}")

    def note_hang(self) -> None:
        """Note that its env does not return any more."""
        self.troubles += 1
        self.hangs = True

    def check_done(self) -> None:
        """What it was asked was done once at most, in order, and nothing else."""
        for act in self.done:
            while self.asked and self.asked[0] != act:
                self.asked.popleft()
            require(self.asked, "done, and not asked, or twice", self.env.env_id, act)
            self.asked.popleft()
