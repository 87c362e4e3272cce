"""`deepaccident demo`: a tour on a small synthetic release, and a page that shows it."""

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
PICTURES: Final = (
    "countdown.png",
    "five_agents_1s_before.png",
    "ego_cameras_1s_before.png",
    "motion_labels_1s_before.png",
)
"""Files beside the page, as its template shows them."""
MODEL_PICTURE: Final = "model_1s_before.png"
"""File of the picture that is made where PyTorch is installed."""
_REPLAY_FILE: Final = "replay.html"
REPORT_FOLDER: Final = "evaluation"
# A browser loads only files beside the page, on a disk or a server; only pages in frames run code.
_CONTENT_POLICY: Final = (
    "default-src 'none'; img-src 'self' file:; frame-src 'self' file:; style-src 'unsafe-inline'"
)
SCENARIO: Final = """\
# The accident of `deepaccident demo`: in clear weather, by day, the other car runs a red light. \
A house hides it from
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
background: {vehicles: [6, 12], two_wheelers: [2, 6], parked: [3, 9], walking: [3, 9], \
crossing: [1, 4]}
weather: Clear
time_of_day: Noon
"""
RELEASE: Final = SynthConfig(scenarios=2, frames=40, seed=1, sensors="accidents", traffic="v1")
# The file by which the demo knows a folder as its own.
_MARKER_FILE: Final = ".deepaccident_demo"
_SCENARIO_FILE: Final = "accident.yaml"
_RUN_NAME: Final = "single_vehicle"
_RESULTS_FILE: Final = f"{_RUN_NAME}.json"
# Seconds before the impact; at the first the house hides the other car from ego.
_COUNTDOWN: Final = (3.0, 2.0, 1.0, 0.5, 0.0)
_SECONDS_BEFORE: Final = 1.0
# Distance from ego to the edge of the model's picture.
_VIEW_RANGE_M: Final = 35.0
# The released labels, but they end at the impact.
_LABEL_CONFIG: Final = MotionLabelConfig(future_frames=2)
# The samples of the table and of the report: ego's in the last four seconds of the accident and of
# its twin.
_SELECTION: Final = SampleSelection(
    split="train", scope="all", agents=("ego_vehicle",), horizon=4.0
)
_AGENT_SET_NAMES: Final = {"single": "single vehicle", "all": "five agents"}
# The protocol of each task, and the heading of each number of the table with its name in the
# result.
_TABLE_NUMBERS: Final[Mapping[ResultsTask, tuple[str, Mapping[str, str]]]] = {
    "motion": ("paper", {"IoU (%)": "iou 100x100", "VPQ (%)": "vpq 100x100"}),
    "accident": ("boxes", {"APA": "apa", "precision": "precision", "recall": "recall"}),
    "detection": ("paper", {"mAP (%)": "mAP"}),
}
# Approximate duration of each step on two cores, seconds.
_STEP_SECONDS: Final = {
    "recording": 15.0,
    "indexing": 1.0,
    "pictures": 5.0,
    "model": 5.0,
    "table": 3.0,
    "evaluation": 4.0,
    "replay": 4.0,
}
_BAR_FORMAT: Final = "{desc:<10} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}"


@dataclass(frozen=True, slots=True)
class NextStep:
    """A suggestion for what to try next.

    Attributes:
        sentence: Description of the step.
        command: Command for a shell.
    """

    sentence: str
    command: str


