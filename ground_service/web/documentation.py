"""The documentation at /help, as built by `make docs`; its inline scripts are allowed by their hashes."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.responses import RedirectResponse

from ground_service.errors import NotFound
from ground_service.web.pages import HELP, MEDIA, files_of

_INLINE_SCRIPT = re.compile(rb"<script>(.*?)</script>", re.DOTALL)
_ABSENT = """<!doctype html><html lang="en"><meta name="viewport" content="width=device-width"><title>LINNA</title>
<h1>No documentation</h1><p>This installation was made without its documentation. Released wheels and the image have it.
In a checkout, <code>make docs</code> builds it; restart the service afterwards.</p><p><a href="/">Overview</a></p>"""
"""Answer to every path where the documentation was not built."""

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
        There is no such file. Where the documentation was not built, every path has a page that says so.
    """
    files = files_of(HELP)
    if not files:
        return Response(_ABSENT, 404, media_type="text/html")
    body = files.get(path)
    if body is None:
        raise NotFound("documentation page", path[:80])
    media = MEDIA[Path(path).suffix]
    headers = {
        "Cache-Control": "no-cache",
        "Content-Security-Policy": policy(body if media[:9] == "text/html" else b""),
    }
    return Response(body, media_type=media, headers=headers)


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
