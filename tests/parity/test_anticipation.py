"""The golden anticipation (tests/data/golden/safety): four published evaluations, and `clean`.

UString, DSTA, DRIVE and DAD were run with their sorts made stable, `clean` is plain code with
scikit-learn's AP and AUC (tests/data/golden/safety/README.md). All numbers to 1e-9; where a
published code raised an error the devkit gives NaN.
"""

import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.evaluation.warning import ScoreSeries, printed_figures
from deepaccident_devkit.evaluation.warning.clean import CleanScores

FIELD_NAMES = {
    "AP": "average_precision",
    "AP_frame": "average_precision",
    "mTTA": "mean_time",
    "mTTA_x5": "mean_time",
    "TTA_R80": "time_at_r80",
    "TTA_R80_x5": "time_at_r80",
    "P_R80": "precision_at_r80",
    "P_05": "precision_at_half",
    "R_05": "recall_at_half",
    "TTA_05": "time_at_half",
}
CLEAN_NAMES = {
    "threshold": "threshold",
    "recall": "recall",
    "precision": "precision",
    "tta_hit": "tta_hit",
    "tta0": "tta0",
    "fa_time_share": "time_in_alarm",
    "fa_episodes_per_min": "episodes_per_minute",
    "fa_seconds_per_min": "alarm_seconds_per_minute",
    "fa_recordings": "false_recordings",
}


@functools.cache
def _cases(folder: Path) -> Mapping[str, Any]:
    path = folder / "safety" / "anticipation.json"
    if not path.is_file():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))["cases"]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    cases = _cases(metafunc.config.getoption("golden"))
    if "code" in metafunc.fixturenames:
        pairs = []
        for name, codes in cases.items():
            pairs += [(name, code) for code in codes if code.endswith("_stable")]
        metafunc.parametrize(("case", "code"), pairs or [(None, None)])
    else:
        metafunc.parametrize("case", list(cases) or [None])


@pytest.fixture
def golden(
    case: str | None, pytestconfig: pytest.Config
) -> tuple[Mapping[str, Any], dict[str, np.ndarray]]:
    folder = pytestconfig.getoption("golden")
    if case is None:
        pytest.fail(f"{folder / 'safety' / 'anticipation.json'}: no case; see pytest --golden DIR")
    with np.load(folder / "safety" / "anticipation.npz") as archive:
        arrays = {name: archive[f"{case}/{name}"] for name in ("scores", "labels", "toa", "length")}
    return _cases(folder)[case], arrays


def make_series(
    entry: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, cut: bool
) -> ScoreSeries:
    positive = arrays["labels"] > 0
    num_frames = arrays["length"] if cut else arrays["scores"].shape[1]
    toa = np.where(positive, arrays["toa"], num_frames)
    return ScoreSeries(
        scores=arrays["scores"].astype(np.float64),
        positive=positive,
        toa=toa.astype(np.int64),
        fps=entry["fps"],
    )


def assert_same(value: float | None, expected: float | None, name: str) -> None:
    if expected is None:
        assert value is None or math.isnan(value), name
    else:
        assert value == pytest.approx(expected, rel=1e-9, abs=1e-9), name


def test_figures_equal_the_published_codes(golden, case: str, code: str) -> None:
    entry, arrays = golden
    expected = entry[code]
    figures = printed_figures(make_series(entry, arrays, cut=False), code.removesuffix("_stable"))
    if "error" in expected:
        assert math.isnan(figures.average_precision)
        assert math.isnan(figures.mean_time)
        assert figures.note
        return
    for name, value in expected.items():
        assert_same(getattr(figures, FIELD_NAMES[name]), value, name)


def test_clean(golden, case: str) -> None:
    entry, arrays = golden
    expected = entry["clean"]
    clean = CleanScores(make_series(entry, arrays, cut=True))
    weight = np.ones(len(arrays["labels"]))

    assert_same(clean.average_precision(weight), expected["AP"], "AP")
    assert_same(clean.area_under_curve(weight), expected["AUC"], "AUC")
    assert_same(clean.mean_time(weight), expected.get("mTTA_curve"), "mTTA_curve")

    thresholds = {
        "at_0.5": 0.5,
        "at_R80": clean.threshold_of_recall(weight),
        "at_P80": clean.threshold_of_precision(weight),
    }
    for point, threshold in thresholds.items():
        figures = clean.at(threshold, weight)
        expected_figures = expected.get(point)
        if expected_figures is None:
            assert math.isnan(figures.recall), point
            continue
        for name, value in expected_figures.items():
            assert_same(getattr(figures, CLEAN_NAMES[name]), value, f"{point}/{name}")
