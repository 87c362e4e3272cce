"""Audit of accident scores: whether they only depend on a clip's length, place or name."""

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import MAX_REASON_LENGTH, ResultsError, shortened
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import MIN_CLUSTERS
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.warning.clean import roc_area
from deepaccident_devkit.plugins.audit.report import AuditFinding, AuditReport
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, as_floats
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.reports import Row
from deepaccident_devkit.support.text import PathType, counted, number_of, path_of
from deepaccident_devkit.support.values import NamedValues

# Number of resamples for an interval.
_RESAMPLES = 400
# Scores follow an attribute if the lower bounds of their rank correlations exceed these: over all
# scenarios, and within scenarios of equal outcome, where it cannot stand in for the truth.
_MIN_CORRELATION = 0.8
_MIN_CORRELATION_AMONG_ALIKE = 0.5
# Attributes whose values are words.
_WORD_ATTRIBUTES = ("town", "weather")
# Attribute → text for scores that fall with it, or rise with it.
_DETECTOR_TEXTS = {
    "length": ("a detector of short clips", "a detector of long clips"),
    "folder": ("a detector of the folder `normal`", "a detector of the folder `accident`"),
    "name": ("a detector of small numbers in names", "a detector of large numbers in names"),
    "town": ("a detector of towns", "a detector of towns"),
    "weather": ("a detector of weather", "a detector of weather"),
    "actors": ("a detector of few actors", "a detector of many actors"),
    "frame": ("a detector of early frames", "a detector of late frames"),
}
_NOTES = (
    (
        "The truth is whether meta names a collision. A scenario's score is the highest score "
        "of its samples; only the frame is compared sample by sample."
    ),
    (
        "The AUC of an attribute is in the better direction. Town and weather are ranked by the "
        "share of collisions among the\nother scenarios with the same word, without the twin."
    ),
    (
        "`with the scores` is Spearman's rank correlation; town and weather are ranked by the mean "
        "score of the word.\n`among alike` is the correlation within collisions and within other "
        "scenarios, where no attribute can replace the\ntruth (the frame: only scenarios without a "
        "collision)."
    ),
    (
        f"From and to: 95 % interval of {_RESAMPLES} resamples of scenarios, twins together; −1 to "
        f"1 for fewer than {MIN_CLUSTERS}."
    ),
)
_HEADING = ("attribute", "AUC", "with the scores", "from", "to", "among alike", "from", "to")
# A token and its score in a table, optionally preceded by a row number.
_LINE = re.compile(
    r"""(?:"?\d*"?[,;\t|])?\s*"?(?P<token>[^\s,;|"]+/[^\s,;|"]+)"?\s*[,;\t|]\s*"""
    r""""?(?P<score>[^\s;|"]+)"?\s*"""
)
_REMEDY = (
    "give results of the task accident, a JSON object of token and score, or a .csv file of "
    "lines `token,score`, separated by a comma, a semicolon, a tab or a bar"
)
_DETECTOR_REMEDY = (
    "Cut all clips to the same length, or compare moments with the same time to the end: "
    "deepaccident evaluate warning."
)
_ALIKE_REASON = (
    "scenarios with the same outcome hardly differ in it, so scores that depend on it cannot be "
    "distinguished from the truth."
)
_FEW_REASON = (
    f"there is nothing to find: all scores are equal, or fewer than {MIN_CLUSTERS} scenarios "
    "(twins count as one) have a score."
)


