"""How a worker ends: as Python does, without what the fork server has left to be done at its end.

A worker is forked, so Python's own end would also run the exit functions of the fork server's
modules, and some of those delete what other workers use. `multiprocessing` ends its processes
likewise.
"""

from __future__ import annotations

import atexit
import gc
import sys
import threading
import weakref
from typing import Any

# What `multiprocessing` uses of them has no public name.
_atexit: Any = atexit
_threading: Any = threading


def drop_inherited() -> None:
    """Forget, in a process that was forked just now, what its parent does at its end."""
    _atexit._clear()  # noqa: SLF001
    finalize: Any = weakref.finalize
    for finaliser in list(finalize._registry):  # noqa: SLF001
        finaliser.atexit = False
    finalize._registered_with_atexit = False  # noqa: SLF001
    if util := _multiprocessing():
        util._finalizer_registry.clear()  # noqa: SLF001


def run_all() -> None:
    """Wait for threads, run finalisers and exit functions, and collect garbage.

    This closes files that have no references, removes temporary folders, and ends daemons of
    `multiprocessing`.
    """
    gc.collect()
    _threading._shutdown()  # noqa: SLF001
    if util := _multiprocessing():
        util._exit_function()  # noqa: SLF001
    _atexit._run_exitfuncs()  # noqa: SLF001


def _multiprocessing() -> Any:
    return sys.modules.get("multiprocessing.util")
