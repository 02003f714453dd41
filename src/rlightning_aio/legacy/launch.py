"""RLightning's `launch`, for programs that need its configs and not its cluster."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlightning_aio.legacy.registry import load_modules_from_config
from rlightning_aio.legacy.sections import MainConfig

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["launch"]


def launch(main_func: Callable[[MainConfig], None], config_path: str | Path) -> None:
    """Call `main_func` with the config that Hydra composes of a folder and the command line.

    Args:
        main_func: the program.
        config_path: folder of the configs; ``--config-name`` chooses one.

    Raises:
        ImportError: Hydra is not installed.
    """
    try:
        hydra: Any = import_module("hydra")
    except ImportError as error:
        raise ImportError(f"launch() needs Hydra: pip install hydra-core ({error})") from error

    def run(composed: Any) -> None:
        config = MainConfig.from_omegaconf(composed)
        os.environ["RLIGHTNING_DEBUG"] = str(int(config.debug))
        os.environ["RLIGHTNING_VERBOSE"] = str(int(config.verbose))
        load_modules_from_config(config)
        main_func(config)

    hydra.main(config_path=str(Path(config_path).resolve()), version_base=None)(run)()