def read_scores(path: PathType) -> dict[str, float]:
    """Read the score of each sample or scenario; a higher score means a more certain accident.

    Args:
        path: Results of the task `accident` (a sample gets its highest score, or 0 without an
            accident); or JSON, an object of token and score or a list of objects with `token` and
            `score`; or a .csv table, each line with a token (which contains a `/`) and a score;
            lines without a token are ignored.

    Raises:
        ResultsError: If the file is unreadable or of another kind, or a score is not finite.
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


def _read_pairs(file: Path) -> NamedValues:
    """Read tokens and unchecked scores from a table or a JSON file; raise ResultsError."""
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
            f"{file}: {shortened(fault_text(error), MAX_REASON_LENGTH)}; {_REMEDY}"
        ) from error


def _pairs_of_table(text: str) -> Iterator[tuple[str, float | None]]:
    """Yield the token and score in each line that has a token; raise ValueError."""
    for number, line in enumerate(text.splitlines(), start=1):
        if "/" not in line:
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise ValueError(
                f"line {number}: expected a token and its score, found {shortened(line)}"
            )
        score = match["score"].replace(",", ".")
        yield match["token"], number_of(score)


def audit_scores(
    dataset: Dataset, scores: Mapping[str, float], split: PathType | None = None
) -> AuditReport:
    """Compare accident scores with the truth, and with attributes that they should not depend on.

    Args:
        dataset: The release.
        scores: Token of a sample or scenario → its score, as returned by `read_scores`.
        split: Only use scenarios of this split: `train`, `val`, … or a split file; None for all
            scenarios with a score.

    Raises:
        TokenError: If a token belongs to neither a sample nor a scenario.
        ResultsError: If no scenario with meta has a score.
    """
    scenarios = dataset.columns("scenario")
    tokens = [record["token"] for record in dataset.scenario[:]]
    cases = _find_cases(dataset, scores)
    is_counted = np.array(scenarios["weather"].is_valid())
    if split:
        is_counted = is_counted & np.isin(tokens, [*dataset.split_scenarios(split)])
    counted_cases = [(row, frame, score) for row, frame, score in cases if is_counted[row]]
    rows, frames, case_scores = np.array(counted_cases, dtype=float).reshape(-1, 3).T
    if not len(rows):
        raise ResultsError(
            "no scenario with meta has a score; give scores of a split whose meta is published"
        )
    scenario_rows, scenario_of_case = np.unique(rows.astype(int), return_inverse=True)
    highest_scores = np.full(len(scenario_rows), -np.inf)
    np.maximum.at(highest_scores, scenario_of_case, case_scores)
    truth = np.array(scenarios["collision"].is_valid())[scenario_rows]
    case_truth = truth[scenario_of_case]
    scenario_clusters = [cluster_of(tokens[row]) for row in scenario_rows]
    clusters = np.unique(scenario_clusters, return_inverse=True)[1]
    attributes = _scenario_attributes(dataset, tokens, scenario_rows)
    columns = []
    areas = []
    for name, values in attributes.items():
        if name in _WORD_ATTRIBUTES:
            columns.append(_word_means(values, highest_scores))
            collision_shares = _word_means(values, truth, clusters)
            areas.append(_roc_area(collision_shares, truth))
        else:
            columns.append(values)
            areas.append(_roc_area(values, truth))
    attributes["frame"] = frames
    areas.append(_roc_area(frames, case_truth))
    scores_area = _roc_area(highest_scores, truth)
    correlations = [
        *_correlations([*columns, highest_scores], truth * 1, clusters),
        *_correlations([frames, case_scores], case_truth * -1, clusters[scenario_of_case]),
    ]
    undecided = list[str]()
    table = list[Row]()
    findings = list[AuditFinding]()
    for (name, values), area, (correlation, within_outcomes) in zip(
        attributes.items(), areas, correlations, strict=True
    ):
        # Shares among the other scenarios can give an AUC below a half only due to leaving one out.
        mirrored_area = 0.5 if name in _WORD_ATTRIBUTES else round(1 - area, 3)
        fitted_area = max(area, mirrored_area)
        table.append((name, fitted_area, *correlation.tolist(), *within_outcomes.tolist()))
        outcomes = case_truth if name == "frame" else truth
        if _hardly_varies(values, outcomes):
            undecided.append(name)
        if _is_followed(name, values, correlation, within_outcomes, highest_scores, truth):
            findings.append(
                _detector_finding(
                    name, correlation, within_outcomes, fitted_area, scores_area, len(truth)
                )
            )
    is_few = len({*clusters}) < MIN_CLUSTERS or len({*highest_scores}) == 1
    cannot_say = []
    if is_few:
        cannot_say.append(_FEW_REASON)
    if undecided:
        cannot_say.append(f"{', '.join(undecided)}: {_ALIKE_REASON}")
    decided_count = 0 if is_few else len(_DETECTOR_TEXTS) - len(undecided)
    return AuditReport(
        compared={"attributes with the scores": decided_count},
        cannot_say=tuple(cannot_say),
        findings=tuple(findings),
        tables={"scores": [_HEADING, ("the scores", scores_area, *[None] * 6), *table]},
        notes=(
            (
                f"{counted(len(truth), 'scenario')} with meta and a score, "
                f"{truth.sum()} with a collision."
            ),
            *_NOTES,
        ),
    )


def _find_cases(dataset: Dataset, scores: Mapping[str, float]) -> list[tuple[int, int, float]]:
    """Return each token's scenario row, frame (0 for a scenario) and score."""
    scenario_row_of_sample = dataset.columns("sample")["scenario_row"]
    cases = []
    for token, score in scores.items():
        if token.count("/") > 1:
            row = scenario_row_of_sample[dataset.getind("sample", token)]
            frame = int(token.rpartition("/")[2])
        else:
            row = dataset.getind("scenario", token)
            frame = 0
        cases.append((row, frame, score))
    return cases


