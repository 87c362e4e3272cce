"""The paper's twelve designs, each a scenario file that ships with the package."""

from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from typing import Final

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth.spec.files import parse_spec
from deepaccident_devkit.synth.spec.template import SpecTemplate

DESIGN_NUMBERS: Final = tuple(range(1, 13))
"""1 to 6 at signalised junctions, 7 to 12 at unsignalised ones."""


class _Designs(Mapping[int, SpecTemplate]):
    """Reads a design's file when it is first asked for."""

    def __getitem__(self, number: int) -> SpecTemplate:
        if number not in DESIGN_NUMBERS:
            raise KeyError(number)
        return _design(number)

    def __iter__(self) -> Iterator[int]:
        return iter(DESIGN_NUMBERS)

    def __len__(self) -> int:
        return len(DESIGN_NUMBERS)


DESIGNS: Final[Mapping[int, SpecTemplate]] = _Designs()
"""Number → design."""


def design_text(number: int) -> str:
    """The scenario file of a design, as it ships.

    Raises:
        ConfigError: there is no such design.
    """
    for entry in files("deepaccident_devkit.synth.spec").joinpath("designs").iterdir():
        if entry.name.startswith(f"{number:02d}_") and entry.name.endswith(".yaml"):
            return entry.read_text(encoding="utf-8")
    raise ConfigError(f"design: {number} is not one of 1 to {len(DESIGN_NUMBERS)}; choose one of these")


@cache
def _design(number: int) -> SpecTemplate:
    return parse_spec(design_text(number), f"design {number}")
