"""`validate` finds each of 200 seeded mutations of a healthy release, except harmless ones."""

from pathlib import Path

import pytest

from deepaccident_devkit.validation import CODES, validate_release
from fault_injection.mutations import BEYOND, HARMLESS, MUTATIONS
from fault_injection.run import NUM_MUTATIONS, list_jobs
from fault_injection.table import summary

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "validation.md"


@pytest.mark.parametrize("deep", [False, True])
def test_the_healthy_release_has_no_errors_and_no_warnings(healthy_release, deep):
    report = validate_release(healthy_release, deep=deep, workers=2)
    assert [finding for finding in report.findings if finding.severity != "note"] == []


def test_200_mutations_of_every_kind_are_tried():
    all_jobs = list_jobs()
    required_jobs = [job for job in all_jobs if job.name not in BEYOND]

    assert len(required_jobs) == NUM_MUTATIONS >= 200
    assert {job.name for job in all_jobs} == set(MUTATIONS)


def test_every_fault_is_found(outcomes):
    not_required = {*HARMLESS, *BEYOND}
    missed = [
        outcome
        for outcome in outcomes
        if not outcome.found and outcome.job.name not in not_required
    ]
    assert missed == []


def test_harmless_changes_are_not_errors(outcomes):
    false_alarms = [
        outcome for outcome in outcomes if outcome.errors and outcome.job.name in HARMLESS
    ]
    assert false_alarms == []


def test_no_pickle_ever_runs(outcomes):
    assert [outcome for outcome in outcomes if outcome.code_ran] == []


def test_codes_marked_deep_come_only_from_sensors(outcomes):
    shallow_codes = set()
    for outcome in outcomes:
        if not MUTATIONS[outcome.job.name].deep:
            shallow_codes.update(outcome.errors, outcome.warnings)

    assert [code for code in sorted(shallow_codes) if CODES[code].deep] == []


def test_the_numbers_in_the_docs_come_from_this_run(outcomes):
    """`PYTHONPATH=tests python -m fault_injection` brings them up to date."""
    assert summary(outcomes) in PAGE.read_text(encoding="utf-8")
