"""`InteractionConfig`: which pairs count as interactions, and what is assumed of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

from deepaccident_devkit.arrays import checked_number
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.interactions.masses import CLASS_MASSES


@dataclass(frozen=True, slots=True, kw_only=True)
class InteractionConfig:
    """Which pairs at which frames count as interactions, and how their measures are made.

    A pair at a frame is one if at least one of the two moves, their centres are within `radius`, and the time to
    collision is at most `max_ttc` or the gap at most `max_gap`.

    Attributes:
        radius: metres between the centres.
        max_ttc: seconds.
        max_gap: metres.
        horizon: seconds; a collision that would come later counts as none.
        taus: seconds, the two thresholds of the times exposed and integrated (TET, TIT), kept as a tuple.
        standing_speed: m/s; up to it an actor stands.
        class_masses: class → kilograms at its median size: an assumption, as the release has no masses; kept read-only.
    """

    radius: float = 200.0
    max_ttc: float = 10.0
    max_gap: float = 5.0
    horizon: float = 20.0
    taus: tuple[float, float] = (1.5, 3.0)
    standing_speed: float = 0.5
    class_masses: Mapping[str, float] = field(default_factory=lambda: CLASS_MASSES)

    def __post_init__(self) -> None:
        """Check the numbers; raises ConfigError."""
        for name in ("radius", "max_ttc", "max_gap", "horizon", "standing_speed"):
            object.__setattr__(self, name, _not_negative(name, getattr(self, name)))
        taus = tuple(_not_negative("taus", tau) for tau in self.taus)
        if len(taus) != 2:
            raise ConfigError(f"taus: expected two thresholds in seconds, found {len(taus)}")
        if self.horizon < self.max_ttc:
            raise ConfigError(f"horizon: expected at least max_ttc, {self.max_ttc} s, found {self.horizon} s")
        object.__setattr__(self, "taus", taus)
        object.__setattr__(self, "class_masses", MappingProxyType(dict(self.class_masses)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Read-only mappings cannot be pickled."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return _made, ({**values, "class_masses": dict(self.class_masses)},)


def _made(values: Mapping[str, Any]) -> InteractionConfig:
    return InteractionConfig(**values)


def _not_negative(name: str, value: object) -> float:
    number = checked_number(name, value, error=ConfigError)
    if not 0 <= number < math.inf:
        raise ConfigError(f"{name}: expected a number from 0, found {value!r}")
    return number
