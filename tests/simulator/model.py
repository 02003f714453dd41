"""What a group must answer: one plain list of envs, each stepped as Gymnasium says.

Written from the contract and docs/, not from the code. A request is played when its result has
come, on a copy of what is known of its env, and the two are compared. Only deaths leave a choice:
an env whose worker may have died may also answer as one that was built anew, and the model then
adopts what it shows.
"""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from simulator.scripted import (
    DYING,
    RAISING,
    TIMEOUT,
    UNLOADABLE,
    Act,
    Outcome,
    Scripts,
    Words,
    blame_of,
    element,
    slow_seconds,
    words_of,
)

from rlightning_aio.errors import EnvAway, EnvHung, EnvRaised, WorkerDied

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Callable, Iterable, Sequence

    from simulator.clients import Client

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.errors import EnvFault

MARKS = {"worker_restarted", "client_lost"}
AGAIN = ", and was replaced)"
"""So goes on what is said of an exception in a reset that was to report a loss."""
COLLECTOR = "collector"
"""Owner of the requests whose results a collect returns."""


class Violation(AssertionError):
    """A group broke its contract."""


def require(true: Any, what: str, *details: object) -> None:
    """Raise `Violation` unless a condition is true."""
    if not true:
        raise Violation(": ".join([what, ", ".join(map(str, details))]) if details else what)


@dataclass
class Entry:
    """What the model must know of an entry of the configuration."""

    name: str
    form: str
    layout: str
    controls: str
    num_envs: int
    mode: str
    limit: int | None
    on_death: str
    max_restarts: int
    on_error: str

    @property
    def own_limit(self) -> float:
        """Steps after which an env truncates its episodes by itself, as `TimeLimit` does."""
        return self.limit if self.limit and self.form in ("gym", "stacked") else math.inf


class Host:
    """Envs that die together.

    Args:
        mortal: it is another process, or its envs are replaced alone.
        count: counts its deaths; None if only those that were asked for are known.
        knows: which env's code it executes; an actor knows no more than the batch.

    Attributes:
        struck: it was killed from outside; aborted: perhaps by an abort, for which it is replaced.
        raised: one of its deaths was, or was dropped by a reset of all envs.
        renewed: some of its envs may be in the next process already, and live on.
    """

    def __init__(
        self,
        *,
        mortal: bool,
        count: Callable[[], int] | None = None,
        knows: bool = True,
        renewed: bool = False,
    ) -> None:
        self.renewed = renewed
        self.mortal = mortal
        self.knows = knows
        self._count = count
        self._asked = 0
        self.struck = self.aborted = self.raised = False

    @property
    def deaths(self) -> int:
        """How many there may have been."""
        return self._asked if self._count is None else self._count()

    def ask(self) -> None:
        """Note that it is about to die, or to hang until it is killed."""
        self._asked += 1


@dataclass
class Request:
    """What an env was asked, and by whom.

    Attributes:
        kind: ``step``, ``reset``, ``restore`` (a reset to a saved state), or ``call``.
        saved: the state to which it is restored: one of these.
        acts: of a step, one for each sub-environment.
        due: `auto_reset` resets the env in place of its step.
        sent: the policy's columns, one value of each; None if it was no response.
        kills: it ends the worker, unless that ends before.
        interrupted: Ctrl-C may have ended it, in an env of this process.
        deaths: of the host, before it was sent.
        before: whether the env was in limbo before it was sent.
    """

    kind: str
    owner: Any = COLLECTOR
    acts: Sequence[Act] = ()
    seed: int | None = None
    options: dict[str, Any] | None = None
    due: bool = False
    sent: dict[str, Any] | None = None
    kills: bool = False
    interrupted: bool = False
    deaths: int = 0
    before: bool = False
    saved: Sequence[State] = ()

    @property
    def resets(self) -> bool:
        return self.kind == "reset" or self.due


class Expected(NamedTuple):
    """What a played request shows, and what it cut."""

    outcome: Outcome
    limit: bool
    truncated: list[bool]
    episodes: list[tuple[float, int] | None]


