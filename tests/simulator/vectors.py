"""Programs of `VectorEnv` and `sb3.VecEnv`, as loops use them that know of no worker."""

from __future__ import annotations

import importlib.util
import sys
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from importlib import import_module
from random import Random
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar
from unittest import mock

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import iterate
from simulator.model import Env, Violation, require, same, sub_info
from simulator.scripted import Scripted, Words, element, encoded, words_of
from simulator.session import Session, stacked
from simulator.trails import Trail, Transition, is_begun

from rlightning_aio.errors import EnvFault, SnapshotError, StartFailed, WorkerDied
from rlightning_aio.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class Vectors(Session):
    """A run of a program that steps a `VectorEnv`.

    Attributes:
        shown: the state that each row showed last; over: its episode has ended; lost: it was lost,
            and the next one has not been shown.
        is_cut_off: the last call has not returned, so that only a reset may follow.
    """

    def build(self) -> None:
        """Nothing: making the envs starts them."""

    def make(self, makers: list[Any], fields: dict[str, Any]) -> Any:
        self.copies = "zero_copy" not in self.features
        mode = AutoresetMode[self.mode.upper()]
        return VectorEnv(makers, copy=self.copies, autoreset_mode=mode, **fields)

    async def start(self) -> bool:
        (plan,) = self.program.plans
        self.mode = self.mode_of()
        makers: list[Any] = []
        for worker in range(plan.num_workers):
            (code,) = plan.codes(0, worker)
            makers.append(partial(Scripted, code, plan.layout, plan.controls))
        fields = plan.config(0)
        for name in ("name", "num_workers", "task"):
            fields.pop(name, None)
        try:
            self.rows = self.make(makers, fields)
        except StartFailed as error:
            self.count(error)
            raise
        self.group = self.rows.group
        return True

    def mode_of(self) -> str:
        """The autoreset mode: any."""
        return Random(self.program.seed).choice(["next_step", "same_step", "disabled"])

    def close_group(self) -> None:
        if hasattr(self, "rows"):
            self.rows.close()

    def begin(self) -> None:
        (plan,) = self.program.plans
        self.layout, self.controls = plan.layout, plan.controls
        limit = float(plan.limit or np.inf)
        self.env_of = [env for env in self.envs for _ in env.codes]
        codes = [code for env in self.envs for code in env.codes]
        either = isinstance(self, Singles)
        self.trails = [Trail(code, limit, cut_or_ended=either) for code in codes]
        self.shown: list[Words] = []
        self.over = [False] * len(codes)
        self.lost = [False] * len(codes)
        self.breaks = 0
        self.kept: list[tuple[Any, Any]] = []
        self.saved: Any = None
        self.is_whole = self.is_cut_off = False
        require(self.rows.num_envs == len(codes), "as many rows", self.rows.num_envs)

    def faults_of(self, env: Env) -> list[str]:
        faults = super().faults_of(env)
        if self.mode == "same_step":  # Nobody compares a last observation with the space.
            return [fault for fault in faults if fault != "rubbish"]
        return faults

    # -- operations

    async def op_reset(self, rng: Random) -> None:
        """Reset all."""
        seed = rng.choice([None, rng.randrange(1000)])
        try:
            with self.cutting_off():
                observation, infos = self.reset_rows(seed)
        except EnvFault as fault:
            self.fail(fault)
            return
        words = self.words(observation)
        self.say(f"   {words}")
        for k, one in enumerate(words):
            require(is_begun(one) and one.code == self.trails[k].code, "no reset", k, one)
            seeded = seed is None or one.seed == seed + k + 1
            require(seeded or self.has_cause(infos, k), "another seed", k, one)
        self.shown, self.over, self.lost = words, [False] * len(words), [False] * len(words)
        # What was not over is abandoned.
        self.breaks += 1
        self.is_whole = True
        self.keep(observation)

    @contextmanager
    def cutting_off(self) -> Iterator[None]:
        """Context of a call of the envs; if it raises, only a reset may follow."""
        was_whole, self.is_whole, self.is_cut_off = self.is_whole, False, True
        yield
        self.is_whole, self.is_cut_off = was_whole, False

    def refused(self, ask: Callable[[], Any]) -> bool:
        """Have a call refused after one that was cut off; return False if none was."""
        if self.is_cut_off:
            with self.expected(ResetNeeded, "a call after one that was cut off"):
                ask()
        return self.is_cut_off

    def reset_rows(self, seed: int | None) -> tuple[Any, Any]:
        return self.rows.reset(seed=seed)

    async def op_step(self, rng: Random) -> None:
        if not self.shown:
            return
        if self.mode == "disabled" and any(self.lost):
            await self.op_mask(rng)
            if any(self.lost):
                await self.op_reset(rng)
            return
        acts = [self.act(rng, env, plain=self.plain) for env in self.env_of]
        actions = self.actions([encoded(self.controls, *act) for act in acts])
        if self.refused(lambda: self.step_rows(actions, rng)):
            return
        try:
            with self.cutting_off():
                found = self.step_rows(actions, rng)
        except EnvFault as fault:
            self.fail(fault)
            return
        self.take(acts, found)

    plain = False

    def step_rows(self, actions: Any, rng: Random) -> Any:
        if rng.random() < 0.5:
            return self.rows.step(actions)
        self.rows.step_async(actions)
        return self.rows.step_wait()

    async def op_mask(self, rng: Random) -> None:
        """Reset those that are over, where nobody else does, and a few others."""
        if not self.is_whole or self.mode != "disabled":
            return
        if rng.random() < 0.4:
            await self.op_kill(rng)
        mask = np.array(self.over) | np.array([rng.random() < 0.3 for _ in self.over])
        if not mask.any():
            return
        try:
            with self.cutting_off():
                observation, _ = self.rows.reset(options={"reset_mask": mask})
        except EnvFault as fault:
            self.fail(fault)
            return
        self.breaks += 1
        for k, one in enumerate(self.words(observation)):
            if mask[k]:
                require(is_begun(one), "no reset", k, one)
            else:
                require(one == self.shown[k], "a row that was not reset", k, one)
            self.shown[k], self.over[k], self.lost[k] = one, False, False

    async def op_call(self, rng: Random) -> None:
        """Call a method of all."""
        if self.refused(lambda: self.rows.call("peek", 7)):
            return
        was_whole = self.is_whole
        try:
            with self.cutting_off():
                values = self.rows.call("peek", 7)
        except WorkerDied as fault:
            self.is_whole, self.is_cut_off = was_whole, False
            self.fail(fault)
            return
        for k, (words, echo) in enumerate(values):
            require(tuple(echo) == (7,), "another call's arguments", echo)
            died = self.env_of[k].losses > 0
            require(
                died or not self.is_whole or tuple(words[0]) == self.shown[k], "state", k, words
            )

    async def op_state(self, rng: Random) -> None:
        """Save the state of all, or restore what was saved last."""
        before = self.is_whole, self.is_cut_off
        if self.saved is None or rng.random() < 0.5:
            if self.refused(self.rows.snapshot) or not self.is_whole:
                return
            with self.perhaps_none(), self.cutting_off():
                state = self.rows.snapshot()
                self.saved = state, deepcopy((self.trails, self.shown, self.over, self.lost))
            self.is_whole, self.is_cut_off = before  # Not after Ctrl-C.
            return
        state, model = self.saved
        found: Any = None
        try:
            with self.cutting_off():
                found, _ = self.rows.restore(state)
        except (SnapshotError, EnvFault) as fault:
            with self.perhaps_none():
                raise
            if isinstance(fault, SnapshotError):  # Nothing was changed.
                self.is_whole, self.is_cut_off = before
            return
        self.trails, self.shown, self.over, self.lost = deepcopy(model)
        for k, now in enumerate(self.words(found)):
            if self.lost[k]:
                require(is_begun(now), "no next episode", k, now)
                self.over[k] = self.lost[k] = False
            else:
                require(now == self.shown[k], "not restored", k, now, self.shown[k])
            self.shown[k] = now
        self.breaks += 1
        self.is_whole = True

    @contextmanager
    def perhaps_none(self) -> Iterator[None]:
        """Context in which there may be no state: of lost envs, or of one that keeps its own."""
        try:
            yield
        except (EnvFault, SnapshotError) as fault:
            lost = any(env.losses for env in self.envs)
            require(lost or "keeps its state" in str(fault), "no state", repr(fault))

    # -- checks

    def fail(self, fault: EnvFault) -> None:
        """Take an error; after that of a step or a reset, all rows must be reset."""
        self.count(fault)
        for one in (fault, *fault.others):
            if isinstance(one, WorkerDied):
                require(
                    any(env.deaths for env in self.envs), "dead, and nothing has died", repr(one)
                )

    def has_cause(self, infos: Any, k: int) -> bool:
        return bool(infos.get("_worker_restarted", np.zeros(k + 1, bool))[k])

    def words(self, observation: Any) -> list[Words]:
        each = iterate(self.rows.observation_space, observation)
        return [words_of(self.layout, one) for one in each]

    def results(self, found: Any) -> tuple[Any, Any, list[tuple[bool, bool]], list[Any]]:
        """Observations, rewards, ends and infos of a step, of each row."""
        observation, rewards, terminated, truncated, infos = found
        rows = range(self.rows.num_envs)
        ends = [(bool(terminated[k]), bool(truncated[k])) for k in rows]
        return observation, rewards, ends, [sub_info(infos, k) for k in rows]

    def actions(self, each: list[Any]) -> Any:
        """The actions of all rows, as a loop passes them."""
        return stacked(each)

    def keep(self, observation: Any) -> None:
        """Keep an observation, to see at the end that nobody wrote to it."""
        if self.copies:
            self.kept.append((observation, deepcopy(observation)))

    def take(self, acts: list[Any], found: Any) -> None:
        observation, rewards, ends, infos = self.results(found)
        words = self.words(observation)
        self.say(f"   {words} {ends}")
        for k, one in enumerate(words):
            self._row(k, acts[k], one, float(rewards[k]), ends[k], infos[k])
            self.counts["rows"] += 1
        self.keep(observation)

    def _row(
        self, k: int, act: Any, now: Words, reward: float, ends: tuple[bool, bool], info: Any
    ) -> None:
        env, trail, before = self.env_of[k], self.trails[k], self.shown[k]
        died = "worker_restarted" in info
        if died:
            self.counts["died"] += 1
            may_be = env.exceptions > 0 or (env.host.mortal and env.deaths > 0)
            require(may_be, "marked, and nothing is lost", info)
        was_over, stays = self.over[k], self.mode == "disabled" and not died
        self.over[k] = any(ends) or (was_over and stays)
        self.shown[k], self.lost[k] = now, False
        if self.mode == "next_step" and was_over:
            require((reward, ends) == (0.0, (False, False)), "a reset", k, reward, ends)
            require(is_begun(now) or died, "no reset", k, now)
            return
        after = now
        if self.mode == "same_step" and any(ends):
            require("final_obs" in info, "an end without final_obs", k, info)
            after = words_of(self.layout, info["final_obs"])
        if died:
            require((reward, ends) == (0.0, (False, True)), "a lost step", k, reward, ends)
            require(after == before, "another last observation", k, after, before)
            if self.mode == "same_step":
                require("worker_restarted" in info["final_info"], "final_info", info)
            trail.last = None  # The episode ends with the step before.
            self.lost[k] = self.mode != "same_step"
            return
        trail.allow(self.breaks + env.losses)
        trail.add(Transition(before, act, reward, *ends, after), goes_on=was_over and stays)

    async def finish(self) -> None:
        self.plain = True
        for _ in range(6):
            # A step that Ctrl-C has cut off may still press it again in other envs.
            await self.interruptible(self.op_reset(Random(1)))
            if self.is_whole:
                await self.op_step(Random(1))
            if self.is_whole:
                return
        raise Violation("the envs can't be used any more")

    def end(self) -> None:
        for observation, copies in self.kept:
            require(same(observation, copies), "an observation was overwritten")


