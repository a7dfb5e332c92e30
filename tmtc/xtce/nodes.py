"""XML documents as trees of plain nodes, read without anything that a document could make the reader do.

Document type declarations are refused, so there are no entities to expand and nothing to fetch. Depth, number of
elements and size are bounded.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from xml.parsers import expat

from tmtc.errors import DefinitionError

MAX_OCTETS = 64 << 20
MAX_ELEMENTS = 400_000
MAX_DEPTH = 100
"""Limits of a document; the largest public XTCE databases have some 10 MB."""

_SEPARATOR = "\x1f"


@dataclass(frozen=True, slots=True, eq=False)
class Node:
    """An element: local name, attributes without namespace, children, text before the first child, place."""

    tag: str
    attributes: dict[str, str]
    document: str
    line: int
    children: list[Node] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The text of the element without white space around it."""
        return "".join(self.texts).strip()

    def child(self, tag: str) -> Node | None:
        """The child of that name, or None; a second one is refused."""
        found = list(self.all(tag))
        if len(found) > 1:
            raise found[1].error("one element of this name", "another")
        return found[0] if found else None

    def required(self, tag: str) -> Node:
        """The child of that name."""
        found = self.child(tag)
        if found is None:
            raise self.error(f"an element {tag}", "none")
        return found

    def all(self, tag: str) -> Iterator[Node]:
        """The children of that name."""
        return (child for child in self.children if child.tag == tag)

    def attribute(self, name: str) -> str:
        """The value of an attribute that must be there."""
        try:
            return self.attributes[name]
        except KeyError:
            raise self.error(f"an attribute {name}", "none") from None

    def only(self, children: Collection[str], attributes: Collection[str] = ()) -> None:
        """Refuse children and attributes that are not named: nothing that could change a value is passed over."""
        for child in self.children:
            if child.tag not in children:
                raise child.error("elements that are supported here", f"{child.tag}, which is not")
        for name in self.attributes:
            if name not in attributes:
                raise self.error("attributes that are supported here", f"{name}, which is not")

    def error(self, expected: str, found: str) -> DefinitionError:
        """An error at this element."""
        name = self.attributes.get("name")
        what = self.tag if name is None else f"{self.tag} {name!r}"
        return DefinitionError(f"{self.document}, line {self.line}, {what}: expected {expected}, found {found}")


def parse_xml(text: str | bytes, document: str) -> Node:
    """The root element of a document; `document` names it in errors.

    Raises
    ------
    DefinitionError
        The document is not well-formed, declares a document type or exceeds a limit.
    """
    octets = text.encode() if isinstance(text, str) else text
    if len(octets) > MAX_OCTETS:
        raise DefinitionError(f"{document}: expected at most {MAX_OCTETS} octets, found {len(octets)}")
    return _Builder(document, "utf-8" if isinstance(text, str) else None).parse(octets)


class _Builder:
    def __init__(self, document: str, encoding: str | None) -> None:
        self.document = document
        self.stack: list[Node] = []
        self.elements = 0
        self.root: Node | None = None
        self.namespace = ""
        self.parser = expat.ParserCreate(encoding, _SEPARATOR)
        self.parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
        self.parser.buffer_text = True
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.CharacterDataHandler = self.characters
        self.parser.StartDoctypeDeclHandler = self.doctype

    def parse(self, octets: bytes) -> Node:
        try:
            self.parser.Parse(octets, True)
        except expat.ExpatError as error:
            raise DefinitionError(
                f"{self.document}, line {error.lineno}: expected well-formed XML, found {expat.ErrorString(error.code)}"
            ) from None
        except (LookupError, ValueError) as error:  # encodings that Python does not know or cannot map
            raise DefinitionError(
                f"{self.document}, line {self.parser.CurrentLineNumber}: expected a known encoding, found {error}"
            ) from None
        assert self.root is not None
        return self.root

    def start(self, name: str, attributes: dict[str, str]) -> None:
        namespace, _, tag = name.rpartition(_SEPARATOR)
        line = self.parser.CurrentLineNumber
        self.elements += 1
        if self.elements > MAX_ELEMENTS:
            raise DefinitionError(f"{self.document}, line {line}: expected at most {MAX_ELEMENTS} elements, found more")
        if len(self.stack) >= MAX_DEPTH:
            raise DefinitionError(
                f"{self.document}, line {line}, {tag}: expected elements at most {MAX_DEPTH} deep, found deeper"
            )
        # attributes of other namespaces (xsi:schemaLocation, xml:base) say nothing about the packets
        own = {key: value for key, value in attributes.items() if _SEPARATOR not in key}
        if not self.stack:
            self.namespace = namespace
        elif namespace != self.namespace:
            tag = f"{tag} of the namespace {namespace!r}"  # refused where it is read
        node = Node(tag, own, self.document, line)
        if not self.stack:
            self.root = node
        else:
            self.stack[-1].children.append(node)
        self.stack.append(node)

    def end(self, _name: str) -> None:
        self.stack.pop()

    def characters(self, text: str) -> None:
        self.stack[-1].texts.append(text)

    def doctype(self, name: str, *_rest: object) -> None:
        raise DefinitionError(
            f"{self.document}, line {self.parser.CurrentLineNumber}: expected no document type declaration, "
            f"found one of {name!r}"
        )
