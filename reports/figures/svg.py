"""A drawing as a piece of SVG for a page: colours become roles of the page's theme, ids are unique, bytes repeat."""

import base64
import io
import re
from collections.abc import Callable, Sequence

from reports.figures.canvas import Canvas, Photo
from reports.figures.theme import LIGHT, drawing

_DPI = 72
_GEOMETRY = re.compile(r' (?:x|y|width|height|transform|style)="[^"]*"')
_NUMBER = re.compile(r"-?\d+\.\d{3,}")
_ID = re.compile(r' id="([^"]+)"')
_PATH = re.compile(r' d="([^"]*)"')
_IMAGE = re.compile(r'xlink:href="data:image/png;base64,[^"]+"')
_MARKERS = re.compile(r'<g((?: clip-path="[^"]*")?)>((?:<use [^>]*/>){2,})</g>')
_MARKER_STYLE = re.compile(r' style="([^"]*)"')
_STYLE_NOISE = re.compile(
    r"font-family: [^;\"]+; |image-rendering:[^;\"]+;?|stroke-linejoin: round;? ?|stroke-linecap: butt;? ?"
)


def draw_svg(key: str, width_in: float, height_in: float, draw: Callable[[Canvas], None], label: str) -> str:
    """SVG text of a drawing; the same drawing gives the same text.

    Parameters
    ----------
    key : name of the figure in its page, which makes its ids unique
    label : text alternative
    """
    from matplotlib.figure import Figure

    from reports.figures.axes import PageRenderer

    with drawing(more={"svg.hashsalt": key}):
        figure = Figure(figsize=(width_in, height_in))
        photos: list[Photo] = []
        draw(Canvas(figure, width_in, height_in, photos=photos))
        buffer = io.StringIO()
        metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        renderer = PageRenderer(_DPI * width_in, _DPI * height_in, buffer, image_dpi=_DPI, metadata=metadata)
        figure.draw(renderer)
        renderer.finalize()
    return _for_page(buffer.getvalue(), key, label, photos)


def _for_page(svg: str, key: str, label: str, photos: Sequence[Photo]) -> str:
    size = re.search(r'viewBox="([^"]+)"', svg)
    view = size.group(1) if size else "0 0 1 1"
    body = svg[svg.index(">", svg.index("<svg")) + 1 : svg.rindex("</svg>")]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r"<style.*?</style>", "", body, flags=re.DOTALL)
    body = _PATH.sub(lambda m: f' d="{" ".join(m.group(1).split())}"', body)
    waiting = iter(photos)
    body = _IMAGE.sub(lambda m: _embedded(next(waiting)), body)
    body = _GEOMETRY.sub(lambda m: _NUMBER.sub(lambda n: _short(n.group(0)), m.group(0)), body)
    body = re.sub(r' transform="rotate\(-0 [^"]*\)"', "", body)
    body = _STYLE_NOISE.sub("", body)
    body = body.replace(' style=""', "").replace("xlink:href", "href")
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', body))
    body = _ID.sub(lambda m: f' id="{key}-{m.group(1)}"' if m.group(1) in used else "", body)
    body = re.sub(r"url\(#", f"url(#{key}-", body)
    body = body.replace('href="#', f'href="#{key}-')
    for role, tint in LIGHT.items():
        body = body.replace(tint, f"var(--f-{role})")
    body = re.sub(r"<defs>\s*</defs>", "", body)
    body = re.sub(r">\s+<", "><", body).strip()
    body = _MARKERS.sub(_with_one_style, body)
    text = label.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return f'<svg viewBox="{view}" role="img" aria-label="{text}">{body}</svg>'


def _with_one_style(found: re.Match[str]) -> str:
    """A group of markers of one look, with that look said once."""
    styles = set(_MARKER_STYLE.findall(found.group(2)))
    if len(styles) != 1:
        return found.group(0)
    return f'<g{found.group(1)} style="{styles.pop()}">{_MARKER_STYLE.sub("", found.group(2))}</g>'


def _short(number: str) -> str:
    text = f"{float(number):.2f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def _embedded(photo: Photo) -> str:
    """Attributes of an image element: its octets, stretched over its place."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(photo.image).save(buffer, format="JPEG", quality=84)
    octets = base64.b64encode(buffer.getvalue()).decode("ascii")
    return f'preserveAspectRatio="none" href="data:image/jpeg;base64,{octets}"'
