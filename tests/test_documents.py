"""All documents: links, configurations, parts of the site, and completeness of the examples.

Commands are run by cli/test_documentation.py, programs by test_examples.py.
"""

from __future__ import annotations

import ast
import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf
from run_python import blocks

import rlightning_aio
from rlightning_aio import EnvConfig, load_config

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text()
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / "benchmarks").glob("*.md")])
PACKAGE = ROOT / "src" / "rlightning_aio"
# Internal packages; other modules export what users need.
INTERNAL = {"_core", "batch", "cli", "config", "envs", "protocol", "registry", "sharing"}
INTERNAL |= {"files", "json_text", "outcomes", "plugins", "trees", "types", "__init__", "__main__"}


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def prose(page: Path) -> str:
    """Return the text without blocks of code, in which brackets have another meaning."""
    return re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Return the anchors of the page's headings, by GitHub's rule, which the site also uses."""
    titles = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def links(page: Path) -> list[str]:
    """Return the links to files and headings of this project."""
    found = re.findall(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"", prose(page))
    return [a or b for a, b in found if not re.match(r"https?:|mailto:", a or b)]


def leads_somewhere(page: Path, link: str) -> bool:
    path, _, anchor = link.partition("#")
    file = (page.parent / path).resolve() if path else page
    return file.exists() and file.is_relative_to(ROOT) and (not anchor or anchor in anchors(file))


def test_every_link_has_a_target() -> None:
    """An existing file, and an existing heading."""
    lost = [
        f"{page}: {link}"
        for page in PAGES
        for link in links(page)
        if not leads_somewhere(page, link)
    ]
    assert lost == []


def members() -> dict[str, set[str]]:
    """Return, by class in `src`, its attributes and methods, including those of its bases."""
    own: dict[str, set[str]] = {}
    bases: dict[str, list[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                names = re.findall(
                    r"\bself\.(\w+)|^    (?:async )?(?:def )?(\w+)", ast.unparse(node), re.MULTILINE
                )
                own.setdefault(node.name, set()).update(a or b for a, b in names)
                bases.setdefault(node.name, []).extend(map(ast.unparse, node.bases))

    def all_of(name: str) -> set[str]:
        return own.get(name, set()).union(*(all_of(base) for base in bases.get(name, ())))

    return {name: all_of(name) for name in own}


@pytest.mark.parametrize("page", ["ARCHITECTURE.md", "CONTRIBUTING.md"])
def test_names_in_pages_on_the_code_exist(page: str) -> None:
    """Files, and methods as ``Class.method``."""
    spans = re.findall(r"`([^`\n]+)`", prose(ROOT / page))
    known = members()
    roots = (ROOT, PACKAGE, PACKAGE / "_core")
    lost = [
        span
        for span in spans
        if re.fullmatch(r"[\w/]+(/|\.py)", span)
        and "/" in span
        and not any((root / span).exists() for root in roots)
    ]
    for span in spans:
        kind, _, name = span.partition(".")
        if kind in known and name.isidentifier() and name not in known[kind]:
            lost.append(span)
    assert [span for span in lost if span not in ("build/", "dist/", "site/")] == []


def test_the_table_of_packages_is_complete() -> None:
    """In ARCHITECTURE.md, each module and folder has its row, and each row exists."""
    table = (ROOT / "ARCHITECTURE.md").read_text().partition("| package | contents |")[2]
    rows = [line.split("|")[1] for line in table.partition("\n\n")[0].splitlines()[2:]]
    listed = {name.rstrip("/") for row in rows for name in re.findall(r"`([\w/]+)`", row)}
    there = {path.stem for path in PACKAGE.glob("[a-z]*.py")}
    there |= {path.parent.name for path in PACKAGE.glob("*/__init__.py")} - {"_core"}
    there |= {path.parent.name for path in PACKAGE.glob("_core/*/__init__.py")}
    assert listed - {"protocol/net"} == there


def test_every_configuration_loads(tmp_path: Path) -> None:
    """A block of YAML with `envs` is a configuration; its backends don't have to be installed."""
    text = "\n".join(page.read_text() for page in PAGES)
    for block in blocks("yaml", text):
        if "envs:" not in block:
            continue
        file = tmp_path / "file.yaml"
        file.write_text(block)
        entries = OmegaConf.load(file)["envs"]
        # Paths of interpreters differ between machines.
        here = [f"envs.{k}.interpreter=null" for k, e in enumerate(entries) if "interpreter" in e]
        assert len(load_config(file, here)) == len(entries)


def test_lists_are_lists_on_the_site() -> None:
    """By older rules of Markdown: after an empty line, and with code indented by four spaces."""
    for page in PAGES:
        assert not re.search(r"^ {1,3}```", page.read_text(), re.MULTILINE), named(page)
        before = ""
        for line in prose(page).splitlines():
            if re.match(r"(-|\d+\.) ", line):
                assert not before or re.match(r" {2,3}\S|-|\d+\.", before), f"{named(page)}: {line}"
            before = line


def test_each_item_of_a_list_begins_a_line() -> None:
    """The site ignores an item that begins within a line."""
    within = re.compile(r"^(?!\|).*[.;:)`] (-|\d\.)( [A-Z`*].*)?$", re.MULTILINE)
    for page in PAGES:
        assert not within.search(re.sub(r"`[^`]+`", "`", prose(page))), named(page)


