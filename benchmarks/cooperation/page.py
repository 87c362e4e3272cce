"""Write the page of the model from study.json: `python docs/make_tables.py model`.

study.py measures the numbers. No number of the page stands here, and its sentences follow from them.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from benchmarks.cooperation.numbers import PATHS
from benchmarks.pages.marks import DOCS

SUMMARY, PAGE = Path(__file__).with_name("study.json"), DOCS / "model.md"
NAMES = {name: said for name, (_, _, said) in PATHS.items()}
"""Numbers → how tables call them."""
PERCENT = ("iou_30", "vpq_30", "iou_100", "vpq_100", "map")
MAIN = ("iou_30", "vpq_30", "iou_100", "vpq_100", "map", "apa", "precision", "recall")
SHORT = ("iou_100", "vpq_100", "map", "apa", "hidden_foreground", "false_foreground")
COMPARED = ("iou_100", "hidden_foreground", "false_foreground")
FOUND = ("hidden_foreground", "seen_foreground", "false_foreground", "hidden_detected", "seen_detected", "false_boxes")
TRAINED = ("single", "all", "all, alone", "all, blanked", "all, strangers")
"""Rows of all models' seeds; the other models' rows are of the first seed alone."""
UNTRAINED = ("labels, single", "labels, all", "nothing", "everything")
GROUPS = ("seen", "held out")
WORDS_A_MINUTE = 200
Numbers = Mapping[str, Mapping[str, Any]]
Summary = Mapping[str, Any]


def page(summary: Summary) -> str:
    """The page's text."""
    sections = (_measured, _tables, _weights, _how, _paper)
    body = "\n".join(line for section in sections for line in section(summary)) + "\n"
    minutes = max(1, round(len(body.split()) / WORDS_A_MINUTE))
    told = f"{minutes} minute{'s' * (minutes != 1)}"
    return body.replace("READING_TIME", told)


def verdict(difference: Mapping[str, Any]) -> str:
    """`more`, `less` or `not decided`, by the interval of a difference."""
    low, high = difference["low"], difference["high"]
    if low is None or high is None or low <= 0 <= high:
        return "not decided"
    return "more" if low > 0 else "less"


def headline_text(summary: Summary) -> str:
    """What came out of the comparison that was fixed beforehand."""
    name, first = summary["headline_number"], summary["differences"][0]
    found = first["numbers"][name]
    size = f"{_difference(found, name)} points of {NAMES[name].removesuffix(' (%)')}"
    told = {
        "more": f"Cooperation wins: with all agents the model has more than alone, by {size}.",
        "less": f"Cooperation loses: with all agents the model has less than alone, by {size}.",
        "not decided": f"It is not decided whether cooperation helps: the difference is {size}.",
    }[verdict(found)]
    seeds = first["seeds"]
    parts = [f"{seed}: {_difference(each[name], name)} ({verdict(each[name])})" for seed, each in seeds.items()]
    more = sum((each[name]["value"] or 0) > 0 for each in seeds.values())
    count = f"{more or 'none'} of {len(seeds)}"
    return f"**{told}** Of the model seeds, {count} gained with all agents: {'; '.join(parts)}."


def reasons_text(summary: Summary) -> str:
    """What the controls say about the headline."""
    name = summary["headline_number"]
    found = {(each["first"], each["second"]): each["numbers"] for each in summary["differences"]}
    hidden = found["all, alone", "all"]["hidden_foreground"]
    false = found["all, alone", "all"]["false_foreground"]
    sentences = {
        "more": "Partners that belong to the scene give more than partners of another one, so that it is their data "
        "that help.",
        "less": "Partners of another scene give more than those that belong to it: whatever differs, it is not what "
        "they see.",
        "not decided": "Whether the partners belong to the scene is not seen to matter: nothing shows that their data "
        "are used.",
    }
    images = {
        "more": "Without images the model has less: it does look.",
        "less": "Without images it has more, so that it has not learned to see.",
        "not decided": "Without images it is not seen to have less, so that most of it may be a map that fits every "
        "junction.",
    }
    actors = {
        "more": "Of the actors that the ego cannot see, the same weights find more with partners than alone",
        "less": "Of the actors that the ego cannot see, the same weights find fewer with partners than alone",
        "not decided": "Whether the same weights find more of the actors that the ego cannot see with partners than "
        "alone is not decided",
    }
    price = {
        "more": "a larger share of the map is false with them",
        "less": "a smaller share of the map is false with them",
        "not decided": "the false share of the map is not seen to change",
    }
    return (
        f"{sentences[verdict(found['all, strangers', 'all'][name])]} "
        f"{images[verdict(found['all, blanked', 'all'][name])]} "
        f"{actors[verdict(hidden)]} ({_difference(hidden, 'hidden_foreground')}); {price[verdict(false)]} "
        f"({_difference(false, 'false_foreground')})."
    )


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *lines))


