"""Values of on-board parameters in force (PUS service 20)."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from tmtc.dictionary.onboard_parameters import BY_NAME, Parameter


@dataclass(slots=True)
class ParameterStore:
    """Values in force: the defaults and what was changed by telecommand."""

    changed: dict[str, float] = field(default_factory=dict)
    defaults: dict[str, float] = field(default_factory=dict)

    def __getitem__(self, name: str) -> float:
        if name in self.changed:
            return self.changed[name]
        return self.defaults.get(name, BY_NAME[name].default)

    def set(self, parameter: Parameter, value: float) -> None:
        """Put a value in force that the parameter accepts."""
        self.changed[parameter.name] = value

    def restore(self, changed: Mapping[str, float]) -> int:
        """Put kept values in force; how many were refused because this build has other limits or names."""
        good = {
            name: float(value)
            for name, value in changed.items()
            if name in BY_NAME and BY_NAME[name].accepts(float(value))
        }
        self.changed = good
        return len(changed) - len(good)