class Singles(Vectors):
    """A run of a program that steps an `sb3.VecEnv`."""

    def make(self, makers: list[Any], fields: dict[str, Any]) -> Any:
        self.copies = True
        return VecEnv(makers, **fields)

    def mode_of(self) -> str:
        return "same_step"

    def reset_rows(self, seed: int | None) -> tuple[Any, Any]:
        if seed is not None:
            self.rows.seed(seed)
        return self.rows.reset(), self.rows.reset_infos

    def has_cause(self, infos: Any, k: int) -> bool:
        return "worker_restarted" in infos[k]

    def words(self, observation: Any) -> list[Words]:
        rows = range(self.rows.num_envs)
        return [words_of(self.layout, element(observation, k)) for k in rows]

    def actions(self, each: list[Any]) -> Any:
        return each if isinstance(each[0], dict) else stacked(each)

    async def op_call(self, rng: Random) -> None:
        """Call a method of all, or get an attribute."""

    def results(self, found: Any) -> tuple[Any, Any, list[tuple[bool, bool]], list[Any]]:
        observation, rewards, dones, infos = found
        ends: list[tuple[bool, bool]] = []
        each: list[Any] = []
        for k, info in enumerate(infos):
            cut = info["TimeLimit.truncated"]
            require(not cut or dones[k], "cut, and not done", info)
            # It says nothing of truncation where the env has terminated.
            ends.append((bool(dones[k] and not cut), bool(cut)))
            own = {name: info[name] for name in ("worker_restarted",) if name in info}
            if dones[k]:
                own |= {"final_obs": info["terminal_observation"], "final_info": info}
            each.append(own)
        return observation, rewards, ends, each


