"""Programs: a configuration and a list of operations, each drawn from one seed.

`draw` makes a program by swarm: each leaves out a random half of the features. An operation draws
its arguments from its own seed and from what the model knows, so that a list of them can be shrunk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from random import Random
from typing import TYPE_CHECKING, Any, Final

from simulator.clients import Client
from simulator.model import Entry, Env, Host, State
from simulator.scripted import CONTROLS, FIXED, LAYOUTS, MAKERS, TIMEOUT, broken
from simulator.world import Faults

if TYPE_CHECKING:
    from collections.abc import Sequence

    from simulator.world import World

FEATURES = (
    "async", "several entries", "several envs", "stacked", "out of band", "base", "awaitable",
    "processes", "ray",
    "auto_reset", "partial steps", "plain values", "extras", "calls", "handles", "snapshots",
    "cancel", "timeouts", "tasks", "raise", "rubbish", "infos", "ends", "slow", "die", "hang",
    "raise deaths", "misuse", "zero_copy", "timeline", "faults",
    "interrupts",
)  # fmt: skip
CLIENTS: Final = "clients"
"""A feature of few groups, beside those of `FEATURES`; see `_with_clients`."""
_OF_OTHERS = (("die", "processes", "ends", "stacked"), ("processes", "hang", "faults"))
THEMES: dict[str, tuple[tuple[str, ...], ...]] = {
    "group": (
        ("snapshots", "die", "processes", "auto_reset"),
        ("snapshots", "die", "processes", "several envs"),
        ("async", "snapshots", "cancel", "timeouts"),
        ("snapshots", "calls", "several envs", "faults", "interrupts"),
        ("processes", "faults", "several envs", "calls"),
        ("auto_reset", "stacked", "ends"),
        ("several envs", "extras", "infos", "partial steps"),
        *_OF_OTHERS,
    ),
    "training": (
        ("async", "cancel", "processes", "several entries", "several envs"),
        *_OF_OTHERS,
    ),
    "evaluations": _OF_OTHERS,
    "vectors": _OF_OTHERS,
    "sb3": _OF_OTHERS,
    "attempts": (
        ("cancel", "timeouts", "die", "processes", "several envs"),
        ("awaitable", "hang", "timeouts", "cancel", "several envs", "processes"),
        ("raise", "ends", "several envs", "several entries"),
        *_OF_OTHERS,
    ),
}
"""Features that matter to each other: half of the programs of a kind have those of a theme."""


@dataclass(frozen=True)
class Op:
    """An operation, and the seed of its arguments."""

    name: str
    seed: int


@dataclass(frozen=True)
class Plan:
    """An entry of the configuration."""

    name: str
    form: str = "gym"
    layout: str = "vector"
    controls: str = "vector"
    num_workers: int = 1
    num_envs: int = 1
    mode: str = "disabled"
    placement: str = "inline"
    share: int = 1
    limit: int | None = None
    on_death: str = "restart"
    max_restarts: int = 3
    on_error: str = "raise"
    timeout: float | None = None
    start: str = ""
    heartbeat: float = 5.0
    recycle: int = 0

    def config(self, number: int) -> dict[str, Any]:
        """The fields of the entry, the `number`-th."""
        found: dict[str, Any] = {
            "name": self.name, "num_workers": self.num_workers, "placement": self.placement,
            "max_restarts": self.max_restarts, "step_timeout": self.timeout,
            "reset_timeout": self.timeout, "on_worker_death": self.on_death,
            "on_env_error": self.on_error,
        }  # fmt: skip
        if self.placement in ("inline", "loop"):
            if self.placement == "inline":
                del found["on_worker_death"]
                if self.on_error == "raise":
                    del found["max_restarts"]
        else:
            found["envs_per_process"] = self.share
            if self.recycle:
                found["recycle"] = {"episodes": self.recycle}
        if self.timeout is None:
            del found["step_timeout"], found["reset_timeout"]
        if self.limit is not None and self.form != "stacked":  # Those have their own.
            found["max_episode_steps"] = self.limit
        if self.form == "base":
            kwargs = {"layout": self.layout, "controls": self.controls}
            kwargs["first_code"] = self.codes(number, 0)[0]
            return found | {
                "backend": "simulated", "task": "-", "imports": ["simulator.scripted"],
                "env_kwargs": kwargs,
            }  # fmt: skip
        make = MAKERS[self.form]
        makers: list[Any] = []
        for worker in range(self.num_workers):
            codes = self.codes(number, worker)
            own = (codes, self.mode, self.limit) if self.form == "stacked" else (codes[0],)
            makers.append(partial(make, *own, self.layout, self.controls))
        if self.start:
            makers[-1] = partial(broken, self.start, make, *makers[-1].args)
            found["start_timeout"] = 5.0
        return found | {"task": makers}

    def served(self) -> dict[str, Any]:
        """The fields of an env_server."""
        found = {
            "name": self.name, "backend": "env_server", "max_episode_steps": self.limit,
            "step_timeout": self.timeout, "reset_timeout": self.timeout,
            "max_restarts": 1_000_000,
            "env_kwargs": {
                "heartbeat": self.heartbeat, "connect_timeout": 900.0,
                "clients": [f"c{k}" for k in range(self.num_workers)],
            },
        }  # fmt: skip
        return {name: value for name, value in found.items() if value is not None}

    def codes(self, number: int, worker: int) -> list[int]:
        """Of the sub-environments of one env."""
        first = number * 64 + worker * (8 if self.form == "stacked" else 1)
        return [first + k for k in range(self.num_envs)]

    def entry(self) -> Entry:
        """What the model must know."""
        return Entry(
            self.name, self.form, self.layout, self.controls, self.num_envs, self.mode,
            self.limit, self.on_death, self.max_restarts, self.on_error,
        )  # fmt: skip


@dataclass(frozen=True)
class Program:
    """One run.

    Attributes:
        kind: of `KINDS`.
        features: what it may use.
        faults: of the world that it runs in.
    """

    seed: int
    kind: str
    features: frozenset[str]
    plans: tuple[Plan, ...]
    ops: tuple[Op, ...]
    faults: Faults

    def configs(self) -> list[dict[str, Any]]:
        return [
            plan.served() if plan.placement == "client" else plan.config(number)
            for number, plan in enumerate(self.plans)
        ]

    def envs(self, workers: list[dict[str, Any]], world: World | None) -> list[Env]:
        """The model's envs, on the hosts that `get_workers` names."""
        host_of: dict[str, Host] = {}
        num_recycled = 0
        for number, worker in enumerate(workers):
            plan = next(plan for plan in self.plans if plan.name == worker["entry"])
            here = plan.placement == "inline"
            on_ray = plan.placement == "ray"
            process = "an actor" if on_ray else f"worker {number}"
            names = [process]
            if plan.recycle:  # Its other host has the next worker.
                names += [] if on_ray else [f"worker {len(workers) + num_recycled}"]
                num_recycled += 1
            count = None if world is None else partial(_deaths_of, world, names)
            renewed = plan.recycle > 0
            host = Host(mortal=on_ray or not here, count=count, knows=not on_ray, renewed=renewed)
            host_of |= dict.fromkeys(worker["env_ids"], host)
        envs: list[Env] = []
        first = 0
        for number, plan in enumerate(self.plans):
            entry = plan.entry()
            for worker in range(plan.num_workers):
                env_id, codes = f"{plan.name}-{worker}", plan.codes(number, worker)
                if plan.placement == "client":
                    assert world is not None
                    envs.append(Client(world, worker, entry, codes, first).env)
                    first += plan.num_envs
                    continue
                # On an event loop each is replaced alone.
                host = Host(mortal=True) if plan.placement == "loop" else host_of[env_id]
                envs.append(Env(env_id, entry, codes, first, host, State(codes, entry)))
                first += plan.num_envs
        return envs