class State:
    """An env, its place in the episode, and the sums of its episodes.

    Attributes:
        count: steps since the reset, as returned; cut: the step limit was reached there.
        forgotten: a context was left since its last result, and nothing is due any more.
        counted: which sub-environments are within an episode.
        begun: seed and options of the reset that began the episode.
        infos, finals: as reported with the last result; no infos if they aren't known.
    """

    def __init__(self, codes: Sequence[int], entry: Entry) -> None:
        self.scripts = Scripts(codes, entry.mode, entry.own_limit)
        self.count, self.cut, self.forgotten = 0, False, False
        self.returns, self.lengths = [0.0] * len(codes), [0] * len(codes)
        self.counted = [False] * len(codes)
        self.begun: tuple[int | None, dict[str, Any] | None] = None, None
        self.infos: list[dict[str, Any]] = []
        self.finals: list[Words | None] = [None for _ in codes]

    def copy(self) -> State:
        found = copy.copy(self)
        found.scripts = copy.copy(self.scripts)
        found.scripts.subs = []
        for sub in self.scripts.subs:
            twin = object.__new__(type(sub))
            vars(twin).update(vars(sub))
            twin.draws = copy.copy(sub.draws)
            found.scripts.subs.append(twin)
        for name in ("returns", "lengths", "counted"):
            setattr(found, name, list(getattr(self, name)))
        return found

    def marked(self, mark: int) -> State:
        """The same with another `mark`."""
        found = self.copy()
        for sub in found.scripts.subs:
            sub.mark = mark
        return found

    @property
    def ended(self) -> bool:
        """All episodes have ended, and the env resets none of them by itself."""
        over = all(sub.over for sub in self.scripts.subs)
        return self.scripts.mode == "disabled" and over and not self.forgotten

    @property
    def refuses(self) -> bool:
        """The next snapshot is refused."""
        return any(sub.refuses for sub in self.scripts.subs)

    @refuses.setter
    def refuses(self, refuses: bool) -> None:
        for sub in self.scripts.subs:
            sub.refuses = refuses

    def faults(self, request: Request) -> list[Act]:
        """What the request does to the process of the env."""
        if request.kind in ("restore", "call"):
            return []
        if request.resets:
            return self.scripts.faults_of_reset(request.options)
        return self.scripts.faults_of_step(request.acts)

    def play(self, request: Request, limit: float = math.inf) -> Expected:
        """Do what was asked, under the limit of the `auto_reset` context that is open."""
        subs, mode = self.scripts.subs, self.scripts.mode
        self.forgotten = False
        many = range(len(subs))
        nothing = [0.0 for _ in many], [False for _ in many], [False for _ in many]
        if request.kind == "restore":
            outcome = Outcome(
                self.scripts.words, *nothing, [True for _ in many], self.finals, self.infos
            )
            return Expected(outcome, False, nothing[1], [None for _ in many])
        self.faults(request)  # Grudges are over.
        if request.resets:
            infos = self.scripts.reset(request.seed, request.options)
            self.count, self.cut, self.infos = 0, False, infos
            self.begun = request.seed, request.options
            self.finals = [None for _ in many]
            self.returns, self.lengths = [0.0 for _ in many], [0 for _ in many]
            self.counted = [True for _ in many]
            outcome = Outcome(
                self.scripts.words, *nothing, [True for _ in many], [None for _ in many], infos
            )
            return Expected(outcome, False, nothing[1], [None for _ in many])
        outcome = self.scripts.step(request.acts)
        self.infos, self.finals = outcome.infos, outcome.finals
        ends = [t or c for t, c in zip(outcome.terminated, outcome.truncated, strict=True)]
        self._count(outcome, ends)
        if all(outcome.resets) or (mode != "disabled" and all(ends or [])):
            self.count = 0
        else:
            self.count += 1
        cut = self.count >= limit
        self.cut |= cut
        truncated = [t or cut for t in outcome.truncated]
        episodes = [
            (self.returns[k], self.lengths[k]) if (ends[k] or cut) and self.lengths[k] else None
            for k in many
        ]
        return Expected(outcome, cut, truncated, episodes)

    def _count(self, outcome: Outcome, ends: Sequence[bool]) -> None:
        """Add a step to the sums; steps between an end and a reset belong to no episode."""
        mode = self.scripts.mode
        for k, reset in enumerate(outcome.resets):
            if reset or (mode == "same_step" and not self.counted[k]):
                self.returns[k], self.lengths[k], self.counted[k] = 0.0, 0, True
            if self.counted[k] and not reset:
                self.returns[k] += outcome.rewards[k]
                self.lengths[k] += 1
            else:
                self.lengths[k] = 0
            self.counted[k] = self.counted[k] and not ends[k]