@verb()
@click.argument("out", type=PATH, default="deepaccident_demo")
@workers_parameter
def demo(out: Path, workers: int | None) -> None:
    """Make a small synthetic release in the folder OUT, and a page that shows what the devkit does.

    The release has an accident, and of its normal twin the labels. The page OUT/index.html has
    pictures, motion labels, a table of what one car and five agents predict, a replay, the report
    of an evaluation, and six next steps. Where PyTorch is installed, it also shows what a small
    trained model foresees.

    OUT must be missing, empty, or the folder of an earlier demo, which then keeps its release.
    """
    _claim(out)
    steps = _next_steps(out)
    with tqdm(total=sum(_STEP_SECONDS.values()), bar_format=_BAR_FORMAT, disable=None) as bar:
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
    """Render the complete page; it refers to the other files of its folder by their names.

    Args:
        table: Rows of `demo_table`.
        steps: Suggestions for what to try next.
        model: Whether there is a picture of a model's predictions.
    """
    # A column for each set of agents fits a narrow window.
    heading, *rows = zip(*table, strict=True)
    return document(
        "demo.html",
        style=page_style(),
        policy=_CONTENT_POLICY,
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
    """Draw the first accident: its countdown, and the moment a second before.

    At that moment, the pictures show the five agents, ego's cameras and ego's labels.
    """
    accident, before = _accident_and_before(release)
    ego = release.samples_of(before)[0]
    countdown = partial(
        release.render_accident, seconds=_COUNTDOWN, agents=("ego_vehicle", "infrastructure")
    )
    labels = partial(release.render_motion_labels, config=_LABEL_CONFIG)
    drawings: tuple[tuple[tuple[float, float], Callable[..., Any], RowArgument], ...] = (
        ((17.0, 8.6), countdown, accident),
        ((20.0, 6.5), release.render_frame, before),
        ((16.0, 5.5), release.render_sample, ego),
        ((11.0, 12.0), labels, ego),
    )
    for name, (size, render, record) in zip(PICTURES, drawings, strict=True):
        fig = render(record, fig=detached_figure(size))
        save_picture(fig, out / name, dpi=80)


def draw_model(release: DeepAccident, out: Path) -> bool:
    """Draw the predictions of the shipped model a second before the impact, beside the truth.

    One column shows the predictions from ego's LiDAR, the other from the LiDARs of all agents.
    Below is the road, and on top the pair at its true positions at each of the two moments.

    Returns:
        Whether PyTorch is installed; without it there is no picture.
    """
    picture_path = out / MODEL_PICTURE
    picture_path.unlink(missing_ok=True)  # of an earlier demo
    use_threads_sparingly()
    try:
        need_plugin("model", "the picture of a model")
        from deepaccident_devkit.plugins.model import PredictConfig, load_model, predictions

        model = load_model("tiny_lidar")
    except (MissingExtraError, MissingPluginError):
        return False
    accident, before = _accident_and_before(release)
    token = release.samples_of(before)[0]["token"]
    label = motion_labels(release, token, model.config.labels)
    road = release.load_bev(token)
    moments = ((0, before["index"]), (None, accident["num_frames"]))
    fig = detached_figure((11.0, 11.0))
    columns = fig.subplots(2, 2).T
    titles_by_agents = {"single": "ego alone", "all": "five agents"}
    for column, (agents, title) in zip(columns, titles_by_agents.items(), strict=True):
        [prediction] = predictions(model, release, [token], PredictConfig(agents=agents))
        for ax, (label_frame, index) in zip(column, moments, strict=True):
            draw_motion_outcome(prediction.motion, label, frame=label_frame, ax=ax)
            limits = (-_VIEW_RANGE_M, _VIEW_RANGE_M)
            ax.set(xlim=limits, ylim=limits, title=f"{title}: {ax.get_title()}")
            draw_underlay(road, ax, target_from_ego=SE3.identity(), view_range=_VIEW_RANGE_M)
            _draw_pair(release, accident, token, index, ax)
    save_picture(fig, picture_path, dpi=80)
    return True


def _draw_pair(
    release: DeepAccident, accident: ScenarioRecord, sample: str, index: int, ax: Any
) -> None:
    """Draw the true outlines of an accident's pair at a frame, with names.

    Args:
        release: The release.
        accident: Record of the scenario.
        sample: Token of the sample with the ego frame to draw in.
        index: Frame number.
        ax: Matplotlib axes.
    """
    scenario = accident["token"]
    collision = accident["collision"]
    pair_ids = collision["ids"] if collision else []
    boxes = scenario_tracks(release, scenario).at(index)
    boxes = boxes.select(np.isin(boxes.actor_id, pair_ids))
    boxes = boxes.transform(release.world_from(sample, "ego").inverse(), "ego")
    draw_boxes_from_above(boxes, ax, [COLLIDER_COLOR] * len(boxes), fill=0, linewidths=2)
    recorders = recorders_of(release, scenario)
    for (x, y, _), actor in zip(boxes.center.tolist(), boxes.actor_id.tolist(), strict=True):
        write_beside(ax, short_name(recorders[actor]), (x, y), COLLIDER_COLOR)


def _accident_and_before(release: DeepAccident) -> tuple[ScenarioRecord, FrameRecord]:
    """Return the first accident's scenario, and its frame a second before the impact."""
    accident = next(scenario for scenario in release.scenario if scenario["collision"])
    impact = release.getind("frame", accident["last_frame_token"])
    return accident, release.frame[impact - round(_SECONDS_BEFORE / FRAME_PERIOD)]


@contextmanager
def _step(bar: tqdm[Any], name: str) -> Iterator[None]:
    """Show a step on the bar, and move the bar to its end; a log gets a line at its beginning."""
    bar.set_description_str(name)
    number = [*_STEP_SECONDS].index(name) + 1
    if _is_log(bar):
        seconds = _STEP_SECONDS[name]
        click.echo(f"{number} of {len(_STEP_SECONDS)}: {name}, which takes some {seconds:.0f} s")
    end = sum(list(_STEP_SECONDS.values())[:number])
    yield
    bar.update(end - bar.n)


def _is_log(bar: tqdm[Any]) -> bool:
    """Return whether the output is no terminal, so that printed lines show the progress."""
    return bar.disable or not sys.stdout.isatty()


def _claim(out: Path) -> None:
    """Mark a folder as the demo's, before anything else is written.

    Raises:
        ConfigError: It contains something, and no demo of this version made it.
    """
    marker = out / _MARKER_FILE
    version = f"{__version__}\n".encode()
    if marker.is_file() and marker.read_bytes() == version:
        return
    remove_leftovers(out)  # of a demo that was killed before it had marked the folder
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(
            f"{out}: exists, and was not made by the demo of version {__version__}; "
            "name a folder that does not exist yet: deepaccident demo OTHER_FOLDER"
        )
    write_bytes(marker, version)


def _make_release(out: Path, workers: int | None, bar: tqdm[Any]) -> None:
    """Make the release unless it exists, and continue an interrupted one."""
    root = place_in(out, "release", opened=True)
    scenario_path = out / _SCENARIO_FILE
    if root.is_dir():
        return
    if not scenario_path.exists():
        write_bytes(scenario_path, SCENARIO.encode())
    recorded = 0.0

    def show_progress(share: float) -> None:
        nonlocal recorded
        previous = recorded
        recorded = recorded + share
        bar.update(share * _STEP_SECONDS["recording"])
        if _is_log(bar) and int(10 * recorded) > int(10 * previous):
            click.echo(f"  {100 * recorded:.0f} % recorded")

    config = replace(RELEASE, spec=scenario_path)
    make_release(root, config, workers=workers or 2, progress=show_progress)


def demo_table(release: DeepAccident) -> list[list[str]]:
    """Return a table of how well ego and five agents foresee crashes.

    Returns:
        A heading, and a line of text for each of the two.
    """
    tokens = _SELECTION.tokens(release)
    heading = [""]
    for _, names_by_heading in _TABLE_NUMBERS.values():
        heading += names_by_heading
    rows = [heading]
    for agents, row_name in _AGENT_SET_NAMES.items():
        baseline = Baseline(agents=agents, horizon=_SELECTION.horizon)
        row = [row_name]
        with TemporaryDirectory() as folder:
            for task, (protocol, names_by_heading) in _TABLE_NUMBERS.items():
                path = predict_results(
                    release, task, tokens, Path(folder) / task, baseline, workers=1
                )
                setup = EvaluationSetup(task=task, protocol=protocol, horizon=_SELECTION.horizon)
                run = evaluate_results(release, path, setup, _SELECTION, workers=1)
                numbers = {number.name: number for number in headlines(run.result)}
                for name in names_by_heading.values():
                    row.append(numbers[name].text().removesuffix(" %"))
        rows.append(row)
    return rows


def _evaluate(release: DeepAccident, out: Path) -> None:
    """Evaluate the baseline of a single vehicle, and write a report and a bundle."""
    path = out / _RESULTS_FILE
    path.unlink(missing_ok=True)  # of an earlier demo
    baseline = Baseline(agents="single", horizon=_SELECTION.horizon)
    tokens = _SELECTION.tokens(release)
    results = read_results(predict_results(release, "accident", tokens, path, baseline, workers=1))
    setup = EvaluationSetup(task="accident", protocol="boxes", horizon=_SELECTION.horizon)
    run = evaluate_results(release, results, setup, _SELECTION, workers=1).broken_down()
    folder = place_in(out, REPORT_FOLDER, opened=True)
    save_report(run, folder, dataset=release, results=results)
    bundle = place_in(folder, _RUN_NAME, opened=True)
    save_run(run, bundle, include_results=True, overwrite=True)


def _next_steps(out: Path) -> tuple[NextStep, ...]:
    """Return the suggestions for what to try next, with the paths of the demo's folder."""
    names = (
        "release",
        "five_agents",
        "own",
        _SCENARIO_FILE,
        f"{REPORT_FOLDER}/{_RUN_NAME}",
        "five_agents/evaluation",
    )
    paths = [shlex.quote(str(out / name)) for name in names]
    root, five, own, scenario, bundle, evaluation = paths
    selection = (
        f"--split {_SELECTION.split} --scope {_SELECTION.scope} --horizon {_SELECTION.horizon:g}"
    )
    return (
        NextStep("See what the release holds:", f"deepaccident info {root} --where collision=true"),
        NextStep(
            "See in your browser which predictions were right; this needs the extra: "
            "pip install '.[explore]'",
            f"deepaccident explore {root} --results {bundle}",
        ),
        NextStep(
            "Check its files, as you would check your download:",
            f"deepaccident validate {root} --deep",
        ),
        NextStep(
            "Let five agents predict together:",
            f"deepaccident predict constant_velocity {root} {selection} --task accident "
            f"--agents all --out {five}",
        ),
        NextStep(
            "Evaluate that, and compare it with the report:",
            f"deepaccident evaluate accident {root} --results {five}/accident.json {selection} "
            f"--protocol boxes --agents ego_vehicle --allow-partial --out {evaluation} "
            f"&& deepaccident evaluate compare {bundle} {evaluation}",
        ),
        NextStep(
            "Edit the scenario file of the accident, such as its weather, and see what happens "
            "in it:",
            f"deepaccident synth {own} --design {scenario} --scenarios 2 --sensors none",
        ),
    )
