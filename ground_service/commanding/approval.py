"""Approval policy: telecommands that need a second person, by effect or by mission description."""

from __future__ import annotations

from dataclasses import dataclass

from tmtc.effects import EFFECTS, CommandEffect, Effect


@dataclass(frozen=True, slots=True)
class ApprovalPolicy:
    """Policy for telecommands that one person enters and a second person releases.

    Attributes
    ----------
    second_person_for
        Subjects of `tmtc.effects`: a telecommand, or a telecommand and its function, such as
        ``perform_function/set_mode``.
    """

    second_person_for: frozenset[str]

    def needs_second_person(self, effect: CommandEffect) -> bool:
        """Return whether a telecommand with this effect needs a second person for release."""
        if effect.subject not in EFFECTS:  # the effect is unknown
            return True
        return effect.subject in self.second_person_for

    def raised(self, *subjects: str) -> ApprovalPolicy:
        """Return the policy extended by telecommands that need a second person."""
        return ApprovalPolicy(self.second_person_for | _known(subjects))

    def relaxed(self, *subjects: str) -> ApprovalPolicy:
        """Return the policy with telecommands that need only one person."""
        return ApprovalPolicy(self.second_person_for - _known(subjects))


DEFAULT_POLICY = ApprovalPolicy(
    frozenset(subject for subject, one in EFFECTS.items() if one.effect is not Effect.ROUTINE)
)
"""Default policy: a second person for all telecommands that change on-board state or destroy data."""


def _known(subjects: tuple[str, ...]) -> frozenset[str]:
    for subject in subjects:
        if subject not in EFFECTS:
            raise ValueError(
                f"approval policy: expected a telecommand or one of its functions, found {subject!r}"
            )
    return frozenset(subjects)
