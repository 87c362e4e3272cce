"""The numbers of a study, from the counts of its samples; and these counts in a file, without any release.

`summarised(read_counts("studies/agents/counts.json.gz"))["headline"]` is what came out of one.
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
# Numbers that the terminal and the figures show, after the headline's.
MAIN: Final = ("apa", "iou_100", "map", "hidden_foreground")
_WORDS: Final = {
    "wins": "{row} wins: it has more {number} than {less}, by {size}",
    "loses": "{row} loses: it has less {number} than {less}, by {size}",
    "not decided": "it is not decided whether {row} has more {number} than {less}: the difference is {size}",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Counted(ShortRepr):
    """All from which the numbers of a study follow.

    Attributes:
        told: `title`, `question`, `headline`, `compare` and `labels` of the recipe, and `over` of its rows.
        groups: name → tokens of its samples, those of `ALL` first.
        rows: name → its evaluators by seed; of a row without seeds, under an empty text.
    """

    told: Mapping[str, Any]
    groups: Mapping[str, Sequence[str]]
    rows: Mapping[str, EvaluatorsBySeed]


def write_counts(counted: Counted, path: str | os.PathLike[str]) -> None:
    """Write all counts, packed; the same ones give the same bytes."""
    rows = {
        name: {
            seed: {
                kind: {token: each.counts[token] for token in sorted(each.tokens)}
                for kind, each in of.items()
            }
            for seed, of in seeds.items()
        }
        for name, seeds in counted.rows.items()
    }
    told = {**counted.told, "groups": counted.groups, "rows": rows}
    write_bytes(
        path_of(path), gzip.compress(json.dumps(told, separators=(",", ":")).encode(), mtime=0)
    )


def read_counts(path: str | os.PathLike[str]) -> Counted:
    """What `write_counts` wrote; raises ResultsError: it cannot be read, or is something else."""
    source = path_of(path)
    try:
        told = parsed_json(gzip.decompress(read_bytes(source, "results")), constants=True)
        return counted_of(told.pop("rows"), told.pop("groups"), told)
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ResultsError(
            f"{source}: no counts of a study ({fault_text(error)}); run the study again"
        ) from error


def counted_of(
    counts: Mapping[str, Mapping[str, Any]],
    groups: Mapping[str, Sequence[str]],
    told: Mapping[str, Any],
) -> Counted:
    """From row → seed → what evaluates → token → counts."""
    rows: dict[str, dict[str, Evaluators]] = {}
    for name, seeds in counts.items():
        for seed, kinds in seeds.items():
            made = rows.setdefault(name, {})[seed] = evaluators_of(told["labels"])
            for kind in [kind for kind in made if kind not in kinds]:
                del made[kind]  # nuScenes has no accidents
            for kind, evaluator in made.items():
                for token, each in kinds[kind].items():
                    evaluator.add(token, each)
    return Counted(told=told, groups=groups, rows=rows)


def summarised(counted: Counted) -> dict[str, Any]:
    """All numbers of a study, as JSON holds them; the same counts give the same.

    `rows`: name → `over` and `groups`: group → number (of `NUMBERS`) → `value`, `low` and `high` of the
    interval, and the value of each of the `seeds`. `comparisons`: `row`, `less` and `groups` of their differences.
    `headline`: the recipe's, with its difference, `verdict` and a `text`.
    """
    rows, groups = counted.rows, counted.groups.items()
    comparisons = [
        {
            "row": row,
            "less": less,
            "groups": {
                group: numbers_of_rows(tokens, rows[row], rows[less]) for group, tokens in groups
            },
        }
        for row, less in counted.told["compare"]
    ]
    headline = counted.told["headline"]
    return {
        "title": counted.told["title"],
        "question": counted.told["question"],
        "headline": None if headline is None else _headline(headline, comparisons),
        "groups": {
            group: {
                "samples": len(tokens),
                "pairs": len({cluster_of(scenario_of(token)) for token in tokens}),
            }
            for group, tokens in groups
        },
        "rows": {
            name: {
                "over": counted.told["over"][name],
                "groups": {group: numbers_of_rows(tokens, seeds) for group, tokens in groups},
            }
            for name, seeds in rows.items()
        },
        "comparisons": comparisons,
    }


def _headline(
    headline: Mapping[str, Any], comparisons: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """With what came out."""
    row, less, number, where = (headline[name] for name in ("row", "less", "number", "where"))
    found = next(
        each["groups"][where or ALL][number]
        for each in comparisons
        if (each["row"], each["less"]) == (row, less)
    )
    size, said = difference_text(found, number), NUMBERS[number][2]
    told = _WORDS[verdict(found)].format(row=f"`{row}`", less=f"`{less}`", number=said, size=size)
    among = f"Among {f'`{where}`' if where else ALL}: "
    return {**headline, **found, "verdict": verdict(found), "text": f"{among}{told}."}


def number_with_interval(found: Mapping[str, Any], number: str) -> str:
    """`12.3 [10.1, 14.8]`, with as many decimals as the number has in tables; a dash for none."""
    digits = 1 if NUMBERS[number][2].endswith("(%)") else 2
    if found["value"] is None:
        return "–"
    ends = (
        ""
        if found["low"] is None
        else f" [{fixed_text(found['low'], digits)}, {fixed_text(found['high'], digits)}]"
    )
    return fixed_text(found["value"], digits) + ends


def difference_text(found: Mapping[str, Any], number: str) -> str:
    """`+2.1 [0.4, 3.8]`."""
    sign = "+" if found["value"] is not None and found["value"] > 0 else ""
    return sign + number_with_interval(found, number)


def main_numbers(summary: Mapping[str, Any]) -> list[str]:
    """The headline's number first, then those of `MAIN`."""
    first = [] if summary["headline"] is None else [summary["headline"]["number"]]
    return [name for name in dict.fromkeys([*first, *MAIN]) if name in known_numbers(summary)]


