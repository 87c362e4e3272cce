"""docs/pictures.md shows every view."""

from types import ModuleType

import pytest
from support.repository_scripts import TOP, load_script

from deepaccident_devkit.cli.render import render

PAGE = TOP / "docs" / "pictures.md"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_script("docs/make_pictures.py")


def test_every_view_is_shown_by_its_command(script: ModuleType) -> None:
    commands = script.COMMAND.findall(PAGE.read_text(encoding="utf-8"))
    views = {line.split()[1] for line in commands if line.startswith("render ")}
    assert views == set(render.commands)
    for command in ("export mcap ", "evaluate compare ", "info "):
        assert any(line.startswith(command) for line in commands), command
