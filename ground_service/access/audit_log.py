"""Queries of the audit log."""

from __future__ import annotations

from ground_service.access.model import AuditHead
from ground_service.errors import AuditBroken
from ground_service.ground import Ground
from ground_service.store import audit as chain


def audit_head(ground: Ground) -> AuditHead:
    """Return the head of the chain.

    Raises
    ------
    AuditBroken
        If its row is missing.
    """
    head = ground.read(chain.read_head)
    if head is None:
        raise AuditBroken("the head of the audit chain is missing; run 'linna verify'")
    return AuditHead(number=head.number, sha256=head.sha256)