def known_numbers(summary: Mapping[str, Any]) -> list[str]:
    """Those of `NUMBERS` that the study has: of nuScenes none of accidents."""
    return list(next(iter(summary["rows"].values()))["groups"][ALL])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyReport(Report):
    """What came out of a study.

    Attributes:
        summary: of `summarised`, with the `recipe`, the `devkit`'s version, and the `cells`.
    """

    summary: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dict(self.summary)

    def named_tables(self) -> Mapping[str, Iterable[Row]]:
        """`rows` and `comparisons`: a line for each number in each group."""
        rows = [((name,), each["groups"]) for name, each in self.summary["rows"].items()]
        pairs = [
            ((each["row"], each["less"]), each["groups"]) for each in self.summary["comparisons"]
        ]
        return {
            "rows": self._table(("row",), rows),
            "comparisons": self._table(("row", "less"), pairs),
        }

    def _table(
        self, heads: tuple[str, ...], lines: Sequence[tuple[tuple[str, ...], Any]]
    ) -> Iterator[Row]:
        seeds = list(
            dict.fromkeys(
                seed
                for _, groups in lines
                for each in groups[ALL].values()
                for seed in each["seeds"]
            )
        )
        yield (
            *heads,
            "group",
            "number",
            "value",
            "low",
            "high",
            *(f"seed {seed}" for seed in seeds),
        )
        for names, groups in lines:
            for group, numbers in groups.items():
                for number, each in numbers.items():
                    ends = (each[name] for name in ("value", "low", "high"))
                    yield (
                        *names,
                        group,
                        number,
                        *ends,
                        *(each["seeds"].get(seed) for seed in seeds),
                    )

    def to_text(self) -> str:
        """The headline, and the rows with the main numbers."""
        numbers = main_numbers(self.summary)
        rows = [
            [
                name,
                *(number_with_interval(each["groups"][ALL][number], number) for number in numbers),
            ]
            for name, each in self.summary["rows"].items()
        ]
        table = columns_text([["row", *(NUMBERS[number][2] for number in numbers)], *rows])
        headline = self.summary["headline"]
        return table if headline is None else f"{table}\n\n{headline['text']}"
