"""The documentation site: its navigation names every page there is; its API pages name modules there are."""

import re
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
NAV = re.findall(r"^ *- (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
PAGES = sorted(str(path.relative_to(DOCS)) for path in DOCS.rglob("*.md"))


def test_the_navigation_names_every_page_once():
    assert sorted(NAV) == PAGES


@pytest.mark.parametrize("page", [page for page in PAGES if page.startswith("api/")])
def test_api_pages_name_modules_that_exist(page: str):
    modules = re.findall(r"^::: (\S+)$", (DOCS / page).read_text(), re.MULTILINE)
    assert modules and [name for name in modules if find_spec(name) is None] == []


@pytest.mark.parametrize("page", PAGES)
def test_links_between_pages_and_to_the_source_lead_somewhere(page: str):
    text = (DOCS / page).read_text()
    targets = [t for t in re.findall(r"\]\(([^)#\s]+)", text) if not re.match(r"[a-z]+:", t)]
    assert [t for t in targets if not (DOCS / page).parent.joinpath(t).exists()] == []


def test_links_to_the_source_become_names():
    spec = spec_from_file_location("links", DOCS / "site" / "links.py")
    assert spec is not None and spec.loader is not None
    links = module_from_spec(spec)
    spec.loader.exec_module(links)
    page = SimpleNamespace(file=SimpleNamespace(src_uri="design.md"))
    text = "see [ply](../src/x.py#L3), [files](files.md#a), [picture](images/a.png)"
    expected = "see `ply`, [files](files.md#a), [picture](images/a.png)"
    assert links.on_page_markdown(text, page, None, None) == expected
