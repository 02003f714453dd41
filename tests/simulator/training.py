"""Programs of `Collector`, and of `evaluate`."""

from __future__ import annotations

import asyncio
import contextlib
import math
import pickle
from random import Random
from typing import TYPE_CHECKING, Any

import numpy as np
from simulator.model import Violation, require, same
from simulator.scripted import TOKENS, Script, decoded, element, mixed, words_of
from simulator.session import Session, action_of, stacked
from simulator.trails import Trail, Transition

from rlightning_aio.collecting import Collector
from rlightning_aio.errors import (
    EnvAway,
    EnvBusy,
    EnvFault,
    EnvRaised,
    NothingPending,
    ResetNeeded,
    SnapshotError,
    WorkerDied,
)
from rlightning_aio.evaluation import EpisodeSpec, evaluate

if TYPE_CHECKING:
    from simulator.model import Env
    from simulator.scripted import Act, Words

    from rlightning_aio.attempts import Attempt
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.collecting import Rollout
    from rlightning_aio.evaluation import Evaluation


class PolicyFailed(Exception):
    """As a policy may."""


class InContext(Session):
    """A run whose envs are reset at their ends: within one `auto_reset`, or as each call does it.

    Attributes:
        limit: of the context. None: the program opens none.
    """

    def begin(self) -> None:
        self.limit = self.drawn_limit(Random(self.program.seed))
        self.by_id = {env.env_id: env for env in self.envs}
        self.enter()
        if self.clients:
            self.revive()

    def revive(self) -> None:
        """Start clients, and again and again those that have ended, or whose env hangs."""
        for client in self.clients:
            if client.hangs and client.process is not None:
                client.process.end(-9)
            if not client.is_alive:
                client.start(self.address)
        self.world.after(20.0, self.revive)

    def end(self) -> None:
        for client in self.clients:
            client.check_done()

    def enter(self) -> None:
        self.context = (
            contextlib.nullcontext() if self.limit is None else self.group.auto_reset(self.limit)
        )
        self.context.__enter__()

    def drawn_limit(self, rng: Random) -> float | None:
        """Draw the limit."""
        return rng.choice([None, None, math.inf, 3, 5])

    def limit_of(self, env: Env) -> float:
        """Steps after which the group truncates the episodes of an env."""
        if self.limit is not None:
            return self.limit
        limit = env.entry.limit if env.entry.mode == "disabled" else None
        return limit or math.inf

    async def finish(self) -> None:
        self.context.__exit__(None, None, None)

    def specs(self, rng: Random, most: int) -> list[EpisodeSpec]:
        """Draw episodes of any entries."""
        tasks = {meta.env_id.rpartition("-")[0]: meta.task for meta in self.group.metas}
        specs: list[EpisodeSpec] = []
        for k in range(rng.randint(1, most)):
            name, options = rng.choice([*tasks]), rng.choice([None, {"token": 1 + k}])
            specs.append(EpisodeSpec(tasks[name], 100 * k + rng.randrange(100), options, name))
        return specs

    def check_death(self, fault: WorkerDied) -> None:
        for env_id in fault.env_ids:
            require(self.by_id[env_id].deaths > 0, "dead, and nothing has died", repr(fault))