OPS: dict[str, tuple[int, str | None]] = {
    "step": (10, None),
    "step_async": (14, None),
    "collect": (16, None),
    "reset": (4, None),
    "reset_async": (3, None),
    "enter": (4, "auto_reset"),
    "leave": (2, "auto_reset"),
    "call": (3, "calls"),
    "mark": (2, "calls"),
    "handle": (4, "handles"),
    "episode": (2, "handles"),
    "snapshot": (5, "snapshots"),
    "restore": (9, "snapshots"),
    "cancel": (6, "cancel"),
    "expire": (4, "timeouts"),
    "abort": (3, "cancel"),
    "drain": (2, "cancel"),
    "task": (8, "tasks"),
    "join": (3, "tasks"),
    "misuse": (4, "misuse"),
    "look": (3, None),
    "trace": (2, "timeline"),
    "kill": (3, "die"),
    "client": (10, CLIENTS),
}
"""Weight of each operation of a group, and the feature that it needs."""
ROWS: dict[str, tuple[int, str | None]] = {
    "reset": (1, None), "step": (12, None), "kill": (2, "die"),
}  # fmt: skip
KINDS: dict[str, tuple[int, dict[str, tuple[int, str | None]]]] = {
    "group": (12, OPS),
    "training": (
        5,
        {
            "rollout": (6, None),
            "learn": (2, None),
            "restart": (1, None),
            "kill": (2, "die"),
            "client": (4, CLIENTS),
        },
    ),
    "evaluations": (2, {"evaluate": (6, None), "kill": (2, "die")}),
    "vectors": (4, ROWS | {"mask": (3, None), "call": (1, "calls"), "state": (2, "snapshots")}),
    "sb3": (2, ROWS),
    "attempts": (0, {"attempts": (6, None), "kill": (2, "die"), "client": (4, CLIENTS)}),
}
"""Kinds of programs: the weight of each, and its operations; see `draw` for that of attempts."""
_ATTEMPTS: Final = 0.06
"""The share of programs that are of attempts, in place of what else they would be."""
RECYCLE: Final = "recycle"
_RECYCLED: Final = 0.4
"""The share of programs whose workers may be renewed."""
_CLIENTS: Final = 0.2
"""The share of programs that have clients, of those that may have them."""


