"""The tables of studies, from what benchmarks/studies keeps of them: `python docs/make_tables.py
model`.

`python -m benchmarks.pages.model STUDIES/NAME…` keeps what a study's folder has: all numbers, and
the counts of accidents of each sample, row and seed, from which every APA follows with its
interval. (Counts of boxes would take 20 MB a study.)
"""

import gzip
import json
import lzma
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from textwrap import fill
from typing import Any, Final

from benchmarks.pages.marks import TOP, put, table
from deepaccident_devkit.plugins.study.numbers import (
    NUMBERS,
    Evaluators,
    EvaluatorsBySeed,
    evaluators_of,
    verdict,
)
from deepaccident_devkit.plugins.study.summary import ALL, difference_text, number_with_interval

KEPT: Final = TOP / "benchmarks" / "studies"
ORDER: Final = (
    "agents",
    "boxes",
    "visibility",
    "fusions",
    "horizons",
    "links",
    "inputs",
    "overfit",
)
ROAD: Final = "road"
"""The recipe whose numbers are on the page of nuScenes."""
SHOWN: Final = ("apa", "iou_100", "vpq_100", "map", "hidden_foreground", "false_foreground")
"""Numbers of the tables; the kept files have all."""
GROUPS: Final = {"agents": ("hidden", "impact_step"), "visibility": ("accident_visibility",)}
"""Recipe → how the groups begin whose APA its table has, where these are not the hidden accidents
alone.
"""
TRIVIAL: Final = ("nothing", "everything")
TRIVIAL_OF: Final = "agents"
"""The recipe whose table has the trivial rows: they are much the same in all."""
ANSWER: Final = ("apa", "precision", "recall", "iou_100", "map", "hidden_foreground")
ANSWERING: Final = (
    *("single", "all", "black", "strangers", "constant velocity, single", "constant velocity, all"),
    *("labels, single", "labels, all"),
)
OUTCOMES: Final = {"wins": "more", "loses": "less", "not decided": "not decided"}
ON_THE_ROAD: Final = ("map", "iou_100", "vpq_100")
CELLS: Final = {"release": "releases", "weights": "training", "row": "prediction and evaluation"}
Summary = Mapping[str, Any]


def keep(folder: Path) -> Path:
    """Keep all numbers that came out of a study, without the paths of the machine."""
    summary = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    for source in summary["recipe"]["releases"].values():
        if "spec" in source:
            source["spec"] = Path(source["spec"]).name
    told = json.loads(gzip.decompress((folder / "counts.json.gz").read_bytes()))
    accidents = {
        row: {
            seed: counts.get("accident", {}) for seed, counts in seeds.items()
        }  # nuScenes has none
        for row, seeds in told["rows"].items()
    }
    path = KEPT / f"{summary['recipe']['name']}.json.xz"
    content = {"summary": summary, "groups": told["groups"], "accidents": accidents}
    path.write_bytes(lzma.compress(json.dumps(content, separators=(",", ":")).encode()))
    return path


def kept(name: str) -> dict[str, Any]:
    """What is kept of a study: `summary`, `groups` → tokens, and `accidents`: row → seed → token →
    counts.
    """
    found: dict[str, Any] = json.loads(lzma.decompress((KEPT / f"{name}.json.xz").read_bytes()))
    return found


def studies() -> dict[str, Summary]:
    """The numbers of the studies that are kept, by their names, in the order of the pages."""
    return {name: kept(name)["summary"] for name in ORDER if (KEPT / f"{name}.json.xz").is_file()}


def accident_rows(study: Mapping[str, Any]) -> dict[str, EvaluatorsBySeed]:
    """The evaluators of accidents of each row and seed of what `kept` gives, with their counts."""
    rows: dict[str, dict[str, Evaluators]] = {}
    for name, seeds in study["accidents"].items():
        for seed, counts in seeds.items():
            evaluator = evaluators_of(study["summary"]["recipe"]["test"]["labels"])["accident"]
            for token, each in counts.items():
                evaluator.add(token, each)
            rows.setdefault(name, {})[seed] = {"accident": evaluator}
    return dict(rows)


def rows_table(
    summary: Summary, columns: Mapping[str, tuple[str, str]], names: Iterable[str] = ()
) -> str:
    """Some rows, or all: what stands above a column → the group and the number of its cells."""
    rows = [
        (
            f"`{name}`",
            *(
                number_with_interval(groups[group][number], number)
                for group, number in columns.values()
            ),
        )
        for name in names or summary["rows"]
        for groups in [summary["rows"][name]["groups"]]
    ]
    return table(("row", *columns), rows)


