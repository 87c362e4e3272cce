"""Audit of scores of accidents: whether they only depend on a clip's length, place or name."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import MOST_TOLD, ResultsError, shortened
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import LEAST_CLUSTERS
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.warning.clean import roc_area
from deepaccident_devkit.plugins.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, as_floats
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.reports import Row
from deepaccident_devkit.support.text import counted, number_of, path_of

_RESAMPLES: Final = 400
# Scores follow an attribute if the lower ends of their rank correlations exceed these: among all
# scenarios, and among scenarios of equal outcome, where the attribute cannot represent the truth.
_MIN_CORRELATION: Final = 0.8
_MIN_CORRELATION_AMONG_ALIKE: Final = 0.5
# Attribute → description of scores that fall, or rise, with it.
_DETECTOR_TEXTS: Final[Mapping[str, tuple[str, str]]] = {
    "length": ("a detector of short clips", "a detector of long clips"),
    "folder": ("a detector of the folder `normal`", "a detector of the folder `accident`"),
    "name": ("a detector of small numbers in names", "a detector of large numbers in names"),
    "town": ("a detector of towns", "a detector of towns"),
    "weather": ("a detector of weather", "a detector of weather"),
    "actors": ("a detector of few actors", "a detector of many actors"),
    "frame": ("a detector of early frames", "a detector of late frames"),
}
_NOTES: Final = (
    (
        "Truth: meta names a collision. A scenario's score is its samples' highest; the frame is "
        "compared by samples."
    ),
    (
        "AUC of an attribute: in the direction that fits; of town and weather, by the share of "
        "collisions among the other\nscenarios of the same word, without the twin."
    ),
    (
        "`with the scores`: Spearman's rank correlation, of town and weather by the mean score of "
        "the word. `among alike`:\nof ranks within the collisions and within the others, where no "
        "attribute can stand for the truth (of the frame, without\ncollisions alone)."
    ),
    (
        f"From, to: 95 % of {_RESAMPLES} resamples of scenarios, twins together; −1 to 1 for fewer "
        f"than {LEAST_CLUSTERS}."
    ),
)
_HEADING: Final = ("attribute", "AUC", "with the scores", "from", "to", "among alike", "from", "to")
# A token and its score in a table, optionally after the number of the row.
_LINE: Final = re.compile(
    r"""(?:"?\d*"?[,;\t|])?\s*"?(?P<token>[^\s,;|"]+/[^\s,;|"]+)"?\s*[,;\t|]\s*"""
    r""""?(?P<score>[^\s;|"]+)"?\s*"""
)
_REMEDY: Final = (
    "give results of the task accident, a JSON object of token and score, or a .csv of lines "
    "`token,score`, with a comma, a semicolon, a tab or a bar"
)
_ALIKE_REASON: Final = (
    "scenarios that end alike hardly differ in it, so scores that go by it cannot be told apart "
    "from the truth here."
)
_FEW_REASON: Final = (
    f"nothing can be found: all are equal, or fewer than {LEAST_CLUSTERS} scenarios (twins are "
    "one) have one."
)


def read_scores(path: str | os.PathLike[str]) -> dict[str, float]:
    """Return the score of each token of a sample or scenario; a higher score is a surer accident.

    Args:
        path: Results of the task `accident` (a sample's score is that of its surest accident, 0
            without one); or JSON, an object of token and score or a list of objects with `token`
            and `score`; or a table (a .csv file) with lines of a token (which has a `/`) and then a
            score; lines without a token are ignored.

    Raises:
        ResultsError: The file cannot be read, is something else, or a score is no finite number.
    """
    file = path_of(path, error=ResultsError)
    scores = _read_pairs(file)
    if not scores:
        raise ResultsError(f"{file}: has no token with a score; {_REMEDY}")
    if "results" in scores:
        results = read_results(file)
        if results.task == "accident":
            scores = {}
            for token in results.tokens:
                accidents = cast("Any", results.prediction(token))
                scores[token] = max((accident.score for accident in accidents), default=0.0)
    for token, score in scores.items():
        if type(score) not in (int, float) or not abs(score) < 1e300:
            entry = f"{shortened(str(token))}: {shortened(repr(score))}"
            raise ResultsError(f"{file}: expected a score, found {entry}; {_REMEDY}")
    return scores


def _read_pairs(file: Path) -> dict[str, Any]:
    """Read a table or a JSON file of tokens and unchecked scores; raises ResultsError."""
    try:
        content = read_bytes(file, "results")
        if file.suffix.lower() in (".csv", ".tsv", ".txt"):
            return dict(_pairs_of_table(content.decode("utf-8-sig")))
        document = parsed_json(content)
        if isinstance(document, list):
            return {entry["token"]: entry["score"] for entry in document}
        return dict(document)
    except (TypeError, LookupError) as error:
        raise ResultsError(
            f"{file}: expected an object of token and score, or a list of these; {_REMEDY}"
        ) from error
    except (OSError, ValueError) as error:
        raise ResultsError(
            f"{file}: {shortened(fault_text(error), MOST_TOLD)}; {_REMEDY}"
        ) from error


