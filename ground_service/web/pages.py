"""Pages, displays, help and their files. A page is a frame of HTML; its script fills it from the API.

Nothing here needs a token: pages hold no data but the telemetry dictionary, which is no secret.
"""

import base64
import gzip
import hashlib
import json
import posixpath
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args
from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from fastapi.routing import APIRoute
from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
from markdown_it import MarkdownIt
from pydantic import BaseModel
from starlette.routing import Route

from ground_service.access.scopes import check_scope
from ground_service.access.security import caller_of
from ground_service.errors import InvalidInput, NotAuthorised, NotFound
from ground_service.evaluation.extras import albedo_picture
from ground_service.evaluation.performance.service import get_monthly_report
from ground_service.evaluation.store import get_report
from ground_service.ground import Ground
from ground_service.http.common import API_PREFIX, Key
from ground_service.missions.model import Approval, StationConnection, StationLink
from ground_service.passes.series import STATE_VALUES
from ground_service.planning.model import StandingRequestIn
from ground_service.regression.store import get_report as get_regression_report
from tmtc.dictionary.arguments import FUNCTION_ARGUMENTS
from tmtc.dictionary.fields import PARAMETERS
from tmtc.dictionary.payload import DICTIONARY, STRUCTURES

_HERE = Path(__file__).parent
_STATIC = _HERE / "static"
HELP = _HERE / "help"
"""Folder of the documentation site; absent where it was not built."""

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)

MEDIA = {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".LICENSE": "text/plain; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".json": "application/json",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".gif": "image/gif",
    ".md": "text/plain; charset=utf-8",
    ".ttf": "font/ttf",
    ".woff": "font/woff",
}
"""Media types of static files, of the documentation and of Open MCT, by ending."""


@dataclass(frozen=True, slots=True)
class Page:
    """A page: its address, its template and script, its area and its name in the navigation ('' for none).

    A page without a template or script of its own is that of a list. `lists` is the path of its list in the API if it
    is not that of the page, `forms` are the models of what it enters. `section` is the page whose name the navigation
    marks as current; "" for its own. `needs` is the lowest role that can use the page; "" for every role.
    """

    path: str
    name: str
    title: str
    area: str
    entry: str = ""
    section: str = ""
    needs: str = ""
    lists: str = ""
    forms: tuple[type[BaseModel], ...] = ()


DISPLAYS = Page("/mct", "mct", "Telemetry displays", "Payload", "Displays")
"""Page that `web.displays` serves."""

_LINKS = (StationConnection, StationLink)
PAGES = (
    Page("/", "shift", "Shift", "Shift", "Shift"),
    Page("/planner", "planner", "Planner", "Plan", "Planner", forms=(StandingRequestIn,)),
    Page("/missions", "missions", "Missions", "Plan", "Missions"),
    Page("/missions/{revision}", "mission", "Mission", "Plan", "", "missions", forms=_LINKS),
    Page("/ephemerides", "ephemerides", "Reference ephemerides", "Plan", "Ephemerides"),
    Page("/passes", "passes", "Passes", "Passes", "Passes"),
    Page("/passes/{pass_id}", "pass", "Pass", "Passes", section="passes"),
    Page("/ingests", "ingests", "Received files", "Passes", "Received files"),
    Page("/comparison", "comparison", "Comparison of passes", "Passes", section="passes"),
    Page("/regression", "regression", "Regression", "Passes", "Regression"),
    Page("/landmarks", "landmarks", "Landmarks learned from flight", "Passes", "Landmarks"),
    Page("/telemetry", "telemetry", "Telemetry", "Payload", "Telemetry"),
    DISPLAYS,
    Page("/events", "events", "Events", "Payload", "Events"),
    Page("/alarms", "alarms", "Alarms", "Payload", "Alarms"),
    Page("/commands", "commands", "Commands", "Payload", "Commands", lists="/telecommands"),
    Page("/live", "live", "Live", "Payload", "Live"),
    Page("/status", "status", "Status of the service", "System", "Status"),
    Page("/audit", "audit", "Audit log", "System", "Audit", needs="operator"),
    Page("/users", "users", "Users and tokens", "System", "Users", needs="admin"),
    Page("/docs", "docs", "HTTP API", "System", "HTTP API"),
    Page("/licences", "licences", "Licences", "System", "Licences"),
)

