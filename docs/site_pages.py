"""What the site has beside the pages of docs/, and links that lead there.

Rule: a page is written once and read in two places, in a checkout and on the site. Its links are
those of a checkout. Here files from elsewhere become pages of the site, a source file that a
page links to among them, and links are turned to where their files are on the site.
"""

from __future__ import annotations

import json
import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING

from mkdocs.structure.files import File

import rlightning_aio

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
PAGES = {
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "RELEASING.md": "releasing.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "benchmarks.md",
    "benchmarks/tables.md": "benchmark_tables.md",
    "examples": "docs/start.md",
}
LINK = re.compile(r"(?<=\])\(([^)\s#:]+)(#[^)\s]*)?\)|(?<=src=)\"([^\"#:]+)\"")
SHOWN = {".py", ".ipynb", ".yaml", ".toml", ".txt", ".cff"}


HOME_WORDS = {"VERSION": rlightning_aio.__version__}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what the pages of docs/ and those from elsewhere link to."""
    texts = {file.src_uri: file.content_string for file in files.documentation_pages()}
    for path, uri in PAGES.items():
        if (ROOT / path).is_file():
            texts[uri] = (ROOT / path).read_text()
            files.append(File.generated(config, uri, content=texts[uri]))
    for uri, text in texts.items():
        for match in LINK.finditer(text):
            path = checkout_path(uri, match[1] or match[3])
            target = site_path(path)
            if (ROOT / path).is_file() and target not in files.src_uris:
                files.append(_added(config, path, target))
    return files


def on_page_markdown(markdown: str, page: Page, files: Files, **_: object) -> str:
    """Turn each link to a file of the checkout to where that is on the site."""
    uri = page.file.src_uri
    if uri == "index.md":
        for word, meaning in HOME_WORDS.items():
            markdown = markdown.replace(word, meaning)

    def turned(match: re.Match[str]) -> str:
        target = site_path(checkout_path(uri, match[1] or match[3]))
        if target not in files.src_uris:
            return match[0]
        link = posixpath.relpath(target, posixpath.dirname(uri) or ".")
        return f'"{link}"' if match[3] else f"({link}{match[2] or ''})"

    return LINK.sub(turned, markdown)


def on_page_content(html: str, **_: object) -> str:
    """Leave out what docstrings have before a block of code, as Sphinx does."""
    return html.replace("<p>::</p>", "").replace("::</p>", ":</p>")


def checkout_path(uri: str, link: str) -> str:
    """The path, from the checkout's root, of what a page of the site links to."""
    homes = {page: path for path, page in PAGES.items()}
    home = homes.get(uri, f"docs/{uri}")
    return posixpath.normpath(posixpath.join(posixpath.dirname(home), link))


def site_path(path: str) -> str:
    """Where a file of the checkout is on the site."""
    path = PAGES.get(path, path)
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"source/{path}.md" if Path(path).suffix in SHOWN else path


def _added(config: MkDocsConfig, path: str, target: str) -> File:
    if not target.startswith("source/"):
        return File.generated(config, target, abs_src_path=str(ROOT / path))
    text = (ROOT / path).read_text()
    if path.endswith(".ipynb"):
        shown = _notebook(text)
    else:
        language = {".py": "python"}.get(Path(path).suffix, Path(path).suffix[1:])
        shown = f"````{language}\n{text}````\n"
    content = f"---\nsearch: {{exclude: true}}\n---\n# {path}\n\n{shown}"
    return File.generated(config, target, content=content)


def _notebook(text: str) -> str:
    """The cells of a notebook as Markdown, without outputs."""
    shown: list[str] = []
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        # A page has one title, and that is the file's path.
        plain = re.sub(r"^#", "##", source, flags=re.MULTILINE)
        shown.append(f"````python\n{source}\n````" if cell["cell_type"] == "code" else plain)
    return "\n\n".join(shown) + "\n"
