"""Scripted envs: an action says what an env does, and an observation shows its whole state.

`Script` is one env as a plain state machine. The envs below wrap it, and the model steps the very
same class, so that it knows each result beforehand. What an env does to its process (`spend` time,
`die`, `hang`) goes through `machine`, in place of which a World puts its own.
"""

from __future__ import annotations

import asyncio
import math
import os
import random
import signal
import string
import time
from copy import deepcopy
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, get_args
from weakref import WeakKeyDictionary

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from rlightning_aio import ENVS, BaseEnv, EnvError, EnvRet
from rlightning_aio.outcomes import Blame
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio.types import PolicyResponse


class Machine:
    """What an env can do to the process that it is in."""

    def spend(self, seconds: float) -> None:
        """Take this long; in real time a hundredth of it."""
        time.sleep(seconds / 100)

    def die(self, how: str) -> None:
        """End the process: ``killed`` or ``exit``; ``soon`` in a world a moment later."""
        if how != "exit":
            os.kill(os.getpid(), signal.SIGKILL)
        os._exit(3)

    def hang(self) -> None:
        """Never return."""
        while True:
            time.sleep(3600)

    def make(self, code: int) -> None:
        """Begin to make the env whose first script has this code."""

    def closing(self, code: int, *, ends: bool) -> None:
        """Begin to close an awaitable env, or end that."""

    async def await_for(self, seconds: float) -> None:
        """Like `spend`, in an awaitable env, while others continue."""
        await asyncio.sleep(seconds / 100)

    async def await_for_ever(self) -> None:
        """Like `hang`, in an awaitable env."""
        await asyncio.Event().wait()


machine = Machine()

EFFECTS = (
    "plain", "end", "cut", "both", "info", "nested", "slow", "raise", "raise oddly", "rubbish",
    "killed", "exit", "hang", "raise next", "die next", "hang next", "keep state",
    "ctrl-c",
)  # fmt: skip
"""What a step does, by number. ``… next`` does it in the next reset; after ``keep state`` the env
refuses one snapshot."""
TIMEOUT = 2.0
"""Of a step or a reset, in seconds, where an entry has one."""
TOKENS = 64
"""Numbers that an action has in addition, to tell it from others."""
RAISING = ("raise", "raise oddly", "ctrl-c")
DYING = ("killed", "exit")


class Odd(BaseException):
    """Neither an `Exception`, nor made from its arguments alone."""

    def __init__(self, *, code: int) -> None:
        super().__init__()
        self.code = code

    def __str__(self) -> str:
        return f"odd {self.code}"