pages = APIRouter(include_in_schema=False)


def _page_answer(page: Page) -> Any:
    def answer(request: Request) -> Response:
        schemas = _schemas(page, request.app.state.operations)
        return page_response(rendered(page, schemas=schemas, provider=request.app.state.provider is not None))

    return answer


def page_response(body: str, policy: str = POLICY) -> Response:
    """Return a page with its content security policy."""
    return Response(body, media_type="text/html; charset=utf-8", headers={"Content-Security-Policy": policy})


for _page in PAGES:
    if _page is not DISPLAYS:
        pages.add_api_route(_page.path, _page_answer(_page), methods=["GET", "HEAD"], name=f"page {_page.name}")


@pages.get("/static/{path:path}")
def static_file(path: str, v: str = "") -> Response:
    """A file of the pages; cached by the browser without limit where its version is asked for."""
    body = files_of(_STATIC).get(path)
    if body is None:
        raise NotFound("file", path[:80])
    headers = {"Cache-Control": "public, max-age=31536000, immutable" if v else "no-cache"}
    return Response(body, media_type=MEDIA[Path(path).suffix], headers=headers)


REPORT_POLICY = (
    "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; font-src data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
"""Policy of reports, which contain their styles and figures and run no script."""


def _document_answer(file_of: Callable[[Any, str], str]) -> Any:
    def answer(request: Request, report_id: Key) -> Response:
        try:
            check_scope(request, caller_of(request, None))
        except NotAuthorised:
            return RedirectResponse(f"/?next={quote(request.url.path)}", status_code=303)
        ground: Ground = request.app.state.ground
        headers = {"Content-Security-Policy": REPORT_POLICY}
        body = ground.files.get(ground.read(file_of, report_id))
        return Response(body, media_type=MEDIA[".html"], headers=headers)

    return answer


# Documents with addresses of their own, for a signed-in browser; others are sent to the sign-in dialog and back.
for _path, _name, _file_of in (
    ("/reports", "report_page", lambda *key: get_report(*key).html_sha256),
    ("/regressions", "regression_page", get_regression_report),
    ("/monthly-reports", "monthly_report_page", lambda *key: get_monthly_report(*key).html_sha256),
):
    pages.add_api_route(f"{_path}/{{report_id}}", _document_answer(_file_of), methods=["GET"], name=_name)


@pages.get("/moon.jpg")
def moon_map(request: Request) -> Response:
    """The Moon's albedo as a background of maps, -180 to 180 degrees east, 90 to -90 north; 404 without the data."""
    albedo = request.app.state.ground.data.albedo
    if albedo is None:
        raise NotFound("data product", "albedo map")
    return Response(basemap_jpeg(albedo), media_type="image/jpeg", headers={"Cache-Control": "private, max-age=86400"})


@cache
def files_of(folder: Path) -> dict[str, bytes]:
    """All files, read once: what is served is what was there at the start, and no path leads elsewhere."""
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.suffix in MEDIA
    }


@cache
def _version() -> str:
    """One version for all files, since scripts import each other by plain names."""
    whole = hashlib.sha256()
    for name, body in files_of(_STATIC).items():
        whole.update(name.encode() + b"\0" + body)
    return whole.hexdigest()[:12]


@lru_cache(maxsize=2 * len(PAGES) + 1)
def rendered(page: Page, template: str = "", openmct: str = "", schemas: str = "{}", *, provider: bool = False) -> str:
    """Return the HTML of a page.

    Parameters
    ----------
    template
        Name of the template; by default that of the page.
    schemas
        JSON of the schemas of its lists and forms.
    openmct
        Version of Open MCT.
    provider
        Whether the sign-in dialog offers an OpenID provider.
    """
    return (
        _environment()
        .select_template([f"{template or page.name}.html", "list.html"])
        .render(
            page=page,
            script=page.name if f"{page.name}.js" in files_of(_STATIC) else "list",
            schemas=schemas,
            openmct=openmct,
            provider=provider,
            areas={one.area: one.path for one in reversed(PAGES) if one.entry},
            pages=[one for one in PAGES if one.entry and one.area == page.area],
            version=_version(),
            dictionary=_dictionary(),
            state_values=STATE_VALUES,
            licences={
                name.removeprefix("vendor/").removesuffix(".LICENSE"): body.decode()
                for name, body in files_of(_STATIC).items()
                if name.endswith(".LICENSE")
            },
        )
    )


