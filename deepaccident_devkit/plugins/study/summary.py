"""The numbers of a study, computed from the counts of its samples; and a file of these counts.

`summarised(read_counts("studies/agents/counts.json.gz"))["headline"]` is the main result of a
study; no release is needed.
"""

from __future__ import annotations

import gzip
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

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
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.reports import Report, Row
from deepaccident_devkit.support.text import columns_text, fixed_text, path_of

# The name of the group of all samples.
ALL: Final = "all samples"
# Numbers that the terminal and the figures show after the headline's number.
MAIN_NUMBERS: Final = ("apa", "iou_100", "map", "hidden_foreground")
_VERDICT_TEXTS: Final = {
    "wins": "{row} wins: it has more {number} than {less}, by {size}",
    "loses": "{row} loses: it has less {number} than {less}, by {size}",
    "not decided": "it is not decided whether {row} has more {number} than {less}: the difference "
    "is {size}",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Counted(ShortRepr):
    """Everything that the numbers of a study are computed from.

    Attributes:
        description: `title`, `question`, `headline`, `compare` and `labels` of the recipe, and
            `over` of its rows.
        groups: Name → tokens of its samples; the group `ALL` comes first.
        rows: Name → its evaluators by seed; a row without seeds has an empty text as its seed.
    """

    description: Mapping[str, Any]
    groups: Mapping[str, Sequence[str]]
    rows: Mapping[str, EvaluatorsBySeed]


def write_counts(counted: Counted, path: str | os.PathLike[str]) -> None:
    """Write all counts to a compressed JSON file; equal counts give equal bytes."""
    rows: dict[str, dict[str, dict[str, Any]]] = {}
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


def read_counts(path: str | os.PathLike[str]) -> Counted:
    """Read a file of `write_counts`; raises ResultsError if it is unreadable or another file."""
    source = path_of(path)
    try:
        payload = parsed_json(gzip.decompress(read_bytes(source, "results")), constants=True)
        return counted_of(payload.pop("rows"), payload.pop("groups"), payload)
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ResultsError(
            f"{source}: no counts of a study ({fault_text(error)}); run the study again"
        ) from error


def counted_of(
    counts: Mapping[str, Mapping[str, Any]],
    groups: Mapping[str, Sequence[str]],
    description: Mapping[str, Any],
) -> Counted:
    """Return the record of counts, given as row → seed → evaluator → token → counts."""
    rows: dict[str, dict[str, Evaluators]] = {}
    for name, seeds in counts.items():
        for seed, counts_by_kind in seeds.items():
            evaluators = evaluators_of(description["labels"])
            rows.setdefault(name, {})[seed] = evaluators
            for kind in list(evaluators):
                if kind not in counts_by_kind:
                    del evaluators[kind]  # nuScenes has no accidents
            for kind, evaluator in evaluators.items():
                for token, sample_counts in counts_by_kind[kind].items():
                    evaluator.add(token, sample_counts)
    return Counted(description=description, groups=groups, rows=rows)


def summarised(counted: Counted) -> dict[str, Any]:
    """Return all numbers of a study, as JSON holds them; equal counts give equal numbers.

    `rows`: name → `over` and `groups`: group → number (of `NUMBERS`) → `value`, `low` and `high` of
    the interval, and the value of each of the `seeds`. `comparisons`: `row`, `less` and `groups` of
    their differences. `headline`: the recipe's, with its difference, `verdict` and a `text`.
    """
    rows, groups = counted.rows, counted.groups
    comparisons = []
    for row, less in counted.description["compare"]:
        differences = {
            group: numbers_of_rows(tokens, rows[row], rows[less])
            for group, tokens in groups.items()
        }
        comparisons.append({"row": row, "less": less, "groups": differences})
    headline = counted.description["headline"]
    if headline is not None:
        headline = _summarised_headline(headline, comparisons)
    group_sizes = {}
    for group, tokens in groups.items():
        pairs = {cluster_of(scenario_of(token)) for token in tokens}
        group_sizes[group] = {"samples": len(tokens), "pairs": len(pairs)}
    row_numbers = {}
    for name, seeds in rows.items():
        numbers = {group: numbers_of_rows(tokens, seeds) for group, tokens in groups.items()}
        row_numbers[name] = {"over": counted.description["over"][name], "groups": numbers}
    return {
        "title": counted.description["title"],
        "question": counted.description["question"],
        "headline": headline,
        "groups": group_sizes,
        "rows": row_numbers,
        "comparisons": comparisons,
    }


def _summarised_headline(
    headline: Mapping[str, Any], comparisons: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the recipe's headline with its difference, verdict and text."""
    row, less, number, where = (headline[name] for name in ("row", "less", "number", "where"))
    difference = next(
        comparison["groups"][where or ALL][number]
        for comparison in comparisons
        if (comparison["row"], comparison["less"]) == (row, less)
    )
    result = verdict(difference)
    text = _VERDICT_TEXTS[result].format(
        row=f"`{row}`",
        less=f"`{less}`",
        number=NUMBERS[number][2],
        size=difference_text(difference, number),
    )
    group_text = f"`{where}`" if where else ALL
    return {
        **headline,
        **difference,
        "verdict": result,
        "text": f"Among {group_text}: {text}.",
    }


def number_with_interval(estimate: Mapping[str, Any], number: str) -> str:
    """Return `12.3 [10.1, 14.8]`, with the decimals that the number has in tables.

    A missing number is a dash.
    """
    digits = 1 if NUMBERS[number][2].endswith("(%)") else 2
    if estimate["value"] is None:
        return "–"
    text = fixed_text(estimate["value"], digits)
    if estimate["low"] is None:
        return text
    low, high = fixed_text(estimate["low"], digits), fixed_text(estimate["high"], digits)
    return f"{text} [{low}, {high}]"


def difference_text(difference: Mapping[str, Any], number: str) -> str:
    """Return `+2.1 [0.4, 3.8]`."""
    value = difference["value"]
    sign = "+" if value is not None and value > 0 else ""
    return sign + number_with_interval(difference, number)


def main_numbers(summary: Mapping[str, Any]) -> list[str]:
    """Return the headline's number, then the other known ones of `MAIN_NUMBERS`."""
    names = list(MAIN_NUMBERS)
    if summary["headline"] is not None:
        names.insert(0, summary["headline"]["number"])
    return [name for name in dict.fromkeys(names) if name in known_numbers(summary)]


def known_numbers(summary: Mapping[str, Any]) -> list[str]:
    """Return the names in `NUMBERS` that the study has; on nuScenes it has none of accidents."""
    row = next(iter(summary["rows"].values()))
    return list(row["groups"][ALL])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyReport(Report):
    """The results of a study.

    Attributes:
        summary: Numbers from `summarised`, with the `recipe`, the `devkit`'s version, and the
            `cells`.
    """

    summary: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return the summary, for JSON."""
        return dict(self.summary)

    def named_tables(self) -> Mapping[str, Iterable[Row]]:
        """Return the tables `rows` and `comparisons`: a line for each number in each group."""
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
        """Yield the heading and the rows of a table; `heads` are the headings of the names."""
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
        """Return the rows with the main numbers, and the headline."""
        numbers = main_numbers(self.summary)
        lines = [["row", *(NUMBERS[number][2] for number in numbers)]]
        for name, row in self.summary["rows"].items():
            estimates = row["groups"][ALL]
            texts = [number_with_interval(estimates[number], number) for number in numbers]
            lines.append([name, *texts])
        table = columns_text(lines)
        headline = self.summary["headline"]
        return table if headline is None else f"{table}\n\n{headline['text']}"
