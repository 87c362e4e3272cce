"""What the numbers of a scenario file may be."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Bounds:
    """The span of a number, both ends included.

    Attributes:
        low: the least.
        high: the most.
        unit: such as `m/s`; empty for a count.
    """

    low: float
    high: float
    unit: str = ""

    def __str__(self) -> str:
        """Such as `0 to 30 m/s`."""
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()
