"""How large is the project? Lines by package, modules, tests, words, pages, options and fields.

    python benchmarks/size.py

Lines are those of `wc -l`, of Python and of C. The *engine* is what runs environments; everything
else of `src` stands around it.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rlightning_aio.cli.app import app
from rlightning_aio.config import EnvConfig

if TYPE_CHECKING:
    from collections.abc import Iterable

ROOT = Path(__file__).resolve().parent.parent
SRC = ROOT / "src" / "rlightning_aio"
SMALL = [
    "__init__", "__main__", "calling", "errors", "files", "json_text", "outcomes",
    "sealing", "sharing", "spaces", "sync", "trees", "types",
]  # fmt: skip
"""Modules beside the packages of the engine that belong to it."""
ENGINE = {"_core", "protocol", "batch", "config", "registry", "remote", "small modules"}


def code(folder: str) -> list[Path]:
    """Return the files of Python and C below a folder of the checkout."""
    return [path for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".c")]


def lines(paths: Iterable[Path]) -> int:
    return sum(path.read_bytes().count(b"\n") for path in paths)


def options() -> list[str]:
    """Return the options of the program and of all commands, without those that typer adds."""
    group: Any = typer.main.get_command(app)
    found = [option for command in (group, *group.commands.values()) for option in command.params]
    added = ("help", "install_completion", "show_completion")
    return [
        option.opts[-1]
        for option in found
        if option.param_type_name == "option" and option.name not in added
    ]


def main() -> None:
    modules = code("src")
    packages: Counter[str] = Counter()
    for path in modules:
        name = path.relative_to(SRC).parts[0].removesuffix(".py")
        packages["small modules" if name in SMALL else name] += lines([path])
    sums = Counter({"engine": 0, "around the engine": 0})
    for name, count in sorted(packages.items()):
        sums["engine" if name in ENGINE else "around the engine"] += count
        print(f"{count:7,}  {'' if name in ENGINE else '  '}{name}")
    pages = list((ROOT / "docs").glob("*.md"))
    texts = [ROOT / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING")]
    found = {
        **sums,
        "src": sums.total(),
        "modules of src": len(modules),
        "tests": lines(code("tests")),
        "benchmarks": lines(code("benchmarks")),
        "words of README, ARCHITECTURE, CONTRIBUTING, docs/*.md": sum(
            len(page.read_text().split()) for page in (*texts, *pages)
        ),
        "pages in docs/": len(pages),
        "options of all commands": len(options()),
        "fields of an entry": len(EnvConfig.model_fields),
    }
    print()
    for name, count in found.items():
        print(f"{count:7,}  {name}")


if __name__ == "__main__":
    main()
