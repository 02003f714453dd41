"""What the pages on collecting and on remote machines say, compared.

The programs of the documents are in test_examples.py.
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from rlightning_aio import EnvGroup, build_env_group
from rlightning_aio.hosts.listener import ServerSettings

DOCS = Path(__file__).parent.parent / "docs"


def table_rows(page: str) -> set[str]:
    return set(re.findall(r"^\| `(\w+)` \|", (DOCS / page).read_text(), re.MULTILINE))


def test_every_argument_and_setting_has_its_row() -> None:
    """No row is missing, and none names what isn't there."""
    collecting = inspect.signature(EnvGroup.collect_async).parameters.keys() - {"self"}
    building = inspect.signature(build_env_group).parameters.keys() - {"env_cfgs"}
    assert table_rows("collecting.md") == collecting | building
    assert table_rows("remote.md") - {"state"} == set(ServerSettings.model_fields)