def _pairs_of_table(text: str) -> Iterator[tuple[str, float | None]]:
    """Yield the token and the score of each line with a token; raises ValueError."""
    for number, line in enumerate(text.splitlines(), start=1):
        if "/" in line:
            match = _LINE.fullmatch(line)
            if match is None:
                raise ValueError(
                    f"line {number}: expected a token and then its score, found {shortened(line)}"
                )
            yield match["token"], number_of(match["score"].replace(",", "."))


def audit_scores(
    dataset: Dataset, scores: Mapping[str, float], split: str | os.PathLike[str] | None = None
) -> AuditReport:
    """Compare scores of accidents with the truth, and with attributes that it should ignore.

    Args:
        dataset: The release.
        scores: Token of a sample or a scenario → its score, as from `read_scores`.
        split: Only use its scenarios: `train`, `val`, … or a split file; None for all scenarios
            that have a score.

    Raises:
        TokenError: A token is neither a sample's nor a scenario's.
        ResultsError: No scenario with meta has a score.
    """
    scenarios = dataset.columns("scenario")
    tokens = [record["token"] for record in dataset.scenario[:]]
    cases = _cases(dataset, scores)
    split_tokens = [*dataset.split_scenarios(split)] if split else tokens
    is_counted = np.isin(tokens, split_tokens) & np.array(scenarios["weather"].is_valid())
    counted_cases = [case for case in cases if is_counted[case[0]]]
    rows, frames, case_scores = np.array(counted_cases, dtype=float).reshape(-1, 3).T
    if not len(rows):
        raise ResultsError(
            "no scenario with meta has a score; give scores of a split whose meta is published"
        )
    scenario_rows, scenario_of_case = np.unique(rows.astype(int), return_inverse=True)
    highest = np.full(len(scenario_rows), -np.inf)
    np.maximum.at(highest, scenario_of_case, case_scores)
    truth = np.array(scenarios["collision"].is_valid())[scenario_rows]
    case_truth = truth[scenario_of_case]
    scenario_clusters = [cluster_of(tokens[row]) for row in scenario_rows]
    clusters = np.unique(scenario_clusters, return_inverse=True)[1]
    words = [np.array(scenarios[name])[scenario_rows].astype(str) for name in ("town", "weather")]
    name_numbers = [int(re.sub(r".*?(\d*)$", r"0\1", tokens[row])) for row in scenario_rows]
    instance_scenarios = dataset.columns("instance")["scenario_row"]
    actor_counts = np.bincount(instance_scenarios, minlength=len(tokens))[scenario_rows]
    length_folder_name: list[AnyArray] = [
        scenarios["num_frames"][scenario_rows],
        scenarios["designed_accident"][scenario_rows],
        np.array(name_numbers),
    ]
    word_scores = [_word_means(values, highest) for values in words]
    columns = [*length_folder_name, *word_scores, actor_counts]
    case_clusters = clusters[scenario_of_case]
    correlations = [
        *_correlations([*columns, highest], truth * 1, clusters),
        *_correlations([frames, case_scores], case_truth * -1, case_clusters),
    ]
    areas = [_area(values, truth) for values in columns]
    areas[3:5] = [_area(_word_means(values, truth, clusters), truth) for values in words]
    areas.append(_area(frames, case_truth))
    scores_area = _area(highest, truth)
    attributes = dict(
        zip(_DETECTOR_TEXTS, [*length_folder_name, *words, actor_counts, frames], strict=True)
    )
    undecided, table, findings = list[str](), list[Row](), list[AuditFinding]()
    for (name, values), area, (overall, alike) in zip(
        attributes.items(), areas, correlations, strict=True
    ):
        # The AUC of shares among other scenarios is no fit below a half: leaving one out causes it.
        fitted_area = max(area, 0.5 if name in ("town", "weather") else round(1 - area, 3))
        table.append((name, fitted_area, *overall.tolist(), *alike.tolist()))
        if _hardly_varies(values, case_truth if name == "frame" else truth):
            undecided.append(name)
        if _is_followed(name, values, overall, alike, highest, truth):
            what = (
                f"these scores are those of {_DETECTOR_TEXTS[name][bool(overall[0] > 0)]}: their "
                f"rank correlation with `{name}` is {overall[0]}, and {alike[0]} among scenarios "
                f"that end alike. Alone, it has an AUC of {fitted_area}, they of {scores_area}."
            )
            remedy = (
                "Cut all clips alike, or compare moments of equal time to the end: deepaccident "
                "evaluate warning."
            )
            findings.append(AuditFinding(kind=name, what=what, remedy=remedy, number=len(truth)))
    is_few = len({*clusters}) < LEAST_CLUSTERS or len({*highest}) == 1
    cannot_say = []
    if is_few:
        cannot_say.append(_FEW_REASON)
    if undecided:
        cannot_say.append(f"{', '.join(undecided)}: {_ALIKE_REASON}")
    scenarios_text = counted(len(truth), "scenario")
    decided_count = len(_DETECTOR_TEXTS) - len(undecided)
    return AuditReport(
        compared={"attributes with the scores": 0 if is_few else decided_count},
        cannot_say=tuple(cannot_say),
        findings=tuple(findings),
        tables={"scores": [_HEADING, ("the scores", scores_area, *[None] * 6), *table]},
        notes=(
            f"{scenarios_text} with meta and a score, {truth.sum()} with a collision.",
            *_NOTES,
        ),
    )


