"""The documentation at /help, as built by `make docs`; its inline scripts are allowed by their hashes."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from pathlib import Path

from fastapi import APIRouter, Response
from fastapi.responses import RedirectResponse

from ground_service.errors import NotFound

FOLDER = Path(__file__).parent / "help"

_INLINE_SCRIPT = re.compile(rb"<script>(.*?)</script>", re.DOTALL)
_MEDIA = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".map": "application/json",
}

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
        There is no such file, or the documentation was not built (`make docs`).
    """
    files = _files(FOLDER)
    if not files:
        raise NotFound("documentation", "it was not built, see make docs")
    body = files.get(path)
    if body is None:
        raise NotFound("documentation page", path[:80])
    media = _MEDIA[Path(path).suffix]
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


@cache
def _files(folder: Path) -> dict[str, bytes]:
    """All files, read once; no path leads elsewhere. Empty if the documentation was not built."""
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.suffix in _MEDIA
    }