def rows_table(rows: Mapping[str, Numbers], names: Sequence[str]) -> str:
    """Numbers of some rows, with their intervals."""
    lines = [[f"`{row}`", *(_sure(numbers[name], name) for name in names)] for row, numbers in rows.items()]
    return table(["row", *(NAMES[name] for name in names)], lines)


INTRO = """# The model, and whether cooperation helps it

For everybody who wants to know what partners are worth to a small camera model: what was measured, and how to repeat
it. READING_TIME.

V2XFormer, the model that was published with DeepAccident, lifts the images of six cameras to a map seen from above,
joins an agent's own past with its present, joins the maps of up to five agents, and predicts motion and boxes.
[Training](training.md#the-papers-model) says how to train it; here it is the preset `tiny`.

`tiny` has cells of 1 m and learns the labels `clean`. So all numbers here are **clean, 1 m**: limits that the metrics
count in cells are twice as long in metres as the released ones, and the labels are others. They never stand beside
numbers of the released protocol, nor beside the paper's ([which numbers
compare](numbers.md#which-number-beside-which-published-one)).

## Does cooperation help?

Fixed before the first test run:
"""
MEASURED = """
- Three synthetic releases with images alone: training (seed {training[seed]}, {training[scenarios]} scenarios), tuning
  (seed {tuning[seed]}, {tuning[scenarios]}) and test (seed {test[seed]}, {test[scenarios]}), half of them normal twins.
  A house hides those who will collide from each other. The test also has the design {held}, which no model saw before.
- For each model seed ({seeds}) a model is trained alone for {first_steps:,} steps. From its weights two arms go on for
  {arm_steps:,} steps: `single` alone, and `all` with all agents, some of whom drop out at random. The last weights are
  tested; nothing is chosen among them.
- The test has {samples} samples of `ego_vehicle`, within the last two seconds of {pairs} pairs of an accident and its
  twin; in {positives} of them an accident comes. In brackets are intervals of 95 % over these pairs
  ([how](numbers.md#intervals)), none where too few of them change a number. The model seeds are pooled: the intervals
  say how a number varies from scene to scene, not from training to training.
- Actors within 50 m that only a partner sees, by the released rule of visibility ({hidden}, beside {seen} that the ego
  sees), are counted apart. One is on the map if the cell of its centre is foreground at the present, and detected if a
  box is within 2 m. The false share is of the foreground cells.
"""
REPEAT = """
## How to repeat it

    python -m benchmarks.cooperation.study WORKDIR --publish && python docs/make_tables.py model
"""
WEIGHTS = """
## The weights that ship

    deepaccident predict tiny DATAROOT --split val --out results
"""
SCORED = {"iou": "IoU", "vpq": "VPQ", "map": "mAP"}
PAPER = """
## The paper's tables

One set of weights serves all configurations of agents and links:

    deepaccident predict runs/all DATAROOT --agents +infrastructure --out results_infrastructure
    deepaccident predict runs/all DATAROOT --pose-noise 0.5 --out results_noise
    deepaccident predict runs/all DATAROOT --latency 0.5 --out results_late
"""
OTHERS = """
Other ways to join agents (`train --from runs/single --fusion cobevt`) and other horizons (`--horizon 4`) were not
trained.
"""


def _measured(summary: Summary) -> list[str]:
    protocol = summary["protocol"]
    test, training = protocol["test"], protocol["training"]
    facts = {
        **{name: protocol[name] for name in ("training", "tuning", "test", "first_steps", "arm_steps")},
        **{name: summary[name] for name in ("samples", "pairs", "positives")},
        **summary["actors"],
        "held": " and ".join(str(each) for each in test["designs"] if each not in training["designs"]),
        "seeds": ", ".join(map(str, protocol["seeds"])),
    }
    return [
        INTRO,
        fill(f"{protocol['headline']}.", 120, initial_indent="> ", subsequent_indent="> "),
        "",
        fill(headline_text(summary), 120),
        "",
        fill(reasons_text(summary), 120),
        "",
        "How it was measured:",
        MEASURED.format_map(facts),
    ]


def _tables(summary: Summary) -> list[str]:
    rows = summary["rows"]
    every = {name: rows[name]["numbers"] for name in (*TRAINED, *UNTRAINED)}
    says = [f"- `{name}`: {rows[name]['says']}." for name in every]
    return [
        "## All numbers",
        "",
        *says,
        "",
        "The rows `labels` read labels in place of images: they are no competitors, but say how much there is to gain.",
        "",
        rows_table(every, MAIN),
        "",
        "Hidden and seen actors:",
        "",
        rows_table(every, FOUND),
        "",
        "Differences; for the intervals, the same pairs are left out of both rows. Only the first line was fixed",
        "beforehand, all others are for exploration and not corrected for their number:",
        "",
        _compared(summary),
        "",
        "By design, those of the training and the one that was held out:",
        "",
        _designs(summary),
    ]


