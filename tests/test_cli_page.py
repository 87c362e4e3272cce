"""docs/cli.md has the current help of all commands."""

from pathlib import Path
from types import ModuleType

import pytest
from support.repository_scripts import load_script

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_script("docs/make_cli_page.py")


def test_the_page_is_up_to_date(script: ModuleType) -> None:
    assert script.PAGE.read_text(encoding="utf-8") == script.page(), (
        "run: python docs/make_cli_page.py"
    )
