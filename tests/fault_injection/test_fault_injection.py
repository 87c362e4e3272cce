"""200 seeded mutations of a healthy release: `validate` finds each, or it is listed by name as
harmless.
"""

from pathlib import Path

import pytest

from deepaccident_devkit.validation import CODES, validate_release
from fault_injection.mutations import BEYOND, HARMLESS, MUTATIONS
from fault_injection.run import NUM_MUTATIONS, jobs
from fault_injection.table import summary

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "validation.md"


@pytest.mark.parametrize("deep", [False, True])
def test_the_healthy_release_has_no_errors_and_no_warnings(healthy_release, deep):
    report = validate_release(healthy_release, deep=deep, workers=2)
    assert [finding for finding in report.findings if finding.severity != "note"] == []


def test_200_mutations_of_every_kind_are_tried():
    tried = jobs()
    assert len([job for job in tried if job.name not in BEYOND]) == NUM_MUTATIONS >= 200
    assert {job.name for job in tried} == set(MUTATIONS)


def test_every_fault_is_found(outcomes):
    assert [
        outcome
        for outcome in outcomes
        if not outcome.found and outcome.job.name not in {*HARMLESS, *BEYOND}
    ] == []


def test_what_does_no_harm_is_no_error(outcomes):
    assert [
        outcome for outcome in outcomes if outcome.errors and outcome.job.name in HARMLESS
    ] == []


def test_no_pickle_ever_runs(outcomes):
    assert [outcome for outcome in outcomes if outcome.code_ran] == []


def test_codes_marked_deep_come_from_sensors_alone(outcomes):
    shallow = {
        code
        for outcome in outcomes
        if not MUTATIONS[outcome.job.name].deep
        for code in (*outcome.errors, *outcome.warnings)
    }
    assert [code for code in sorted(shallow) if CODES[code].deep] == []


def test_the_numbers_in_the_docs_are_those_of_this_run(outcomes):
    """`PYTHONPATH=tests python -m fault_injection` brings them up to date."""
    assert summary(outcomes) in PAGE.read_text(encoding="utf-8")
