"""Clients of an env_server: what they lend, what happens to them, and what a group may show of it.

A client lives in processes of the world, one after the other, and has sessions with the server. As
a session begins, its env is reset, and that result answers no request. A session may end only if
something has happened to it: a broken connection, a stop or an end of the process, a request that
took too long, or the trainer's abort. Then its client's next result is marked, and what follows is
the first result of a later session.
"""

from __future__ import annotations

import contextlib
import itertools
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from simulator.model import COLLECTOR, Env, Host, Request, State, compare, require
from simulator.scripted import RAISING, ScriptedBase

from rlightning_aio import EnvConfig

if TYPE_CHECKING:
    from collections.abc import Iterator

    from simulator.model import Entry, Expected, Model, Row
    from simulator.network import ClientProcess
    from simulator.scripted import Script
    from simulator.world import World

    from rlightning_aio import EnvRet, PolicyResponse

__all__ = ["Client"]

_FIRST_CODE = 1024
"""Each process of a client has another code, so that their states differ."""


class Begun(NamedTuple):
    """A session: its env before the reset that begins it, and the client's troubles until then."""

    before: State
    troubles: int


class Lent(ScriptedBase):
    """The env that a client lends, which notes what is done to it."""

    def __init__(self, client: Client, code: int) -> None:
        entry = client.env.entry
        kwargs = {"first_code": code, "layout": entry.layout, "controls": entry.controls}
        config = EnvConfig(name="lent", backend="simulated", task="-", env_kwargs=kwargs)
        super().__init__(config)
        self.is_finished = False
        self._client = client
        self._troubles: int | None = client.troubles

    @property
    def script(self) -> Script:
        return self.env.scripts.subs[0]

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> EnvRet:
        if self._troubles is None:
            self._client.done.append(("reset", 0))
        else:
            before = State([self.script.code], self._client.env.entry)
            before.scripts.subs = [self.script]
            self._client.sessions.append(Begun(before.copy(), self._troubles))
            self._troubles = None
        with self._ending():
            return super().reset(seed=seed, options=options)

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        act = self.act_of(policy_resp)
        self._client.done.append(act)
        if act[0] == "hang":
            self._client.note_hang()
        with self._ending():
            return super().step(policy_resp)

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

    def on_disconnect(self) -> None:
        self._troubles = self._client.troubles

    def is_finish(self) -> bool:
        return self.is_finished


