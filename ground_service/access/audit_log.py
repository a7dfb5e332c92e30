"""Queries of the audit log."""

from __future__ import annotations

from ground_service.access.model import AuditHead
from ground_service.errors import AuditBroken, InvalidInput
from ground_service.ground import Ground
from ground_service.store import audit as chain


def audit_head(ground: Ground) -> AuditHead:
    """Return the head of the chain.

    Raises
    ------
    AuditBroken
        If its row is missing.
    """
    with ground.database.reading() as connection:
        head = chain.read_head(connection)
    if head is None:
        raise AuditBroken("the head of the audit chain is missing; run 'linna verify'")
    return AuditHead(number=head.number, sha256=head.sha256)


def parse_head(text: str) -> chain.Head:
    """Return the head that `linna audit head` printed as NUMBER:SHA256.

    Raises
    ------
    InvalidInput
        If the text is something else.
    """
    number, _, sha256 = text.strip().partition(":")
    if (
        not (number.isascii() and number.isdigit())
        or len(sha256) != 64
        or set(sha256) - set("0123456789abcdef")
    ):
        raise InvalidInput(
            "audit head", "", "NUMBER:SHA256 as 'linna audit head' prints it", repr(text)[:100]
        )
    return chain.Head(int(number), sha256)
