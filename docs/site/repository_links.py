"""Links of the written pages to other files of the repository, which have pages of their own in the site."""

import posixpath
import re
from collections.abc import Iterable
from pathlib import Path

MOUNTED = {
    "README.md": "readme.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security-policy.md",
}
"""Pages in the repository's root, by their place in the site."""
LINK = re.compile(r"(?<=\]\()([^)\s#]+)")
"""Matches the target of a link, without its anchor."""
WEB = re.compile(r"[a-z]+:")
OUTSIDE = re.compile(r"(?:\.\./)*((?:src|tests|benchmarks|examples)/[^)\s#]+|NOTICE|LICENSE)")
"""Matches a link to code, results or a licence, from a page of any depth."""
RESULTS = "benchmarks/results/"
FOLDERS = {"benchmarks/results": "benchmarks/index.md", "src/foredrive": "api/index.md"}
"""Folders that pages link to, and what shows them."""
LEXERS = {".py": "python", ".yaml": "yaml", ".toml": "toml", ".json": "json"}


def source_uri(path: str) -> str:
    """Return the page that shows a file of the repository."""
    if path.startswith(RESULTS):
        return f"benchmarks/{Path(path).stem}.md"
    return f"source/{path}.md" if not path.endswith(".md") else f"source/{path}"


def source_page(root: Path, path: str) -> str:
    """Return the Markdown of a page that shows a file."""
    text = (root / path).read_text()
    if path.endswith(".md"):
        return text
    head = f"---\nsearch:\n  exclude: true\n---\n\n# {path}"
    return f"{head}\n\n`````{LEXERS.get(Path(path).suffix, 'text')}\n{text}`````\n"


def linked_files(root: Path, pages: Iterable[str]) -> list[str]:
    """Return the files of code that pages link to, relative to the root. Results have pages anyway."""
    targets = {target for text in pages for target in LINK.findall(text) if not WEB.match(target)}
    found = {match[1] for target in targets if (match := OUTSIDE.fullmatch(target))}
    return sorted(path for path in found if (root / path).is_file() and not path.startswith(RESULTS))


def rewritten(markdown: str, uri: str) -> str:
    """Return a page whose links lead to pages of the site.

    Args:
        markdown: the page as it stands in the repository.
        uri: its place in the site.
    """
    mounted = {place: name for name, place in MOUNTED.items()}
    here = mounted.get(uri, uri.removeprefix("source/") if uri.startswith("source/") else f"docs/{uri}")

    def in_site(match: re.Match[str]) -> str:
        if WEB.match(match[0]):
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(here), match[0]))
        if path in MOUNTED:
            place = MOUNTED[path]
        elif path in FOLDERS:
            place = FOLDERS[path]
        elif path.startswith("docs/"):
            place = re.sub(r"(tutorials/\w+)\.py$", r"\1.md", path.removeprefix("docs/"))
        elif OUTSIDE.fullmatch(path):
            place = source_uri(path)
        else:
            place = path  # not there: a strict build fails
        return posixpath.relpath(place, posixpath.dirname(uri) or ".")

    return LINK.sub(in_site, markdown)
