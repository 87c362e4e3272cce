"""Reading scenario files."""

import os
from pathlib import Path

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth.spec.checks import check_scenario
from deepaccident_devkit.synth.spec.model import ScenarioSpec
from deepaccident_devkit.synth.spec.reading import read_part
from deepaccident_devkit.synth.spec.template import SpecTemplate
from deepaccident_devkit.synth.spec.yaml_nodes import parse_yaml

_MOST_CHARACTERS = 200_000
"""PyYAML reads as many in a few seconds."""


def read_spec(path: str | os.PathLike[str]) -> SpecTemplate:
    """The scenario of a YAML file (docs/scenarios.md says what one can hold).

    Raises:
        ConfigError: there is no such file, or it cannot be carried out; the message names line, field and remedy.
    """
    try:
        with Path(path).open(encoding="utf-8") as file:
            text = file.read(_MOST_CHARACTERS + 1)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); give a YAML file in UTF-8") from error
    if len(text) > _MOST_CHARACTERS:
        raise ConfigError(
            f"{path}: has more than {_MOST_CHARACTERS} characters; give a scenario file, it has a few dozen lines"
        )
    return parse_spec(text, str(path))


def parse_spec(text: str, source: str = "scenario") -> SpecTemplate:
    """The scenario of a YAML text.

    Args:
        text: as in a file.
        source: what messages call it.

    Raises:
        ConfigError: it cannot be carried out; the message names line, field and remedy.
    """
    root = read_part(parse_yaml(text, source), ScenarioSpec)
    check_scenario(root)
    return SpecTemplate(root)