def numbers_in(group: str, numbers: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Columns of some numbers of one group."""
    return {NUMBERS[number][2]: (group, number) for number in numbers}


def answer_table(summary: Summary) -> str:
    """What the headline's rows, the controls and the ceiling have, where the headline asks."""
    return rows_table(summary, numbers_in(summary["headline"]["where"], ANSWER), ANSWERING)


def made_text(summary: Summary) -> str:
    """How a study was made."""
    tested, cells = summary["groups"][ALL], summary["cells"]
    hours = {
        kind: sum(each["seconds"] for each in cells if each["kind"] == kind) / 3600
        for kind in CELLS
    }
    spent = ", ".join(f"{CELLS[kind]} {each:.1f}" for kind, each in hours.items() if each)
    rows = [each["groups"][ALL] for each in summary["rows"].values()]
    seeds = sorted(
        {seed for numbers in rows for each in numbers.values() for seed in each["seeds"]}
    )
    told = f"seeds {', '.join(seeds)}; " if seeds else ""
    return (
        f"{tested['samples']:,} samples of {tested['pairs']:,} pairs of an accident "
        f"and its twin; {told}hours of one "
        f"process: {spent}."
    )


def study_text(name: str, summary: Summary) -> str:
    """A study's section: its rows at all samples, and their APA in some groups; the kept files have
    all.
    """
    chosen = GROUPS.get(name, ("hidden",))
    groups = {
        f"APA, `{group}` ({each['samples']:,} samples)": (group, "apa")
        for group, each in summary["groups"].items()
        if group.startswith(chosen)
    }
    made = f"{summary['question']} `deepaccident study {name} studies`: {made_text(summary)}"
    told = [made, f"**{summary['headline']['text']}**"] if summary["headline"] else [made]
    rows = [row for row in summary["rows"] if name == TRIVIAL_OF or row not in TRIVIAL]
    columns = groups if name == "visibility" else numbers_in(ALL, SHOWN) | groups
    return "\n\n".join(
        [f"## {summary['title']}", *map(wrapped, told), rows_table(summary, columns, rows)]
    )


def findings_table(found: Mapping[str, Summary]) -> str:
    """What was compared in all studies, at the hidden accidents and at all samples; the kept files
    have all else.
    """
    rows = []
    for name, summary in found.items():
        for each in summary["comparisons"]:
            apa, everywhere = each["groups"]["hidden"]["apa"], each["groups"][ALL]
            rows.append(
                (
                    f"`{name}`",
                    f"`{each['row']}` less `{each['less']}`",
                    difference_text(apa, "apa"),
                    of_seeds(apa, "apa"),
                    OUTCOMES[verdict(apa)],
                    difference_text(everywhere["apa"], "apa"),
                    difference_text(everywhere["iou_100"], "iou_100"),
                    of_seeds(everywhere["iou_100"], "iou_100"),
                )
            )
    heads = (
        "APA, hidden collider",
        "of each seed",
        "verdict",
        "APA, all samples",
        "IoU 100x100 (%), all",
    )
    return table(("recipe", "difference", *heads, "of each seed"), rows)


def road_text(summary: Summary) -> str:
    """What came out on the road: the headline, all rows, and all differences."""
    differences = [
        (
            f"`{each['row']}` less `{each['less']}`",
            *(difference_text(each["groups"][ALL][number], number) for number in ON_THE_ROAD),
            of_seeds(each["groups"][ALL][ON_THE_ROAD[0]], ON_THE_ROAD[0]),
        )
        for each in summary["comparisons"]
    ]
    names = [NUMBERS[number][2] for number in ON_THE_ROAD]
    return "\n\n".join(
        [
            wrapped(f"**{summary['headline']['text']}**"),
            wrapped(made_text(summary)),
            rows_table(summary, numbers_in(ALL, ON_THE_ROAD)),
            table(("difference", *names, f"{names[0]} of each seed"), differences),
        ]
    )


def of_seeds(found: Mapping[str, Any], number: str) -> str:
    """A difference's value for each seed."""
    return ", ".join(
        difference_text({"value": one, "low": None}, number) for one in found["seeds"].values()
    )


def weights_table() -> str:
    """The weights that come with the devkit, with what their notes say."""
    from deepaccident_devkit.plugins.model.checkpoint import SHIPPED_FILES, read_weights

    rows = []
    for name, path in SHIPPED_FILES.items():
        notes = read_weights(path).meta
        made, scored = notes["made"], notes["scored"]["scores"]
        scores = (f"{100 * scored[each]:.1f}" for each in ("iou", "vpq", "map"))
        by = f"`{made['study']}`: `{made['weights']}`, seed {made['seed']}"
        rows.append((f"`{name}`", by, f"{path.stat().st_size / 1e6:.1f}", *scores))
    return table(
        ("weights", "made by", "MB", "IoU 100x100 (%)", "VPQ 100x100 (%)", "mAP (%)"), rows
    )


def wrapped(text: str) -> str:
    """A paragraph of the pages' width."""
    return fill(text, 120, break_long_words=False, break_on_hyphens=False)


def main(_release: Path | None = None) -> None:
    """Write the page of tables, and the headline on the page of the model."""
    found = studies()
    put("studies", "\n\n".join(study_text(name, each) for name, each in found.items()))
    put("headline", wrapped(f"**{found['agents']['headline']['text']}**"))
    put("answer", answer_table(found["agents"]))
    put("findings", findings_table(found))
    put("weights", weights_table())
    put("road", road_text(kept(ROAD)["summary"]))


def keep_all(folders: Iterable[str]) -> None:
    """Keep some."""
    KEPT.mkdir(exist_ok=True)
    for folder in folders:
        print(keep(Path(folder)))


if __name__ == "__main__":
    keep_all(sys.argv[1:])
