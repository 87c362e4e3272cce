"""Write the tables of the studies of models from the numbers that benchmarks/studies keeps.

`python docs/make_tables.py model` writes the pages. `python -m benchmarks.pages.model keep
STUDIES/NAME…` keeps what the folder of a study has: all numbers, and the counts of accidents of
each sample, row and seed, from which every APA follows with its interval. (The counts of boxes
would take 20 MB a study.) `python -m benchmarks.pages.model show NAME` prints the rows of a kept
study.
"""

import gzip
import json
import lzma
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import click

from benchmarks.pages.marks import TOP, put, table, wrapped
from deepaccident_devkit.plugins.study.numbers import (
    NUMBERS,
    Evaluators,
    EvaluatorsBySeed,
    evaluators_of,
    verdict,
)
from deepaccident_devkit.plugins.study.summary import (
    ALL,
    difference_text,
    headline_text,
    number_with_interval,
)

STUDIES_FOLDER: Final = TOP / "benchmarks" / "studies"
STUDY_NAMES: Final = (
    "agents",
    "boxes",
    "visibility",
    "fusions",
    "horizons",
    "links",
    "inputs",
    "overfit",
)
"""Kept studies in the order of the page."""
ROAD: Final = "road"
"""The recipe whose numbers are on the page of nuScenes."""
ROW_NUMBERS: Final = ("apa", "iou_100", "vpq_100", "map", "hidden_foreground", "false_foreground")
"""Numbers of the rows of a study; the kept files have all."""
APA_GROUPS: Final = {"agents": ("hidden", "impact_step"), "visibility": ("accident_visibility",)}
"""Recipe → prefixes of the groups whose APA its table has, if not only the hidden accidents."""
ANSWER_NUMBERS: Final = ("apa", "precision", "recall", "iou_100", "hidden_foreground")
ANSWER_ROWS: Final = (
    *("single", "all", "black", "strangers"),
    *("constant velocity, single", "constant velocity, all"),
)
ROAD_NUMBERS: Final = ("map", "iou_100", "vpq_100")
CELL_KINDS: Final = {
    "release": "the releases",
    "weights": "training",
    "row": "prediction and evaluation",
}
"""Kind of a cell of a study → the work that it is."""
Summary = Mapping[str, Any]


def keep_study(folder: Path) -> Path:
    """Keep all numbers that came out of a study, without the paths of the machine."""
    summary = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    for source in summary["recipe"]["releases"].values():
        if "spec" in source:
            source["spec"] = Path(source["spec"]).name
    counts = json.loads(gzip.decompress((folder / "counts.json.gz").read_bytes()))
    accident_counts: dict[str, dict[str, Any]] = {}
    for row, counts_by_seed in counts["rows"].items():
        accident_counts[row] = {}
        for seed, evaluator_counts in counts_by_seed.items():
            # nuScenes has no accidents
            accident_counts[row][seed] = evaluator_counts.get("accident", {})
    content = {"summary": summary, "groups": counts["groups"], "accidents": accident_counts}
    path = STUDIES_FOLDER / f"{summary['recipe']['name']}.json.xz"
    path.write_bytes(lzma.compress(json.dumps(content, separators=(",", ":")).encode()))
    return path


def kept_names() -> list[str]:
    """Return the names of all kept studies, sorted."""
    return sorted(path.name.partition(".")[0] for path in STUDIES_FOLDER.glob("*.json.xz"))


def read_study(name: str) -> dict[str, Any]:
    """Read a kept study.

    Returns:
        `summary`; `groups`: name → tokens; `accidents`: row → seed → token → counts.
    """
    compressed = (STUDIES_FOLDER / f"{name}.json.xz").read_bytes()
    content: dict[str, Any] = json.loads(lzma.decompress(compressed))
    return content