def _scenario_attributes(
    dataset: Dataset, tokens: Sequence[str], rows: IntArray
) -> dict[str, AnyArray]:
    """Return the attributes of scenarios (S,) by name, in the order of `_DETECTOR_TEXTS`."""
    scenarios = dataset.columns("scenario")
    name_numbers = [int(re.sub(r".*?(\d*)$", r"0\1", tokens[row])) for row in rows]
    instance_scenarios = dataset.columns("instance")["scenario_row"]
    actor_counts = np.bincount(instance_scenarios, minlength=len(tokens))
    return {
        "length": scenarios["num_frames"][rows],
        "folder": scenarios["designed_accident"][rows],
        "name": np.array(name_numbers),
        "town": np.array(scenarios["town"])[rows].astype(str),
        "weather": np.array(scenarios["weather"])[rows].astype(str),
        "actors": actor_counts[rows],
    }


def _detector_finding(
    name: str,
    correlation: FloatArray,
    within_outcomes: FloatArray,
    area: float,
    scores_area: float,
    number: int,
) -> AuditFinding:
    """Return the finding that the scores follow an attribute.

    Args:
        name: Name of the attribute.
        correlation: Rank correlation over all scenarios and the bounds of its interval, shape (3,).
        within_outcomes: The same correlation only among scenarios with the same outcome.
        area: AUC of the attribute as a score.
        scores_area: AUC of the scores.
        number: Number of scenarios.
    """
    detector = _DETECTOR_TEXTS[name][bool(correlation[0] > 0)]
    what = (
        f"these scores are those of {detector}: their rank correlation with `{name}` is "
        f"{correlation[0]}, and {within_outcomes[0]} among scenarios with the same outcome. The "
        f"attribute has an AUC of {area}, the scores have {scores_area}."
    )
    return AuditFinding(kind=name, what=what, remedy=_DETECTOR_REMEDY, number=number)


def _hardly_varies(values: AnyArray, outcomes: BoolArray) -> bool:
    """Return whether fewer than two values (N,) differ from the most common one per outcome."""
    pairs = zip(values, outcomes, strict=True)
    counts = sorted(Counter(pairs).values())
    num_outcomes = len({*outcomes})
    return sum(counts[:-num_outcomes]) < 2


