"""Reports: one value and named tables in all forms, with names that are harmless."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from refusals import assert_refused
from report_page import Page

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.reports import CheckReport, Report, Row, Table, table_html

HOSTILE = "<script>alert('1')</script>"


@dataclass(frozen=True, slots=True, kw_only=True)
class Speeds(Report):
    """Speeds by name; None is not known."""

    speeds: dict[str, float | None]

    def named_tables(self) -> dict[str, Iterable[Row]]:
        return {"speeds": [("name", "m/s"), *self.speeds.items()], "empty": [("name",)]}


def test_all_forms_have_the_same_numbers(tmp_path: Path) -> None:
    report = Speeds(speeds={HOSTILE: 1.5, "b": None})
    assert json.loads(report.to_json()) == report.to_dict() == {"speeds": {HOSTILE: 1.5, "b": None}}
    tables = [path.read_text() for path in report.to_csv(tmp_path / "new")]
    assert tables == [f"name,m/s\n{HOSTILE},1.5\nb,\n", "name\n"]
    assert report.to_text() == f"speeds\nname{' ' * 25}m/s\n{HOSTILE}  1.5\nb\n\nempty\nname"
    page = Page(report.to_html())
    assert [len(page.all(tag)) for tag in ("table", "tr", "script")] == [2, 4, 0]
    assert HOSTILE in page.text


@dataclass(frozen=True, slots=True, kw_only=True)
class Checked(CheckReport):
    """Whether speeds are right."""

    is_right: bool = True

    @property
    def is_good(self) -> bool:
        return self.is_right


def test_checks_say_what_they_compared() -> None:
    for compared, is_right, status in (
        ({"speeds": 1200, "names": 0}, True, 0),
        ({}, True, 2),
        ({"a": 0}, False, 1),
    ):
        report = Checked(compared=compared, is_right=is_right, cannot_say=("no name.",))
        assert (report.exit_status, json.loads(report.to_json())["compared"]) == (status, compared)
        assert report.to_text().endswith("\nCannot say: no name.")
    assert "Compared: 3 speeds, 0 names." in Checked(compared={"speeds": 3, "names": 0}).to_text()


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert_refused(
        (
            lambda: Speeds(speeds={}).to_csv(tmp_path / "file"),
            ConfigError,
            "is a file; give a folder",
        )
    )


def test_notes_stand_below_a_table() -> None:
    assert (
        Table(rows=[("a", "b"), ("name", "1.0")], notes=("of one",)).to_text()
        == "a       b\nname  1.0\nof one"
    )
    assert table_html([("a",), ("b",)], "c") == (
        "<table><caption>c</caption><tr><th>a</th></tr><tr><td>b</td></tr></table>"
    )
