"""`deepaccident demo`: everything once, on a small synthetic release, and a page that shows it."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

import click
import numpy as np
from tqdm import tqdm

from deepaccident_devkit.cli.options import PATH, use_threads_sparingly, workers_parameter
from deepaccident_devkit.cli.verbs import verb
from deepaccident_devkit.dataset import RowArgument
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError, MissingExtraError, MissingPluginError
from deepaccident_devkit.evaluation.results import ResultsTask, read_results
from deepaccident_devkit.evaluation.runs import SampleSelection, evaluate_results, save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.motion import MotionLabelConfig, motion_labels
from deepaccident_devkit.plugins.baselines import Baseline, predict_results
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render import detached_figure, render_replay
from deepaccident_devkit.render.boxes import draw_boxes_from_above, recorders_of, write_beside
from deepaccident_devkit.render.evaluation import draw_motion_outcome, save_report
from deepaccident_devkit.render.figures import save_picture
from deepaccident_devkit.render.ground import draw_underlay
from deepaccident_devkit.render.styles import COLLIDER_COLOR, page_style
from deepaccident_devkit.support.files import place_in, remove_leftovers, write_bytes
from deepaccident_devkit.support.pages import document
from deepaccident_devkit.support.plugins import need_plugin
from deepaccident_devkit.support.text import columns_text
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD, short_name
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import FrameRecord, ScenarioRecord

_PAGE_FILE: Final = "index.html"
# Files beside the page, as its template shows them.
PICTURES: Final = (
    "countdown.png",
    "five_agents_1s_before.png",
    "ego_cameras_1s_before.png",
    "motion_labels_1s_before.png",
)
# Likewise, of the picture that is made where PyTorch is installed.
MODEL_PICTURE: Final = "model_1s_before.png"
_REPLAY_FILE: Final = "replay.html"
REPORT_FOLDER: Final = "evaluation"
# A browser loads only what lies beside the page, on a disk or a server; only the pages in frames run anything.
_POLICY: Final = (
    "default-src 'none'; img-src 'self' file:; frame-src 'self' file:; style-src 'unsafe-inline'"
)
SCENARIO: Final = """\
# The accident of `deepaccident demo`: in clear weather, by day, the other car runs a red light. A house hides it from
# ego until about 2.5 s before the impact; from then on it is in ego's front camera.
name: demo
road: {kind: four-way, signalized: true, lanes: 1}
view: hidden
actors:
  - {role: ego, from: west, max_speed: 10}
  - {role: ego_behind, gap: [8, 16]}
  - {role: other, from: south, max_speed: 4, ignores: [signal]}
  - {role: other_behind, gap: [8, 16]}
