"""Check the prose and the names of `src`: plain English, one word for one concept.

`make check` runs it. Words are those of comments, docstrings and other strings. Names are the
identifiers that `src` defines.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
SRC = ROOT / "src"

PROSE = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)}
MAX_IDIOMS = 20
"""Per 10,000 words."""
MAX_REFERRALS = 10
"""Docstrings that only point to another."""

IDIOMS = {
    r"\b(un)?told\b|\btells?\b(?! apart)": "report, say, pass",
    r"\bwhoever\b|\bwhatever (it|they)\b|\bnobody\b|\bsomebody\b|\beverybody\b": "name who it is",
    r"\b(of|by|in|for|to|from|with) (which|whom|whose)\b": "a sentence of its own",
    r"\bbefalls?\b|\bbefell\b|\bbefallen\b": "happens to",
    r"\bbury\b|\bburied\b|\bunheard\b|\bthereof\b|\bwherein\b": "a plain verb",
    r"\banew\b": "again",
    r"\bno more\b|\bany ?more\b": "no longer",
    r"\bneedn't\b|\bneed not\b": "does not have to",
    r"\b(is|are|was|were) to be\b": "must be, will be",
    r"\btakes? in\b|\btaken in\b|\btakes? note\b": "read, apply, record",
    r"\bso many\b": "a number",
    r"\bgoes on\b|\bgo on\b": "continues",
    r"\bstands? (where|at|by itself)\b|\bwhere (it|they|envs?) stands?\b": "state, position",
    r"\bgives? away\b|\bgiven away\b": "send",
    r"\bmakes? of\b|\bmade of somebody\b": "does with",
    r"\blies? (there|in)\b|\blay there\b": "is in",
    r"\bbeside (its?|the|them|that|these)\b": "in addition to, next to",
    r"\bhas an? .{1,20} of (its|their|his) own\b": "its own",
    r"\bof the same (name|kind)\b": "with the same",
    r"\bas it is\b|\bas they are\b": "unchanged",
}
"""Archaic phrases, and what to write in their place."""

REFUSED_NAMES = {
    "env": "environment",
    "slot": "seat|place_of_env",
    "completion": "tell|told|tell_of|untold|unheard",
    "exit": "bury|buried",
    "shown_result": "[sS]hown|came",
    "authenticator": "[gG]ate|[dD]oor",
}
"""By a word, names that mean the same."""

FACADES = ("aio.py", "sync.py")
"""Two interfaces to one thing, whose classes have the same names on purpose, as has `legacy`."""

RELATIVE = re.compile(
    r"(What|Whether|Whose|Whom?|Which|Where|When|How|That|Those|Of|As|If|Until|Does|Is|Are) "
)
REFERRAL = re.compile(r"See .{1,50}")


def modules() -> Iterator[tuple[Path, str, ast.Module]]:
    for path in sorted(SRC.rglob("*.py")):
        text = path.read_text()
        yield path.relative_to(ROOT), text, ast.parse(text)


def prose_of(text: str) -> Iterator[tuple[int, str]]:
    """Comments and strings, with their line numbers."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in PROSE:
            yield token.start[0], token.string


def idioms(show: bool) -> list[str]:
    words = 0
    found: Counter[str] = Counter()
    for path, text, _ in modules():
        for line, prose in prose_of(text):
            words += len(prose.split())
            for idiom, plain in IDIOMS.items():
                for match in re.finditer(idiom, prose, re.IGNORECASE):
                    found[idiom] += 1
                    if show:
                        at = line + prose.count("\n", 0, match.start())
                        print(f"{path}:{at}: {match[0]!r}: write {plain}")
    rate = 10_000 * sum(found.values()) / words
    print(f"{rate:.0f} archaic idioms per 10,000 words of src (at most {MAX_IDIOMS})")
    return [] if rate <= MAX_IDIOMS else [f"{found.most_common(8)}; list them with --show"]


def docstrings() -> list[str]:
    problems: list[str] = []
    referrals: list[str] = []
    for path, _, tree in modules():
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            doc = ast.get_docstring(node) or ""
            if RELATIVE.match(doc) and not isinstance(node, ast.ClassDef):
                problems.append(
                    f"{path}:{node.lineno}: the docstring of {node.name} starts with "
                    f"{doc.split()[0]!r}: start with an imperative verb, or with a noun phrase"
                )
            if REFERRAL.fullmatch(doc):
                referrals.append(f"{path}:{node.lineno}")
    print(f"{len(referrals)} docstrings only refer to another (at most {MAX_REFERRALS})")
    return problems + (referrals if len(referrals) > MAX_REFERRALS else [])


def names_in(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Identifiers that a module defines: functions, classes, arguments, variables, attributes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr


def names() -> list[str]:
    problems: list[str] = []
    classes: dict[str, str] = {}
    for path, _, tree in modules():
        for line, name in names_in(tree):
            problems += [
                f"{path}:{line}: {name!r} is refused: use {word!r}"
                for word, others in REFUSED_NAMES.items()
                if re.fullmatch(rf"_*({others})", name)
            ]
        if "legacy" in path.parts or path.name in FACADES:
            continue
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                other = classes.setdefault(node.name, f"{path}:{node.lineno}")
                if other != f"{path}:{node.lineno}":
                    problems.append(f"{path}:{node.lineno}: class {node.name} is also in {other}")
    return problems


def main() -> int:
    problems = idioms("--show" in sys.argv) + docstrings() + names()
    for problem in problems:
        print(problem)
    print(f"{len(problems)} problems of prose and names")
    return bool(problems)


if __name__ == "__main__":
    sys.exit(main())
