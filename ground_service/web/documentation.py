"""The documentation at /help: the site that `make docs` built, otherwise the Markdown files of `docs`, rendered.

The inline scripts of the site are allowed by their hashes.
"""

from __future__ import annotations

import base64
import hashlib
import posixpath
import re
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.responses import RedirectResponse
from markdown_it import MarkdownIt

from ground_service.errors import NotFound
from ground_service.web.pages import HELP, MEDIA, POLICY, files_of, help_page

DOCS = Path(__file__).parents[2] / "docs"
"""Folder of the Markdown files; absent in wheels, which contain the site."""

_INLINE_SCRIPT = re.compile(rb"<script>(.*?)</script>", re.DOTALL)
_ADMONITION = re.compile(r'^( *)!!! \w+ "(.*)"$\n((?:\1    .*\n|\n)*)', re.MULTILINE)
_ABSENT = """<!doctype html><html lang="en"><meta name="viewport" content="width=device-width"><title>LINNA</title>
<h1>No documentation</h1><p>This installation was made without its documentation. Released wheels and the image have it.
In a checkout, <code>make docs</code> builds it; restart the service afterwards.</p><p><a href="/">Overview</a></p>"""
"""Answer to every path where there is neither."""

documentation = APIRouter(include_in_schema=False)


@documentation.get("/help")
@documentation.get("/help/")
def documentation_start() -> Response:
    """The first page of the documentation."""
    return RedirectResponse("/help/index.html")


@documentation.get("/help/{path:path}")
def documentation_file(path: str) -> Response:
    """A file of the documentation.

    Raises
    ------
    NotFound
        There is no such file. Without any documentation, every path has a page that says so.
    """
    files = files_of(HELP)
    rendered = not files
    files = files or files_of(DOCS)
    if not files:
        return Response(_ABSENT, 404, media_type="text/html")
    source = path.removesuffix(".html") + ".md" if rendered and path.endswith(".html") else path
    body = files.get(source)
    if body is None:
        raise NotFound("documentation page", path[:80])
    media = MEDIA[Path(path).suffix]
    headers = {"Cache-Control": "no-cache"}
    if rendered:
        headers["Content-Security-Policy"] = POLICY
        body = page_of(source).encode() if source != path else body
    else:
        headers["Content-Security-Policy"] = policy(body if media[:9] == "text/html" else b"")
    return Response(body, media_type=media, headers=headers)


@lru_cache(maxsize=16)
def page_of(source: str) -> str:
    """Return a Markdown file of the documentation as a page.

    Headings have the anchors of the site. Links to pages that only the site has are plain text.
    """
    files = files_of(DOCS)
    text = _ADMONITION.sub(lambda found: _quoted(*found.groups()), files[source].decode())
    markdown = MarkdownIt("commonmark").enable("table")
    tokens = markdown.parse(text)
    title = source
    for token, inline in pairwise(tokens):
        if token.type == "heading_open":
            token.attrSet("id", slug(inline.content))
            title = inline.content if token.tag == "h1" else title
    for link in (one for token in tokens for one in token.children or () if one.type == "link_open"):
        target, _, anchor = str(link.attrGet("href")).partition("#")
        if target.endswith(".md") and ":" not in target:
            known = posixpath.normpath(posixpath.join(posixpath.dirname(source), target)) in files
            link.attrs = (
                {"href": target.removesuffix(".md") + ".html" + ("#" + anchor if anchor else "")}
                if known
                else {"title": "a page of the built documentation: make docs"}
            )
    return help_page(title, markdown.renderer.render(tokens, markdown.options, {}))


def slug(heading: str) -> str:
    """Return the anchor of a heading, as the site has it."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())


def _quoted(indent: str, title: str, text: str) -> str:
    lines = [f"**{title}**", "", *(line.removeprefix(indent + "    ") for line in text.splitlines())]
    return "".join(f"{indent}> {line}\n" for line in lines) + "\n"


def policy(page: bytes) -> str:
    """Return the content security policy of a page: only files of this service, and the page's own inline scripts."""
    hashes = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"
        for script in dict.fromkeys(_INLINE_SCRIPT.findall(page))
    )
    return (
        f"default-src 'none'; script-src 'self' {hashes}; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
        "connect-src 'self'; worker-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    )
