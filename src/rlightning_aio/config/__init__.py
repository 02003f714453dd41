"""Configurations: `EnvConfig` and the functions that read entries from Python values and files.

Rule: every mistake is reported here, before any process starts, in one message that names the
file, entry and field of each. OmegaConf reads, pydantic checks single entries, and `checks`
compares their fields and looks for what they name, importing none of it. Defaults that depend on
the machine are left to the group.
"""

from __future__ import annotations

from rlightning_aio.config.checks import check_installed, runs_here
from rlightning_aio.config.documents import load_config, parse_configs
from rlightning_aio.config.entry import MADE_BY_GYMNASIUM, EnvConfig, makers_of, moved

__all__ = [
    "MADE_BY_GYMNASIUM",
    "EnvConfig",
    "check_installed",
    "load_config",
    "makers_of",
    "moved",
    "parse_configs",
    "runs_here",
]
