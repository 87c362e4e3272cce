"""The plugin in a foreign project: pytest finds it, it costs nothing, and it can be turned off."""

import pytest

FOREIGN_TESTS = """
import pytest

seen = []

def test_release(deepaccident_release, deepaccident_layout, tmp_path):
    seen.append(deepaccident_layout)
    labels = list(deepaccident_release.rglob("label/*/*.txt"))
    assert len(labels) == 3 * 5 * 3
    assert (deepaccident_release / "val").exists() == (deepaccident_layout == "B")

def test_copy(deepaccident_release, deepaccident_release_copy):
    path = next(deepaccident_release_copy.rglob("*.txt"))
    path.write_text("mine")
    assert (deepaccident_release / path.relative_to(deepaccident_release_copy)).read_text() != "mine"

def test_broken(deepaccident_broken, deepaccident_release):
    broken, again = deepaccident_broken("label-missing"), deepaccident_broken("meta-missing")
    assert not broken.path.exists() and not again.path.exists()
    assert (deepaccident_release / broken.path.relative_to(broken.root)).exists()
    with pytest.raises(ValueError, match="expected one of"):
        deepaccident_broken("label-purple")

def test_factory(make_deepaccident_release):
    small = make_deepaccident_release(frames=1, splits=("val",), channels=())
    assert small == make_deepaccident_release(frames=1, splits=("val",), channels=())
    assert small != make_deepaccident_release(frames=1, splits=("test",), channels=())

def test_factory_with_a_configuration_of_which_one_option_is_another(make_deepaccident_release, deepaccident_config):
    one = make_deepaccident_release(deepaccident_config, frames=1, channels=[])
    assert len(list(one.rglob("label/*/*.txt"))) == 3 * 5
    assert (one / "val").exists() == (deepaccident_config.layout == "B")

def test_the_folder_of_the_test_is_its_own(deepaccident_release_copy, deepaccident_broken, tmp_path):
    deepaccident_broken("meta-missing")
    assert not list(tmp_path.iterdir())

def test_both_layouts_were_there():
    assert seen == ["A", "B"]
"""  # noqa: E501
IMPORT_TEST = """
import sys

def test_nothing_else_was_imported():
    assert "deepaccident_devkit.testing.plugin" in sys.modules
    assert not {"numpy", "deepaccident_devkit.release", "hypothesis"} & set(sys.modules)
"""


FIXTURE_TEST = "def test_release(deepaccident_release): pass\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "options", "output"),
    [
        (FOREIGN_TESTS, (), "12 passed"),  # in both layouts
        (IMPORT_TEST, (), "1 passed"),
        (FIXTURE_TEST, ("-p", "no:deepaccident"), "fixture 'deepaccident_release' not found"),
    ],
    ids=["fixtures", "imports nothing until a fixture is asked for", "turned off"],
)
def test_in_a_foreign_project(foreign, code: str, options: tuple[str, ...], output: str) -> None:
    (foreign.folder / "test_mine.py").write_text(code)
    process = foreign.pytest(*options)
    assert output in process.stdout, process.stdout + process.stderr