class Training(InContext):
    """A run of a program that collects rollouts.

    Its policy chooses at random what each env does next, and attaches what it has seen. So the
    rollouts themselves say what they must hold.
    """

    def begin(self) -> None:
        super().begin()
        self.raised = dict.fromkeys(self.by_id, 0)
        self.kept: list[tuple[Any, Any]] = []
        self.begins = True
        rng = Random(self.program.seed)
        self.options = self._options(rng)
        self.trails: dict[tuple[int, int], Trail] = {}
        local = [env for env in self.envs if env.client is None]
        self.env_of = {env.first + k: env for env in local for k in range(len(env.codes))}
        single = len(self.program.plans) == 1
        policy: Any = self.policy if single else {p.name: self.policy for p in self.program.plans}
        self.collector: Any = Collector(self.group, policy, **self.options)

    def _options(self, rng: Random) -> dict[str, Any]:
        width = sum(len(env.codes) for env in self.envs)
        blocks = not self.clients
        options: dict[str, Any] = {"seed": rng.choice([None, 7]), "infos": ("extra",)}
        blocks = blocks and all(
            plan.form != "stacked" or plan.mode == "same_step" for plan in self.program.plans
        )
        if blocks and rng.random() < 0.3:
            return options | {"wait_all": True, "num_transitions": width * rng.randint(1, 4)}
        if rng.random() < 0.7:
            options["min_results"] = rng.randint(1, 4)
        return options | {"num_transitions": rng.randint(1, rng.choice([3, 4 * width]))}

    def policy(self, batch: BatchedData) -> Any:
        """Choose actions; sometimes it fails."""
        if "raise" in self.features and not self.plain and self.rng.random() < 0.03:
            raise PolicyFailed
        envs = [self.by_id[env_id] for env_id in batch.env_ids()]
        acts = [self.acts(self.rng, env, plain=self.plain) for env in envs]
        for env, own, index in zip(envs, acts, batch.index, strict=True):
            if env.client is not None:
                env.client.asked.extend(own)
                require(self.env_of.setdefault(int(index), env) is env, "another's index", index)
            env.hangs += env.entry.form == "awaitable" and own[0][0].startswith("hang")
        actions = [action_of(env, own) for env, own in zip(envs, acts, strict=True)]
        shape = batch.is_reset.shape
        log_prob = np.array([self.rng.random() for _ in range(batch.is_reset.size)]).reshape(shape)
        return {"action": stacked(actions), "log_prob": log_prob, "seen": batch.observation}

    # -- operations

    plain = False

    async def op_rollout(self, rng: Random) -> bool:
        """Collect a rollout, or be disturbed meanwhile."""
        self.rng = rng
        cancels = self.is_async and "cancel" in self.features and rng.random() < 0.4
        seconds = 10 ** rng.uniform(-6, -1) if cancels and not self.plain else None
        try:
            if seconds is None:
                found = await self.done(self.collector.collect())
            else:
                async with asyncio.timeout(seconds):
                    found = await self.collector.collect()
        except KeyboardInterrupt:
            with self.expected(ResetNeeded, "a collect after Ctrl-C"):
                self.collector.collect()
            await self.op_restart(rng)
            raise
        except EnvFault as fault:
            self.count(fault)
            self.restore_order(fault)
        except NothingPending as error:
            self.count(error)
            raise Violation("nothing to collect, and envs are there") from error
        except EnvBusy as error:
            self.count(error)
            require("a call that was cancelled" in str(error), "busy", repr(error))
        except (PolicyFailed, TimeoutError):
            self.counts["disturbed rollouts"] += 1
        else:
            self.take(found)
            return True
        return False

    def restore_order(self, fault: EnvFault) -> None:
        """Reset the envs that an error names, or leave that to the collector."""
        for one in (fault, *fault.others):
            if isinstance(one, WorkerDied):
                self.check_death(one)
                continue
            env = self.by_id[one.env_id]
            if env.client is not None and isinstance(one, EnvAway):
                continue  # It comes back by itself.
            require(isinstance(one, EnvRaised), "an odd error", repr(one))
            self.raised[one.env_id] += 1
            if env.client is None and self.rng.random() < 0.5:
                continue  # The collector does it.
            try:
                self.group.reset_async(env_ids=[one.env_id])
            except KeyboardInterrupt:  # Of before: nothing was sent.
                self.group.reset_async(env_ids=[one.env_id])
                raise
            except WorkerDied as died:
                self.check_death(died)

    async def op_restart(self, rng: Random) -> None:
        """Begin all episodes anew, or where the program has reset or restored the envs."""
        for env_id in self.by_id:
            self.raised[env_id] += 1
        self.begins, batch = True, None
        if rng.random() < 0.6 and not self.clients:
            batch = await self.interruptible(self.prepared(rng))
        if batch is None:
            self.collector.restart(rng.choice([None, 5]))
        else:
            self.collector.restart(batch=batch)
        self.counts["restarts"] += 1

    async def prepared(self, rng: Random) -> BatchedData | None:
        """Reset all envs, and perhaps save and restore them; None if one fails."""
        try:
            while self.group.pending:
                with contextlib.suppress(EnvRaised):
                    await self.done(self.group.collect_async())
            batch, _ = await self.done(self.group.reset(seed=rng.choice([None, 3])))
            if rng.random() < 0.5 and "snapshots" in self.features:
                batch, _ = await self.done(
                    self.group.restore(await self.done(self.group.snapshot()))
                )
        except EnvFault as fault:
            self.count(fault)
        except SnapshotError as error:
            self.count(error)
        else:
            return batch
        return None

    async def op_learn(self, rng: Random) -> None:
        """Time passes, and the policy is another one."""
        self.collector.policy_version += 1
        await self.rest()

    async def finish(self) -> None:
        self.plain = True
        for _ in range(20):
            if await self.interruptible(self.op_rollout(Random(1))):
                break
        else:
            raise Violation("no rollout is collected any more")
        await super().finish()

    # -- rollouts

    def take(self, found: Any) -> None:
        """Check rollouts, and that the one before was left alone."""
        self.counts["rollouts"] += 1
        self.begins = False
        parts = [found] if len(self.program.plans) == 1 else [found[name] for name in sorted(found)]
        total = sum(part.index.size for part in parts)
        require(total == self.options["num_transitions"], "the size of a rollout", total)
        for part in parts:
            self._take(part)
        if self.kept:
            columns, copies = self.kept[-1]
            require(same(columns, copies), "a rollout was overwritten too soon")
        own = [[part[name] for name in part] for part in parts]
        self.kept.append((own, pickle.loads(pickle.dumps(own))))

    def _take(self, rollout: Rollout) -> None:
        after = rollout.next_observation
        ended: dict[int, list[tuple[float, int]]] = {}
        for place in np.ndindex(rollout.shape):
            index = int(rollout.index[place])
            env = self.env_of[index]
            layout = env.entry.layout
            words = words_of(layout, _at(rollout.observation, place))
            trail = self._trail(env, index, words.code)
            number = len(trail.ended)
            require(words_of(layout, _at(rollout.seen, place)) == words, "another seen", words)
            trail.add(
                Transition(
                    words,
                    decoded(env.entry.controls, _at(rollout.action, place)),
                    float(rollout.reward[place]),
                    bool(rollout.terminated[place]),
                    bool(rollout.truncated[place]),
                    words_of(layout, _at(after, place)),
                    bool(rollout.first[place]),
                )
            )
            self.counts["transitions"] += 1
            ended.setdefault(index, []).extend(trail.ended[number:])
        found: dict[int, list[tuple[float, int]]] = {index: [] for index in ended}
        for index, total, length, _ in zip(*rollout.episodes.values(), strict=True):
            found.setdefault(int(index), []).append((float(total), int(length)))
        require(found == ended, "episodes", found, ended)

    def _trail(self, env: Env, index: int, code: int) -> Trail:
        """What was stored of an env; each process of a client has another code, and a trail."""
        if (index, code) not in self.trails:
            before = max((other for place, other in self.trails if place == index), default=-1)
            is_own = code in env.codes
            require(is_own and code > before, "a transition of another env", index, code)
            together = env.entry.mode != "disabled"
            limits = env.entry.own_limit, self.limit_of(env)
            self.trails[index, code] = Trail(code, *limits, cut_together=together)
        trail = self.trails[index, code]
        troubles = 0 if env.client is None else env.client.troubles
        trail.allow(env.losses + self.raised[env.env_id] + troubles)
        return trail