def read_summaries() -> dict[str, Summary]:
    """Return the summaries of the kept studies by name, in the order of the page."""
    summaries = {}
    for name in STUDY_NAMES:
        if (STUDIES_FOLDER / f"{name}.json.xz").is_file():
            summaries[name] = read_study(name)["summary"]
    return summaries


def accident_evaluators(study: Mapping[str, Any]) -> dict[str, EvaluatorsBySeed]:
    """Return evaluators of accidents that hold the counts of a kept study, by row and seed."""
    labels = study["summary"]["recipe"]["test"]["labels"]
    rows: dict[str, dict[str, Evaluators]] = {}
    for row, counts_by_seed in study["accidents"].items():
        for seed, counts_by_token in counts_by_seed.items():
            evaluator = evaluators_of(labels)["accident"]
            for token, counts in counts_by_token.items():
                evaluator.add(token, counts)
            rows.setdefault(row, {})[seed] = {"accident": evaluator}
    return dict(rows)


def rows_table(
    summary: Summary, columns: Mapping[str, tuple[str, str]], names: Iterable[str] = ()
) -> str:
    """Return a table of rows of a study.

    Args:
        summary: The study.
        columns: Heading → group and number of the column's cells.
        names: The rows; all if there are none.
    """
    rows = []
    for name in names or summary["rows"]:
        groups = summary["rows"][name]["groups"]
        cells = [
            number_with_interval(groups[group][number], number)
            for group, number in columns.values()
        ]
        rows.append((f"`{name}`", *cells))
    return table(("row", *columns), rows)