@dataclass
class Env:
    """An env of the group, as far as its results are known.

    Attributes:
        codes: of its sub-environments.
        first: its first place in `batch.index`.
        limbo: the call that it executes may have been given up.
        deadly: its code was to end its worker, or to hang until that is ended; or it was aborted.
        kept: aborted requests that may have ended in an error before; a collect still raises that.
        dirty: its last result could not be read, so its episode must end.
        hangs: how often it was to hang and be replaced alone, as awaitable envs are.
        exceptions: how often it may have raised, where it is then rebuilt.
        errors: of these since it last completed a step: at least and at most as many.
        put_away: it has raised, and is rebuilt before it does anything else; perhaps: unless a
            Ctrl-C came before that.
        lost: its episode surely is, which its next result says, unless that is a restore's.
        seen: `deaths` that its results have shown.
        loose: states of which it may have one, because a call was given up; torn: the same of a
            restore that failed, after which only a marked result, or one of a reset or a restore,
            may come from them.
        episodes: return and length of each that has ended.
        client: that lends it, if one does.
    """

    env_id: str
    entry: Entry
    codes: Sequence[int]
    first: int
    host: Host
    state: State
    request: Request | None = None
    limbo: bool = False
    deadly: bool = False
    kept: list[Request] = field(default_factory=list)
    dirty: bool = False
    hangs: int = 0
    exceptions: int = 0
    errors: tuple[int, int] = (0, 0)
    put_away: bool = False
    perhaps: bool = False
    lost: bool = False
    seen: int = 0
    loose: list[State] = field(default_factory=list)
    torn: list[State] = field(default_factory=list)
    episodes: list[tuple[float, int]] = field(default_factory=list)
    client: Client | None = None

    @property
    def idle(self) -> bool:
        return self.request is None

    @property
    def may_be_lost(self) -> bool:
        return self.deaths > self.seen or bool(self.torn)

    @property
    def deaths(self) -> int:
        """How often its host may have died, or the env been replaced alone."""
        return self.host.deaths + self.hangs

    @property
    def losses(self) -> int:
        """How often its episode may have been lost."""
        return self.deaths + self.exceptions

    @property
    def was_reset(self) -> bool:
        is_shown = self.client is None or self.client.is_shown
        return is_shown and self.state.scripts.subs[0].episode > 0

    def fresh(self) -> State:
        return State(self.codes, self.entry)

    def after_loss(self) -> list[State]:
        """The states in which a replacement may be."""
        if self.client is not None:
            return [state.copy() for state in self.client.befores]
        states = [state.copy() for state in (*self.loose, *self.torn)] + [self.fresh()]
        # Its mark may have been set since then.
        marks = {one.scripts.subs[0].mark for one in (self.state, *self.loose)}
        return states + [state.marked(mark) for state in states for mark in sorted(marks)]

    def adopt(self, state: State, *others: State) -> None:
        """Note the state that it has shown, and others that show the same but for their mark."""
        mark = state.scripts.subs[0].mark
        if self.client is not None:
            self.client.befores.clear()
        self.state, self.dirty, self.torn = state, False, []
        self.put_away = self.perhaps = self.lost = False
        self.loose = [other for other in others if other.scripts.subs[0].mark != mark]

    def possible(self) -> list[State]:
        """The states that it may have."""
        is_lost = self.lost or self.may_be_lost
        return [self.state, *(self.after_loss() if is_lost else self.loose)]


class Row(NamedTuple):
    """One result; each list has one value for each sub-environment."""

    env_id: str
    words: list[Words]
    rewards: list[float]
    terminated: list[bool]
    truncated: list[bool]
    resets: list[bool] | None
    limit: list[bool] | None
    restarted: list[bool] | None
    index: list[int] | None
    info: dict[str, Any]
    sent: dict[str, Any] | None


@dataclass
class Context:
    """An open `auto_reset`."""

    limit: float | None
    on_done: bool

    def limit_of(self, env: Env) -> float:
        if self.limit is not None:
            return self.limit
        return (
            math.inf if env.entry.limit is None or env.entry.mode != "disabled" else env.entry.limit
        )


