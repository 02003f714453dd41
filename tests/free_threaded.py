"""Import all that users import but simulators, and tell whether the global lock stays disabled.

CI runs it on a free-threaded build of Python, where an extension module that doesn't declare its
support enables the lock again. On other builds it imports the same modules and says that there is
nothing to check.
"""

from __future__ import annotations

import importlib
import sys
import sysconfig

MODULES = (
    "rlightning_aio.cli",
    "rlightning_aio.collecting",
    "rlightning_aio.evaluation",
    "rlightning_aio.normalize",
    "rlightning_aio.remote",
    "rlightning_aio.sync",
    "rlightning_aio.vector",
    "rlightning_aio._core.hosts.process.worker",
    "rlightning_aio.envs.simulators.gymnasium",
)


def main() -> int:
    """Return the exit status: 1 if the lock is enabled on a free-threaded build."""
    package = importlib.import_module("rlightning_aio")
    for name in package.__all__:
        getattr(package, name)
    for module in MODULES:
        importlib.import_module(module)
    if not sysconfig.get_config_var("Py_GIL_DISABLED"):
        sys.stdout.write("This build has a global interpreter lock; nothing was checked.\n")
        return 0
    enabled: bool = vars(sys)["_is_gil_enabled"]()
    sys.stdout.write(f"The global interpreter lock is {'enabled' if enabled else 'disabled'}\n")
    return int(enabled)


if __name__ == "__main__":
    sys.exit(main())
