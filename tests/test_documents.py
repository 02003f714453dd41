"""The documents as a whole: links, configurations, the site's parts, and what has no example."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

from omegaconf import OmegaConf

from rlightning_aio import load_config

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), ROOT / "benchmarks" / "README.md"])
PACKAGE = ROOT / "src" / "rlightning_aio"
# Internal packages. The package itself or another module offers what users need from them.
INTERNAL = {"batch", "cli", "config", "envs", "group", "hosts", "protocol", "registry", "sharing"}
INTERNAL |= {"types", "video", "__init__"}


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def prose(page: Path) -> str:
    """Without blocks of code, in which brackets mean something else."""
    return re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """What headings of the page are called in links, by GitHub's rule, which is the site's, too."""
    titles = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def links(page: Path) -> list[str]:
    """Those to files and headings of ours."""
    found = re.findall(r"\]\(([^)\s]+)\)|src=\"([^\"]+)\"", prose(page))
    return [a or b for a, b in found if not re.match(r"https?:|mailto:", a or b)]


def leads_somewhere(page: Path, link: str) -> bool:
    path, _, anchor = link.partition("#")
    file = (page.parent / path).resolve() if path else page
    return file.exists() and file.is_relative_to(ROOT) and (not anchor or anchor in anchors(file))


def test_every_link_leads_somewhere() -> None:
    """To a file that is there, and to a heading that it has."""
    lost = [
        f"{page}: {link}"
        for page in PAGES
        for link in links(page)
        if not leads_somewhere(page, link)
    ]
    assert lost == []


def test_every_configuration_loads(tmp_path: Path) -> None:
    """A block of YAML with `envs` is a configuration; its backends needn't be installed."""
    text = "\n".join(page.read_text() for page in PAGES)
    for block in re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        if "envs:" not in block:
            continue
        file = tmp_path / "file.yaml"
        file.write_text(block)
        entries = OmegaConf.load(file)["envs"]
        # An interpreter is somewhere else on each machine.
        here = [f"envs.{k}.interpreter=null" for k, e in enumerate(entries) if "interpreter" in e]
        assert len(load_config(file, here)) == len(entries)


def test_lists_are_lists_on_the_site() -> None:
    """By Markdown's older rules: after an empty line, and with code indented by four blanks."""
    for page in PAGES:
        assert not re.search(r"^ {1,3}```", page.read_text(), re.MULTILINE), named(page)
        before = ""
        for line in prose(page).splitlines():
            if re.match(r"(-|\d+\.) ", line):
                assert not before or re.match(r" {2,3}\S|-|\d+\.", before), f"{named(page)}: {line}"
            before = line


def test_each_item_of_a_list_begins_a_line() -> None:
    """One that follows another within a line is lost on the site."""
    within = re.compile(r"^(?!\|).*[.;:)`] (-|\d\.)( [A-Z`*].*)?$", re.MULTILINE)
    for page in PAGES:
        assert not within.search(re.sub(r"`[^`]+`", "`", prose(page))), named(page)


def test_every_page_has_its_place_in_the_navigation() -> None:
    """And no place is without a page."""
    nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2].partition("\n\n")[0]
    listed = set(re.findall(r": ([\w/-]+\.md)$", nav, re.MULTILINE))
    written = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    brought = set(re.findall(r'": "([\w-]+\.md)"', (DOCS / "site_pages.py").read_text()))
    assert listed == written | brought


def public_names() -> dict[str, set[str]]:
    """By module: what it says is public, read rather than imported, as some need more packages."""
    files = {"rlightning_aio": PACKAGE / "__init__.py"}
    files["rlightning_aio.envs.contract"] = PACKAGE / "envs" / "contract.py"
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
    """All code that is shown: in pages and docs, in the examples and the notebook."""
    shown = [path.read_text() for path in (ROOT / "examples").glob("*.py")]
    for page in PAGES:
        shown += re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    notebook = json.loads((ROOT / "examples" / "notebook.ipynb").read_text())
    shown += ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    return "\n".join(shown)


def test_every_public_name_has_an_example() -> None:
    """It is used in a program of a page or in an example; all of them run."""
    words = set(re.findall(r"\w+", examples()))
    assert {name for names in public_names().values() for name in names} - words == set()


def test_every_public_name_is_in_the_reference() -> None:
    """By itself or with its module; the package's errors with those of their own module."""
    pages = "\n".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    described = set(re.findall(r"^::: ([\w.]+)$", pages, re.MULTILINE))
    names = public_names()
    assert "rlightning_aio.errors" in described
    names["rlightning_aio"] -= names["rlightning_aio.errors"]
    for module, public in names.items():
        missing = {name for name in public if f"{module}.{name}" not in described}
        assert module in described or not missing, (module, missing)


def test_one_version_is_told() -> None:
    """By the package, the project, the changelog and the citation."""
    (version,) = re.findall(
        r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE
    )
    assert f'__version__ = "{version}"' in (PACKAGE / "__init__.py").read_text()
    assert re.search(rf"^version: {version}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert re.search(
        rf"^## \[{version}\] - \d{{4}}-\d\d-\d\d$",
        (ROOT / "CHANGELOG.md").read_text(),
        re.MULTILINE,
    )


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE))


def test_workflows_run_what_a_contributor_types() -> None:
    """Each `make` in them has a target."""
    workflows = list((ROOT / ".github" / "workflows").glob("*.yml"))
    used = re.findall(r"run: make ([a-z-]+)", "\n".join(file.read_text() for file in workflows))
    assert set(used) >= {"check", "test", "docs", "test-pythons"}
    assert set(used) <= make_targets()


def test_every_make_target_is_described() -> None:
    """Those that `make help` lists are in CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    assert {
        target for target in make_targets() - {"help"} if f"`make {target}`" not in text
    } == set()