class Model:
    """The envs of a group, and the `auto_reset` that is open.

    Args:
        envs: of the group, in its order.
        counts: what comes of requests.
        starts_fail: replacements may fail, which counts as deaths that nobody sees.
        calm: workers end only as they are told to.
    """

    def __init__(
        self, envs: Iterable[Env], counts: Counter[str], *, starts_fail: bool, calm: bool
    ) -> None:
        self.counts = counts
        self.starts_fail = starts_fail
        self.calm = calm
        self.envs = {env.env_id: env for env in envs}
        self.context: Context | None = None

    # -- requests

    def idle(self) -> list[Env]:
        return [env for env in self.envs.values() if env.idle]

    def pending(self, *owners: Any) -> list[Env]:
        """Envs that owe something, to these owners if any are given."""
        return [
            env
            for env in self.envs.values()
            if env.request is not None and (not owners or env.request.owner in owners)
        ]

    def send(self, env: Env, request: Request) -> None:
        """Note a request that was accepted."""
        require(env.idle, "a busy env was asked again", env.env_id)
        request.before, request.deaths = env.limbo, env.deaths
        context = self.context
        if env.client is not None:
            env.client.asked.extend(request.acts)
        if request.kind == "step" and context is not None:
            request.due = env.state.cut or (context.on_done and env.state.ended)
        acts = env.state.copy().faults(request)
        effects = [effect for effect, _ in acts]
        request.kills = any(effect in (*DYING, "hang") for effect in effects)
        slowness = sum(slow_seconds(token) for effect, token in acts if effect == "slow")
        env.deadly |= request.kills or slowness > TIMEOUT / 2
        if request.kills and env.entry.form == "awaitable" and "hang" in effects:
            env.hangs += 1
        elif request.kills:
            env.host.ask()
        env.request, env.limbo = request, False

    def withdraw(self, env: Env) -> None:
        """Note that its request was not accepted after all."""
        assert env.request is not None
        env.limbo, env.request = env.request.before, None

    def orphan(self, owner: Any) -> None:
        """Note that a call no longer waits: its results go to the collector, its values nowhere."""
        for env in self.pending(owner):
            assert env.request is not None
            if env.request.kind == "call":
                env.request, env.limbo = None, True
            else:
                env.request.owner = COLLECTOR

    def abort(self, env: Env) -> None:
        """Note that nobody gets what a request leads to: it may have been done, or its env lost."""
        if env.client is not None:  # It may be sent away for that.
            env.client.note_trouble()
        before = [env.state.copy(), env.fresh(), *env.after_loss()]
        # Without a request it was a call that was given up before.
        done = [] if env.request is None else [env.request, Request("reset")]
        env.loose = list(before)
        for request, state in itertools.product(done, before):
            env.loose.append(state.copy())
            env.loose[-1].play(request)
        if env.request is not None:
            env.kept.append(env.request)
            env.lost = env.client is None or env.client.is_shown
        env.request, env.limbo, env.dirty, env.deadly = None, False, True, True
        env.errors = 0, env.errors[1] + 1
        env.host.aborted = True
        self.counts["aborted"] += 1

    # -- results

    def take(self, rows: Iterable[Row], owner: Any) -> None:
        """Compare results with what was asked."""
        for row in rows:
            env = self.envs.get(row.env_id)
            require(env is not None, "a result of a stranger", row)
            assert env is not None
            request = env.request
            require(request is not None, "a result that nobody asked for", row)
            assert request is not None
            require(request.owner == owner, "a result for another call", owner, request, row)
            try:
                self._judge(env, request, row)
            except Violation as violation:
                raise Violation(
                    f"{violation}\n  env {env.env_id}, {env.state.scripts.words}"
                    f"\n  {request}\n  {row}"
                ) from None
            env.request = None
            self.counts["results"] += 1

    def _judge(self, env: Env, request: Request, row: Row) -> None:
        restarted, was_shown = row.restarted, env.client is None or env.client.is_shown
        if restarted is None:
            restarted = [bool(row.info.keys() & MARKS)] * len(row.words)
        require(len(set(restarted)) == 1, "restarted in part")
        _check_sent(env, request, row)
        if env.client is not None:
            require(restarted[0] == ("client_lost" in row.info), "marked, or not", row)
            require(request.kind != "reset" or "client" in row.info, "of no client", row)
            own = {name: value for name, value in row.info.items() if name != "client"}
            row = row._replace(info=own)
            env.client.is_shown = True
        if request.kind == "restore":
            require(not restarted[0], "a restore is marked")
            self._judge_restored(env, request, row)
            return
        if restarted[0] and row.info.get("worker_restarted", "")[:7] == "raised ":
            self._judge_restarted(env, request, row)
            return
        if restarted[0]:
            self._judge_marked(env, request, row)
            return
        require(not env.lost and (not env.put_away or env.perhaps), "lost, and not marked")
        states = [env.state, *env.loose]
        if not was_shown:  # It had nothing to lose.
            states = env.possible()
        marks = {state.scripts.subs[0].mark for state in states}
        if request.resets and env.host.renewed and UNLOADABLE in marks:
            states.append(env.fresh())  # Its next worker can't take its generators over.
        limit = self.limit_of(env)
        now = [state.copy() for state in states]
        played = [state.play(request, limit) for state in now]
        found = [k for k, expected in enumerate(played) if expected.outcome.words == row.words]
        require(found, f"another state than {self._played(env, request)}")
        endless = {*RAISING, *DYING, "hang", "rubbish"}
        acts = [{effect for effect, _ in state.copy().faults(request)} for state in states]
        found = [k for k in found if not acts[k] & endless]
        require(found, "a result where there is none")
        compare(env, played[found[0]], row)
        env.adopt(*[now[k] for k in found])
        if request.kind == "step" and not request.due:
            env.errors = 0, 0
        expected = played[found[0]]
        env.episodes += [episode for episode in expected.episodes if episode is not None]

    def _judge_restored(self, env: Env, request: Request, row: Row) -> None:
        """Check the result of an env that was put into a saved state."""
        states = [state.copy() for state in request.saved]
        played = [state.play(request) for state in states]
        found = [k for k, expected in enumerate(played) if expected.outcome.words == row.words]
        require(found, "another state than was saved", [state.scripts.words for state in states])
        compare(env, played[found[0]], row)
        env.adopt(*[states[k] for k in found])
        if self.context is None:
            env.state.cut = False
        self.counts["restored"] += 1

    def limit_of(self, env: Env) -> float:
        return math.inf if self.context is None else self.context.limit_of(env)

    def _played(self, env: Env, request: Request) -> list[Words]:
        return env.state.copy().play(request).outcome.words

    def _raising(self, env: Env, request: Request) -> list[Act]:
        """What of a request an env may raise."""
        request = self._executed(env, request)
        asked = [(state, request) for state in (env.state, *env.loose)]
        for state in env.torn:  # A new episode in place of the step.
            asked.append((state, Request("reset")))
            if request.resets:  # Sent when the loss was known.
                asked.append((state, request))
            elif env.entry.form == "awaitable":
                asked.append((state, self._begun_again(env, request)))
        if env.lost and request.resets:  # Its replacement knows nothing of what was before.
            asked.append((env.fresh(), request))
        if env.entry.form == "awaitable" and env.may_be_lost:  # Its last reset may have raised.
            asked.append((env.fresh(), self._begun_again(env, request)))
        acts: list[Act] = []
        for state, one in asked:  # They stay as they are.
            each = state.copy().faults(one)
            raised = [act for act in each if act[0] in RAISING]
            acts += raised[:1] or [act for act in each if act[0] == "rubbish"]
        return acts

    def _executed(self, env: Env, request: Request) -> Request:
        """What an env does for a request: one that was put away begins again."""
        begins = env.put_away and request.kind == "step"
        return self._begun_again(env, request) if begins else request

    def _begun_again(self, env: Env, request: Request) -> Request:
        """The reset that follows an exception; an awaitable env begins the same episode again."""
        if env.entry.form != "awaitable":
            return Request("reset")
        seed, options = (request.seed, request.options) if request.resets else env.state.begun
        return Request("reset", seed=seed, options=options)

    def _judge_restarted(self, env: Env, request: Request, row: Row) -> None:
        """Check the result of an env that has raised and was rebuilt."""
        require(env.entry.on_error == "restart", "restarted, where exceptions are raised")
        self.judge_heads(row)
        require(row.info["env_at_fault"] == env.env_id, "another env has raised", row.info)
        if not env.put_away:
            require(self._raising(env, request), "restarted, and nothing has raised")
            env.errors = env.errors[0] + 1, env.errors[1] + 1
            require(env.errors[0] <= env.entry.max_restarts, "restarted once too often")
        again = [self._begun_again(env, request)]
        if env.put_away and request.kind == "reset":
            again.append(request)
        states = [env.state, *env.loose] if env.put_away else [env.fresh()]
        found = _shown(states, again, row)
        require(found, "not as rebuilt", again)
        env.adopt(found[0])
        self.counts["restarted after an exception"] += 1

    def _put_away(self, env: Env, request: Request) -> None:
        """Check an exception that no restart follows at once."""
        retried = env.entry.form == "awaitable" and request.resets
        most = env.entry.max_restarts + 1 if retried else env.errors[1] + 1
        spent = most + env.deaths > env.entry.max_restarts
        require(spent, "raised, with restarts left", env.errors)
        env.errors = (most if not env.deaths else 0), max(most, env.errors[1] + 1)
        begun = self._begun_again(env, request)
        env.state = env.fresh()
        env.state.begun = begun.seed, begun.options
        env.loose, env.torn = [], []
        env.put_away, env.perhaps = True, False
        self.counts["exceptions past max_restarts"] += 1

    def judge_heads(self, row: Row, cause: str = "worker_restarted") -> None:
        """Check that a result is marked in all ways."""
        require(isinstance(row.info.get(cause), str), "marked without a cause")
        many = len(row.words)
        heads = row.rewards, row.terminated, row.truncated
        require(heads == ([0.0] * many, [False] * many, [True] * many), "not marked in all ways")
        for column, value in ((row.resets, True), (row.limit, False)):
            require(column in (None, [value] * many), "not marked in all ways")
        require("episode" not in row.info, "an episode that was lost")

    def _judge_marked(self, env: Env, request: Request, row: Row) -> None:
        if not (env.torn or env.lost):
            failed_start = self.starts_fail and row.info["outcome"].kind == "not_started"
            may_be_lost = env.may_be_lost or failed_start
            require(env.host.mortal and may_be_lost, "marked, and nothing has died")
            is_known = env.entry.on_death != "raise" or env.host.aborted or env.host.raised
            owed = [e for e in self.envs.values() if e.host is env.host and e.request]
            is_known |= len(owed) > 1  # Another's error may still have to be raised.
            require(is_known, "marked, where a death is to be raised")
        cause = "worker_restarted" if env.client is None else "client_lost"
        self.judge_heads(row, cause)
        self._judge_blame(env, row.info.get("env_at_fault"))
        again = [Request("reset")]
        if env.entry.form == "awaitable":  # One that hung begins the same episode again.
            seed, options = (request.seed, request.options) if request.resets else env.state.begun
            again.append(Request("reset", seed=seed, options=options))
        if request.kind == "reset":  # What was lost was lost before it.
            again.append(request)
        raised = self._may_be_rebuilt(env, request)  # Before that.
        env.errors = env.errors[0], self._most_errors(env)
        found = _shown([*env.after_loss(), *[env.fresh()] * raised], again, row)
        require(found, "marked, in no state that it may have")
        was_idle = request.deaths > env.seen
        known = env.torn or env.lost
        env.seen = min(max(env.seen + (not known), request.deaths), env.deaths)
        env.adopt(*found)
        self.counts["died"] += 1
        self.counts["died while idle"] += was_idle
        self.counts["hung"] += row.info[cause].startswith("hung")

    def _judge_blame(self, env: Env, at_fault: str | None) -> None:
        """Check who is said to have ended the worker of an env."""
        host = env.host
        together = [one for one in self.envs.values() if one.host is host]
        if at_fault is not None:
            own = at_fault in self.envs and self.envs[at_fault].host is host
            require(own, "a stranger is blamed", at_fault)
        if self.calm and host.knows and not (host.struck or env.torn or env.lost):
            waits = env.entry.form == "awaitable" and len(together) > 1
            deadly = waits if at_fault is None else self.envs[at_fault].deadly
            require(deadly, "an innocent env is blamed, or none", at_fault)

    # -- errors

    def failed(self, fault: EnvFault, owner: Any, busy: Sequence[str] = ()) -> list[Env]:
        """End the requests that an error answers; return their envs.

        Those that are `busy` after it have got another request, because they were aborted.
        """
        ended: list[Env] = []
        for one in (fault, *fault.others):
            for env_id in getattr(one, "env_ids", ()) or (one.env_id,):
                env = self.envs.get(env_id)
                require(env is not None, "an error of a stranger", repr(one))
                assert env is not None
                ended.append(env)
                request = env.request
                if env.kept and (request is None or env_id in busy):
                    env.kept.pop(0)
                    self.counts["error of an aborted request"] += 1
                    if isinstance(one, WorkerDied) and env.may_be_lost:  # Else that was shown.
                        self.died(env, one)
                    continue
                require(
                    request is not None and request.owner == owner,
                    "an error that answers nothing", owner, request, repr(one),
                )  # fmt: skip
                assert request is not None
                self._judge_fault(env, request, one)
                env.request = None
        return ended

    def _judge_fault(self, env: Env, request: Request, fault: EnvFault) -> None:
        if isinstance(fault, WorkerDied):
            self.died(env, fault)
            if request.resets:  # An awaitable env begins that episode again.
                env.state.begun = request.seed, request.options
            if request.kind == "restore":  # Its next result says so.
                self.counts["died in a restore"] += 1
            else:
                env.seen = max(env.seen + 1, request.deaths)
            return
        if env.client is not None and isinstance(fault, EnvAway):
            require(env.may_be_lost or not env.client.is_shown, "away, and it was there", request)
            self.counts["clients away"] += 1
            return
        require(isinstance(fault, EnvRaised), "an odd error", repr(fault))
        assert isinstance(fault, EnvRaised)
        if request.kind == "restore":
            self._judge_not_restored(env, request, fault)
        elif request.kind != "call":
            self._judge_raised(env, request, fault)

    def _judge_not_restored(self, env: Env, request: Request, fault: EnvRaised) -> None:
        """Check an env that could not be restored: it has lost its episode."""
        interrupted = request.interrupted and fault.exception_type == "KeyboardInterrupt"
        marks = [state.scripts.subs[0].mark for state in request.saved]
        require(interrupted or UNLOADABLE in marks, "an error of nobody", repr(fault))
        states = (env.state, *env.loose, *env.torn, *request.saved)
        env.torn, env.lost = [*map(State.copy, states), env.fresh()], True
        self.counts["not restored"] += 1

    def _judge_raised(self, env: Env, request: Request, fault: EnvRaised) -> None:
        if request.interrupted and fault.exception_type == "KeyboardInterrupt":
            self.counts["Ctrl-C in an env"] += 1
            after = [state.copy() for state in (env.state, *env.loose)]
            for state in after:  # It may have been done with it.
                state.play(request)
            for done, state in itertools.product((request, Request("reset")), env.torn):
                after.append(state.copy())
                after[-1].play(done)
            if self._may_be_rebuilt(env, request):  # And interrupted in the reset that follows.
                env.errors = env.errors[0], self._most_errors(env)
                env.put_away = env.perhaps = True
                after += [env.fresh(), env.fresh()]
                after[-1].play(Request("reset"))
            env.loose += after
            env.dirty = True
            return
        if request.resets and env.may_be_lost:  # What was saved can't be shown any more.
            env.torn = [*env.after_loss(), env.fresh()]
        acts = self._raising(env, request)
        for state in (env.state, *env.loose):  # What has raised has no grudge any more.
            state.faults(self._executed(env, request))
        for state in env.torn:
            state.faults(Request("reset"))
        raising = [act for act in acts if act[0] in RAISING]
        is_rubbish = not raising and any(effect == "rubbish" for effect, _ in acts)
        if env.entry.on_error == "restart" and fault.exception_type != "KeyboardInterrupt":
            require(raising or is_rubbish, "an error of nobody", repr(fault), request)
            self._put_away(env, request)
        elif raising:
            self._judge_raising(env, request, fault, raising)
        else:
            require(is_rubbish and not request.resets, "an error of nobody", repr(fault), request)
            env.state.scripts.step(request.acts)
            env.state.infos = []
            env.dirty = True

    def _judge_raising(
        self, env: Env, request: Request, fault: EnvRaised, raising: list[Act]
    ) -> None:
        """Check an exception that is one of those that an env was to raise."""
        found = fault.exception_text
        likely = [act for act in raising if raised_text(*act) == found]
        effect, token = (likely or raising)[0]
        check_raised(fault, effect, token)
        if not (env.may_be_lost or env.put_away):  # Its outcome would be that loss.
            check_outcome(fault, request, effect, token)
        if request.resets:  # An awaitable env that hangs after that is reset like this again.
            env.state.begun = request.seed, request.options
        elif AGAIN in str(fault):  # The loss is still to be reported.
            begun, env.state = env.state.begun, env.fresh()
            env.state.begun, env.loose = begun, []
        self.counts["Ctrl-C in an env"] += raising[0][0] == "ctrl-c"

    def _may_be_rebuilt(self, env: Env, request: Request) -> bool:
        """Whether it may have raised in a request, which is a restart; Ctrl-C is none."""
        acts = self._raising(env, request) if env.entry.on_error == "restart" else []
        return any(effect != "ctrl-c" for effect, _ in acts)

    def _most_errors(self, env: Env) -> int:
        """How often in a row an env may have raised, also in a request that ended otherwise."""
        request = env.request
        if request is None or not self._may_be_rebuilt(env, request):
            return env.errors[1]
        is_retried = env.entry.form == "awaitable" and request.resets
        return env.errors[1] + (env.entry.max_restarts if is_retried else 1)

    def died(self, env: Env, fault: WorkerDied) -> None:
        """Check an error that says that an env's worker has ended: its episode is lost."""
        host, entry = env.host, env.entry
        may_have_died = host.mortal and (env.may_be_lost or self.starts_fail)
        require(may_have_died, "dead, and nothing has died", repr(fault))
        hung = isinstance(fault, EnvHung)
        require(fault.exit_code != 0, "dead, and left in order", hung)
        in_call = env.request is not None and env.request.kind in ("call", "restore")
        if not in_call:
            errors = [self._most_errors(one) for one in self.envs.values() if one.host is host]
            spent = entry.on_death == "raise" or env.deaths + max(errors) > entry.max_restarts
            require(spent or self.starts_fail, "raised, with restarts left", repr(fault))
        env.lost = host.raised = True


