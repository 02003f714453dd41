"""Run a program on Linux without what macOS lacks: `as_on_macos.py PROGRAM ARGUMENTS`.

`sys.platform` says darwin, nothing can be opened in /proc and /sys, and the calls and constants
of Linux alone are gone from `os`, `select`, `signal`, `socket`, `resource` and the C library. In
place of epoll there is a kqueue, which behaves as that of macOS for reading and writing.
"""

# pyright: basic

from __future__ import annotations

import _socket
import ctypes
import errno
import os
import resource
import runpy
import select
import signal
import sys
import sysconfig
import time
import types
from typing import Any, NamedTuple

_epoll, _EPOLLIN, _EPOLLOUT = select.epoll, select.EPOLLIN, select.EPOLLOUT
_READ, _WRITE, _ADD, _DELETE = -1, -2, 1, 2
_C_FUNCTIONS = ("epoll_create1", "eventfd", "memfd_create", "pidfd_open", "prctl", "syscall")


class Event(NamedTuple):
    ident: int
    filter: int
    flags: int = _ADD
    fflags: int = 0
    data: int = 0
    udata: int = 0


class Kqueue:
    """See `select.kqueue`."""

    def __init__(self) -> None:
        self._epoll, self._masks = _epoll(), {}

    def control(self, changes: Any, max_events: int, timeout: float | None = None) -> list[Event]:
        for ident, kind, flags, *_ in changes or ():
            self._change(ident, _EPOLLIN if kind == _READ else _EPOLLOUT, flags)
        if not max_events:
            return []
        found = []
        for descriptor, events in self._epoll.poll(-1 if timeout is None else timeout, max_events):
            mask = self._masks[descriptor]
            ended = events & ~(_EPOLLIN | _EPOLLOUT)
            if mask & _EPOLLIN and (events & _EPOLLIN or ended):
                found.append(Event(descriptor, _READ))
            if mask & _EPOLLOUT and (events & _EPOLLOUT or ended):
                found.append(Event(descriptor, _WRITE))
        return found

    def _change(self, descriptor: int, bit: int, flags: int) -> None:
        before = self._masks.get(descriptor, 0)
        if flags & _DELETE and not before & bit:
            raise FileNotFoundError(errno.ENOENT, "it is not there")
        after = before & ~bit if flags & _DELETE else before | bit
        if not before:
            self._epoll.register(descriptor, after)
        elif not after:
            self._epoll.unregister(descriptor)
        else:
            self._epoll.modify(descriptor, after)
        self._masks[descriptor] = after

    @property
    def closed(self) -> bool:
        return self._epoll.closed

    def fileno(self) -> int:
        return self._epoll.fileno()

    def close(self) -> None:
        self._epoll.close()


def _remove(module: Any, *beginnings: str) -> None:
    for name in list(vars(module)):
        if name.startswith(beginnings):
            delattr(module, name)


def _refuse_files_of_linux(event: str, arguments: tuple[Any, ...]) -> None:
    if event not in ("open", "os.listdir", "os.scandir") or not arguments:
        return
    if str(arguments[0]).startswith(("/proc", "/sys")):
        raise FileNotFoundError(errno.ENOENT, "macOS has no such file", str(arguments[0]))


def _c_function(library: Any, name: str) -> Any:
    if name in _C_FUNCTIONS:
        raise AttributeError(f"symbol not found: {name}")
    return _getattr(library, name)


_getattr = ctypes.CDLL.__getattr__


def become_macos() -> None:
    """Remove everything, before anything else is imported."""
    late = {"asyncio", "selectors", "socket", "subprocess", "urllib.request"} & sys.modules.keys()
    assert not late, f"{late} have seen Linux already"
    _remove(os, "eventfd", "EFD_", "memfd_create", "MFD_", "pidfd_open", "P_PIDFD", "pipe2")
    _remove(os, "sched_getaffinity", "sched_setaffinity", "sched_getparam", "sched_setparam")
    _remove(os, "sched_getscheduler", "sched_setscheduler", "sched_rr_get_interval", "getrandom")
    _remove(os, "posix_fadvise", "posix_fallocate", "splice", "copy_file_range", "O_TMPFILE")
    _remove(os, "unshare", "setns", "getresuid", "getresgid", "setresuid", "setresgid")
    # Since Python 3.13, it asks sched_getaffinity where that was when `os` was imported.
    vars(os).update(process_cpu_count=os.cpu_count)
    _remove(select, "epoll", "EPOLL", "POLLRDHUP", "POLLMSG")
    _remove(signal, "SIGRTM", "SIGPWR", "SIGSTKFLT", "SIGPOLL", "SIGCLD")
    _remove(signal, "sigtimedwait", "sigwaitinfo", "pidfd_send_signal")
    _remove(_socket, "SOCK_SEQPACKET", "SOCK_CLOEXEC", "SOCK_NONBLOCK", "SO_PEERCRED")
    _remove(_socket, "AF_NETLINK", "AF_PACKET", "AF_VSOCK", "AF_CAN", "CAN_", "MSG_NOSIGNAL")
    _remove(resource, "prlimit", "RUSAGE_THREAD")
    _remove(time, "CLOCK_BOOTTIME", "CLOCK_TAI")
    ctypes.CDLL.__getattr__ = _c_function
    kinds = {"KQ_FILTER_READ": _READ, "KQ_FILTER_WRITE": _WRITE}
    flags = {"KQ_EV_ADD": _ADD, "KQ_EV_DELETE": _DELETE}
    vars(select).update(kqueue=Kqueue, kevent=Event, **kinds, **flags)
    # What the standard library asks on macOS for the proxies of the system.
    proxies: Any = types.ModuleType("_scproxy")
    proxies._get_proxies = proxies._get_proxy_settings = dict
    # GLFW would look for a library of macOS.
    sys.modules.update(_scproxy=proxies, glfw=types.ModuleType("glfw"))
    sysconfig.get_config_vars()  # The file of macOS is not here.
    sys.addaudithook(_refuse_files_of_linux)
    sys.platform = "darwin"


if __name__ == "__main__":
    become_macos()
    _, program, *arguments = sys.argv
    sys.argv = [program, *arguments]
    sys.path[0] = os.path.dirname(program)  # noqa: PTH120
    runpy.run_path(program, run_name="__main__")