meet: {actors: [ego, other], offset: [-0.2, 0.2]}
background: {vehicles: [6, 12], two_wheelers: [2, 6], parked: [3, 9], walking: [3, 9], crossing: [1, 4]}
weather: Clear
time_of_day: Noon
"""
RELEASE: Final = SynthConfig(scenarios=2, frames=40, seed=1, sensors="accidents", traffic="v1")
# The file by which the demo knows a folder as its own.
_MARK: Final = ".deepaccident_demo"
_SCENARIO_FILE: Final = "accident.yaml"
_RUN: Final = "single_vehicle"
_RESULTS: Final = f"{_RUN}.json"
# Seconds before the impact; at the first the house hides the other car from ego.
_COUNTDOWN: Final = (3.0, 2.0, 1.0, 0.5, 0.0)
_SECONDS_BEFORE: Final = 1.0
# Metres from ego to the edge of the model's picture.
_REACH: Final = 35.0
# The released labels, but they end at the impact.
_LABELS: Final = MotionLabelConfig(future_frames=2)
# The samples of the table and of the report: ego's in the last four seconds of the accident and of its twin.
_SELECTION: Final = SampleSelection(
    split="train", scope="all", agents=("ego_vehicle",), horizon=4.0
)
_AGENTS: Final = {"single": "single vehicle", "all": "five agents"}
# Task → the protocol, and the heading of each number of the table with its name in the result.
_NUMBERS: Final[Mapping[ResultsTask, tuple[str, Mapping[str, str]]]] = {
    "motion": ("paper", {"IoU (%)": "iou 100x100", "VPQ (%)": "vpq 100x100"}),
    "accident": ("boxes", {"APA": "apa", "precision": "precision", "recall": "recall"}),
    "detection": ("paper", {"mAP (%)": "mAP"}),
}
# About how many seconds each step takes on two cores.
_STEPS: Final = {
    "recording": 15.0,
    "indexing": 1.0,
    "pictures": 5.0,
    "model": 5.0,
    "table": 3.0,
    "evaluation": 4.0,
    "replay": 4.0,
}
_BAR: Final = "{desc:<10} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"


@dataclass(frozen=True, slots=True)
class NextStep:
    """Something to try next.

    Attributes:
        sentence: what it does.
        command: for a shell.
    """

    sentence: str
    command: str


@verb()
@click.argument("out", type=PATH, default="deepaccident_demo")
@workers_parameter
def demo(out: Path, workers: int | None) -> None:
    """Make a small synthetic release in the folder OUT, and a page that shows what the devkit does with it.

    The release has an accident, and of its normal twin the labels. The page OUT/index.html has pictures, motion labels,
    a table of what one car and five agents predict, a replay, the report of an evaluation, and six next steps. Where
    PyTorch is installed, it also shows what a small trained model foresees.

    OUT must be missing, empty, or the folder of an earlier demo, which then keeps its release.
    """
    _claim(out)
    steps = _next_steps(out)
    with tqdm(total=sum(_STEPS.values()), bar_format=_BAR, disable=None) as bar:
        with _step(bar, "recording"):
            _make_release(out, workers, bar)
        with _step(bar, "indexing"):
            release = DeepAccident("v1", out / "release", workers=workers, verbose=False)
        with _step(bar, "pictures"):
            draw_accident(release, out)
        with _step(bar, "model"):
            model = draw_model(release, out)
        with _step(bar, "table"):
            table = demo_table(release)
        with _step(bar, "evaluation"):
            _evaluate(release, out)
        with _step(bar, "replay"):
            render_replay(release, None, out / _REPLAY_FILE)
    write_bytes(out / _PAGE_FILE, demo_page(table, steps, model=model).encode())
    click.echo(f"{columns_text(table)}\n\nNext steps:")
    for number, step in enumerate(steps, 1):
        click.echo(f"{number}. {step.sentence}\n   {step.command}")
    click.echo(f"\nOpen this page in a browser, it shows all that was made: {out / _PAGE_FILE}")


def demo_page(table: Sequence[Sequence[str]], steps: Sequence[NextStep], *, model: bool) -> str:
    """The complete page; it refers to the other files of its folder by their names.

    Args:
        table: of `demo_table`.
        steps: what to try next.
        model: whether there is a picture of a model's predictions.
    """
    heading, *rows = zip(
        *table, strict=True
    )  # a column for each set of agents: it fits a narrow window
    return document(
        "demo.html",
        style=page_style(),
        policy=_POLICY,
        pictures=PICTURES,
        model=MODEL_PICTURE if model else "",
        heading=heading,
        rows=rows,
        replay=_REPLAY_FILE,
        report=f"{REPORT_FOLDER}/report.html",
        folder=str(Path.cwd()),
        steps=steps,
    )


def draw_accident(release: DeepAccident, out: Path) -> None:
    """Render the first accident: the countdown to it, and the five agents, ego's cameras and labels a second before."""
    accident, before = _accident_and_before(release)
    ego = release.samples_of(before)[0]
    countdown = partial(
        release.render_accident, seconds=_COUNTDOWN, agents=("ego_vehicle", "infrastructure")
    )
    drawings: tuple[tuple[tuple[float, float], Callable[..., Any], RowArgument], ...] = (
        ((17.0, 8.6), countdown, accident),
        ((20.0, 6.5), release.render_frame, before),
        ((16.0, 5.5), release.render_sample, ego),
        ((11.0, 12.0), partial(release.render_motion_labels, config=_LABELS), ego),
    )
    for name, (size, render, record) in zip(PICTURES, drawings, strict=True):
        save_picture(render(record, fig=detached_figure(size)), out / name, dpi=80)


