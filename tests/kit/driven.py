"""Groups of either kind behind one interface, and where their envs live.

`Driven` is a group of any driver for plain code; `Awaited` a synchronous one for coroutines. A test
of faults mainly costs the start of workers, so what the driver can't affect is tested on one.
"""

from __future__ import annotations

import asyncio
import inspect
import os
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import pytest
import uvloop
from kit.awaitable import awaitable_twins
from patience import HANG

import rlightning_aio
import rlightning_aio.sync
from rlightning_aio._core.group.drivers.aio_driver import AioDriver

if TYPE_CHECKING:
    from collections.abc import Iterable


class Driven:
    """A group of either kind for plain code: awaitable methods are awaited here."""

    def __init__(self, driver: str, cfgs: Any, **kwargs: Any) -> None:
        self.runner: asyncio.Runner | None = None
        if driver == "sync":
            self.group: Any = rlightning_aio.sync.build_env_group(cfgs, **kwargs)
        else:
            factory = uvloop.new_event_loop if driver == "uvloop" else asyncio.new_event_loop
            self.runner = asyncio.Runner(loop_factory=factory)
            self.group = rlightning_aio.build_env_group(cfgs, **kwargs)

    def done(self, result: Any) -> Any:
        """Return what a call has returned; awaited, if it must be."""
        if not inspect.iscoroutine(result):
            return result
        assert self.runner is not None
        return self.runner.run(result)

    def __getattr__(self, name: str) -> Any:
        method = getattr(self.group, name)
        return lambda *args, **kwargs: self.done(method(*args, **kwargs))

    def __len__(self) -> int:
        return len(self.group)

    def call(self, env_id: str, name: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method through the env's handle."""
        return self.done(self.group[env_id].call(name, *args, **kwargs))

    def end(self) -> None:
        """Close the group, and the loop."""
        self.done(self.group.close())
        if self.runner is not None:
            self.runner.close()


on_one_driver = pytest.mark.parametrize("driver", ["sync"])
"""For behaviour that is decided before any wait, or in the worker."""


def kinds_on_both_drivers(name: str, values: Iterable[str]) -> pytest.MarkDecorator:
    """Parametrise `name` with a list: all `values` on one driver, the first on the other.

    For variants that look alike to the driver, tested one after another.
    """
    kinds = list(values)
    cases = [pytest.param("sync", kinds, id="sync"), pytest.param("uvloop", kinds[:1], id="uvloop")]
    return pytest.mark.parametrize(("driver", name), cases)


FOR_BOTH = {
    "abort", "call", "call_with", "get_attr", "offload", "reload", "render", "set_attr",
}  # fmt: skip
"""Methods that wait, and are written once for both kinds of group."""


class Awaited:
    """A synchronous group or handle with the awaitable methods of the asynchronous one."""

    def __init__(self, wrapped: Any, like: type) -> None:
        self.wrapped = wrapped
        self._like = like

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self.wrapped, name)
        if name == "_driver":  # That of `calling`.
            return Awaited(attribute, AioDriver)
        if name == "_core":
            return attribute
        if not inspect.iscoroutinefunction(getattr(self._like, name)) and name not in FOR_BOTH:
            return attribute

        async def awaited(*args: Any, **kwargs: Any) -> Any:
            return attribute(*args, **kwargs)

        return awaited

    def __len__(self) -> int:
        return len(self.wrapped)

    def __getitem__(self, env_id: str) -> Awaited:
        return Awaited(self.wrapped[env_id], rlightning_aio.EnvHandle)

    async def __aenter__(self) -> Self:
        self.wrapped.__enter__()
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.wrapped.__exit__(*exc)


@dataclass(frozen=True)
class Place:
    """Where envs live, and the driver that waits for them."""

    name: str
    fields: dict[str, Any]
    synchronous: bool = False
    awaitable: bool = False

    @property
    def inline(self) -> bool:
        return self.name == "inline"

    def build(self, entries: Any, **kwargs: Any) -> Any:
        """Build a group of `entries` in this place."""
        listed = entries if isinstance(entries, list) else [entries]
        fields = [self.fields] * len(listed)
        if self.name == "mixed" and len(listed) > 1:
            fields[-1] = INLINE.fields
        placed = [entry | own for entry, own in zip(listed, fields, strict=True)]
        with awaitable_twins() if self.awaitable else nullcontext():
            if self.synchronous:
                group = rlightning_aio.sync.build_env_group(placed, **kwargs)
                return Awaited(group, rlightning_aio.EnvGroup)
            return rlightning_aio.build_env_group(placed, **kwargs)


LOOP = Place("loop", {"placement": "loop"}, awaitable=True)
"""The envs' awaitable twins, on the trainer's event loop."""
INLINE = Place("inline", {"placement": "inline"})
INLINE_SYNC = Place("inline", {"placement": "inline"}, synchronous=True)
SEVERAL = Place("several workers", {"envs_per_process": 2})
MIXED_SYNC = Place("mixed", {"envs_per_process": 2}, synchronous=True)
"""Two envs in each worker, and the last of several entries in this process."""
# Each actor is a separate Python; on a busy machine, four of them may take minutes to start.
ON_ACTORS = {"placement": "ray", "num_cpus": 0, "start_timeout": HANG}
RAY = Place("ray", {**ON_ACTORS, "envs_per_process": 2})
RAY_SYNC = Place("ray", {**ON_ACTORS, "envs_per_process": 100}, synchronous=True)
# Ray needs a separate environment and takes minutes: `make test-ray`.
ON_RAY = "RLIGHTNING_AIO_ON_RAY" in os.environ
AWAITING = Place("awaiting workers", {"envs_per_process": 2}, synchronous=True, awaitable=True)
"""Awaitable envs in workers. Only `test_stepping` runs on them; it is representative."""
PLACES = [RAY, RAY_SYNC] if ON_RAY else [INLINE, INLINE_SYNC, MIXED_SYNC, SEVERAL, LOOP, AWAITING]


def without_times(stats: dict[str, Any]) -> dict[str, Any]:
    """The figures of an env, of `get_env_stats`, that are the same in each run."""
    return {name: value for name, value in stats.items() if not name.startswith("seconds_")}
