"""The site in a browser, opened from its folder: nothing is clipped, and search finds things.

Screenshots go to `build/screenshots`, for people to look at.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from browser import Browser, found_browser

from rlightning_aio import __version__

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.site

ROOT = Path(__file__).parent.parent
SHOTS = ROOT / "build" / "screenshots"
WIDTHS = (390, 768, 1366)
PAGES = ("index", "start", "tutorial", "training", "reference/collecting", "benchmarks")
# Blocks of code and tables that a reader must scroll sideways.
CLIPPED = """
[...document.querySelectorAll('pre > code, .md-typeset__table')]
    .filter(e => e.offsetParent && e.scrollWidth > e.clientWidth + 1)
    .map(e => e.textContent.trim().slice(0, 60) + ' … ' + (e.scrollWidth - e.clientWidth))
"""
# A page as a whole that is wider than the window.
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
SEARCH = """
new Promise(done => {
    const field = document.querySelector('[data-md-component=search-query]');
    const list = document.querySelector('[data-md-component=search-result] ol');
    const look = () => { const links = [...list.querySelectorAll('a')].map(a => a.href);
                         if (links.length) done(links); };
    new MutationObserver(look).observe(list, {childList: true, subtree: true});
    document.querySelector('#__search').checked = true;
    document.querySelector('#__search').dispatchEvent(new Event('change'));
    field.focus();
    field.value = %r;
    field.dispatchEvent(new KeyboardEvent('keyup'));
    field.dispatchEvent(new Event('input'));
})
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed: pip install -r requirements/docs.txt")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True)
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    path = found_browser()
    if path is None:
        pytest.skip("no browser is installed; on Debian: apt install chromium")
    with Browser(path, tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture(scope="module", autouse=True)
def folder_of_screenshots() -> None:
    shutil.rmtree(SHOTS, ignore_errors=True)
    SHOTS.mkdir(parents=True)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("page", PAGES)
def test_pages_fit_the_window(page: str, width: int, site: Path, browser: Browser) -> None:
    """None is wider than the window, on a phone, a tablet or a laptop."""
    browser.open(f"file://{site}/{page}.html", width)
    browser.screenshot(SHOTS / f"{page.replace('/', '-')}-{width}.png")
    assert browser.evaluate(WIDER) <= 0


def test_no_line_is_clipped_at_1366_pixels(site: Path, browser: Browser) -> None:
    """On any page, sources included: a reader scrolls down only."""
    clipped = {}
    for file in sorted(site.rglob("*.html")):
        browser.open(f"file://{file}", 1366)
        if found := browser.evaluate(CLIPPED):
            clipped[file.relative_to(site).as_posix()] = found
    assert clipped == {}


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("reward normalization", "reference/collecting.html#rlightning_aio.normalize.Normalizer"),
        ("Collector", "reference/collecting.html#rlightning_aio.collecting.Collector"),
        ("worker died", "faults.html"),
    ],
)
def test_search_works_in_a_folder(words: str, wanted: str, site: Path, browser: Browser) -> None:
    """Without a server, and what people look for is among the first ten links."""
    browser.open(f"file://{site}/index.html", 1366)
    links = browser.evaluate(SEARCH % words)
    browser.screenshot(SHOTS / f"search-{words.replace(' ', '-')}.png")
    assert any(wanted in link for link in links[:10]), links[:10]


def test_the_home_page_has_what_newcomers_need(site: Path, browser: Browser) -> None:
    """A film that is loaded, three entry points, and the version."""
    browser.open(f"file://{site}/index.html", 1366)
    assert browser.evaluate("document.querySelector('.home figure img').naturalWidth") > 300
    assert browser.evaluate("document.querySelectorAll('.home .entry a').length") >= 3
    text = browser.evaluate("document.querySelector('.home').innerText")
    assert f"version {__version__}" in text