def blame_of(token: int) -> Blame | None:
    """Whom an env that is to raise something blames, if it says so."""
    return get_args(Blame)[token // 3 % 5] if token % 3 == 1 else None


def slow_seconds(token: int) -> float:
    """How long a slow step takes."""
    return (token + 1) / 50


def perform(effect: str, token: int) -> None:
    """Do to the process what `effect` says."""
    if effect == "slow":
        machine.spend(slow_seconds(token))
    elif effect in DYING:
        machine.die(effect)
    elif effect == "hang":
        machine.hang()
    else:
        _raise(effect, token)


async def perform_awaiting(effect: str, token: int) -> None:
    """Like `perform`, in an awaitable env."""
    if effect == "slow":
        await machine.await_for(slow_seconds(token))
    elif effect == "hang":
        await machine.await_for_ever()
    else:
        perform(effect, token)


def _raise(effect: str, token: int) -> None:
    if effect == "raise":
        blame, text = blame_of(token), f"as asked for: {token}"
        raise EnvError(text, blame=blame) if blame else ValueError(text)
    if effect == "raise oddly":
        raise Odd(code=token)
    if effect == "ctrl-c":
        signal.raise_signal(signal.SIGINT)


UNCLOSABLE, UNLOADABLE, DEADLY, SLOW = 98, 97, 96, 95
"""The `mark` of an env that raises when it is closed; or when its state is loaded, that then ends
its process, that then takes long.
"""


class Words(NamedTuple):
    """The state of an env, as its observations show it.

    Attributes:
        seed: 0 if it never got one, else one more.
        mix: a hash of all that was done since the reset.
    """

    code: int
    seed: int
    episode: int
    step: int
    mix: int


BITS = Words(12, 20, 7, 7, 16)
"""Of each word, so that all of them fit into one number."""


def mixed(*numbers: int) -> int:
    """A hash of 16 bits, other than Python's the same in each process."""
    found = 7
    for number in numbers:
        found = (found * 31_337 + number + 1) % 65_521
    return found


class Draws(random.Random):
    """What goes over to the next worker, as a random generator does.

    Attributes:
        last: seed of a reset; code, episode, mark, grudge: of `Script`. The code may have come
            from another env, with a state that was restored.
    """

    def __init__(self, code: int = 0) -> None:
        super().__init__(0)
        self.code, self.last, self.episode, self.mark, self.grudge = code, -1, 0, 0, ""

    def getstate(self) -> Any:
        return vars(self).copy()

    def setstate(self, state: Any) -> None:
        vars(self).update(state)


def _of_draws(name: str) -> Any:
    return property(
        lambda self: getattr(self.draws, name),
        lambda self, value: setattr(self.draws, name, value),
    )


class Script:
    """One env, or sub-environment, which does nothing to its process.

    Attributes:
        mark: can be set from outside, and goes into the next `mix`.
        grudge: what the next reset does.
        refuses: the next snapshot is refused, until a reset.
        over: its episode has ended.
        limit: a wrapper truncates its episodes once as many steps have elapsed since the last
            reset, which may have failed.
    """

    code, seed, episode = _of_draws("code"), _of_draws("last"), _of_draws("episode")
    mark, grudge = _of_draws("mark"), _of_draws("grudge")

    def __init__(self, code: int, limit: float = math.inf) -> None:
        self.limit = limit
        self.draws = Draws(code)
        self.steps = self.elapsed = self.mix = 0
        self.refuses = self.over = False

    def __getstate__(self) -> dict[str, Any]:
        if self.refuses:
            self.refuses = False
            raise RuntimeError("it keeps its state")
        return vars(self).copy()

    def __setstate__(self, state: dict[str, Any]) -> None:
        mark = state["draws"].mark
        if mark == UNLOADABLE:
            raise RuntimeError("it does not load")
        if mark == DEADLY:
            machine.die("soon")
        elif mark == SLOW:
            machine.spend(0.1)
        vars(self).update(state)

    @property
    def words(self) -> Words:
        return Words(self.code, self.seed + 1, self.episode, self.steps, self.mix)

    def fault_of_reset(self, options: dict[str, Any] | None) -> str:
        """What the next reset does to its process; forgets a grudge."""
        grudge, self.grudge, self.elapsed = self.grudge, "", 0
        return grudge or (options or {}).get("effect", "plain")

    def reset(self, seed: int | None, options: dict[str, Any] | None) -> dict[str, Any]:
        if seed is not None:
            self.seed = int(seed)
        self.episode, self.steps, self.over = (self.episode + 1) % 128, 0, False
        self.elapsed, self.refuses = 0, False
        token = (options or {}).get("token", 0)
        # With a seed, what follows depends on nothing that was before.
        self.mix = mixed(
            self.code, self.seed, 0 if seed is not None else self.episode, token, self.mark
        )
        return {"seed": -1 if seed is None else int(seed), **({"token": token} if token else {})}

    def step(self, effect: str, token: int) -> tuple[float, bool, bool, dict[str, Any]]:
        """Make a step; return reward, terminated, truncated and info."""
        self.steps, self.elapsed = (self.steps + 1) % 128, self.elapsed + 1
        self.mix = mixed(self.mix, EFFECTS.index(effect), token, self.mark)
        if effect.endswith(" next"):
            self.grudge = {"raise next": "raise", "die next": "exit", "hang next": "hang"}[effect]
        self.refuses |= effect == "keep state"
        info: dict[str, Any] = {"mix": self.mix, "step": self.steps}
        if effect == "info":
            info |= _changing(token)
        elif effect == "nested":
            info["nested"] = {"token": token, "array": np.arange(3) + token, "words": ["a", {}]}
        ended = effect in ("end", "both")
        cut = effect in ("cut", "both") or self.elapsed >= self.limit
        self.over |= ended or cut
        return (self.mix % 64) / 4, ended, cut, info


def _changing(token: int) -> dict[str, Any]:
    """An entry of an info whose key and type depend on the token."""
    kinds: tuple[dict[str, Any], ...] = (
        {"success": token % 8 / 8}, {"extra": token / 2}, {"text": f"t{token}"},
        {"array": np.full(3, token, np.float32)}, {"extra": token}, {"extra": token / 4},
        {"": token},
    )  # fmt: skip
    return kinds[token % len(kinds)]


def _with_floats(info: dict[str, Any]) -> dict[str, Any]:
    """Gymnasium joins infos in a column of the first one's type, which may cut others off."""
    return {key: float(value) if key == "extra" else value for key, value in info.items()}


Act = tuple[str, int]
"""An effect and a token."""


class Outcome(NamedTuple):
    """What a step of an env gives: of each sub-environment, or of its only one.

    Attributes:
        words: the states that are observed; finals: those of ended episodes whose sub-environment
            was reset in the same step.
        resets: which were reset in place of a step.
        infos: one for each.
    """

    words: list[Words]
    rewards: list[float]
    terminated: list[bool]
    truncated: list[bool]
    resets: list[bool]
    finals: list[Words | None]
    infos: list[dict[str, Any]]


class Scripts:
    """An env of one or several scripts, without its simulator's interface.

    Attributes:
        subs: the scripts.
        mode: when an ended one is reset: ``disabled``, ``next_step`` or ``same_step``.
    """

    def __init__(
        self, codes: Sequence[int], mode: str = "disabled", limit: float = math.inf
    ) -> None:
        self.subs = [Script(code, limit) for code in codes]
        self.mode = mode

    @property
    def words(self) -> list[Words]:
        return [sub.words for sub in self.subs]

    def faults_of_reset(self, options: dict[str, Any] | None) -> list[Act]:
        """What a reset does to its process, one after the other."""
        token = (options or {}).get("token", 0)
        chosen = self._chosen(options)
        return [(self.subs[k].fault_of_reset(options), token) for k in chosen]

    def _chosen(self, options: dict[str, Any] | None) -> list[int]:
        """Which a reset resets."""
        mask = (options or {}).get("reset_mask")
        return [k for k in range(len(self.subs)) if mask is None or mask[k]]

    def faults_of_step(self, acts: Sequence[Act]) -> list[Act]:
        """What a step does to its process; scripts that are reset instead ignore their action."""
        resets = [self.mode == "next_step" and sub.over for sub in self.subs]
        return [
            (sub.fault_of_reset(None), 0) if reset else act
            for sub, act, reset in zip(self.subs, acts, resets, strict=True)
        ]

    def reset(self, seed: int | None, options: dict[str, Any] | None) -> list[dict[str, Any]]:
        """Reset all, or those of a mask; sub-environment k gets ``seed + k``."""
        infos: list[dict[str, Any]] = [{} for _ in self.subs]
        for k in self._chosen(options):
            infos[k] = self.subs[k].reset(None if seed is None else seed + k, options)
        return infos

    def step(self, acts: Sequence[Act]) -> Outcome:
        found = Outcome([], [], [], [], [], [], [])
        for sub, act in zip(self.subs, acts, strict=True):
            resets = self.mode == "next_step" and sub.over
            step = (0.0, False, False, sub.reset(None, None)) if resets else sub.step(*act)
            final = sub.words if self.mode == "same_step" and sub.over else None
            if final is not None:
                sub.reset(None, None)
            for column, value in zip(
                found, (sub.words, *step[:3], resets, final, step[3]), strict=True
            ):
                column.append(value)
        return found


# -- observations


class Layout(NamedTuple):
    """A space of observations, and how `Words` become one and back."""

    space: gym.Space[Any]
    encode: Callable[[Words], Any]
    decode: Callable[[Any], Any]


def _packed(words: Sequence[int]) -> int:
    number = 0
    for word, bits in zip(words, BITS, strict=True):
        number = number << bits | word
    return number


def _unpacked(number: int) -> list[int]:
    words: list[int] = []
    for bits in reversed(BITS):
        words.append(number & (1 << bits) - 1)
        number >>= bits
    return words[::-1]


def _as_bytes(words: Words) -> np.ndarray:
    return np.array(words, "<u4").view(np.uint8).reshape(5, 4).copy()


def _as_tree(words: Words) -> dict[str, Any]:
    head = np.array(words[:3], np.float32)
    return {"head": head, "rest": (words.step, {"mix": np.array([words.mix], np.uint16)})}


def _from_tree(tree: dict[str, Any]) -> list[int]:
    return [*tree["head"], tree["rest"][0], *tree["rest"][1]["mix"]]


_NUMBERS = string.digits + ","
_VECTOR = spaces.Box(-np.inf, np.inf, (5,), np.float64)
LAYOUTS: dict[str, Layout] = {
    "vector": Layout(_VECTOR, lambda w: np.array(w, np.float64), list),
    "single": Layout(
        spaces.Box(-np.inf, np.inf, (5,), np.float32), lambda w: np.array(w, np.float32), list
    ),
    "bytes": Layout(
        spaces.Box(0, 255, (5, 4), np.uint8),
        _as_bytes,
        lambda o: np.ascontiguousarray(o).view("<u4").ravel(),
    ),
    "digits": Layout(
        spaces.MultiDiscrete([1 << bits for bits in BITS]), lambda w: np.array(w, np.int64), list
    ),
    "number": Layout(
        spaces.Discrete(1 << sum(BITS)), lambda w: np.int64(_packed(w)), lambda o: _unpacked(int(o))
    ),
    "tree": Layout(
        spaces.Dict(
            head=spaces.Box(-np.inf, np.inf, (3,), np.float32),
            rest=spaces.Tuple(
                [
                    spaces.Discrete(1 << BITS.step),
                    spaces.Dict(mix=spaces.Box(0, 65_535, (1,), np.uint16)),
                ]
            ),
        ),
        _as_tree,
        _from_tree,
    ),
    "text": Layout(
        spaces.Text(64, charset=_NUMBERS), lambda w: ",".join(map(str, w)), lambda o: o.split(",")
    ),
    "list": Layout(
        spaces.Sequence(spaces.Box(0, 1 << 20, (1,), np.float64)),
        lambda w: tuple(np.array([word], np.float64) for word in (*w, *range(w.mix % 3))),
        lambda o: [one[0] for one in o[:5]],
    ),
    "part": Layout(
        spaces.Dict(named=_VECTOR, said=spaces.Text(8, charset=_NUMBERS)),
        lambda w: {"named": np.array(w, np.float64), "said": str(w.mix)},
        lambda o: [*o["named"][:4], int(o["said"])],
    ),
    "anything": Layout(Anything(), lambda w: w._asdict(), lambda o: o.values()),
    "half": Layout(
        spaces.Dict(named=_VECTOR, said=Anything()),
        lambda w: {"named": np.array(w, np.float64), "said": ["mix", w.mix]},
        lambda o: [*o["named"][:4], o["said"][1]],
    ),
}
FIXED = ("vector", "single", "bytes", "digits", "tree")
"""Layouts that can be stacked in a vector env."""


def words_of(layout: str, observation: Any) -> Words:
    """The state that an observation shows."""
    return Words(*(int(word) for word in LAYOUTS[layout].decode(observation)))


def element(column: Any, row: int) -> Any:
    """One row of a column: of an array, a list, or dicts and tuples of such."""
    if isinstance(column, dict):
        return {key: element(part, row) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(element(part, row) for part in column)
    return column[row]


# -- actions


class Controls(NamedTuple):
    """A space of actions, and how an effect and a token become one and back."""

    space: gym.Space[Any]
    encode: Callable[[int, int], Any]
    decode: Callable[[Any], Any]


_PAIR = spaces.MultiDiscrete([len(EFFECTS), TOKENS])
CONTROLS: dict[str, Controls] = {
    "vector": Controls(
        spaces.Box(-99, 99, (2,), np.float64), lambda e, t: np.array([e, t], np.float64), list
    ),
    "single": Controls(
        spaces.Box(-99, 99, (2,), np.float32), lambda e, t: np.array([e, t], np.float32), list
    ),
    "digits": Controls(_PAIR, lambda e, t: np.array([e, t], np.int64), list),
    "number": Controls(
        spaces.Discrete(len(EFFECTS) * TOKENS),
        lambda e, t: e * TOKENS + t,
        lambda a: divmod(int(a), TOKENS),
    ),
    "tree": Controls(
        spaces.Dict(
            effect=spaces.Discrete(len(EFFECTS)),
            rest=spaces.Tuple([spaces.Box(0, TOKENS, (1,), np.float32)]),
        ),
        lambda e, t: {"effect": e, "rest": (np.array([t], np.float32),)},
        lambda a: (a["effect"], a["rest"][0][0]),
    ),
    "text": Controls(
        spaces.Text(8, charset=_NUMBERS), lambda e, t: f"{e},{t}", lambda a: a.split(",")
    ),
    "anything": Controls(Anything(), lambda e, t: {"do": [e, t]}, lambda a: a["do"]),
}


def encoded(controls: str, effect: str, token: int) -> Any:
    """The action that has an env do `effect`."""
    return CONTROLS[controls].encode(EFFECTS.index(effect), token)


def decoded(controls: str, action: Any) -> tuple[str, int]:
    """What an action has an env do."""
    effect, token = CONTROLS[controls].decode(action)
    return EFFECTS[int(effect)], int(token)


# -- envs


_MADE_AS: WeakKeyDictionary[_Body, int] = WeakKeyDictionary()
"""The code of each env, also when the state of another was restored."""


class _Body:
    """What all envs of scripts have: the scripts, and what can be asked of them."""

    def __init__(self, codes: Sequence[int], mode: str, layout: str, controls: str) -> None:
        machine.make(codes[0])
        _MADE_AS[self] = codes[0]
        self.layout, self.controls = layout, controls
        self.scripts = Scripts(codes, mode)

    @property
    def mark(self) -> int:
        """A part of the state of each script that can be set from outside."""
        return self.scripts.subs[0].mark

    @mark.setter
    def mark(self, mark: int) -> None:
        for sub in self.scripts.subs:
            sub.mark = mark

    def peek(self, *echo: Any) -> Any:
        """Return the state, and the arguments."""
        return [tuple(words) for words in self.scripts.words], echo

    def fault(self, effect: str, token: int) -> None:
        """Do to the process what a step would."""
        perform(effect, token)

    def close(self) -> None:
        if self.mark == UNCLOSABLE:
            raise RuntimeError("it does not close")

    def observed(self, words: Words, effect: str = "plain") -> Any:
        return "rubbish" if effect == "rubbish" else LAYOUTS[self.layout].encode(words)


class _Single(_Body):
    """One script; those with an odd code return the same array again and again."""

    def __init__(self, code: int, layout: str, controls: str) -> None:
        super().__init__([code], "disabled", layout, controls)
        self._returned: np.ndarray | None = None
        self.observation_space = deepcopy(LAYOUTS[layout].space)
        self.action_space = deepcopy(CONTROLS[controls].space)

    def observed(self, words: Words, effect: str = "plain") -> Any:
        observed = super().observed(words, effect)
        if not self.scripts.subs[0].code % 2 or not isinstance(observed, np.ndarray):
            return observed
        if self._returned is None:
            self._returned = observed
        self._returned[...] = observed
        return self._returned

    def _begun(self, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, Any]:
        (info,) = self.scripts.reset(seed, options)
        if options is not None:
            options.clear()  # They are this env's own.
        return self.observed(self.scripts.words[0]), info

    def _stepped(self, act: Act) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        found = self.scripts.step([act])
        head = found.rewards[0], found.terminated[0], found.truncated[0]
        return (self.observed(found.words[0], act[0]), *head, found.infos[0])


class Scripted(_Single, gym.Env[Any, Any]):
    """A script as an env of Gymnasium."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        for fault in self.scripts.faults_of_reset(options):
            perform(*fault)
        return self._begun(seed, options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        act = decoded(self.controls, action)
        perform(*act)
        return self._stepped(act)

    def render(self) -> Any:
        return np.full((16, 16, 3), self.scripts.words[0].mix % 256, np.uint8)


class Awaitable(_Single):
    """A script with `async def`; one with an odd code takes long to close."""

    async def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        for fault in self.scripts.faults_of_reset(options):
            await perform_awaiting(*fault)
        return self._begun(seed, options)

    async def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        act = decoded(self.controls, action)
        await perform_awaiting(*act)
        return self._stepped(act)

    async def close(self) -> None:
        code = _MADE_AS[self]
        machine.closing(code, ends=False)
        try:
            if code % 2:
                await machine.await_for(3.0)
            super().close()
        finally:
            machine.closing(code, ends=True)


class Stacked(_Body, gym.vector.VectorEnv[Any, Any, Any]):
    """Several scripts as a vector env of Gymnasium, which cuts their episodes itself."""

    def __init__(
        self, codes: Sequence[int], mode: str, limit: int | None, layout: str, controls: str
    ) -> None:
        super().__init__(codes, mode, layout, controls)
        self.scripts = Scripts(codes, mode, limit or math.inf)
        self.spec = EnvSpec("Stacked-v0", max_episode_steps=limit)
        self.num_envs = len(codes)
        self.metadata = {"autoreset_mode": AutoresetMode[mode.upper()]}
        self.single_observation_space = deepcopy(LAYOUTS[layout].space)
        self.single_action_space = deepcopy(CONTROLS[controls].space)
        # Otherwise they are seeded at random when they are batched.
        self.single_observation_space.seed(0)
        self.single_action_space.seed(0)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def _stacked(self, words: Sequence[Words], acts: Sequence[Act] = ()) -> Any:
        if any(effect == "rubbish" for effect, _ in acts):
            return "rubbish"
        rows = [self.observed(each) for each in words]
        empty = create_empty_array(self.single_observation_space, len(rows))
        return concatenate(self.single_observation_space, rows, empty)

    def _joined(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        joined: dict[str, Any] = {}
        for k, info in enumerate(infos):
            joined = self._add_info(joined, info, k)
        return joined

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        for fault in self.scripts.faults_of_reset(options):
            perform(*fault)
        infos = self.scripts.reset(seed, options)
        if options is not None:
            options.clear()
        return self._stacked(self.scripts.words), self._joined(infos)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        acts = [decoded(self.controls, one) for one in iterate(self.action_space, actions)]
        faults = self.scripts.faults_of_step(acts)
        for fault in faults:
            perform(*fault)
        found = self.scripts.step(acts)
        infos = [
            info if final is None else {"final_obs": self.observed(final), "final_info": info}
            for info, final in zip(map(_with_floats, found.infos), found.finals, strict=True)
        ]
        head = map(np.array, (found.rewards, found.terminated, found.truncated))
        return (self._stacked(found.words, faults), *head, self._joined(infos))


@ENVS.register("simulated")
class ScriptedBase(BaseEnv):
    """A script as an env of this package; a response's `shift` is added to the token."""

    def __init__(self, config: Any, worker_index: int = 0, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, worker_index, *args, **kwargs)
        first_code, layout, controls = (
            config.env_kwargs[name] for name in ("first_code", "layout", "controls")
        )
        self.env = Scripted(first_code + worker_index, layout, controls)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> EnvRet:
        observation, info = self.env.reset(seed=seed, options=options)
        return EnvRet(env_id=self.env_id, observation=observation, info=info)

    def act_of(self, policy_resp: PolicyResponse) -> Act:
        """What a response has it do."""
        effect, token = decoded(self.env.controls, self._preprocess_fn(policy_resp))
        return effect, (token + int(getattr(policy_resp, "shift", 0))) % TOKENS

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        effect, token = self.act_of(policy_resp)
        perform(effect, token)
        observation, reward, terminated, truncated, info = self.env._stepped((effect, token))
        return EnvRet(
            env_id=self.env_id, observation=observation, last_reward=reward,
            last_terminated=terminated, last_truncated=truncated, info=info,
            _extra={"step": self.env.scripts.subs[0].steps},
        )  # fmt: skip

    def peek(self, *echo: Any) -> Any:
        return self.env.peek(*echo)

    def fault(self, effect: str, token: int) -> None:
        perform(effect, token)

    def close(self) -> None:
        self.env.close()

    def save_state(self) -> Any:
        return [sub.__getstate__() for sub in self.env.scripts.subs]

    def load_state(self, state: Any) -> None:
        for sub, own in zip(self.env.scripts.subs, state, strict=True):
            sub.__setstate__(own)


def broken(effect: str, make: Callable[..., Any], *args: Any) -> Any:
    """Do something to the process, then make an env."""
    perform(effect, 0)
    return make(*args)


MAKERS: dict[str, Callable[..., Any]] = {
    "gym": Scripted,
    "awaitable": Awaitable,
    "stacked": Stacked,
}
"""What `task` may call, by the form of the envs; `ScriptedBase` is a backend."""
