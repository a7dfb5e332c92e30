"""Which telecommands two people have to agree on: by their effect, unless the mission says otherwise."""

from __future__ import annotations

from dataclasses import dataclass

from tmtc.effects import EFFECTS, CommandEffect, Effect


@dataclass(frozen=True, slots=True)
class ApprovalPolicy:
    """Telecommands that one person enters and another releases.

    Attributes
    ----------
    second_person_for
        Subjects of `tmtc.effects`: a telecommand, or a telecommand and its function, such as
        ``perform_function/set_mode``.
    """

    second_person_for: frozenset[str]

    def needs_second_person(self, effect: CommandEffect) -> bool:
        """Whether a telecommand with this effect is released by somebody else than entered it."""
        if effect.subject not in EFFECTS:  # nobody knows what it does
            return True
        return effect.subject in self.second_person_for

    def raised(self, *subjects: str) -> ApprovalPolicy:
        """Return the policy with a second person for these, too."""
        return ApprovalPolicy(self.second_person_for | _known(subjects))

    def relaxed(self, *subjects: str) -> ApprovalPolicy:
        """Return the policy with one person for these."""
        return ApprovalPolicy(self.second_person_for - _known(subjects))


DEFAULT_POLICY = ApprovalPolicy(
    frozenset(subject for subject, one in EFFECTS.items() if one.effect is not Effect.ROUTINE)
)
"""Whatever changes the state of the payload or destroys data needs a second person."""


def _known(subjects: tuple[str, ...]) -> frozenset[str]:
    for subject in subjects:
        if subject not in EFFECTS:
            raise ValueError(
                f"approval policy: expected a telecommand or one of its functions, found {subject!r}"
            )
    return frozenset(subjects)
