"""Hooks of MkDocs: the generated pages of the site, and links that leave docs/."""

import re
from pathlib import Path
from typing import TypeGuard

from api_pages import api_pages
from benchmark_pages import arms_of_today, benchmark_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from repository_links import MOUNTED, linked_files, rewritten, source_page, source_uri
from tutorials import tutorial_pages
from verb_help import verb_page

ROOT = Path(__file__).parents[2]
LOADED = re.compile(r"<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=.?https?:[^ >]*")
"""Matches what a page loads from the web."""

LOOP = re.compile(r'<img [^>]*src="loop.svg"[^>]*>')
"""Matches the picture of the loop, in pages beside it."""


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the generated pages: API, benchmarks, verbs, files of the repository that pages link to."""
    pages: dict[str, str | bytes] = {uri: (ROOT / name).read_text() for name, uri in MOUNTED.items()}
    pages |= api_pages(ROOT / "src" / "foredrive")
    pages |= benchmark_pages(ROOT / "benchmarks" / "results", arms_of_today(ROOT))
    pages["how-to/verbs.md"] = verb_page(ROOT)
    pages |= tutorial_pages(ROOT / "docs" / "tutorials", ROOT)
    written = [file.content_string for file in files.documentation_pages()]
    for path in linked_files(ROOT, [*written, *filter(is_text, pages.values())]):
        pages[source_uri(path)] = source_page(ROOT, path)
    for uri, text in pages.items():
        files.append(File.generated(config, uri, content=text))
    return files


def is_text(content: str | bytes) -> TypeGuard[str]:
    """Return whether the content of a page is text, not a picture."""
    return isinstance(content, str)


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to files outside docs/ to their pages in the site."""
    return rewritten(markdown, page.file.src_uri)


def on_page_content(html: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the picture of the loop into its pages, because links of a picture that is only shown are dead."""
    return LOOP.sub(lambda _: (ROOT / "docs" / "loop.svg").read_text(), html)


def on_post_page(output: str, *, page: Page, config: MkDocsConfig) -> str:
    """Check that a page loads nothing from the web, so that it opens from disk."""
    if found := LOADED.search(output):
        raise PluginError(f"{page.file.src_uri} is not self-contained: {found[0]}")
    return output
