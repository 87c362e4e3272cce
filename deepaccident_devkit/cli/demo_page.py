"""The page on which `deepaccident demo` shows what it made."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from deepaccident_devkit.render.markup import Markup, document, joined, table, tag

PAGE: Final = "index.html"
PICTURES: Final = {
    "countdown.png": (
        "The crash comes",
        (
            "The last three seconds, from left to right. In the first row ego drives towards the junction: a house on "
            "the right hides the other car, until it comes out from behind it. In the second row the roadside pole "
            "sees both all the time. The colliding pair is red."
        ),
    ),
    "five_agents_1s_before.png": (
        "Five agents, one second before the impact",
        "The front cameras of all five agents; below, from above, their LiDAR points and all labelled boxes.",
    ),
    "ego_cameras_1s_before.png": (
        "All that ego records, one second before the impact",
        "The six cameras of ego and its LiDAR points, with the labelled boxes.",
    ),
    "motion_labels_1s_before.png": (
        "Motion labels",
        "What a network learns to predict: where everybody is now, in 0.5 s and in 1 s, on a grid from above.",
    ),
}
"""File beside the page → what it shows, in a few words, and what one sees."""
MODEL_PICTURE: Final = {
    "model_1s_before.png": (
        "What a trained model foresees",
        (
            "The small model that the devkit ships sees with cameras alone: on the left with those of ego, on the "
            "right with those of all five agents. One second before the impact, it says where everybody is now, and "
            "where they will be at the impact. It is too small to see far or sharply."
        ),
    )
}
"""Likewise, of the picture that is made where PyTorch is installed."""
REPLAY: Final = "replay.html"
REPORT_FOLDER: Final = "evaluation"
_POLICY: Final = "default-src 'none'; img-src 'self' file:; frame-src 'self' file:; style-src 'unsafe-inline'"
"""A browser loads only what lies beside the page, on a disk or a server; only the pages in frames run anything."""
_TABLE: Final = """\
How well one car and five agents together predict the crash. The predictor is a baseline: each actor that is seen \
keeps its speed. The numbers are of every half second of the last four before the impact, and look four seconds \
ahead. IoU and VPQ measure the predicted maps, APA, precision and recall the predicted accidents, mAP the boxes seen."""
_REPLAY: Final = "Press Play, or drag the slider: all five cameras, the scene from above, and who sees whom."
_REPORT: Final = """\
The predictions of each agent alone, for both scenarios: what it foresees, what it misses, how often its alarm is \
false, and when."""


@dataclass(frozen=True, slots=True)
class NextStep:
    """Something to try next.

    Attributes:
        sentence: what it does.
        command: for a shell.
    """

    sentence: str
    command: str


def demo_page(rows: Sequence[Sequence[str]], steps: Sequence[NextStep], *, model: bool) -> str:
    """The complete page; it refers to the other files of its folder by their names.

    Args:
        rows: of `demo.demo_table`.
        steps: what to try next.
        model: whether there is a picture of a model's predictions.
    """
    heading, *lines = zip(*rows, strict=True)  # a column for each set of agents: it fits a narrow window
    parts = [
        *((*words, _image(name, *words)) for name, words in (PICTURES | (MODEL_PICTURE if model else {})).items()),
        ("What one car and five agents foresee", _TABLE, table(heading, lines)),
        ("Replay", _REPLAY, _frame("Replay", REPLAY)),
        ("Report of an evaluation", _REPORT, _frame("Report", f"{REPORT_FOLDER}/report.html")),
        ("Six next steps", f"Type these in the folder {Path.cwd()}.", _commands(steps)),
    ]
    links = [tag("a", name, href=f"#{number}") for number, (name, _, _) in enumerate(parts)]
    return document(
        "DeepAccident devkit: the demo",
        tag("h1", "A crash that five agents see coming"),
        tag(
            "p",
            "A synthetic accident and its normal twin, recorded by two cars, a car behind each, and a roadside pole.",
        ),
        tag("nav", *links),
        *(
            tag("section", tag("h2", name), tag("p", sentence), body, id=str(number))
            for number, (name, sentence, body) in enumerate(parts)
        ),
        policy=_POLICY,
    )


def _image(name: str, heading: str, sentence: str) -> Markup:
    """A picture, not larger than it is; in a narrow window it is smaller, and a link to the whole."""
    image = tag("img", src=name, alt=f"{heading}: {sentence}", style="width: auto; max-width: 100%")
    return tag("figure", tag("a", image, href=name))


def _frame(title: str, source: str) -> Markup:
    """Another page, in a frame and as a link."""
    style = "width: 100%; height: 48rem; border: 1px solid #d0d0d0"
    link = tag("p", tag("a", f"Open it alone: {source}", href=source))
    return joined([link, tag("iframe", src=source, title=title, loading="lazy", style=style)])


def _commands(steps: Sequence[NextStep]) -> Markup:
    """Each command is selected by one click."""
    style = "white-space: pre-wrap; user-select: all; margin: .2rem 0"
    items = (tag("li", step.sentence, tag("pre", tag("code", step.command), style=style)) for step in steps)
    return tag("ol", *items)
