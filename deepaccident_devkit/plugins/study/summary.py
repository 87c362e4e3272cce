"""The numbers of a study, computed from its samples' counts; and a file that stores these counts.

`summarised(read_counts("studies/agents/counts.json.gz"))["headline"]` is the main result of a
study. It can be computed without a release.
"""

import gzip
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from deepaccident_devkit.errors import ResultsError
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.plugins.study.numbers import (
    NUMBERS,
    Evaluators,
    EvaluatorsBySeed,
    evaluators_of,
    numbers_of_rows,
    verdict,
)
from deepaccident_devkit.support.arrays import ShortRepr
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import read_bytes, reason_text
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import PathType, columns_text, fixed_text, path_of
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

# Numbers of a study or of a part of it, which can be written as JSON.
Summary = Mapping[str, Any]
# Name of the group that contains all samples.
ALL = "all samples"
# Numbers that the terminal and the figures show after the number in the headline.
MAIN_NUMBERS = ("apa", "iou_100", "map", "hidden_foreground")
_VERDICT_TEXTS = {
    "wins": "{row} wins: its {number} is higher than that of {less}, by {size}",
    "loses": "{row} loses: its {number} is lower than that of {less}, by {size}",
    "not decided": "no significant difference in {number} between {row} and {less} ({size})",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Counted(ShortRepr):
    """The counts from which all numbers of a study are computed.

    Attributes:
        description: The recipe's `title`, `question`, `headline`, `compare` and `labels`, and the
            rows' `over`.
        groups: Name → tokens of the group's samples; the group `ALL` comes first.
        rows: Name → seed → evaluators; a row without seeds has the seed "".
    """

    description: Mapping[str, Any]
    groups: Mapping[str, Sequence[str]]
    rows: Mapping[str, EvaluatorsBySeed]


def write_counts(counted: Counted, path: PathType) -> None:
    """Write all counts to a compressed JSON file; equal counts yield identical files."""
    rows: dict[str, dict[str, NamedValues]] = {}
    for name, seeds in counted.rows.items():
        rows[name] = {}
        for seed, evaluators in seeds.items():
            rows[name][seed] = {
                kind: {token: evaluator.counts[token] for token in sorted(evaluator.tokens)}
                for kind, evaluator in evaluators.items()
            }
    payload = {**counted.description, "groups": counted.groups, "rows": rows}
    text = json.dumps(payload, separators=(",", ":"))
    write_bytes(path_of(path), gzip.compress(text.encode(), mtime=0))


def read_counts(path: PathType) -> Counted:
    """Read a file written by `write_counts`; raise ResultsError if it is not such a file."""
    source = path_of(path)
    try:
        payload = parsed_json(gzip.decompress(read_bytes(source, "results")), constants=True)
        return counted_of(payload.pop("rows"), payload.pop("groups"), payload)
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ResultsError(
            f"{source}: contains no counts of a study ({reason_text(error)}); run the study again"
        ) from error


def counted_of(
    counts: Mapping[str, ReadOnlyValues],
    groups: Mapping[str, Sequence[str]],
    description: ReadOnlyValues,
) -> Counted:
    """Build `Counted` from counts by row, seed, evaluator and token (nested in this order)."""
    rows: dict[str, dict[str, Evaluators]] = {}
    for name, seeds in counts.items():
        for seed, counts_by_kind in seeds.items():
            evaluators = evaluators_of(description["labels"])
            rows.setdefault(name, {})[seed] = evaluators
            for kind in list(evaluators):
                if kind not in counts_by_kind:
                    del evaluators[kind]  # nuScenes contains no accidents
            for kind, evaluator in evaluators.items():
                for token, sample_counts in counts_by_kind[kind].items():
                    evaluator.add(token, sample_counts)
    return Counted(description=description, groups=groups, rows=rows)


def summarised(counted: Counted) -> dict[str, Any]:
    """Compute all numbers of a study as JSON values; equal counts yield equal numbers.

    `rows`: name → `over` and `groups`: group → number (of `NUMBERS`) → `value`, `low` and `high`
    of the interval, and `seeds`, the value of each seed. `comparisons`: `row`, `less`, and `groups`
    of their differences. `headline`: the recipe's, with its difference, `verdict` and a `text`.
    """
    rows = counted.rows
    groups = counted.groups
    description = counted.description
    comparisons = []
    for row, less in description["compare"]:
        differences = {}
        for group, tokens in groups.items():
            differences[group] = numbers_of_rows(tokens, rows[row], rows[less])
        comparisons.append({"row": row, "less": less, "groups": differences})
    headline = description["headline"]
    if headline is not None:
        headline = _summarise_headline(headline, comparisons)
    group_sizes = {}
    for group, tokens in groups.items():
        pairs = {cluster_of(scenario_of(token)) for token in tokens}
        group_sizes[group] = {"samples": len(tokens), "pairs": len(pairs)}
    row_numbers = {}
    for name, seeds in rows.items():
        numbers = {group: numbers_of_rows(tokens, seeds) for group, tokens in groups.items()}
        row_numbers[name] = {"over": description["over"][name], "groups": numbers}
    return {
        "title": description["title"],
        "question": description["question"],
        "headline": headline,
        "groups": group_sizes,
        "rows": row_numbers,
        "comparisons": comparisons,
    }


def _summarise_headline(headline: Summary, comparisons: Iterable[Summary]) -> NamedValues:
    """Add the difference, verdict and text to the recipe's headline."""
    row = headline["row"]
    less = headline["less"]
    number = headline["number"]
    group = headline["where"] or ALL
    pairs = {(comparison["row"], comparison["less"]): comparison for comparison in comparisons}
    difference = pairs[row, less]["groups"][group][number]
    summarised_headline = {**headline, **difference, "verdict": verdict(difference)}
    return {**summarised_headline, "text": headline_text(summarised_headline)}


def headline_text(headline: Summary) -> str:
    """Return a sentence that says what came out, from the headline of a summary."""
    number = headline["number"]
    text = _VERDICT_TEXTS[headline["verdict"]].format(
        row=f"`{headline['row']}`",
        less=f"`{headline['less']}`",
        number=NUMBERS[number][2],
        size=difference_text(headline, number),
    )
    group_text = ALL
    if headline["where"]:
        group_text = f"`{headline['where']}`"
    return f"Among {group_text}: {text}."


def number_with_interval(estimate: Summary, number: str) -> str:
    """Format a number with its interval, such as `12.3 [10.1, 14.8]`, rounded as in tables.

    A missing number is formatted as a dash.
    """
    if estimate["value"] is None:
        return "–"
    digits = 1 if NUMBERS[number][2].endswith("(%)") else 2
    text = fixed_text(estimate["value"], digits)
    if estimate["low"] is None:
        return text
    low = fixed_text(estimate["low"], digits)
    high = fixed_text(estimate["high"], digits)
    return f"{text} [{low}, {high}]"


def difference_text(difference: Summary, number: str) -> str:
    """Format a difference with its sign and interval, such as `+2.1 [0.4, 3.8]`."""
    text = number_with_interval(difference, number)
    value = difference["value"]
    if value is not None and value > 0:
        return f"+{text}"
    return text


def main_numbers(summary: Summary) -> list[str]:
    """Return the headline's number, then the other numbers of `MAIN_NUMBERS` that are known."""
    names = list(MAIN_NUMBERS)
    headline = summary["headline"]
    if headline is not None:
        names.insert(0, headline["number"])
    known_names = known_numbers(summary)
    return [name for name in dict.fromkeys(names) if name in known_names]


def known_numbers(summary: Summary) -> list[str]:
    """Return which of `NUMBERS` the study has; on nuScenes, none are about accidents."""
    row = next(iter(summary["rows"].values()))
    return list(row["groups"][ALL])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyReport(Report):
    """The results of a study.

    Attributes:
        summary: Numbers from `summarised`, with the `recipe`, the `devkit` version and the `cells`.
    """

    summary: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as JSON values."""
        return dict(self.summary)

    def named_tables(self) -> Mapping[str, Iterable[Row]]:
        """Return the tables `rows` and `comparisons`, with one line per number and group."""
        rows = [((name,), row["groups"]) for name, row in self.summary["rows"].items()]
        pairs = []
        for comparison in self.summary["comparisons"]:
            names = (comparison["row"], comparison["less"])
            pairs.append((names, comparison["groups"]))
        return {
            "rows": self._table(("row",), rows),
            "comparisons": self._table(("row", "less"), pairs),
        }

    def _table(
        self, heads: tuple[str, ...], lines: Sequence[tuple[tuple[str, ...], Any]]
    ) -> Iterator[Row]:
        """Yield the heading and rows of a table; `heads` are the headings of the name columns."""
        seeds: dict[str, None] = {}
        for _, groups in lines:
            for estimate in groups[ALL].values():
                seeds |= dict.fromkeys(estimate["seeds"])
        seed_heads = [f"seed {seed}" for seed in seeds]
        yield (*heads, "group", "number", "value", "low", "high", *seed_heads)
        for names, groups in lines:
            for group, numbers in groups.items():
                for number, estimate in numbers.items():
                    interval = (estimate["value"], estimate["low"], estimate["high"])
                    seed_values = [estimate["seeds"].get(seed) for seed in seeds]
                    yield (*names, group, number, *interval, *seed_values)

    def to_text(self) -> str:
        """Return the rows with their main numbers, then the headline."""
        numbers = main_numbers(self.summary)
        lines = [["row", *(NUMBERS[number][2] for number in numbers)]]
        for name, row in self.summary["rows"].items():
            estimates = row["groups"][ALL]
            texts = [number_with_interval(estimates[number], number) for number in numbers]
            lines.append([name, *texts])
        table = columns_text(lines)
        headline = self.summary["headline"]
        if headline is None:
            return table
        return f"{table}\n\n{headline['text']}"
