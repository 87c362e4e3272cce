"""docs/pictures.md shows every view; its pictures are there, small, and the only ones beside those of other pages."""

from types import ModuleType

import pytest
from scripts import TOP, loaded_script

from deepaccident_devkit.cli.render import render

IMAGES = TOP / "docs" / "images"
PAGE = TOP / "docs" / "pictures.md"
MOST_BYTES = 250_000


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return loaded_script("docs/make_pictures.py")


def test_every_view_is_shown_by_its_command(script: ModuleType) -> None:
    commands = script.COMMAND.findall(PAGE.read_text(encoding="utf-8"))
    views = {line.split()[1] for line in commands if line.startswith("render ")}
    assert views == set(render.commands)
    for others in ("export mcap ", "evaluate compare ", "info "):
        assert any(line.startswith(others) for line in commands), others


def test_the_pictures_are_there_and_small(script: ModuleType) -> None:
    pictures = script.PICTURE.findall(PAGE.read_text(encoding="utf-8"))
    assert len(pictures) > 20
    sizes = {name: (IMAGES / name).stat().st_size for name in pictures}
    assert [name for name, size in sizes.items() if size > MOST_BYTES] == ["video.webp"]


def test_every_picture_is_on_a_page() -> None:
    pages = [TOP / "ARCHITECTURE.md", *(TOP / "docs").glob("*.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    assert [path.name for path in IMAGES.iterdir() if f"images/{path.name})" not in text] == []
