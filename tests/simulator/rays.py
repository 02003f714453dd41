"""A simulated Ray: actors in processes of the world, and the calls between them and the trainer.

It is what `hosts.ray.host` uses of Ray. Calls reach an actor in order, their values travel as
pickles, and their outcomes arrive in order, late. An actor may not find a node at first, and may
end, alone or with its node; calls that have not returned then end in Ray's errors.
"""

from __future__ import annotations

import importlib.util
import pickle
import signal
import sys
from collections import deque
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

from simulator.processes import Process

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from simulator.world import World

__all__ = ["MODULE", "SimulatedRay", "importable"]

_NAME = "rlightning_aio._core.hosts.ray.host"
_ENDS = {-signal.SIGKILL: "Worker unexpectedly exits with a connection error code 2. End of file."}


def _module() -> ModuleType:
    """Import the package's module for Ray, also where Ray is not installed."""
    is_installed = importlib.util.find_spec("ray") is not None
    if not is_installed:
        sys.modules["ray"] = ModuleType("ray")
    found = importlib.import_module(_NAME)
    if not is_installed:
        for name in ("ray", _NAME):
            del sys.modules[name]
    return found


MODULE = _module()


@contextmanager
def importable() -> Iterator[None]:
    """Have the module found by its name, also where Ray is not installed."""
    is_added = _NAME not in sys.modules
    sys.modules.setdefault(_NAME, MODULE)
    yield
    if is_added:
        del sys.modules[_NAME]


class _Call(NamedTuple):
    """A call that has not returned; `outcome` gets what becomes of it."""

    method: str
    arguments: bytes
    outcome: _Reference


class _Reference:
    """See `ray.ObjectRef`."""

    def __init__(self) -> None:
        self._then: Callable[[Any], None] = lambda _: None

    def _on_completed(self, then: Callable[[Any], None]) -> None:
        self._then = then

    def complete(self, outcome: Any) -> None:
        """Pass the outcome on, as a thread of Ray does."""
        self._then(outcome)


class SimulatedRay:
    """See `ray`."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._is_initialized = False

    def is_initialized(self) -> bool:
        return self._is_initialized

    def init(self, address: str | None = None) -> None:
        del address
        self._is_initialized = True

    def shutdown(self) -> None:
        self._is_initialized = False

    def remote(self, **options: Any) -> Callable[[type], _ActorClass]:
        del options
        return lambda actor_class: _ActorClass(self._world, actor_class)

    def kill(self, handle: _Handle) -> None:
        handle.actor.end(-signal.SIGKILL)


class _ActorClass:
    """See what `ray.remote` returns."""

    def __init__(self, world: World, actor_class: type) -> None:
        self._world = world
        self._actor_class = actor_class

    def options(self, **options: Any) -> _ActorClass:
        del options
        return self

    def remote(self, *arguments: Any) -> _Handle:
        if self._world.refuses():
            raise RuntimeError("Ray is not there, as the world wants it")
        return _Handle(Actor(self._world, self._actor_class, pickle.dumps(arguments)))


class _Handle:
    """See `ray.actor.ActorHandle`."""

    def __init__(self, actor: Actor) -> None:
        self.actor = actor

    def __getattr__(self, name: str) -> _Method:
        return _Method(self.actor, name)


class _Method:
    """See `ray.actor.ActorMethod`."""

    def __init__(self, actor: Actor, name: str) -> None:
        self._actor, self._name = actor, name

    def remote(self, *arguments: Any) -> _Reference:
        call = _Call(self._name, pickle.dumps(arguments), _Reference())
        self._actor.call(call)
        return call.outcome


class Actor(Process):
    """The process of an actor, which executes one call after the other."""

    def __init__(self, world: World, actor_class: type, arguments: bytes) -> None:
        super().__init__(world, "an actor", self._serve, self._on_end)
        self._make = lambda: actor_class(*pickle.loads(arguments))
        self._waiting: deque[_Call] = deque()
        self._unanswered: list[_Call] = []

    def call(self, call: _Call) -> None:
        """Take a call, which is executed after all others."""
        if not self.alive:
            self._answer(call, _Gone("The actor is dead: ray.kill"))
            return
        self._unanswered.append(call)
        self._waiting.append(call)
        self.wake()

    def _serve(self) -> int:
        self._instance = self._make()
        while True:
            self.wait_for(lambda: self._waiting, None)
            self._execute(self._waiting.popleft())

    def _execute(self, call: _Call) -> None:
        self.world.point()
        try:
            outcome = getattr(self._instance, call.method)(*pickle.loads(call.arguments))
            value = pickle.loads(pickle.dumps(outcome))
        except Exception as error:  # noqa: BLE001  # Ray passes it on.
            value = error
        self.world.point()
        self.world.note("{} has executed {}", self.name, call.method)
        self._unanswered.remove(call)
        self._answer(call, value)

    def _answer(self, call: _Call, value: Any) -> None:
        """Send what became of a call, which may arrive before earlier outcomes."""
        self.world.after(self.world.delay(), partial(call.outcome.complete, value))

    def _on_end(self, code: int, stderr: str) -> None:
        del stderr
        why = _ENDS.get(code, f"Worker exits with an exit code {code}.")
        if self.world.rng.random() < 0.2:
            why = "The actor died because its node has died."
        for call in self._unanswered:
            self._answer(call, _Gone(why))


class _Gone(Exception):
    """See `ray.exceptions.ActorDiedError`."""