def draw_model(release: DeepAccident, out: Path) -> bool:
    """Render what the shipped model foresees a second before, by ego's LiDAR and by all agents', beside the truth.

    Beneath is the road, and above it the pair as it truly is at each of the two moments.

    Returns:
        Whether PyTorch is installed; without it there is no picture.
    """
    (out / MODEL_PICTURE).unlink(missing_ok=True)  # of an earlier demo
    use_threads_sparingly()
    try:
        need_plugin("model", "the picture of a model")
        from deepaccident_devkit.plugins.model import PredictConfig, load_model, predictions

        model = load_model("tiny_lidar")
    except (MissingExtraError, MissingPluginError):
        return False
    accident, before = _accident_and_before(release)
    token = release.samples_of(before)[0]["token"]
    label, road = motion_labels(release, token, model.config.labels), release.load_bev(token)
    fig = detached_figure((11.0, 11.0))
    for column, agents, title in zip(
        fig.subplots(2, 2).T, ("single", "all"), ("ego alone", "five agents"), strict=True
    ):
        [found] = predictions(model, release, [token], PredictConfig(agents=agents))
        for ax, frame, moment in zip(
            column, (0, None), (before["index"], accident["num_frames"]), strict=True
        ):
            draw_motion_outcome(found.motion, label, frame=frame, ax=ax)
            ax.set(
                xlim=(-_REACH, _REACH), ylim=(-_REACH, _REACH), title=f"{title}: {ax.get_title()}"
            )
            draw_underlay(road, ax, target_from_ego=SE3.identity(), view_range=_REACH)
            _draw_pair(release, accident, token, moment, ax)
    save_picture(fig, out / MODEL_PICTURE, dpi=80)
    return True


def _draw_pair(
    release: DeepAccident, accident: ScenarioRecord, sample: str, moment: int, ax: Any
) -> None:
    """Render the true outlines of an accident's pair at a frame, in the ego frame of a sample, with names."""
    scenario, collision = accident["token"], accident["collision"]
    boxes = scenario_tracks(release, scenario).at(moment)
    boxes = boxes.select(np.isin(boxes.actor_id, collision["ids"] if collision else []))
    boxes = boxes.transform(release.world_from(sample, "ego").inverse(), "ego")
    draw_boxes_from_above(boxes, ax, [COLLIDER_COLOR] * len(boxes), fill=0, linewidths=2)
    recorders = recorders_of(release, scenario)
    for (x, y, _), actor in zip(boxes.center.tolist(), boxes.actor_id.tolist(), strict=True):
        write_beside(ax, short_name(recorders[actor]), (x, y), COLLIDER_COLOR)


def _accident_and_before(release: DeepAccident) -> tuple[ScenarioRecord, FrameRecord]:
    """The first accident's scenario, and its frame a second before the impact."""
    accident = next(scenario for scenario in release.scenario if scenario["collision"])
    impact = release.getind("frame", accident["last_frame_token"])
    return accident, release.frame[impact - round(_SECONDS_BEFORE / FRAME_PERIOD)]


@contextmanager
def _step(bar: tqdm[Any], name: str) -> Iterator[None]:
    """Name a step on the bar, and move the bar to its end; a log gets a line at its beginning."""
    bar.set_description_str(name)
    if _is_log(bar):
        click.echo(
            f"{[*_STEPS].index(name) + 1} of {len(_STEPS)}: {name}, which takes some {_STEPS[name]:.0f} s"
        )
    end = sum(list(_STEPS.values())[: list(_STEPS).index(name) + 1])
    yield
    bar.update(end - bar.n)


def _is_log(bar: tqdm[Any]) -> bool:
    """Whether what is printed goes elsewhere than to a terminal, so that lines say how far it is."""
    return bar.disable or not sys.stdout.isatty()


def _claim(out: Path) -> None:
    """Mark a folder as the demo's, before anything else is written.

    Raises:
        ConfigError: it holds something, and no demo of this version made it.
    """
    mark, version = out / _MARK, f"{__version__}\n".encode()
    if mark.is_file() and mark.read_bytes() == version:
        return
    remove_leftovers(out)  # of a demo that was killed before it had marked the folder
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(
            f"{out}: exists, and was not made by the demo of version {__version__}; name a folder that does not exist "
            "yet: deepaccident demo OTHER_FOLDER"
        )
    write_bytes(mark, version)