class Client:
    """One client, by its name at the server.

    Args:
        number: among the clients of its server.
        entry: of that server.

    Attributes:
        name: at the server.
        env: what the model knows of its env.
        sessions: that have begun at the client.
        session: whose results the trainer has got last; -1 before the first.
        is_in: it may go on; is_out: the trainer may know that it has ended. After an abort, both
            are true.
        is_known: the trainer has its id; last: the observation that it has got last.
        withdrawn: what was sent to it since it was out.
        dropped: requests that were aborted since its last result, which it may have executed.
        troubles: what has happened to it that may end a session.
        hangs: its env does not return any more.
        asked, done: steps and resets that were sent, and that were executed, in order.
    """

    def __init__(self, world: World, number: int, entry: Entry) -> None:
        self.name = f"c{number}"
        codes, host = [_FIRST_CODE + 256 * number], Host(mortal=False)
        env_id, state = f"{entry.name}-0/{self.name}", State(codes, entry)
        self.env = Env(env_id, entry, codes, -1, host, state, client=self)
        self.sessions: list[Begun] = []
        self.session = -1
        self.is_in = self.is_known = False
        self.is_out = True
        self.last = state.scripts.words
        self.withdrawn: dict[str, Any] | None = None
        self.dropped: list[Request] = []
        self.troubles = 0
        self.asked: deque[tuple[str, int]] = deque()
        self.done: list[tuple[str, int]] = []
        self.process: ClientProcess | None = None
        self.hangs = False
        self._world = world
        self._lent: Lent | None = None
        self._code = codes[0]

    # -- the client -----------------------------------------------------------------

    @property
    def is_alive(self) -> bool:
        return self.process is not None and self.process.alive

    @property
    def is_leaving(self) -> bool:
        """It ends in order after the next request, at the latest."""
        return self.is_alive and self._lent is not None and self._lent.is_finished

    def is_code(self, code: int) -> bool:
        """Return True if one of its processes has this code."""
        return self.env.codes[0] < code <= self._code

    def start(self, address: str) -> None:
        """Start another process of it."""
        self._code += 1
        self._lent = lent = Lent(self, self._code)
        self.hangs = False
        self.process = self._world.network.client(
            lambda: lent, address, self.name, self.note_trouble
        )

    def leave(self) -> None:
        """Have it end in order, soon."""
        assert self._lent is not None
        self.note_trouble()
        self._lent.is_finished = True

    def note_trouble(self) -> None:
        """Note what may end a session."""
        self.troubles += 1

    def note_hang(self) -> None:
        """Note that its env does not return any more."""
        self.troubles += 1
        self.hangs = True

    # -- what the trainer may see ---------------------------------------------------

    @property
    def may_be_lost(self) -> bool:
        """The session that the trainer knows may have ended."""
        return self.is_out or self.troubles > self.sessions[self.session].troubles

    @property
    def may_be_back(self) -> bool:
        return self.session + 1 < len(self.sessions)

    def note_pending(self, *, is_pending: bool) -> None:
        """Note whether a result of it waits or is awaited, which may be without a request."""
        request = self.env.request
        if is_pending and request is None:
            require(self.may_be_back, "pending, and nobody has asked or come", self.env.env_id)
            self.is_known = True
            self.env.request = Request("join", sent=self.withdrawn)
        elif not is_pending and request is not None and request.owner == COLLECTOR:
            gone = self.is_out or (request.resets and self.may_be_lost)
            require(gone and request.kind != "join", "nobody answers", self.env.env_id, request)
            self.withdraw(request)

    def withdraw(self, request: Request) -> None:
        """Note that it is away: its next first result answers the request."""
        self.withdrawn, self.env.request = request.sent, None
        self.is_in, self.is_out = False, True

    def note_away(self, request: Request) -> None:
        """Check an error that says that it is not connected."""
        self.is_known = True
        gone = self.is_out or (request.resets and self.may_be_lost)
        require(gone, "away, and its loss was not reported", self.env.env_id, request)
        self.withdrawn = None if self.withdrawn is None else request.sent
        self.is_in, self.is_out = False, True

    def note_raised(self, request: Request) -> None:
        """Note that its env has raised: in a reset perhaps in a session that shows nothing else."""
        env, self.is_known = self.env, True
        firsts = self._firsts()
        if request.resets and not self.is_in:
            require(firsts, "it has raised, and was not back", env.env_id, request)
            env.adopt(firsts.pop(0))
            self.session, self.last = self.session + 1, env.state.scripts.words
            self.is_in, self.is_out, self.withdrawn = True, False, None
        if request.resets:
            env.loose += firsts

    def _firsts(self) -> list[State]:
        """The states that begin the sessions after the one that the trainer knows."""
        firsts = [begun.before.copy() for begun in self.sessions[self.session + 1 :]]
        for state in firsts:
            state.play(Request("reset"))
        return firsts

    def note_aborted(self) -> None:
        """Note that the trainer has dropped a result, or has ended the session."""
        request, self.env.request = self.env.request, None
        if request is not None and request.kind != "join":
            states = [self.env.state, *self.env.loose]
            for state, one in itertools.product(states, request.alternatives()):
                done = state.copy()
                done.play(one)
                done.count = state.count if request.kind == "step" else 0
                self.env.loose.append(done)
            self.dropped.append(request)
        self.troubles += 1
        # A first result answers a step, too.
        self.is_in |= request is not None and (request.kind == "join" or self.may_be_back)
        self.is_out, self.withdrawn = True, None

    def judge(self, model: Model, request: Request, row: Row) -> None:
        """Compare a result with what was asked of its env, and with what it has done."""
        env = self.env
        if "client_lost" in row.info:
            self._judge_lost(model, request, row)
            return
        played = list(self._played(model, request))
        found = [one for one in played if one[2].outcome.words == row.words]
        require(found, "in none of the states", [tuple(one[2].outcome.words[0]) for one in played])
        number, state, expected = found[0]
        is_step = number == self.session and not request.resets
        effects = [effect for effect, _ in request.acts] if is_step else []
        require(not {*effects} & {*RAISING, "rubbish"}, "a result where there is none")
        if env.first < 0 and row.index is not None:
            others = [other.first + len(other.codes) for other in model.envs.values()]
            require(row.index[0] not in [n - 1 for n in others], "the index of another", row.index)
            env.first = row.index[0]
        compare(env, expected, row)
        env.episodes += [episode for episode in expected.episodes if episode is not None]
        model.counts["first results"] += number != self.session
        self.session, self.is_in, self.is_out, self.withdrawn = number, True, False, None
        self.is_known, self.last, self.dropped = True, row.words, []
        env.adopt(state)

    def _played(self, model: Model, request: Request) -> Iterator[tuple[int, State, Expected]]:
        """How a result may have come about: of which session it is, and the state after it."""
        limit = model.limit_of(self.env)
        if self.is_in and request.kind != "join":
            for one in request.alternatives():
                for state in map(State.copy, (self.env.state, *self.env.loose)):
                    yield self.session, state, state.play(one, limit)
        is_plain = request.seed is None and not request.options and not request.seeds
        for number in range(self.session + 1, len(self.sessions)):
            state = self.sessions[number].before.copy()
            first = state.play(Request("reset"))
            if self.is_out or (is_plain and request.resets):
                yield number, state, first
            is_due = request.resets or (self.is_out and model.context is not None)
            # Its first result was dropped.
            was_dropped = self.is_in and self.is_out and request.kind != "join"
            ways = [{"due": True}] * is_due + [{}] * was_dropped
            for one, way in itertools.product(request.alternatives(), ways):
                for again in self._after_dropped(state):
                    yield number, again, again.play(replace(one, **way), limit)

    def _after_dropped(self, state: State) -> Iterator[State]:
        """The states after each end of what was dropped, which may have come to this session."""
        each = [request.alternatives() for request in self.dropped]
        for begin in range(len(each) + 1):
            for requests in itertools.product(*each[begin:]):
                again = state.copy()
                for request in requests:
                    again.play(request)
                yield again

    def _judge_lost(self, model: Model, request: Request, row: Row) -> None:
        # A reset may be sent to one that is about to come back.
        require(self.is_in or request.resets, "lost again, and it was not back")
        require(self.may_be_lost, "lost, and nothing has happened to it", self.troubles)
        model.judge_heads(row, "client_lost")
        seen = [self.last, *(state.scripts.words for state in self.env.loose)]
        if request.resets or self.is_out:  # Which may have dropped a first result.
            seen += [expected.outcome.words for _, _, expected in self._played(model, request)]
            ends = (self._after_dropped(state) for state in self._firsts())
            seen += [end.scripts.words for end in itertools.chain.from_iterable(ends)]
        require(row.words in seen, "not its last observation", seen)
        self.is_in, self.is_out, self.env.dirty, self.withdrawn = False, True, False, None
        model.counts["clients lost"] += 1

    def check_done(self) -> None:
        """What it was asked was done once at most, in order, and nothing else."""
        for act in self.done:
            while self.asked and self.asked[0] != act:
                self.asked.popleft()
            require(self.asked, "done, and not asked, or twice", self.env.env_id, act)
            self.asked.popleft()
