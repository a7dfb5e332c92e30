"""The figures of a pass that scripts and the demonstration print."""

from __future__ import annotations

from ground_service.evaluation.service import pass_summary

__all__ = ["pass_summary"]
