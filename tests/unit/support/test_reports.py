"""Reports have the same values in all forms, and hostile names in them are harmless."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from support.expected_errors import assert_raises
from support.report_page import ReportPage

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.reports import CheckReport, Report, Row, Table, table_html

HOSTILE_NAME = "<script>alert('1')</script>"


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedReport(Report):
    """A report of speeds by name; None means unknown."""

    speeds: dict[str, float | None]

    def named_tables(self) -> dict[str, Iterable[Row]]:
        return {"speeds": [("name", "m/s"), *self.speeds.items()], "empty": [("name",)]}


def test_all_forms_have_the_same_numbers(tmp_path: Path) -> None:
    report = SpeedReport(speeds={HOSTILE_NAME: 1.5, "b": None})
    expected = {"speeds": {HOSTILE_NAME: 1.5, "b": None}}
    assert json.loads(report.to_json()) == report.to_dict() == expected
    tables = [path.read_text() for path in report.to_csv(tmp_path / "new")]
    assert tables == [f"name,m/s\n{HOSTILE_NAME},1.5\nb,\n", "name\n"]
    assert report.to_text() == f"speeds\nname{' ' * 25}m/s\n{HOSTILE_NAME}  1.5\nb\n\nempty\nname"

    page = ReportPage(report.to_html())
    assert len(page.all("table")) == 2
    assert len(page.all("tr")) == 4
    assert len(page.all("script")) == 0
    assert HOSTILE_NAME in page.text


def test_only_forms_for_people_have_minus_signs(tmp_path: Path) -> None:
    report = SpeedReport(speeds={"a": -1.5})
    assert report.to_text() == "speeds\nname   m/s\na     −1.5\n\nempty\nname"
    assert "−1.5" in ReportPage(report.to_html()).text
    assert json.loads(report.to_json()) == {"speeds": {"a": -1.5}}
    tables = [path.read_text() for path in report.to_csv(tmp_path)]
    assert tables == ["name,m/s\na,-1.5\n", "name\n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedCheckReport(CheckReport):
    """A report of a check of speeds."""

    is_right: bool = True

    @property
    def is_good(self) -> bool:
        return self.is_right


def test_checks_state_what_they_compared() -> None:
    for compared, is_right, status in (
        ({"speeds": 1200, "names": 0}, True, 0),
        ({}, True, 2),
        ({"a": 0}, False, 1),
    ):
        report = SpeedCheckReport(compared=compared, is_right=is_right, cannot_say=("no name.",))
        assert report.exit_status == status
        assert json.loads(report.to_json())["compared"] == compared
        assert report.to_text().endswith("\nCannot say: no name.")
    report = SpeedCheckReport(compared={"speeds": 3, "names": 0})

    assert "Compared: 3 speeds, 0 names." in report.to_text()


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert_raises(
        (
            lambda: SpeedReport(speeds={}).to_csv(tmp_path / "file"),
            ConfigError,
            "is a file; give a folder",
        )
    )


def test_notes_stand_below_a_table() -> None:
    table = Table(rows=[("a", "b"), ("name", "1.0")], notes=("of one",))
    assert table.to_text() == "a       b\nname  1.0\nof one"
    assert table_html([("a",), ("b",)], "c") == (
        "<table><caption>c</caption><tr><th>a</th></tr><tr><td>b</td></tr></table>"
    )