def test_every_page_has_its_place_in_the_navigation() -> None:
    """And every entry has a page."""
    nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2].partition("\n\n")[0]
    listed = set(re.findall(r": ([\w/-]+\.md)$", nav, re.MULTILINE))
    written = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    brought = set(re.findall(r'": "([\w-]+\.md)"', (DOCS / "site_pages.py").read_text()))
    assert listed == written | brought


def public_names() -> dict[str, set[str]]:
    """Return the public names by module, parsed rather than imported, because some need more
    packages.
    """
    files = {"rlightning_aio": PACKAGE / "__init__.py"}
    for path in (*PACKAGE.glob("*.py"), *PACKAGE.glob("*/__init__.py")):
        name = path.parent.name if path.name == "__init__.py" else path.stem
        if name not in INTERNAL | {"rlightning_aio"}:
            files[f"rlightning_aio.{name}"] = path
    found = {}
    for module, path in files.items():
        (names,) = [
            ast.literal_eval(node.value)
            for node in ast.parse(path.read_text()).body
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
        ]
        found[module] = set(names)
    return found


def examples() -> str:
    """Return all code that is shown: in pages, docstrings, examples and the notebook."""
    shown = [path.read_text() for path in (ROOT / "examples").glob("*.py")]
    for page in PAGES:
        shown += blocks("python", page.read_text())
    notebook = json.loads((ROOT / "examples" / "notebook.ipynb").read_text())
    shown += ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    return "\n".join(shown)


def test_every_public_name_has_an_example() -> None:
    """It is used in a program of a page or in an example; all of them are run by tests."""
    words = set(re.findall(r"\w+", examples()))
    assert {name for names in public_names().values() for name in names} - words == set()


def described_names() -> set[str]:
    pages = "\n".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    return set(re.findall(r"^::: ([\w.]+)$", pages, re.MULTILINE))


def test_every_public_name_is_in_the_reference() -> None:
    """By itself or with its module; names of the top level with those of their own module."""
    described = described_names()
    names = public_names()
    assert "rlightning_aio.errors" in described
    for module in ("errors", "collecting", "evaluation", "spaces"):
        names["rlightning_aio"] -= names[f"rlightning_aio.{module}"]
    for module, public in names.items():
        missing = {name for name in public if f"{module}.{name}" not in described}
        assert module in described or not missing, (module, missing)


def test_plug_ins_use_only_names_of_the_reference() -> None:
    """By themselves or with their module."""
    described = described_names()
    described |= {f"rlightning_aio.{name}" for name in public_names()["rlightning_aio"]}
    used: set[str] = set()
    for path in (PACKAGE / "plugins").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE.name):
                module = node.module or ""
                if not module.startswith("rlightning_aio.plugins") and module not in described:
                    used |= {f"{module}.{name.name}" for name in node.names}
    assert used - described == set()


def test_the_changelog_has_a_section_of_the_version() -> None:
    section = rf"^## \[{rlightning_aio.__version__}\] - \d{{4}}-\d\d-\d\d$"
    assert re.search(section, (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE))


def test_workflows_and_the_readme_run_existing_make_targets() -> None:
    """Each `make` in them has a target."""
    texts = [file.read_text() for file in (ROOT / ".github" / "workflows").glob("*.yml")]
    texts += blocks("sh", README)
    used = re.findall(r"^(?:.*run: )?make ([a-z-]+)", "\n".join(texts), re.MULTILINE)
    assert set(used) >= {"check", "test", "docs", "test-pythons", "run"}
    assert set(used) <= make_targets()


def test_every_make_target_is_described() -> None:
    """Targets in `make help` are in CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    assert {
        target for target in make_targets() - {"help"} if f"`make {target}`" not in text
    } == set()


def test_the_page_on_configuration_names_every_field() -> None:
    """Each field of `EnvConfig` has its item, and no item names another."""
    page = (DOCS / "configuration.md").read_text()
    items = re.findall(r"^- (.*?): ", page, re.MULTILINE)
    named = {
        name for item in items for name in re.findall(r"`(\w+)`", re.sub(r"\(.*?\)", "", item))
    }
    assert named == set(EnvConfig.model_fields)


def test_the_readme_is_short() -> None:
    """A reader reads the whole README before going on."""
    assert len(README.split()) <= 700


# Names that differ on conda-forge, and what an extra of Gymnasium's brings.
CONDA_NAMES = {"mujoco": "mujoco-python"}
OF_EXTRAS = {"imageio", "packaging"}


def test_the_recipe_asks_for_what_the_project_asks_for() -> None:
    """The same version, and the same requirements with the same bounds."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == rlightning_aio.__version__
    assert f">={recipe['context']['python_min']}" == project["requires-python"]
    wanted = set()
    for requirement in project["dependencies"]:
        name, bound = re.match(r"([\w-]+)(?:\[\w+\])?>=([\d.]+)", requirement).groups()
        wanted.add(f"{CONDA_NAMES.get(name, name)} >={bound}")
    run = {entry for entry in recipe["requirements"]["run"] if not re.match(r"python |__", entry)}
    assert {entry for entry in run if entry.split()[0] not in OF_EXTRAS} == wanted