def draw(seed: int, *, without: frozenset[str] = frozenset(), num_ops: int = 60) -> Program:
    """The program of a seed, without some features; a third of them have few."""
    program = _drawn(seed, without, num_ops)
    apart = Random(seed ^ 0x2EC7C1E)
    if apart.random() > _RECYCLED or RECYCLE in without:
        return program
    plans = tuple(_recycled(apart, plan) for plan in program.plans)
    return replace(program, plans=plans, features=program.features | {RECYCLE})


def _drawn(seed: int, without: frozenset[str], num_ops: int) -> Program:
    rng = Random(seed)
    share = rng.choice((0.25, 0.5, 0.5))
    kind = rng.choices([*KINDS], [weight for weight, _ in KINDS.values()])[0]
    if Random(seed ^ 0x5EED).random() < _ATTEMPTS:  # The draws of the others stay what they were.
        kind = "attempts"
    theme = rng.choice(THEMES[kind]) if rng.random() < 0.5 else ()
    features = frozenset(f for f in FEATURES if f in theme or rng.random() < share) - without
    if kind == "attempts":
        features = features - {"stacked"} | {"async"}
    plans = [_plan(rng, features, "a")]
    if "several entries" in features:
        plans += [_plan(rng, features, name) for name in "bc"[: rng.randint(1, 2)]]
    remote = ("process", "ray")
    workers = [k for k, p in enumerate(plans) if p.placement in remote and p.form in MAKERS]
    if workers and rng.random() < 0.03:
        k = rng.choice(workers)
        plans[k] = replace(plans[k], start=rng.choice(["raise", "exit", "hang"]))
    if kind in ("vectors", "sb3"):
        features, plans = _as_rows(rng, features, kind)
    apart = Random(~seed)  # Of a later feature: the draws of the others stay what they were.
    if {"raise", "rubbish"} & features and apart.random() < 0.8:
        plans = [_restarted(apart, plan) for plan in plans]
    has_clients = kind in ("group", "training", "attempts") and apart.random() < _CLIENTS
    has_clients = has_clients and CLIENTS not in without
    if has_clients:
        features, plans = _with_clients(apart, features, plans)
    ops_of_kind = KINDS[kind][1]
    names = [name for name, (_, needs) in ops_of_kind.items() if needs is None or needs in features]
    # A few of them make up most of a program.
    weights = [ops_of_kind[name][0] * rng.choice((0.2, 1.0, 5.0)) for name in names]
    most = num_ops // {"attempts": 10, "training": 5, "evaluations": 5}.get(kind, 1)
    count = rng.randint(most // 4, most)
    ops = [Op(name, rng.getrandbits(32)) for name in rng.choices(names, weights, k=count)]
    begins = kind in ("group", "vectors", "sb3") and rng.random() < 0.8
    first = [Op("reset", rng.getrandbits(32))] if begins else []
    kinds = ["deaths", "stops", "lags", "starts", "fork_servers"]
    kinds += ["interrupts"] * ("async" not in features and "interrupts" in features)
    if rng.random() < 0.5:
        kinds = rng.sample(kinds, 1)
    else:
        kinds = [kind for kind in kinds if rng.random() < 0.4]
    chances = {kind: rng.choice([0.01, 0.03, 0.1, 0.4]) for kind in kinds}
    faults = Faults(**chances) if "faults" in features else Faults()
    if has_clients and apart.random() < 0.5:
        faults = replace(faults, cuts=apart.choice([0.003, 0.03, 0.1]))
    return Program(seed, kind, features, tuple(plans), (*first, *ops), faults)


def _as_rows(rng: Random, features: frozenset[str], kind: str) -> tuple[frozenset[str], list[Plan]]:
    """What a vector interface is made of: envs of one kind, in a synchronous group."""
    features -= {"async", "base", "awaitable", "several entries", "stacked"}
    if kind == "sb3":
        features -= {"out of band"}
    plan = _plan(rng, features, "env")
    return features, [plan]


def _with_clients(
    rng: Random, features: frozenset[str], plans: list[Plan]
) -> tuple[frozenset[str], list[Plan]]:
    """The same and an env_server, perhaps in place of all else."""
    robots = Plan(
        "robots", "base", rng.choice([*FIXED, "number", "text", "part"]),
        rng.choice([c for c in CONTROLS if c != "anything"]), num_workers=rng.randint(1, 3),
        limit=rng.choice([None, 3]), placement="client", heartbeat=rng.choice([5.0, 30.0]),
        timeout=TIMEOUT if "hang" in features and rng.random() < 0.7 else None,
    )  # fmt: skip
    return features | {CLIENTS}, [*(plans if rng.random() < 0.6 else ()), robots]


def _restarted(rng: Random, plan: Plan) -> Plan:
    """The same plan, perhaps with envs that are rebuilt after an exception."""
    if rng.random() < 0.3:
        return plan
    return replace(plan, on_error="restart", max_restarts=rng.choice([3, 1, 0]))


def _recycled(rng: Random, plan: Plan) -> Plan:
    """The same plan, perhaps with workers that are replaced after so many episodes."""
    if plan.placement not in ("process", "ray"):
        return plan
    return replace(plan, recycle=rng.choice([0, 1, 1, 2, 3, 5, 8]))


def _deaths_of(world: World, names: Sequence[str]) -> int:
    return sum(world.deaths[name] for name in names)


def _plan(rng: Random, features: frozenset[str], name: str) -> Plan:
    forms = ("gym", "stacked", "stacked", "base", "awaitable")
    form = rng.choice([f for f in forms if f == "gym" or f in features])
    fixed = form == "stacked" or "out of band" not in features
    controls = [c for c in CONTROLS if not fixed or c not in ("text", "anything")]
    layouts = [*FIXED, "number"] if form != "stacked" and fixed else FIXED if fixed else LAYOUTS
    plan = Plan(
        name, form, rng.choice([*layouts]), rng.choice(controls),
        num_workers=rng.randint(1, 3) if "several envs" in features else 1,
        limit=rng.choice([None, 3]),
    )  # fmt: skip
    if form == "stacked":
        modes = ["disabled", "disabled", "next_step", "same_step"]
        plan = replace(plan, num_envs=rng.randint(2, 3), mode=rng.choice(modes))
    places = ["inline"] if form != "awaitable" else ["loop"] if "async" in features else []
    if "processes" in features or not places:
        places += ["process"] if form == "awaitable" else ["process"] * 5
    if "ray" in features and form != "awaitable":
        places += ["ray"] * 3
    placement = rng.choice(places)
    if placement in ("inline", "loop"):
        return replace(plan, placement=placement)
    plan = replace(plan, placement=placement, share=rng.randint(1, 3))
    if "hang" in features and rng.random() < 0.7:
        plan = replace(plan, timeout=TIMEOUT)
    if "raise deaths" in features and rng.random() < 0.3:
        return replace(plan, on_death="raise")
    return plan