def _schemas(page: Page, routes: Iterable[Route]) -> str:
    """Return the schemas of the lists and forms of a page as JSON; those of lists as in the OpenAPI document."""
    found: dict[str, Any] = {one.__name__: one.model_json_schema() for one in page.forms}
    path = page.lists or page.path
    for route in routes:
        if not isinstance(route, APIRoute) or route.path != API_PREFIX + path or route.methods != {"GET"}:
            continue
        for asked in route.dependant.query_params:
            entity = get_args(route.response_model.model_fields["items"].annotation)[0]
            filters: Any = asked.field_info.annotation
            items = entity.model_json_schema(mode="serialization")
            found[path] = {"filters": filters.model_json_schema(), "items": items}
    return json.dumps(found).replace("<", "\\u003c")


def sign_in_page(*, next_page: str = "/", refusal: str = "") -> str:
    """Return the HTML of the answer to a sign-in: opens the next page, or states why it was refused."""
    return _environment().get_template("sign_in.html").render(next_page=next_page, refusal=refusal, version=_version())


def help_page(title: str, body: str) -> str:
    """Return the HTML of a page of the documentation."""
    return _environment().get_template("help.html").render(title=title, body=body, version=_version())


@cache
def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(_HERE / "templates"),
        autoescape=select_autoescape(default=True, default_for_string=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@cache
def _dictionary() -> dict[str, Any]:
    """Return the parts of the dictionary for pages: telecommands to enter, parameters to look at."""
    second = Approval().needs_second_person
    return {
        "version": DICTIONARY.version,
        "hash": DICTIONARY.hash,
        "telecommands": [asdict(one) | {"critical": second(one.name)} for one in DICTIONARY.telecommands],
        "functions": {name: list(map(asdict, fields)) for name, fields in FUNCTION_ARGUMENTS.items()},
        "onboard_parameters": [
            asdict(one) | {"description": one.meaning, "type": "u32" if one.whole else "f64", "labels": {}}
            for one in PARAMETERS
        ],
        "parameters": [asdict(field) for packet in STRUCTURES.values() for field in packet.fields[1:]],
        "estimators": list(DICTIONARY.labels("navigation_state", "estimator").values()),
    }


@lru_cache(maxsize=2)
def basemap_jpeg(path: Path) -> bytes:
    """The map, half as high as it is wide, its grey values stretched over the whole range.

    Raises
    ------
    InvalidInput
        If the file is no picture.
    """
    import cv2

    picture = albedo_picture(path)
    good, octets = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    if not good:
        raise InvalidInput(str(path), "", "a map that can be written as JPEG", str(picture.shape))
    return octets.tobytes()


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


FOLDER = Path(__file__).parents[2] / "deploy" / "openmct" / "node_modules" / "openmct"
"""Folder in which `make openmct` installs the npm package `openmct`."""

DISPLAY_POLICY = (
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
    return page_response(rendered(DISPLAYS, "displays", openmct=found.version), DISPLAY_POLICY)


@displays.get("/mct/{version}/{path:path}")
def displays_file(request: Request, version: str, path: str) -> Response:
    """A file of Open MCT; addresses contain the version, so browsers cache files without limit."""
    found = installation(request.app.state.openmct)
    body = None if found is None or found.version != version else found.plain.get(path)
    if found is None or body is None:
        raise NotFound("file", f"{version[:20]}/{path[:80]}")
    headers = {
        "Cache-Control": "public, max-age=31536000, immutable",
        "Content-Security-Policy": DISPLAY_POLICY,
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
    packed = {path: gzip.compress(body, 6, mtime=0) for path, body in plain.items() if path.endswith(_COMPRESSED)}
    smaller = {path: body for path, body in packed.items() if len(body) < len(plain[path])}
    return Installation(str(version), plain, smaller)