def _compared(summary: Summary) -> str:
    """The differences of rows."""
    lines = [
        [f"`{each['second']}` less `{each['first']}`", NAMES[name], _difference(numbers, name), verdict(numbers)]
        for each in summary["differences"]
        for name, numbers in sorted(each["numbers"].items(), key=lambda item: item[0] != summary["headline_number"])
        if name in COMPARED
    ]
    return table(["difference", "number", "value", "verdict"], lines)


def _designs(summary: Summary) -> str:
    """Two numbers of seen and held-out designs."""
    columns = [(name, group) for name in (summary["headline_number"], "hidden_foreground") for group in GROUPS]
    lines = [
        [f"`{row}`", *(_sure(summary["rows"][row]["designs"][group][name], name) for name, group in columns)]
        for row in TRAINED
    ]
    return table(["row", *(f"{NAMES[name]}, {group}" for name, group in columns)], lines)


def _how(summary: Summary) -> list[str]:
    machine, tuning, seconds = summary["machine"], summary["tuning"], summary["seconds"]
    gpu = f"The models ran on {machine['gpu']}." if machine["gpu"] else "No GPU was used: nothing was measured on one."
    took = (
        f"It took {sum(seconds.values()) / 3600:.1f} hours on {machine['processor']} ({machine['cores']} cores, "
        f"{machine['processes']} processes at a time, Python {machine['python']}, torch {machine['torch']}, devkit "
        f"{machine['devkit']}). {gpu}"
    )
    rates = [f"{float(rate):g}" for each in tuning["rounds"] for rate in each]
    trials = (
        f"On the tuning release the learning rates {' and '.join(rates)} were tried, and "
        f"{tuning['learning_rate']:g} was chosen. Before all this was fixed, shorter trials on parts of the training "
        "release led to what `tiny` has beside the release: only points near the road count, a cell has their mean, "
        "and foreground weighs more."
    )
    prints = ", ".join(f"{name} `{each['fingerprint']}`" for name, each in summary["releases"].items())
    return [
        REPEAT,
        fill(took, 120),
        "",
        fill(trials, 120),
        "",
        fill(
            f"Fingerprints of the releases: {prints}. benchmarks/cooperation/study.json has all numbers, and "
            "benchmarks/cooperation/counts.json.gz the counts of each sample, except those of detection.",
            120,
        ),
    ]


def _weights(summary: Summary) -> list[str]:
    found, protocol = summary["weights"], summary["protocol"]
    scores = ", ".join(f"{name} {100 * found['scores'][key]:.1f} %" for key, name in SCORED.items())
    told = (
        f"They are those of `{found['agents']}`, seed {protocol['seeds'][0]}, in half precision: "
        f"{found['bytes'] / 1e6:.1f} MB. Notes in the file say how they were made. On a release of "
        f"{found['synth']['scenarios']} other scenarios, made from seed {found['synth']['seed']}, they have with all "
        f"agents {scores} (clean, 1 m; all samples, of all agents). A test makes the release and scores them again. "
        "They have seen synthetic scenes alone: nobody knows what they do on the dataset."
    )
    return [WEIGHTS, fill(told, 120)]


def _paper(summary: Summary) -> list[str]:
    rows = summary["rows"]
    seed = str(summary["protocol"]["seeds"][0])
    once = {name: rows[name]["seeds"][seed] for name in rows if name not in UNTRAINED}
    shown = {name: each for name, each in once.items() if name not in TRAINED or name in ("all", "all, alone")}
    return [
        PAPER,
        f"Those that were run, with the weights `all` of seed {seed}:",
        "",
        rows_table(shown, SHORT),
        OTHERS.rstrip(),
    ]


def _sure(number: Mapping[str, Any], name: str) -> str:
    """`12.3 [10.1, 14.8]`."""
    if number["value"] is None:
        return "–"
    ends = "" if number["low"] is None else f" [{_text(number['low'], name)}, {_text(number['high'], name)}]"
    return _text(number["value"], name) + ends


def _difference(number: Mapping[str, Any], name: str) -> str:
    """`+2.1 [0.4, 3.8]`."""
    sign = "+" if number["value"] is not None and number["value"] > 0 else ""
    return sign + _sure(number, name)


def _text(value: float, name: str) -> str:
    return f"{value:.{1 if name in PERCENT else 2}f}"


def main() -> None:
    """Write it."""
    summary = json.loads(SUMMARY.read_text(encoding="utf-8"))
    if summary["smoke"]:
        raise SystemExit(f"{SUMMARY}: is of another protocol; its numbers are for no page")
    PAGE.write_text(page(summary), encoding="utf-8")