class Evaluations(InContext):
    """A run of a program that evaluates a policy, whose actions follow from what it sees.

    Attributes:
        calls_left: of the policy until it raises.
        cut_off: the last one was cut off while it ended what it had sent, after an error.
    """

    calls_left = math.inf
    cut_off = False

    def drawn_limit(self, rng: Random) -> float | None:
        """None is finite with envs that reset themselves, of which it cuts several at once."""
        alone = all(plan.mode == "disabled" for plan in self.program.plans)
        return super().drawn_limit(rng) if alone else rng.choice([None, math.inf])

    def choose(self, words: Words) -> Act:
        kind = mixed(words.seed, words.step, words.mix)
        if "infos" in self.features and kind % 3 == 1:
            return (
                "info",
                kind // 3 % 9 * 7,
            )  # It says how far it has succeeded, which counts at an end.
        return ("end" if kind % 6 == 0 else "cut" if kind % 11 == 0 else "plain"), kind % TOKENS

    def policy(self, batch: BatchedData) -> Any:
        self.calls_left -= 1
        if self.calls_left < 0:
            raise PolicyFailed
        actions: list[Any] = []
        rets = batch.values()
        for ret in rets:
            env = self.by_id[ret.env_id]
            many = env.entry.form == "stacked"
            each = (
                [_at(ret.observation, (k,)) for k in range(len(env.codes))]
                if many
                else [ret.observation]
            )
            actions.append(
                action_of(env, [self.choose(words_of(env.entry.layout, one)) for one in each])
            )
        return batch.respond(action=actions)

    async def op_evaluate(self, rng: Random) -> None:
        singles = all(plan.form != "stacked" for plan in self.program.plans)
        await self.settle()
        self.calls_left = rng.randint(0, 20) if rng.random() < 0.3 else math.inf
        self.pressed, self.cut_off = self.num_interrupts, False
        try:
            if singles and rng.random() < 0.6:
                await self._queue(rng)
            else:
                await self._number(rng)
        except PolicyFailed:
            self.counts["evaluations whose policy failed"] += 1
        except KeyboardInterrupt as interrupt:
            self.cut_off = isinstance(interrupt.__context__, Exception)
            raise

    async def settle(self) -> None:
        """Check that an evaluation has left nothing, unless its end was cut off itself."""
        if self.group.pending:
            again = self.num_interrupts > self.pressed + 1
            require(again or self.cut_off, "left in flight", self.group.pending)
            with contextlib.suppress(EnvFault):
                await self.done(self.group.drain(1.0))

    async def _found(self, rng: Random, answer: Any) -> Any:
        """Wait for an evaluation, or cancel it: then None."""
        if not self.is_async or "cancel" not in self.features or rng.random() < 0.6:
            return await self.done(answer)
        playing = asyncio.ensure_future(answer)
        await asyncio.wait({playing}, timeout=10 ** rng.uniform(-6, 1))
        playing.cancel()
        try:
            return await playing
        except asyncio.CancelledError as cancelled:
            self.cut_off = isinstance(cancelled.__context__, Exception)
            self.counts["evaluations cancelled"] += 1

    async def _number(self, rng: Random) -> None:
        """As many episodes of each env."""
        count, seed = rng.randint(1, 3), rng.randrange(1000)
        found = await self._found(rng, evaluate(self.group, self.policy, count, seed=seed))
        if found is None:
            return
        self.check_rate(found)
        width = sum(len(env.codes) for env in self.envs)
        places = {(one.env_id, one.sub_env, one.index): one for one in found.attempts}
        require(len(places) == len(found.attempts) == count * width, "as many of each", found)
        for env in self.envs:
            for k in range(len(env.codes)):
                # Of those that reset themselves only the first is seeded.
                seeded = count if env.entry.mode == "disabled" else 1
                for number in range(seeded):
                    own = seed + number * width + env.first + k
                    self.check(places[env.env_id, k, number], env, k, own)
        self.counts["episodes"] += len(places)

    async def _queue(self, rng: Random) -> None:
        """A queue of episodes, for any env of their entries."""
        specs = self.specs(rng, 8)
        found = await self._found(rng, evaluate(self.group, self.policy, specs))
        if found is None:
            return
        self.check_rate(found)
        keys = sorted(one.spec.key for one in found.attempts)
        require(keys == sorted(spec.key for spec in specs), "other episodes", keys)
        for attempt in found.attempts:
            env = self.by_id[attempt.env_id]
            require(env.entry.name == attempt.spec.entry, "an env of another entry", attempt)
            self.check(attempt, env, 0, attempt.spec.seed)
        self.counts["episodes"] += len(specs)

    def check_rate(self, found: Evaluation) -> None:
        """It is that of the attempts whose success is known; `check` looks at each."""
        known = [one.success for one in found.attempts if one.success is not None]
        shown = None if found.success is None else (found.success.mean, found.success.count)
        right = (sum(known) / len(known), len(known)) if known else None
        require(shown == right, "another rate", shown, right)
        self.counts["successes"] += sum(known)

    def check(self, attempt: Attempt, env: Env, k: int, seed: int | None) -> None:
        """An episode ends as it does alone, or has failed and says why."""
        lost = [*attempt.failures, *([attempt.outcome] if attempt.outcome.is_failure else [])]
        for outcome in lost:
            kinds = ("env_died", "env_hung", "not_started")
            require(outcome.kind in kinds, "another failure", attempt)
        if lost:
            require(any(e.deaths for e in self.envs), "lost, and nothing has died", attempt)
        if attempt.outcome.is_failure:
            require(attempt.reward is None, "a failure with a reward", attempt)
        else:
            shown = attempt.reward, attempt.length, attempt.success
            right = self.played(env, k, seed, attempt.spec.options)
            require(shown == right, "an episode", attempt, right)

    def played(
        self, env: Env, k: int, seed: int | None, options: Any
    ) -> tuple[float, int, bool | None]:
        """Return, length and success of an episode that is played alone."""
        script = Script(env.codes[k], env.entry.own_limit)
        script.reset(seed, options)
        total, length = 0.0, 0
        while True:
            reward, ended, cut, info = script.step(*self.choose(script.words))
            total, length = total + reward, length + 1
            if ended or cut or length >= self.limit_of(env):
                return total, length, info["success"] > 0.5 if "success" in info else None

    async def finish(self) -> None:
        await self.op_evaluate(Random(1))
        await super().finish()


def _at(column: Any, place: tuple[int, ...]) -> Any:
    for k in place:
        column = element(column, k)
    return column
