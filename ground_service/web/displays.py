"""Telemetry displays at /mct: Open MCT, if it is installed (`make openmct`), with our plugin.

Open MCT compiles templates of its views in the browser, so its page permits `unsafe-eval`; no other page does.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse

from ground_service.access.security import caller_of
from ground_service.errors import NotAuthorised, NotFound
from ground_service.web.pages import DISPLAYS, MEDIA, page_response, rendered

FOLDER = Path(__file__).parents[2] / "deploy" / "openmct" / "node_modules" / "openmct"
"""Where `make openmct` installs the npm package `openmct`."""

POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; worker-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)

_COMPRESSED = (".css", ".js", ".md", ".svg")

displays = APIRouter(include_in_schema=False)


@dataclass(frozen=True, slots=True)
class Installation:
    """Files of an installed package `openmct` by path: plain, and compressed with gzip where this is smaller."""

    version: str
    plain: Mapping[str, bytes]
    compressed: Mapping[str, bytes]


@displays.get("/mct", name="page mct")
@displays.head("/mct", name="page mct head")
def displays_page(request: Request) -> Response:
    """The displays; without Open MCT a page that says how to install it. Without a session: the sign-in dialog."""
    found = installation(request.app.state.openmct)
    if found is None:
        return page_response(rendered(DISPLAYS))
    try:
        caller_of(request, None)
    except NotAuthorised:
        return RedirectResponse("/?next=/mct", status_code=303)
    return page_response(rendered(DISPLAYS, "displays", openmct=found.version), POLICY)


@displays.get("/mct/{version}/{path:path}")
def displays_file(request: Request, version: str, path: str) -> Response:
    """A file of Open MCT; addresses contain the version, so browsers keep files for good."""
    found = installation(request.app.state.openmct)
    body = None if found is None or found.version != version else found.plain.get(path)
    if found is None or body is None:
        raise NotFound("file", f"{version[:20]}/{path[:80]}")
    headers = {
        "Cache-Control": "public, max-age=31536000, immutable",
        "Content-Security-Policy": POLICY,
        "Vary": "Accept-Encoding",
    }
    if path in found.compressed and "gzip" in request.headers.get("accept-encoding", ""):
        body = found.compressed[path]
        headers["Content-Encoding"] = "gzip"
    return Response(body, media_type=MEDIA[Path(path).suffix], headers=headers)


@cache
def installation(folder: Path) -> Installation | None:
    """Return the files of the package in a folder, read once; None if it is not installed there."""
    try:
        version = json.loads((folder / "package.json").read_bytes())["version"]
        licence = (folder / "LICENSE.md").read_bytes()
        script = (folder / "dist" / "openmct.js").is_file()
    except (OSError, ValueError, KeyError):
        return None
    if not script:
        return None
    plain = {"LICENSE.md": licence} | {
        file.relative_to(folder / "dist").as_posix(): file.read_bytes()
        for file in sorted((folder / "dist").rglob("*"))
        if file.suffix in MEDIA and file.is_file()
    }
    packed = {
        path: gzip.compress(body, 6, mtime=0) for path, body in plain.items() if path.endswith(_COMPRESSED)
    }
    smaller = {path: body for path, body in packed.items() if len(body) < len(plain[path])}
    return Installation(str(version), plain, smaller)