def _cases(dataset: Dataset, scores: Mapping[str, float]) -> list[tuple[int, int, float]]:
    """Return the row of the scenario, the frame (0 for a scenario) and the score of each token."""
    scenario_row_of_sample = dataset.columns("sample")["scenario_row"]
    cases = []
    for token, score in scores.items():
        if token.count("/") > 1:
            row = scenario_row_of_sample[dataset.getind("sample", token)]
            frame = int(token.rpartition("/")[2])
        else:
            row, frame = dataset.getind("scenario", token), 0
        cases.append((row, frame, score))
    return cases


def _hardly_varies(values: AnyArray, outcomes: BoolArray) -> bool:
    """Return whether fewer than two values (N,) differ from the usual value of their outcome."""
    numbers = sorted(Counter(zip(values, outcomes, strict=True)).values())
    return sum(numbers[: -len({*outcomes})]) < 2


def _is_followed(
    name: str,
    values: AnyArray,
    overall: FloatArray,
    alike: FloatArray,
    highest: FloatArray,
    truth: BoolArray,
) -> bool:
    """Return whether the scores follow an attribute.

    Args:
        name: Name of the attribute.
        values: Its values, shape (N,).
        overall: Rank correlation of all scenarios, and the ends of its interval, shape (3,).
        alike: As `overall`, among scenarios of equal outcome.
        highest: Highest score of each scenario, shape (S,).
        truth: Whether each scenario has a collision, shape (S,).
    """
    rises = bool(overall[0] > 0)
    low, low_alike = (overall[1], alike[1]) if rises else (-overall[2], -alike[2])
    is_followed = low_alike > _MIN_CORRELATION_AMONG_ALIKE
    if name == "folder":  # scenarios whose folder and outcome differ are too few for an interval
        agrees = (highest > highest.mean()) == (values == rises)
        agrees_with_folder = agrees[values != truth]
        min_agreeing = max(1, _MIN_CORRELATION * len(agrees_with_folder))
        is_followed |= agrees_with_folder.sum() > min_agreeing
    return bool(low > _MIN_CORRELATION and is_followed)


def _area(values: FloatArray, truth: BoolArray) -> float:
    """Return the area under the ROC curve, to three decimals; 0.5 if all outcomes are equal."""
    area = roc_area(np.unique(values, return_inverse=True)[1], truth, np.ones(len(truth)))
    return 0.5 if math.isnan(area) else round(area, 3)


def _word_means(words: AnyArray, values: AnyArray, clusters: IntArray | None = None) -> FloatArray:
    """Return the mean value over all rows with the same word, shape (N,); 0 for no rows.

    With clusters, only rows of other clusters count.
    """
    is_averaged = words[:, None] == words
    if clusters is not None:
        is_averaged &= clusters[:, None] != clusters
    counts = np.maximum(is_averaged.sum(axis=1), 1)
    return as_floats(is_averaged @ values.astype(float) / counts)


def _correlations(columns: Sequence[Any], alike: IntArray, clusters: IntArray) -> FloatArray:
    """Return rank correlations of A columns with the last column, and their intervals, (A, 2, 3).

    They are over all rows, and within the rows of equal outcome. `alike` (N,) is the outcome, 0 or
    1, and negative for rows that do not count there. Correlations are 0 where nothing varies.
    """
    from scipy.stats import rankdata

    table = np.column_stack(columns).astype(float)

    def correlations_of(rows: IntArray) -> FloatArray:
        groups = [rows, rows[alike[rows] == 0], rows[alike[rows] == 1]]
        ranks = [rankdata(table[group], axis=0) - (len(group) + 1) / 2 for group in groups]
        correlations = []
        for group_ranks in (ranks[0], np.concatenate(ranks[1:])):
            product = group_ranks.T @ group_ranks
            squares = np.diag(product)[:-1] * product[-1, -1]
            correlations.append(product[:-1, -1] / np.sqrt(squares + 1e-9))
        return np.stack(correlations, axis=-1)

    parts = [np.flatnonzero(clusters == cluster) for cluster in np.unique(clusters)]
    draws = np.random.default_rng(0).integers(len(parts), size=(_RESAMPLES, len(parts)))
    resampled = []
    for draw in draws:
        rows = np.concatenate([parts[part] for part in draw])
        resampled.append(correlations_of(rows))
    ends = (
        np.quantile(resampled, (0.025, 0.975), axis=0)
        if len(parts) >= LEAST_CLUSTERS
        else [[[-1]], [[1]]] + 0 * resampled[0]
    )
    return np.stack([correlations_of(np.arange(len(table))), *ends], axis=-1).round(3)
