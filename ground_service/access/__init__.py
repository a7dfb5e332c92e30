"""Users, tokens, roles, idempotency keys and the audit log."""