def _shown(states: Sequence[State], requests: Sequence[Request], row: Row) -> list[State]:
    """What each of these states becomes by each of these resets, if a result shows that."""
    found = [state.copy() for state in states for _ in requests]
    each = zip(found, [*requests] * len(states), strict=True)
    return [state for state, one in each if state.play(one).outcome.words == row.words]


def raised_text(effect: str, token: int) -> str:
    """What an env says that raises; nothing at Ctrl-C."""
    texts = {
        "raise": f"as asked for: {token}",
        "raise oddly": f"odd {token}",
    }
    return texts.get(effect, "")


def check_raised(fault: EnvRaised, effect: str, token: int) -> None:
    """Compare an error with what an env was to raise."""
    kind, builtin = {
        "raise": _raised_class(token),
        "raise oddly": ("Odd", EnvRaised),
        "ctrl-c": ("KeyboardInterrupt", EnvRaised),
    }[effect]
    text = raised_text(effect, token)
    found = fault.exception_text
    require(found == text, "another error", fault.exception_text, text)
    require(fault.exception_type.endswith(kind), "another type", fault.exception_type)
    require(isinstance(fault, builtin), "another class", type(fault))
    require(fault.traceback_text and fault.env_id in str(fault), "an error without its place")


def _raised_class(token: int) -> tuple[str, type[Exception]]:
    return ("EnvError", EnvRaised) if blame_of(token) else ("ValueError", ValueError)


