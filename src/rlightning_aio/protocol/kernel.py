"""The functions of the hot path: compiled ones, or their twins in `exchange`.

They are attributes of this module, to be called by it (``kernel.submit``), so that `select` can
exchange them. The compiled ones are used where they were built, unless ``RLIGHTNING_AIO_IMPL``
says ``python``. Both use the same shared memory, so trainer and workers may differ.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Final

from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol import exchange

if TYPE_CHECKING:
    from types import ModuleType

VARIABLE: Final = "RLIGHTNING_AIO_IMPL"
"""The environment variable that names an implementation."""
_FUNCTIONS: Final = ("arm", "complete", "gather", "is_due", "row_step", "serve", "submit")

arm = exchange.arm
complete = exchange.complete
gather = exchange.gather
is_due = exchange.is_due
row_step = exchange.row_step
serve = exchange.serve
submit = exchange.submit

selected = "python"
"""The implementation in use, ``python`` or ``c``."""


def compiled() -> ModuleType | None:
    """Return the compiled functions, or None where they were not built."""
    try:
        from rlightning_aio.protocol import _kernel  # noqa: PLC0415
    except ImportError:
        return None
    return _kernel


def select(wanted: str | None) -> None:
    """Use ``python`` or ``c`` from now on; None stands for the compiled functions if they exist.

    Raises:
        ConfigError: there is no such implementation.
    """
    if wanted not in (None, "", "python", "c"):
        raise ConfigError(f"{VARIABLE} must be python or c, not {wanted!r}")
    found = None if wanted == "python" else compiled()
    if wanted == "c" and found is None:
        raise ConfigError(
            f"{VARIABLE}=c, but this installation has no compiled kernel: it was installed from "
            "source without a C compiler. Install a wheel or a compiler, or unset the variable"
        )
    functions = {name: getattr(found or exchange, name) for name in _FUNCTIONS}
    globals().update(functions, selected="python" if found is None else "c")


select(os.environ.get(VARIABLE))
