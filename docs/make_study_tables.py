"""Measure the tables of docs/baselines.md: `python docs/make_study_tables.py [FOLDER]`, from a checkout; some minutes.

FOLDER holds releases to take in place of new synthetic ones, `ordinary` and `hidden`, if they were made as `RELEASES`
says.
"""

import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import make_accident_tables
from make_accident_tables import HERE, put

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.baselines import METRICS, StudyConfig, StudyRow, V2XStudy, v2x_study
from deepaccident_devkit.baselines.conditions import LINKED
from deepaccident_devkit.baselines.study_result import number_text, sure_text
from deepaccident_devkit.synth import SynthConfig, make_release

RELEASES = {
    "ordinary": SynthConfig(scenarios=24, frames=40, seed=12, sensors=False),
    "hidden": SynthConfig(scenarios=24, frames=40, seed=12, sensors=False, view="hidden"),
}
SPLIT, CONFIG = "train", StudyConfig(quick=True)
SHOWN = ("vpq_100", "apa", "boxes_apa", "mAP")
LINK_SHOWN = ("vpq_100", "boxes_apa")
PERFECT = "perfect"
DECIDED = ("iou_30", "iou_100", *SHOWN)
Studies = Mapping[str, V2XStudy]


def main() -> None:
    """Write all tables into the page."""
    make_accident_tables.PAGE = HERE / "baselines.md"
    with tempfile.TemporaryDirectory() as made:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else made)
        for name, config in RELEASES.items():
            if not (folder / name).exists():
                make_release(folder / name, config)
        studies = {
            name: v2x_study(DeepAccident("v1", folder / name, verbose=False), SPLIT, CONFIG) for name in RELEASES
        }
    put("study-size", size_text(studies))
    put("study-configurations", configurations_table(studies))
    put("study-decided", decided_table(studies))
    put("study-link", link_table(studies))
    put("study-decided-link", decided_link_table(studies))


def size_text(studies: Studies) -> str:
    """How much the tables are of."""
    parts = []
    for name, study in studies.items():
        row = study.tables["configurations"].rows[0]
        parts.append(f"{row.samples} samples of {row.scenarios} accidents ({row.clusters} clusters) in the {name} view")
    return f"The tables are of {' and '.join(parts)}."


def configurations_table(studies: Studies) -> str:
    """Who cooperates: the views beside each other."""
    head = ["agents", *(f"{METRICS[name]}, {view}" for name in SHOWN for view in studies)]
    columns = [study.tables["configurations"].rows for study in studies.values()]
    lines = [
        [f"`{rows[0].agents}`", *(sure_text(row, name) for name in SHOWN for row in rows)]
        for rows in zip(*columns, strict=True)
    ]
    return table(head, lines)


def decided_table(studies: Studies) -> str:
    """Who gets more than a single vehicle."""
    lines = [
        [METRICS[name], view, *sides({row.agents: row for row in study.tables["configurations"].rows[1:]}, name)]
        for name in DECIDED
        for view, study in studies.items()
    ]
    return table(["number", "view", "more than `single`", "less than `single`", "not decided"], lines)


def link_table(studies: Studies) -> str:
    """Noise and latency; with noise the least and the most of single seeds, too."""
    head = ["agents", "link", *(f"{METRICS[name]}, {view}" for name in LINK_SHOWN for view in studies)]
    columns = [linked_rows(study) for study in studies.values()]
    lines = [
        [f"`{agents}`", link, *(_with_seeds(rows[agents, link], name) for name in LINK_SHOWN for rows in columns)]
        for agents, link in columns[0]
    ]
    return table(head, lines)


def decided_link_table(studies: Studies) -> str:
    """Which links give less than a perfect one."""
    lines = []
    for name in DECIDED:
        for view, study in studies.items():
            for agents in LINKED:
                rows = {link: row for (who, link), row in linked_rows(study).items() if who == agents}
                found = sides({link: row for link, row in rows.items() if link != PERFECT}, name)
                lines.append([METRICS[name], view, f"`{agents}`", *found])
    return table(["number", "view", "agents", "more than with a perfect link", "less", "not decided"], lines)


def linked_rows(study: V2XStudy) -> dict[tuple[str, str], StudyRow]:
    """Agents and link → row; the perfect link once."""
    rows = [*study.tables["pose_noise"].rows, *study.tables["latency"].rows]
    return {(row.agents, _link(row)): row for row in sorted(rows, key=lambda row: row.agents == "all")}


def sides(rows: Mapping[str, StudyRow], metric: str) -> list[str]:
    """Which rows have more of a number than their base, which less, and of which that is not decided."""
    above, below, rest = [], [], []
    for name, row in rows.items():
        low, high = row.gains.get(metric, (0.0, 0.0))
        (above if low > 0 else below if high < 0 else rest).append(name)
    return [", ".join(each) or "–" for each in (above, below, rest)]


def table(head: Iterable[str], lines: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    columns = list(head)
    rows = [columns, ["---"] * len(columns), *lines]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _with_seeds(row: StudyRow, name: str) -> str:
    ends = row.spread.get(name)
    seeds = f"; seeds {number_text(ends[0], name)} to {number_text(ends[1], name)}" if ends else ""
    return f"{sure_text(row, name)}{seeds}"


def _link(row: StudyRow) -> str:
    if row.pose_noise:
        return f"{row.pose_noise:g} m of noise"
    return f"{row.latency:g} s late" if row.latency else PERFECT


if __name__ == "__main__":
    main()
