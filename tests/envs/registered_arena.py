"""Registers an environment with PettingZoo, as packages do that bring some."""

from __future__ import annotations

import pettingzoo

pettingzoo.register("parallel", "arena/tag-v3", "mpe2.simple_tag_v3:parallel_env", max_cycles=7)