def _is_followed(
    name: str,
    values: AnyArray,
    correlation: FloatArray,
    within_outcomes: FloatArray,
    highest_scores: FloatArray,
    truth: BoolArray,
) -> bool:
    """Return whether the scores follow an attribute: correlate with it clearly, in all outcomes.

    Args:
        name: Name of the attribute.
        values: Values of the attribute, shape (N,).
        correlation: Rank correlation over all scenarios and the bounds of its interval, shape (3,).
        within_outcomes: The same correlation only among scenarios with the same outcome.
        highest_scores: Highest score of each scenario, shape (S,).
        truth: Whether each scenario has a collision, shape (S,).
    """
    rises = correlation[0] > 0
    sign = 1 if rises else -1
    lower_bound = min(sign * correlation[1:])
    lower_bound_within = min(sign * within_outcomes[1:])
    is_followed = lower_bound_within > _MIN_CORRELATION_AMONG_ALIKE
    if name == "folder":
        # So few scenarios do not end as their folder says that there may be no useful interval.
        follows_folder = (highest_scores > highest_scores.mean()) == (values == rises)
        follows_wrong_folder = follows_folder[values != truth]
        min_followers = max(1, _MIN_CORRELATION * len(follows_wrong_folder))
        is_followed |= follows_wrong_folder.sum() > min_followers
    return bool(lower_bound > _MIN_CORRELATION and is_followed)


def _roc_area(values: FloatArray, truth: BoolArray) -> float:
    """Return the area under the ROC curve to three decimals; 0.5 if all outcomes are equal."""
    ranks = np.unique(values, return_inverse=True)[1]
    area = roc_area(ranks, truth, np.ones(len(truth)))
    if math.isnan(area):
        return 0.5
    return round(area, 3)


def _word_means(words: AnyArray, values: AnyArray, clusters: IntArray | None = None) -> FloatArray:
    """Return for each row the mean value over all rows with the same word, shape (N,).

    With clusters, only rows in other clusters are used. The mean over no rows is 0.
    """
    is_averaged = words[:, None] == words
    if clusters is not None:
        is_averaged &= clusters[:, None] != clusters
    counts = np.maximum(is_averaged.sum(axis=1), 1)
    sums = is_averaged @ values.astype(float)
    return as_floats(sums / counts)


def _correlations(columns: Sequence[Any], outcomes: IntArray, clusters: IntArray) -> FloatArray:
    """Compute the rank correlations of A columns with the last column, and their intervals.

    The correlations are computed over all rows, and only among rows with the same outcome. They are
    0 if a column does not vary.

    Args:
        columns: The A columns, then the last column, each with shape (N,).
        outcomes: Outcome of each row, shape (N,): 0 or 1; negative for rows that are only used in
            correlations over all rows.
        clusters: Cluster of each row, shape (N,).

    Returns:
        Correlations and the bounds of their intervals, shape (A, 2, 3).
    """
    from scipy.stats import rankdata

    table = np.column_stack(columns).astype(float)

    def centered_ranks(rows: IntArray) -> FloatArray:
        ranks = rankdata(table[rows], axis=0)
        return as_floats(ranks - (len(rows) + 1) / 2)

    def correlations_of(rows: IntArray) -> FloatArray:
        row_outcomes = outcomes[rows]
        groups = [centered_ranks(rows[row_outcomes == outcome]) for outcome in (0, 1)]
        correlations = []
        for ranks in (centered_ranks(rows), np.concatenate(groups)):
            product = ranks.T @ ranks
            squares = np.diag(product)[:-1] * product[-1, -1]
            correlations.append(product[:-1, -1] / np.sqrt(squares + 1e-9))
        return np.stack(correlations, axis=-1)

    rows_by_cluster = [np.flatnonzero(clusters == cluster) for cluster in np.unique(clusters)]
    count = len(rows_by_cluster)
    draws = np.random.default_rng(0).integers(count, size=(_RESAMPLES, count))
    resampled = []
    for draw in draws:
        rows = np.concatenate([rows_by_cluster[cluster] for cluster in draw])
        resampled.append(correlations_of(rows))
    estimates = correlations_of(np.arange(len(table)))
    if count >= MIN_CLUSTERS:
        low, high = np.quantile(resampled, (0.025, 0.975), axis=0)
    else:
        low = np.full_like(estimates, -1)
        high = np.full_like(estimates, 1)
    return np.stack([estimates, low, high], axis=-1).round(3)