def columns_of_group(group: str, numbers: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return the columns of `rows_table` for some numbers of one group."""
    return {NUMBERS[number][2]: (group, number) for number in numbers}


def answer_table(summary: Summary) -> str:
    """Return the rows that answer the headline, on the samples that the headline is about."""
    columns = columns_of_group(summary["headline"]["where"], ANSWER_NUMBERS)
    return rows_table(summary, columns, ANSWER_ROWS)


def seeds_text(summary: Summary) -> str:
    """Return the seeds of a study's rows, such as `1, 2`; empty if no row has any."""
    seeds = set()
    for row in summary["rows"].values():
        for number in row["groups"][ALL].values():
            seeds.update(number["seeds"])
    return ", ".join(sorted(seeds))


def hours_by_work(summary: Summary) -> dict[str, float]:
    """Return the hours that one process took for each kind of work, such as `training` → 4.3."""
    hours = {}
    for kind, work in CELL_KINDS.items():
        seconds = sum(cell["seconds"] for cell in summary["cells"] if cell["kind"] == kind)
        if seconds:
            hours[work] = seconds / 3600
    return hours


def setup_text(summary: Summary) -> str:
    """Return on how many samples, with which seeds and in how many hours a study was made."""
    tested = summary["groups"][ALL]
    hours = [f"{number:.1f} h for {work}" for work, number in hours_by_work(summary).items()]
    return (
        f"The test has {tested['samples']:,} samples of {tested['pairs']:,} pairs of an accident "
        f"and its twin; the seeds are {seeds_text(summary)}. One process took "
        f"{', '.join(hours[:-1])} and {hours[-1]}."
    )


def studies_table(summaries: Mapping[str, Summary]) -> str:
    """Return a table with the question and the making of each study."""
    rows = []
    for name, summary in summaries.items():
        tested = summary["groups"][ALL]
        samples = f"{tested['samples']:,} of {tested['pairs']:,}"
        hours = f"{sum(hours_by_work(summary).values()):.1f}"
        rows.append((f"`{name}`", summary["question"], samples, seeds_text(summary), hours))
    return table(("recipe", "question", "samples of pairs", "seeds", "hours"), rows)


def study_rows(name: str, summary: Summary) -> str:
    """Return all rows of a study: their numbers on all samples, and their APA in some groups."""
    if name == ROAD:  # nuScenes has no accidents
        return rows_table(summary, columns_of_group(ALL, ROAD_NUMBERS))
    apa_columns = {}
    for group, tested in summary["groups"].items():
        if group.startswith(APA_GROUPS.get(name, ("hidden",))):
            apa_columns[f"APA, `{group}` ({tested['samples']:,} samples)"] = (group, "apa")
    return rows_table(summary, columns_of_group(ALL, ROW_NUMBERS) | apa_columns)


def findings_table(summaries: Mapping[str, Summary]) -> str:
    """Return what was compared in all studies, at the hidden accidents and on all samples.

    Decided differences of the hidden accidents are bold. A comparison that an earlier study also
    made, with the same numbers, has no row.
    """
    rows = []
    previous_rows = set()
    for name, summary in summaries.items():
        recipe = f"`{name}`"
        for comparison in summary["comparisons"]:
            hidden_apa = comparison["groups"]["hidden"]["apa"]
            iou = comparison["groups"][ALL]["iou_100"]
            apa_text = difference_text(hidden_apa, "apa")
            if verdict(hidden_apa) != "not decided":
                apa_text = f"**{apa_text}**"
            rows_compared = f"`{comparison['row']}` minus `{comparison['less']}`"
            row = (rows_compared, apa_text, difference_text(iou, "iou_100"))
            if row not in previous_rows:
                previous_rows.add(row)
                rows.append((recipe, *row))
                recipe = ""
    iou_name = NUMBERS["iou_100"][2]
    head = ("recipe", "difference", "APA, hidden collider", f"{iou_name}, all")
    return table(head, rows)


def road_text(summary: Summary) -> str:
    """Return what came out on the road: the headline and all rows."""
    paragraphs = [
        wrapped(f"**{headline_text(summary['headline'])}**"),
        wrapped(setup_text(summary)),
        rows_table(summary, columns_of_group(ALL, ROAD_NUMBERS)),
    ]
    return "\n\n".join(paragraphs)


def weights_table() -> str:
    """Return the weights that come with the devkit, with their scores."""
    from deepaccident_devkit.plugins.model.checkpoint import SHIPPED_FILES, read_weights

    rows = []
    for name, path in SHIPPED_FILES.items():
        notes = read_weights(path).meta
        made, scores = notes["made"], notes["scored"]["scores"]
        source = f"`{made['study']}`: `{made['weights']}`, seed {made['seed']}"
        percents = [f"{100 * scores[score]:.1f}" for score in ("iou", "vpq", "map")]
        rows.append((f"`{name}`", source, f"{path.stat().st_size / 1e6:.1f}", *percents))
    names = [NUMBERS[number][2] for number in ("iou_100", "vpq_100", "map")]
    head = ("weights", "made by", "MB", *names)
    return table(head, rows)


def main(_release: Path | None = None) -> None:
    """Write the page of tables, and the headline on the page of the model."""
    summaries = read_summaries()
    agents = summaries["agents"]
    put("studies", studies_table(summaries))
    put("headline", wrapped(f"**{headline_text(agents['headline'])}**"))
    put("answer", answer_table(agents))
    put("findings", findings_table(summaries))
    put("weights", weights_table())
    put("road", road_text(read_study(ROAD)["summary"]))


@click.group(help=__doc__)
def commands() -> None:
    """Keep or show studies."""


@commands.command()
@click.argument(
    "folders",
    nargs=-1,
    required=True,
    type=click.Path(exists=True, file_okay=False, path_type=Path),
)
def keep(folders: tuple[Path, ...]) -> None:
    """Keep what the folders of studies have."""
    STUDIES_FOLDER.mkdir(exist_ok=True)
    for folder in folders:
        click.echo(keep_study(folder))


@commands.command()
@click.argument(
    "names", nargs=-1, required=True, metavar="NAME...", type=click.Choice(kept_names())
)
def show(names: tuple[str, ...]) -> None:
    """Print the rows of kept studies."""
    for name in names:
        click.echo(study_rows(name, read_study(name)["summary"]))


if __name__ == "__main__":
    commands()
