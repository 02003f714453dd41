"""Faults from outside: signals to processes, failing builds, floods of connections.

No process is stopped for good while it executes a call: calls have no time limit, so waiting for
one is correct. `muted` says which envs must not get calls.
"""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

    from chaos_books import Books
    from chaos_judge import Env

FAULTS = {
    "kill worker": 30.0,
    "stop and continue worker": 30.0,
    "stop worker": 3.0,
    "continue anybody": 5.0,
    "kill fork server": 0.5,
    "stop and continue fork server": 3.0,
    "stop fork server": 0.2,
    "stop worker and fork server": 0.3,
    "stop, then kill worker": 3.0,
    "break the next build": 4.0,
    "kill client": 4.0,
    "stop and continue client": 4.0,
    "stop client for long": 0.5,
    "flood the env_server": 2.0,
}
"""The frequency of each fault."""
CLIENT_STOP = 4.0
"""Seconds; longer than a heartbeat."""


class Strikes:
    """Injects faults into one group.

    Args:
        orders: the faults of the next build of each env.
        after: calls a function some seconds later, whatever waits meanwhile.
        flood: opens many connections to the env_server; None if there is none.
    """

    def __init__(
        self,
        books: Books,
        orders: Any,
        rng: random.Random,
        after: Callable[[float, Callable[[], object]], None],
        flood: Callable[[], None] | None,
    ) -> None:
        self._books = books
        self._orders = orders
        self._rng = rng
        self._after = after
        self._flood = flood
        self._signal = books.processes.signal
        self._muted: set[int] = set()
        self._strikes: dict[str, Callable[[Env], bool]] = {
            "kill worker": self._kill_worker,
            "stop and continue worker": self._stop_and_continue_worker,
            "stop worker": self._stop_worker,
            "continue anybody": self._continue_anybody,
            "kill fork server": self._kill_fork_server,
            "stop and continue fork server": self._stop_and_continue_fork_server,
            "stop fork server": self._stop_fork_server,
            "stop worker and fork server": self._stop_both,
            "stop, then kill worker": self._stop_then_kill_worker,
            "break the next build": self._break_build,
            "kill client": lambda env: self._signal(env.pid, signal.SIGKILL),
            "stop and continue client": lambda env: self._stop_client(env, CLIENT_STOP / 10),
            "stop client for long": lambda env: self._stop_client(env, CLIENT_STOP),
        }

    def muted(self, env: Env) -> bool:
        """Return True if its worker or fork server is stopped."""
        return env.pid in self._muted or env.parent in self._muted

    def strike(self) -> str | None:
        """Inject one fault; return its name, or None if it was not possible."""
        name = self._rng.choices(list(FAULTS), list(FAULTS.values()))[0]
        if name == "flood the env_server":
            if self._flood is None:
                return None
            self._flood()
            return name
        place = "client" if "client" in name else "process"
        envs = [e for e in self._books.envs.values() if e.place == place and not e.gone]
        if not envs:
            return None
        return name if self._strikes[name](self._rng.choice(envs)) else None

    def _kill_worker(self, env: Env) -> bool:
        self._books.doomed.add(env.pid)
        return self._signal(env.pid, signal.SIGKILL)

    def _stop_and_continue_worker(self, env: Env) -> bool:
        if self.muted(env):
            return False
        pid = env.pid
        self._books.doomed.add(pid)
        self._after(self._rng.uniform(0.001, 0.3), lambda: self._signal(pid, signal.SIGCONT))
        return self._signal(pid, signal.SIGSTOP)

    def _continue_anybody(self, env: Env) -> bool:
        if self.muted(env):
            return False
        return self._signal(self._rng.choice((env.pid, env.parent)), signal.SIGCONT)

    def _kill_fork_server(self, env: Env) -> bool:
        self._books.doomed.add(env.parent)
        return self._signal(env.parent, signal.SIGKILL)

    def _stop_and_continue_fork_server(self, env: Env) -> bool:
        parent = env.parent
        if not self._mute(env, parent):
            return False

        def go_on() -> None:
            self._muted.discard(parent)
            self._signal(parent, signal.SIGCONT)

        self._after(self._rng.uniform(0.001, 0.5), go_on)
        return self._signal(parent, signal.SIGSTOP)

    def _mute(self, env: Env, pid: int) -> bool:
        """Send no calls to a process; return False if it has a call or is muted already."""
        mates = [mate for mate in self._books.envs.values() if mate.parent == env.parent]
        calling = any(m.limbo or (m.request and m.request.kind == "call") for m in mates)
        if calling or self.muted(env):
            return False
        self._muted.add(pid)
        self._books.doomed.update((env.pid, env.parent))
        return True

    def _stop_worker(self, env: Env) -> bool:
        return self._mute(env, env.pid) and self._signal(env.pid, signal.SIGSTOP)

    def _stop_fork_server(self, env: Env) -> bool:
        return self._mute(env, env.parent) and self._signal(env.parent, signal.SIGSTOP)

    def _stop_both(self, env: Env) -> bool:
        if not self._mute(env, env.parent):
            return False
        self._signal(env.pid, signal.SIGSTOP)
        return self._signal(env.parent, signal.SIGSTOP)

    def _stop_then_kill_worker(self, env: Env) -> bool:
        pid = env.pid
        if not self._mute(env, pid):
            return False
        self._after(self._rng.uniform(0.0, 0.2), lambda: self._signal(pid, signal.SIGKILL))
        return self._signal(pid, signal.SIGSTOP)

    def _break_build(self, env: Env) -> bool:
        self._orders[env.index] = self._rng.choices((1, 2, 3), (5, 5, 1))[0]
        return self._kill_worker(env)

    def _stop_client(self, env: Env, most: float) -> bool:
        pid = env.pid
        self._after(self._rng.uniform(most / 10, most), lambda: self._signal(pid, signal.SIGCONT))
        return self._signal(pid, signal.SIGSTOP)
