"""What a browser would make of a page: its tags, its text, what it would fetch."""

import re
from html.parser import HTMLParser

EVIL = 'x"><svg onload=alert(1)>'
"""A name that ends the attribute or the tag it is put into, and runs a script."""
VOID = ("meta", "img", "br", "input", "wbr")


class Page(HTMLParser):
    """Tags with their attributes, and the text, of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""
        self._html = html
        self.feed(html)
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def references(self) -> list[str]:
        """Everything a browser could fetch."""
        named = ("src", "href", "xlink:href", "srcset", "data", "action", "poster")
        found = [attributes[name] for _, attributes in self.tags for name in named if attributes.get(name)]
        found += re.findall(r"url\(['\"]?([^)'\"]+)", self._html)
        found += re.findall(r"@import\s+['\"]?([^'\";]+)", self._html)
        return list(map(str, found))


def assert_harmless(html: str, times: int) -> None:
    """The evil name stands in the page's text that often, and is nothing but text."""
    page = Page(html)
    assert page.text.count(EVIL) >= times, page.text.count(EVIL)
    for tag, attributes in page.tags:
        assert tag != "script"
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