def check_outcome(fault: EnvRaised, request: Request, effect: str, token: int) -> None:
    """Check who is said to be to blame: whom the env names, or else as docs/faults.md says."""
    blame = blame_of(token) if effect == "raise" else None
    usual = ("not_started", "env") if request.resets else ("env_raised", "either")
    right = usual[0], blame or usual[1]
    found = fault.outcome.kind, fault.outcome.blame
    require(found == right, "another outcome", found, right)


def compare(env: Env, expected: Expected, row: Row) -> None:
    """Compare a result with what was expected."""
    outcome = expected.outcome
    many = len(outcome.words)
    for what, found, right in (
        ("rewards", row.rewards, outcome.rewards),
        ("terminated", row.terminated, outcome.terminated),
        ("truncated", row.truncated, expected.truncated),
        ("is_reset", row.resets, outcome.resets),
        ("limit_reached", row.limit, [expected.limit] * many),
        ("index", row.index, [env.first + k for k in range(many)]),
    ):
        require(found is None or found == right, f"{what} must be {right}")
    info = dict(row.info)
    episode = info.pop("episode", None)
    found = [None] * many
    if episode is not None:
        returns, lengths = np.ravel(episode["r"]), np.ravel(episode["l"])
        found = [(float(returns[k]), int(lengths[k])) if lengths[k] else None for k in range(many)]
    require(found == expected.episodes, f"episodes must be {expected.episodes}")
    for k, right in enumerate(outcome.infos):
        final = outcome.finals[k]
        own = info if env.entry.form != "stacked" else sub_info(info, k)
        if final is not None:
            shown = words_of(env.entry.layout, own["final_obs"])
            require(shown == final, f"final_obs must be {final}")
            own = own["final_info"]
        require(same(own, right), f"info must be {right}", own)