class _Base:
    """What `sb3.VecEnv` uses of its base class, where Stable-Baselines3 is not installed."""

    metadata: ClassVar[dict[str, Any]] = {}

    def __init__(self, num_envs: int, observation_space: Any, action_space: Any) -> None:
        self.num_envs = num_envs
        self.observation_space, self.action_space = observation_space, action_space
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._reset_seeds()
        self._reset_options()

    def _reset_seeds(self) -> None:
        self._seeds: list[int | None] = [None] * self.num_envs

    def _reset_options(self) -> None:
        self._options: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]

    def _get_indices(self, indices: Any) -> Any:
        return range(self.num_envs) if indices is None else [indices]

    def seed(self, seed: int) -> None:
        self._seeds = [seed + k for k in range(self.num_envs)]

    def step(self, actions: Any) -> Any:
        self.step_async(actions)  # type: ignore[attr-defined]
        return self.step_wait()  # type: ignore[attr-defined]


def _vec_env() -> Any:
    """Import `sb3.VecEnv`, with a base class of ours if there is no other."""
    name = "stable_baselines3.common.vec_env.base_vec_env"
    if importlib.util.find_spec("stable_baselines3") is not None:
        return import_module("rlightning_aio.sb3").VecEnv
    base = ModuleType(name)
    vars(base)["VecEnv"] = _Base
    with mock.patch.dict(sys.modules, {name: base}):
        found = import_module("rlightning_aio.sb3").VecEnv
    sys.modules.pop("rlightning_aio.sb3", None)
    return found


VecEnv = _vec_env()