def _make_release(out: Path, workers: int | None, bar: tqdm[Any]) -> None:
    """Make the release, if it is not there; what an interrupted demo has recorded is kept."""
    root, scenario = place_in(out, "release", opened=True), out / _SCENARIO_FILE
    if root.is_dir():
        return
    if not scenario.exists():
        write_bytes(scenario, SCENARIO.encode())
    recorded = 0.0

    def moved(share: float) -> None:
        nonlocal recorded
        before, recorded = recorded, recorded + share
        bar.update(share * _STEPS["recording"])
        if _is_log(bar) and int(10 * recorded) > int(10 * before):
            click.echo(f"  {100 * recorded:.0f} % recorded")

    make_release(root, replace(RELEASE, spec=scenario), workers=workers or 2, progress=moved)


def demo_table(release: DeepAccident) -> list[list[str]]:
    """How well ego alone and five agents foresee crashes: a heading, and a line of text for each of the two."""
    tokens = _SELECTION.tokens(release)
    rows = [["", *(heading for _, numbers in _NUMBERS.values() for heading in numbers)]]
    for agents, name in _AGENTS.items():
        baseline, row = Baseline(agents=agents, horizon=_SELECTION.horizon), [name]
        with TemporaryDirectory() as folder:
            for task, (protocol, numbers) in _NUMBERS.items():
                path = predict_results(
                    release, task, tokens, Path(folder) / task, baseline, workers=1
                )
                setup = EvaluationSetup(task=task, protocol=protocol, horizon=_SELECTION.horizon)
                run = evaluate_results(release, path, setup, _SELECTION, workers=1)
                found = {each.name: each for each in headlines(run.result)}
                row += [found[number].text().removesuffix(" %") for number in numbers.values()]
        rows.append(row)
    return rows


def _evaluate(release: DeepAccident, out: Path) -> None:
    """Evaluate what the baseline of a single vehicle predicts, and write a report and a bundle."""
    path = out / _RESULTS
    path.unlink(missing_ok=True)  # of an earlier demo
    baseline, tokens = (
        Baseline(agents="single", horizon=_SELECTION.horizon),
        _SELECTION.tokens(release),
    )
    results = read_results(predict_results(release, "accident", tokens, path, baseline, workers=1))
    setup = EvaluationSetup(task="accident", protocol="boxes", horizon=_SELECTION.horizon)
    run = evaluate_results(release, results, setup, _SELECTION, workers=1).broken_down()
    folder = place_in(out, REPORT_FOLDER, opened=True)
    save_report(run, folder, dataset=release, results=results)
    save_run(run, place_in(folder, _RUN, opened=True), include_results=True, overwrite=True)


def _next_steps(out: Path) -> tuple[NextStep, ...]:
    names = (
        "release",
        "five_agents",
        "own",
        _SCENARIO_FILE,
        f"{REPORT_FOLDER}/{_RUN}",
        "five_agents/evaluation",
    )
    root, five, own, scenario, bundle, second = (shlex.quote(str(out / name)) for name in names)
    of_both = (
        f"--split {_SELECTION.split} --scope {_SELECTION.scope} --horizon {_SELECTION.horizon:g}"
    )
    return (
        NextStep("See what the release holds:", f"deepaccident info {root} --where collision=true"),
        NextStep(
            "See in your browser which predictions were right; this needs the extra: pip install '.[explore]'",
            f"deepaccident explore {root} --results {bundle}",
        ),
        NextStep(
            "Check its files, as you would check your download:",
            f"deepaccident validate {root} --deep",
        ),
        NextStep(
            "Let five agents predict together:",
            f"deepaccident predict constant_velocity {root} {of_both} --task accident --agents all --out {five}",
        ),
        NextStep(
            "Evaluate that, and compare it with the report:",
            f"deepaccident evaluate accident {root} --results {five}/accident.json {of_both} --protocol boxes "
            f"--agents ego_vehicle --allow-partial --out {second} && deepaccident evaluate compare {bundle} {second}",
        ),
        NextStep(
            "Edit the scenario file of the accident, such as its weather, and see what happens in it:",
            f"deepaccident synth {own} --design {scenario} --scenarios 2 --sensors none",
        ),
    )
