"""Content of a page as tests read it, with nothing but the standard library."""

import re
from html.parser import HTMLParser


class Page(HTMLParser):
    """Ids, references, addresses and text of a page, and the tags that were left open."""

    VOID = frozenset({"meta", "link", "br", "hr", "img", "input"})

    def __init__(self, text):
        super().__init__()
        self.ids = []
        self.references = set()
        self.addresses = []
        self.styles = []
        self.tags = []
        self._open = []
        self._words = []
        self.feed(text)
        self.close()
        self.left_open = list(self._open)
        self.text = re.sub(r"\s+", " ", " ".join(self._words))

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            value = value or ""
            if name == "id":
                self.ids.append(value)
            if name in ("href", "src", "xlink:href", "action", "poster", "srcset"):
                if value.startswith("#"):
                    self.references.add(value[1:])
                else:
                    self.addresses.append(value)
            self.references.update(re.findall(r"url\(#([^)]+)\)", value))
            if name == "style":
                self.styles.append(value)
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self._open.pop()

    def handle_endtag(self, tag):
        if self._open and self._open[-1] == tag:
            self._open.pop()
        else:
            self._open.append(f"/{tag}")

    def handle_data(self, data):
        if self._open and self._open[-1] == "style":
            self.styles.append(data)
        else:
            self._words.append(data)
