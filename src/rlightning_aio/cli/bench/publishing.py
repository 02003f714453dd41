"""The page that `bench --publish` writes: figures of one machine, with all that they depend on.

A page is Markdown, so it can be a page of a site, a comment or a file in a repository. It repeats
the config in full; anybody can repeat the measurement. Left out: charts (`--plot`) and whatever
names the machine's owner (host name, paths, user).
"""

from __future__ import annotations

import datetime as dt
from typing import TYPE_CHECKING, Any

from rlightning_aio.cli.bench.contender_table import as_markdown
from rlightning_aio.cli.option_files import naming_option
from rlightning_aio.cli.terminal import counted
from rlightning_aio.files import write_file

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rlightning_aio.cli.bench.measuring import Contender

__all__ = ["publish"]


def publish(
    path: Path,
    config: Path,
    overrides: Sequence[str],
    document: dict[str, Any],
    contenders: Sequence[Contender],
) -> None:
    """Write the page.

    Args:
        path: the page's file.
        config: the file of the config.
        overrides: of its fields.
        document: the figures with their surroundings, as ``--json`` prints them.
        contenders: all that were measured, one at least with a round.

    Raises:
        ConfigError: the file can't be written.
    """
    versions = ", ".join(f"{name} {version}" for name, version in document["versions"].items())
    rounds = max(len(contender.rounds) for contender in contenders)
    command = " ".join(["rlightning-aio", "bench", config.name, *overrides])
    today = dt.datetime.now(dt.UTC).date()
    text = f"""# {config.stem}: env steps per second

{counted(document["cores"], "core")} ({document["cpu"]}); {versions}. Medians of \
{counted(rounds, "round")}, {today}{", interrupted" if document["interrupted"] else ""}.

{as_markdown(contenders)}

Measured by `{command}` with this config as `{config.name}`:

```yaml
{config.read_text().rstrip()}
```

`envs in` says where the envs lived, `results` which rule collected their results, and `±` how far
the rounds spread. Latency is the time from sending an action to receiving its result; `start` and
`reset` are those of all envs, and memory is that of the worker processes.
"""
    with naming_option("--publish", path):
        write_file(path, text.encode())