def sub_info(info: dict[str, Any], k: int) -> dict[str, Any]:
    """What an info in Gymnasium's vector form says of one sub-environment."""
    found: dict[str, Any] = {}
    for key, value in info.items():
        if key[:1] != "_" and info[f"_{key}"][k]:
            found[key] = sub_info(value, k) if isinstance(value, dict) else value[k]
    return found


def same(one: Any, other: Any) -> bool:
    """Return True if two values are equal, arrays and what holds them included."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        one, other = np.asarray(one), np.asarray(other)
        if object in (one.dtype, other.dtype):
            return one.shape == other.shape and same(one.tolist(), other.tolist())
        return np.array_equal(one, other, equal_nan="f" in one.dtype.kind + other.dtype.kind)
    return bool(one == other)


def _check_sent(env: Env, request: Request, row: Row) -> None:
    if row.sent is None or request.sent is None:
        return
    for name, value in request.sent.items():
        require(name in row.sent, "a column that was sent is missing", name)
        require(same(row.sent[name], value), f"sent.{name} must be {value}", row.sent[name])


# -- batches


def rows_of(batch: BatchedData, envs: dict[str, Env], flags: Sequence[bool] | None) -> list[Row]:
    """The results of a batch, one by one."""
    env_ids = batch.env_ids()
    require(batch.ids() == env_ids and len(batch) == len(env_ids), "ids", batch.ids(), env_ids)
    require(flags is None or len(flags) == len(env_ids), "as many flags as results", flags)
    names = {envs[env_id].entry.name for env_id in env_ids if env_id in envs}
    parts = [batch] if len(names) == 1 else list(batch.by_entry().values())
    rows = {row.env_id: row for part in parts for row in _rows_of(part, envs)}
    require(sorted(rows) == sorted(env_ids), "a part of the batch is missing", sorted(rows))
    found = [rows[env_id] for env_id in env_ids]
    if flags is not None:
        limits = [row.limit is not None and row.limit[0] for row in found]
        require(flags == limits, "flags and limit_reached differ", flags, limits)
    return found


def _rows_of(part: BatchedData, envs: dict[str, Env]) -> list[Row]:
    env_ids = part.env_ids()
    entry = envs[env_ids[0]].entry
    columns = [
        column.reshape(len(env_ids), -1).tolist()
        for column in (
            part.reward, part.terminated, part.truncated, part.is_reset, part.limit_reached,
            part.restarted, part.index,
        )
    ]  # fmt: skip
    require((part.done == part.terminated | part.truncated).all(), "done is not what it is made of")
    observation, infos = part.observation, part.info()
    sent = {name: part.sent[name] for name in part.sent}
    rows: list[Row] = []
    for k, env_id in enumerate(env_ids):
        own = {name: element(column, k) for name, column in sent.items()}
        words = all_words(entry, element(observation, k))
        rows.append(Row(env_id, words, *(column[k] for column in columns), infos[k], own))
    check_infos(part.infos, infos)
    return rows


def all_words(entry: Entry, observation: Any) -> list[Words]:
    """The state of each sub-environment that an observation shows."""
    if entry.form != "stacked":
        return [words_of(entry.layout, observation)]
    return [words_of(entry.layout, element(observation, k)) for k in range(entry.num_envs)]


def row_of_ret(entry: Entry, ret: Any) -> Row:
    """A result as a handle returns it."""
    head = (
        np.ravel(x).tolist() for x in (ret.last_reward, ret.last_terminated, ret.last_truncated)
    )
    words = all_words(entry, ret.observation)
    return Row(ret.env_id, words, *head, None, None, None, None, ret.info, None)


def check_infos(columns: dict[str, Any], infos: Sequence[dict[str, Any]]) -> None:
    """Compare infos as columns, in Gymnasium's form, with single ones."""
    keys = {key for info in infos for key in info if key[:1] != "_"}
    require({key for key in columns if key[:1] != "_"} == keys, "other keys", columns.keys(), keys)
    for key in keys:
        there = [key in info for info in infos]
        mask = columns[f"_{key}"]
        require([bool(np.any(one)) for one in mask] == there, "another mask", key, mask)
        if isinstance(columns[key], dict):
            check_infos(columns[key], [info.get(key, {}) for info in infos])
            continue
        for k, info in enumerate(infos):
            require(not there[k] or same(columns[key][k], info[key]), "another info", key)
