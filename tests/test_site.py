"""The documentation site: built strictly, looked at in a browser that has no network."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("sphinx")
pytest.importorskip("tornado")
from browser import Browser, find_browser

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parent.parent
LOOKED_AT = ("index", "first-ten-minutes", "what-now", "how-it-works", "uncertainty", "api", "_api/switchfit.estimate")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the pages; any warning is an error."""
    pytest.importorskip("furo")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", ROOT / "docs", folder]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if find_browser() is None:
        pytest.skip("there is no Chromium")
    browser = Browser(tmp_path_factory.mktemp("profile"))
    browser.call("Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0)
    yield browser
    browser.close()


def look(browser, page, *, width, dark=False):
    """Open a page and wait until it has loaded."""
    loaded = f"document.readyState === 'complete' && location.pathname.endsWith('{page.name}')"
    browser.open(page, width=width, height=900, dark=dark, ready=loaded)


def test_no_page_loads_anything_from_a_network(site):
    """Scripts, images and styles; links to click do not count."""
    pages = list(site.rglob("*.html"))
    assert len(pages) > 60
    for page in pages:
        loaded = re.findall(r"<(?:script|img|iframe|source|link)\b[^>]*>", page.read_text(encoding="utf-8"))
        sources = [re.search(r'\b(?:src|href)="([^"]*)"', tag) for tag in loaded if 'rel="canonical"' not in tag]
        assert not [source[1] for source in sources if source and "//" in source[1]], page.name


def test_formulas_are_mathml(site):
    """Also those that converters get wrong: 1/2 without braces, letters with dots and hats."""
    page = (site / "how-it-works.html").read_text(encoding="utf-8")
    assert re.search(r"<mfrac>(<mrow>)?<mn>1</mn>(</mrow><mrow>)?<mn>2</mn>(</mrow>)?</mfrac>", page)
    assert page.count("<math") > 8
    assert "\\frac" not in page.replace("annotation", "")
    assert "MathJax" not in page


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [400, 1280])
@pytest.mark.parametrize("name", LOOKED_AT)
def test_pages_fit_the_screen_and_have_no_errors(name, width, dark, site, browser):
    look(browser, site / f"{name}.html", width=width, dark=dark)
    assert browser.errors == []
    assert all(request.startswith(("file://", "data:")) for request in browser.requests)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate("[...document.images].every((i) => i.naturalWidth > 0 || i.loading === 'lazy')")
    ground = browser.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).slice(0, 3).map(Number)")
    assert (max(ground) < 80) is dark


def test_the_search_finds_a_page(site, browser):
    """The index is a script, since a page from a disk may not read other files."""
    look(browser, site / "search.html", width=1280)
    browser.call("Page.navigate", url=(site / "search.html").resolve().as_uri() + "?q=kink")
    browser.wait("document.querySelectorAll('ul.search li').length > 2")
