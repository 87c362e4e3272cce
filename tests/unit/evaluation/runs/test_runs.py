"""Every default and constant of evaluation runs, against the values written out here."""

from pathlib import Path

from support.default_values import package_values
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.runs import compare_bundles
from deepaccident_devkit.evaluation.runs.bundles import checked_target
from deepaccident_devkit.evaluation.runs.evaluation_run import breakdowns_of
from deepaccident_devkit.evaluation.runs.rows import read_rows, write_rows
from deepaccident_devkit.evaluation.runs.sanity import SanityReport
from deepaccident_devkit.evaluation.runs.setups import (
    TASKS,
    Coverage,
    EvaluationSetup,
    default_selection,
)
from deepaccident_devkit.evaluation.runs.text import notes_of
from deepaccident_devkit.evaluation.runs.verification import find_differences

EXPECTED_VALUES = {
    "bundles.SUMMARY_FILE": "'metrics_summary.json'",
    "bundles.COUNTS_FILE": "'counts.json'",
    "bundles.ROWS_FILE": "'samples.parquet'",
    "bundles.SCENARIOS_FILE": "'scenarios.json'",
    "bundles.FILES_FILE": "'files.json'",
    "bundles.RESULTS_FOLDER": "'results'",
    "bundles.SCENARIOS_FORMAT": "'DeepAccident scenario hashes'",
    "bundles.FILES_FORMAT": "'DeepAccident evaluation bundle'",
    "bundles.checksums_of": "listed=None",
    "bundles.save_run": "include_results=False, overwrite=False, extras=()",
    "bundles.checked_target": "overwrite=False, requested=None",
    "comparison.ComparedNumber": "higher_is_better=None",
    "comparison.compare_bundles": "resampling=None, common=False",
    "evaluation_run.SUMMARY_FORMAT": "'DeepAccident metrics summary'",
    "evaluation_run.SUMMARY_VERSION": "1",
    "evaluation_run.BREAKDOWNS": (
        "('all', 'time_to_impact', 'accident_visibility', 'agent', 'scenario_type', 'town', "
        "'weather_group', 'time_of_day_group', 'road_type', 'trajectory_type', 'collision_status')"
    ),
    "evaluation_run.EvaluationRun": "sanity=None, left_out=0, further=<factory>",
    "evaluation_run.EvaluationRun.broken_down": "by=None, resampling=None",
    "evaluation_run.evaluate_results": "selection='val', allow_partial=False, out=None",
    "further.with_further": "resampling=None",
    "over_bytes.over_bytes": "resampling=None, common=False",
    "rows.STAMP_KEY": "b'deepaccident'",
    "sanity.SAMPLE_COUNT": "20",
    "sanity.LIST_COUNT": "60",
    "sanity.TIME_TOLERANCE_S": "0.15",
    "sanity.MIN_SPEED_MPS": "4.0",
    "sanity.HEADING_TOLERANCE_RAD": "0.2617993877991494",
    "sanity.FEW_FRAMES": "3",
    "sanity.SanityReport": "compared='', sought=()",
    "sanity.SampleEvidence": "empty=False, scores=(), probabilities=False",
    "setups.LIST_STEP": "0.5",
    "setups.SampleSelection": "samples='evaluate', scope='accident', agents=None, horizon=2.0",
    "setups.Coverage": "missing=(), extra=(), unknown=(), splits=(), agents=(), options=''",
    "setups.EvaluationSetup": "protocol='released', switches=<factory>, horizon=2.0",
    "setups.coverage": "explain=True",
    "setups.default_selection": "split='val', samples=None, scope=None, agents=None",
    "setups.evaluation_store": "command=''",
    "text.SHOWN_BREAKDOWNS": "('time_to_impact', 'accident_visibility')",
    "text.summary_text": "by=('time_to_impact', 'accident_visibility')",
    "verification.ABSENT_TEXT": "'absent'",
    "verification.find_differences": "without=(), path=''",
    "verification.verify_bundle": "results=None, split=None",
}

EXPECTED_PROTOCOLS = {
    "motion": ("released", "paper"),
    "accident": ("released", "paper", "boxes"),
    "detection": ("released", "released_iou", "paper", "opencood"),
    "tracking": ("clean", "nuscenes"),
    "warning": ("clean", "field"),
    "planning": (
        *("clean", "uniad", "stp3", "vad", "bev_planner"),
        *("uniad_own_box", "stp3_own_box", "vad_own_box", "bev_planner_own_box"),
    ),
    "forecasting": ("clean",),
    "segmentation": ("clean", "onebev"),
}


def test_every_default_and_constant_written_out(tmp_path: Path) -> None:
    protocols = {task: tuple(evaluator.protocols) for task, evaluator in TASKS.items()}
    assert package_values("deepaccident_devkit.evaluation.runs") == EXPECTED_VALUES
    assert protocols == EXPECTED_PROTOCOLS

    text = "split val, samples evaluate (the last 2 s), scope accident, all agents"
    assert default_selection(EvaluationSetup(task="motion")).text() == text

    write_rows(tmp_path / "rows", [], {})
    assert read_rows(tmp_path / "rows") == ([], {})
    assert list(find_differences({}, {})) == []
    assert list(notes_of({})) == []
    assert checked_target(tmp_path / "new") == tmp_path / "new"
    assert breakdowns_of("warning")[:2] == ("all", "agent")
    assert SanityReport(samples=0, warnings=()).sought == ()
    assert Coverage(expected=1).is_complete is True
    assert_raises(
        (lambda: compare_bundles(tmp_path / "a", tmp_path / "b"), ResultsError, ("no such folder",))
    )
