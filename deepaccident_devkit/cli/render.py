"""`deepaccident render`: images and videos of a release; each view is a subcommand."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

import click

from deepaccident_devkit.cli.agents import (
    cooperating_parameter,
    link_parameters,
    names_or_configuration,
)
from deepaccident_devkit.cli.options import (
    PATH,
    frame_range_parameter,
    no_title_option,
    open_release,
    pixel_size,
    refuse_unused,
    release_parameters,
    seed_parameter,
    split_words,
)
from deepaccident_devkit.cli.render_targets import picture_paths, rows_to_draw
from deepaccident_devkit.cli.verbs import Verb, WordChoice, advanced, together, verb
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.results import Results, read_results
from deepaccident_devkit.evaluation.runs.setups import scenario_of
from deepaccident_devkit.render.accident import COUNTDOWN, render_accident
from deepaccident_devkit.render.actors import render_annotation, render_instance
from deepaccident_devkit.render.bev import render_bev
from deepaccident_devkit.render.camera import (
    ColorBy,
    render_pointcloud_in_image,
    render_sample_data,
)
from deepaccident_devkit.render.captions import missing_words
from deepaccident_devkit.render.figures import (
    LAYERS,
    PICTURE_SUFFIXES,
    Layer,
    figure_of_pixels,
    save_picture,
)
from deepaccident_devkit.render.link import render_link
from deepaccident_devkit.render.motion import MotionStyle, render_motion_labels
from deepaccident_devkit.render.outcomes import render_evaluation
from deepaccident_devkit.render.outcomes.results_grid import (
    PICKED_SAMPLES,
    Pick,
    named_results,
    pick_samples,
    render_results,
    shared_samples,
)
from deepaccident_devkit.render.replay import render_replay
from deepaccident_devkit.render.samples import render_calibration, render_frame, render_sample
from deepaccident_devkit.render.styles import current_style, style
from deepaccident_devkit.render.teaser import TEASER_SECONDS, render_teaser
from deepaccident_devkit.render.video import SUFFIXES, VIEWS, check_target, render_scenario_video
from deepaccident_devkit.render.visibility import render_visibility, render_visibility_matrix
from deepaccident_devkit.support.text import size_text
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, LIDAR, Frame, StyleName
from deepaccident_devkit.v2x import Link
from deepaccident_devkit.v2x.collisions import default_scenario

_RELEASE_OPTIONS = ("dataroot", "version", "index_dir", "workers", "executor", "on_error")
_VISIBILITY_STYLES = ("map", "table")
_FRONT_AND_POINTS = (CAMERAS[0], LIDAR)
_logger = logging.getLogger(__name__)
_OUT_HELP = f"File to write ({', '.join(PICTURE_SUFFIXES)}), or a folder for several pictures."


def _with_link(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap `draw` so that it takes --latency, --pose-noise and --seed instead of `link`."""

    def draw_with_link(
        dataset: Dataset,
        token: str,
        *,
        latency: float,
        pose_noise: float,
        seed: int,
        **choices: Any,
    ) -> Any:
        # noise with a mean of 0 m would still have a spread
        link = Link(latency=latency, pose_noise=pose_noise or None, seed=seed)
        return draw(dataset, token, link=link, **choices)

    return draw_with_link


def _draw_evaluation(
    dataset: Dataset, tokens: str | Sequence[str], *, results: Mapping[str, Results], **choices: Any
) -> Any:
    """Draw one sample of one results file, or a list of samples of all of them."""
    if not isinstance(tokens, str):
        return render_results(dataset, tokens, results, **choices)
    (predictions,) = results.values()
    prediction: Any = predictions.prediction(tokens)
    task = choices.pop("task", None) or predictions.task
    return render_evaluation(dataset, tokens, prediction, task=task, **choices)


def _parse_named_paths(
    _context: click.Context, _parameter: click.Parameter, values: tuple[str, ...]
) -> tuple[tuple[str, Path], ...]:
    """Parse PATH or NAME=PATH; an existing path may contain an equals sign."""
    named_paths = []
    for value in values:
        name, separator, path = value.partition("=")
        if not separator or Path(value).exists():
            name, path = "", value
        named_paths.append((name, Path(path)))
    return tuple(named_paths)


def _read_named(named_paths: Sequence[tuple[str, Path]], task: str | None) -> dict[str, Results]:
    """Open results files by the names of their models."""
    opened = [(name, read_results(path)) for name, path in named_paths]
    return named_results(opened, task)


def _open_with_results(
    choices: NamedValues, tokens: Sequence[str], release: ReadOnlyValues
) -> tuple[Dataset, Sequence[str]]:
    """Open the results among the options of a view, then the release; choose the samples."""
    pick = choices.pop("pick", None)
    if pick is not None and tokens:
        raise click.UsageError("--pick chooses the samples; leave out their names, or --pick")
    if "results" in choices:
        choices["results"] = _read_named(choices["results"], choices.get("task"))
        tokens = tokens or shared_samples(choices["results"])[:1]
    dataset = open_release(**release)
    if pick is not None:
        rules = {name: choices.get(name) for name in ("task", "protocol")}
        tokens = pick_samples(dataset, choices["results"], pick, release["workers"], **rules)
    return dataset, tokens


def _draw_sensor_file(
    dataset: Dataset, token: str, *, color_by: ColorBy | None = None, **choices: Any
) -> Any:
    """Draw a sensor's data; with `color_by`, draw the LiDAR points onto the camera's image."""
    if color_by is None:
        return render_sample_data(dataset, token, **choices)
    refuse_unused("with --color-by, which shows the image and all points", "layers")
    return render_pointcloud_in_image(dataset, token, color_by=color_by, **choices)


def _draw_visibility(
    dataset: Dataset, token: str, *, style: str = _VISIBILITY_STYLES[0], **choices: Any
) -> Any:
    """Draw which agents see which actors, as a top view or as a table."""
    if style == _VISIBILITY_STYLES[0]:
        return render_visibility(dataset, token, **choices)
    refuse_unused(f"with --style {style}", "frame", "view_range", "layers")
    return render_visibility_matrix(dataset, token, **choices)


def _parse_seconds(
    context: click.Context, parameter: click.Parameter, value: str | None
) -> list[float] | None:
    if value is None:
        return None
    try:
        return list(map(float, value.split(",")))
    except ValueError:
        raise click.BadParameter(
            f"expected seconds, such as 2,1,0, found {value!r}", context, parameter
        ) from None


def _seconds_option(default: Sequence[float]) -> Any:
    return click.option(
        "--seconds",
        callback=_parse_seconds,
        help="Moments to show, in seconds before the impact.  "
        f"[default: {','.join(f'{second:g}' for second in default)}]",
        metavar="S[,S…]",
    )


_AGENTS = cooperating_parameter("Agents to show", "chosen by the view")
_VIEW_RANGE = click.option(
    "--view-range", type=float, metavar="M", help="Metres to show in each direction."
)
_COORDINATES = advanced(
    "--frame",
    type=WordChoice(get_args(Frame)),
    help="Coordinate frame of the axes.  [default: ego]",
)
_BY_CLASS = click.option(
    "--color-by", type=WordChoice(("class",)), help="Colour boxes by their class."
)
_LAYERS = click.option(
    "--layers",
    multiple=True,
    metavar="NAME[,NAME…]",
    help=f"Draw only these layers. Each view has some of {', '.join(LAYERS)}.",
)
_NO_TITLE = no_title_option()
_RESULTS_TASK = click.option(
    "--task",
    metavar="TASK",
    help="Task that draws the results, also of a plug-in, such as warning for accidents.  "
    "[default: the kind of the results]",
)
# Options for views that show several agents.
_AGENT_OPTIONS = (_AGENTS, _BY_CLASS, _LAYERS)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Picture:
    """A view that is drawn as an image.

    Attributes:
        draw: Function of the render package, or one that calls it.
        table: Table whose rows it draws.
        canvas: `fig` if it draws into a figure, `ax` if it draws into axes.
        options: Options that only this subcommand has.
        help: First line of the subcommand's help.
        default: Row that is drawn if no token is passed.
        styles: Styles of this view; the first is the default.
        channels: Channels that it shows; in a partial download, the agent that is drawn for a
            scenario is the one with the most files of these channels.
    """

    draw: Callable[..., Any]
    table: str
    help: str
    canvas: str = "fig"
    options: tuple[Any, ...] = (_BY_CLASS, _LAYERS)
    default: str = "the first accident, or if there is none, the first scenario"
    styles: tuple[str, ...] = ()
    channels: tuple[str, ...] = (*CAMERAS, LIDAR)

    def figure(
        self,
        dataset: Dataset,
        row: str | Sequence[str],
        size: tuple[int, int] | None,
        dpi: float,
        choices: NamedValues,
    ) -> Any:
        """Draw a row, or several side by side, into a figure.

        The figure has `size` in pixels, or the view's default size.
        """
        if size is None:
            return self.draw(dataset, row, **choices)
        canvas: Any = figure_of_pixels(*size, dpi=dpi)
        if self.canvas == "ax":
            canvas = canvas.add_subplot()
        return self.draw(dataset, row, **choices, **{self.canvas: canvas})


_PICTURES = {
    "sample": _Picture(
        draw=render_sample,
        table="sample",
        help="Render one sample: its six camera images, and its boxes and LiDAR points from above.",
        options=_AGENT_OPTIONS,
    ),
    "sample-data": _Picture(
        draw=_draw_sensor_file,
        table="sample_data",
        help="Render what one sensor recorded: a camera image, or the LiDAR or the BEV camera "
        "from above.",
        canvas="ax",
        options=(
            click.option(
                "--color-by",
                type=WordChoice((*get_args(ColorBy), "class")),
                help="Colour all LiDAR points on a camera image by this value, including points "
                "hidden behind objects. class: colour boxes by their class.",
            ),
            _LAYERS,
        ),
    ),
    "annotation": _Picture(
        draw=render_annotation,
        table="annotation",
        help="Render one box: in the camera that shows it largest, from above, and described in "
        "words.",
    ),
    "instance": _Picture(
        draw=render_instance,
        table="instance",
        help="Render one actor over time: its path, its camera images, its speed, and which "
        "agents see it.",
        options=_AGENT_OPTIONS,
    ),
    "frame": _Picture(
        draw=render_frame,
        table="frame",
        help="Render one moment of all agents side by side: front cameras, and boxes and LiDAR "
        "from above.",
        options=_AGENT_OPTIONS,
        channels=_FRONT_AND_POINTS,
    ),
    "bev": _Picture(
        draw=_with_link(render_bev),
        table="sample",
        canvas="ax",
        channels=(LIDAR, BEV_CAMERA),
        options=(
            _AGENTS,
            _VIEW_RANGE,
            _COORDINATES,
            advanced(
                "--sweeps",
                type=click.IntRange(min=1),
                help="Number of frames of LiDAR points.  [default: 1]",
            ),
            link_parameters(),
            seed_parameter,
            _BY_CLASS,
            _LAYERS,
        ),
        help="Render one moment from above: boxes, LiDAR points and other layers, of one or "
        "several agents.",
    ),
    "labels": _Picture(
        draw=render_motion_labels,
        table="sample",
        help="Render the motion labels of one sample: one column per frame; instances, "
        "centerness, offset and flow.",
        options=(_LAYERS,),
        styles=get_args(MotionStyle),
        channels=(),
    ),
    "visibility": _Picture(
        draw=_draw_visibility,
        table="frame",
        help="Render who sees whom: from above, with one dot per actor for each agent that sees "
        "it, or as a table.",
        canvas="ax",
        styles=_VISIBILITY_STYLES,
        channels=(),
        options=(_AGENTS, _COORDINATES, _VIEW_RANGE, _BY_CLASS, _LAYERS),
    ),
    "accident": _Picture(
        draw=render_accident,
        default="the first accident",
        table="scenario",
        help="Render the countdown to an accident: one column per moment, one row per agent. "
        "Where space is limited, as on a slide, it shows only the agents that see the pair "
        "best; --agents all shows all agents.",
        options=(
            _AGENTS,
            _seconds_option(COUNTDOWN),
            _LAYERS,
        ),
    ),
    "teaser": _Picture(
        draw=render_teaser,
        default="the first accident",
        table="scenario",
        help="Render an accident as one wide figure: moments of the best camera, the "
        "infrastructure's view, all paths on a map, and since when each agent has seen the pair.",
        options=(_AGENTS, _seconds_option(TEASER_SECONDS), _LAYERS),
    ),
    "evaluation": _Picture(
        draw=_draw_evaluation,
        table="sample",
        options=(
            click.option(
                "--results",
                multiple=True,
                required=True,
                callback=_parse_named_paths,
                metavar="[NAME=]PATH",
                help="Results file of a model. Several give one picture with the label and the "
                "models in rows, and samples in columns.  [default name: the method in its notes]",
            ),
            click.option(
                "--pick",
                type=WordChoice(get_args(Pick)),
                help="Samples to show side by side: those with the worst or best score of the "
                f"first model, or where the first two differ most; {PICKED_SAMPLES} at most, from "
                "different scenarios.",
            ),
            click.option(
                "--task",
                metavar="TASK",
                help="Task that judges the predictions, also of a plug-in, such as accident or "
                "warning for predicted motion.  [default: the kind of the results]",
            ),
            click.option(
                "--protocol",
                help="Name of the protocol.  [default: released; for explicit accidents: boxes; "
                "for other tasks: their first]",
            ),
            _LAYERS,
        ),
        help="Render the label of a sample next to a model's prediction, with the verdict in "
        "numbers.",
        default="the first sample of the results",
    ),
    "link": _Picture(
        draw=_with_link(render_link),
        table="sample",
        channels=(LIDAR,),
        options=(_AGENTS, _VIEW_RANGE, link_parameters(0.2, 0.3), seed_parameter, _LAYERS),
        help="Render how latency and pose noise change the data that partners share with the "
        "sample's agent.",
    ),
    "calibration": _Picture(
        draw=render_calibration,
        table="frame",
        help="Render LiDAR points and boxes of all agents in camera images, to check the "
        "calibration.",
        options=_AGENT_OPTIONS,
        channels=_FRONT_AND_POINTS,
    ),
}


@click.group()
def render() -> None:
    """Render pictures of a release, one command per view.

    `video` and `replay` show a whole scenario.
    """


def _format_help(picture: _Picture) -> str:
    text = f"{picture.help}\n\nTOKEN is a row of the table {picture.table}."
    if picture.table not in ("scenario", "instance"):
        text += (
            " A scenario's token stands for the moment two seconds before its end; in a partial "
            "download, for the moment with the most sensor files up to then."
        )
    return f"{text} Without TOKEN the command renders {picture.default}."


def _format_style_help(picture: _Picture) -> str:
    text = "Style of the figure."
    if picture.styles:
        text = f"{' or '.join(picture.styles)}  [default: {picture.styles[0]}], and a figure style."
    return (
        f"{text} cvpr-…, ieee-…: as wide as a column or page of the paper, with small text, few "
        "panels and no token. paper: one panel per column, several panels over a page (IEEE). "
        "slide: 16:9, with large text."
    )


def _make_verb(name: str, picture: _Picture) -> click.Command:
    """Build the subcommand that draws a view."""

    @verb(name, help=_format_help(picture), short_help=picture.help)
    @release_parameters
    @click.argument("tokens", nargs=-1, metavar="[TOKEN…]")
    @click.option("--out", type=PATH, required=True, metavar="FILE|FOLDER", help=_OUT_HELP)
    @click.option(
        "--size",
        callback=pixel_size,
        metavar="WxH",
        help="Size in pixels.  [default: chosen by the view]",
    )
    @advanced(
        "--dpi",
        type=click.FloatRange(min=1),
        help="Pixels per inch; text scales with it.  [default: 100; papers: 300; slide: 240]",
    )
    @click.option(
        "--style",
        "styles",
        multiple=True,
        type=WordChoice((*picture.styles, *get_args(StyleName))),
        help=_format_style_help(picture),
    )
    @_NO_TITLE
    @frame_range_parameter
    @together(*picture.options)
    def render_view(
        tokens: tuple[str, ...],
        out: Path,
        size: tuple[int, int] | None,
        dpi: float | None,
        styles: tuple[str, ...],
        no_title: bool,
        frames: range | None,
        **options: Any,
    ) -> None:
        release = {option: options.pop(option) for option in _RELEASE_OPTIONS}
        options["agents"] = names_or_configuration(options.pop("agents", ()))
        if name == "bev" and options["agents"] in (None, "single"):
            refuse_unused(
                "without --agents, as it changes only the data of partners",
                "latency",
                "pose_noise",
                "seed",
            )
        if not options.get("pose_noise"):
            refuse_unused("without --pose-noise", "seed")
        options["layers"] = split_words(options.pop("layers", ())) or None
        choices = {option: value for option, value in options.items() if value is not None}
        side_by_side = "pick" in choices or len(choices.get("results", ())) > 1
        dataset, shown_tokens = _open_with_results(choices, tokens, release)
        rows = rows_to_draw(dataset, picture.table, shown_tokens, frames, picture.channels)
        figure_style: Any = None
        for word in styles:
            if word in picture.styles:
                choices["style"] = word
            else:
                figure_style = word
        box_colors: Any = "role"
        if choices.get("color_by") == "class":  # only the other values are passed to the view
            box_colors = choices.pop("color_by")
        with style(figure_style, title=not no_title, color_by=box_colors):
            shown_rows: list[Any] = [rows] if side_by_side else rows
            paths = picture_paths(out, name, rows[:1] if side_by_side else rows)
            for row, path in zip(shown_rows, paths, strict=True):
                figure = picture.figure(dataset, row, size, dpi or current_style().dpi, choices)
                save_picture(figure, path, dpi=dpi)
                missing = missing_words(figure)
                if missing:
                    _logger.warning("%s: %s", path, "; ".join(missing))
                click.echo(f"wrote {path} ({', '.join(rows) if side_by_side else row})")

    return render_view


for _name, _picture in _PICTURES.items():
    render.add_command(_make_verb(_name, _picture))


@render.command(cls=Verb, short_help="Write a scenario as a video of one or several views.")
@release_parameters
@click.argument("scenario", required=False)
@click.option(
    "--out",
    type=PATH,
    required=True,
    metavar="FILE",
    help=f"File to write ({', '.join(SUFFIXES)}).",
)
@click.option(
    "--what",
    "views",
    multiple=True,
    metavar="VIEW[,VIEW…]",
    help=f"Views to show side by side: {', '.join(VIEWS)}.  [default: frame; with --beside: bev]",
)
@click.option(
    "--turntable",
    is_flag=True,
    help="Show the points of all agents in three dimensions, from a camera that goes around them; "
    "the same as the view turntable.",
)
@click.option(
    "--beside",
    multiple=True,
    callback=_parse_named_paths,
    metavar="twin|[NAME=]PATH",
    help="twin: show an accident and its normal twin side by side, with one clock, verdicts and "
    "the pair's time to collision. A results file: show its predictions beside the recording; "
    "two files: two models side by side.",
)
@_RESULTS_TASK
@_AGENTS
@_LAYERS
@frame_range_parameter
@click.option(
    "--size",
    callback=pixel_size,
    metavar="WxH",
    default="1280x720",
    show_default=True,
    help="Size in pixels; rounded down to even numbers for MP4.",
)
@_NO_TITLE
@click.option(
    "--fps", default=10.0, show_default=True, help="Frames per second; the recordings have 10."
)
def video(
    scenario: str | None,
    out: Path,
    views: tuple[str, ...],
    agents: tuple[str, ...],
    layers: tuple[str, ...],
    no_title: bool,
    beside: tuple[tuple[str, Path], ...],
    **options: Any,
) -> None:
    """Write one scenario of the release in DATAROOT as a video.

    Without SCENARIO the command takes the first scenario that the results predict; without results
    the first accident, or if there is none, the first scenario.
    MP4 needs the extra `video`: pip install '.[video]' in a checkout.
    """
    release = {option: options.pop(option) for option in _RELEASE_OPTIONS}
    check_target(out, size=options["size"], fps=options["fps"])  # before the release is indexed
    if options.pop("turntable"):
        views = (*views, "turntable")
    sides: Any = "twin"
    if beside != (("", Path("twin")),):
        sides = _read_named(beside, options["task"]) or None
        scenario = scenario or (sides and scenario_of(shared_samples(sides)[0]))
    if not isinstance(sides, dict):
        refuse_unused("without a results file for --beside", "task")
    elif len(sides) > 1:
        refuse_unused("with two models, which are shown from above", "views", "layers")
    dataset = open_release(**release)
    click.get_current_context().with_resource(style(title=not no_title))
    path = render_scenario_video(
        dataset,
        scenario or default_scenario(dataset),
        out,
        views=split_words(views) or ("bev" if sides else "frame"),
        beside=sides,
        agents=names_or_configuration(agents),
        layers=cast(list[Layer] | None, split_words(layers) or None),
        workers=release["workers"],
        executor=release["executor"],
        **options,
    )
    click.echo(f"wrote {path} ({size_text(path.stat().st_size)})")


@render.command(cls=Verb, short_help="Write a scenario as one HTML file that plays.")
@release_parameters
@click.argument("scenario", required=False)
@click.option(
    "--out",
    required=True,
    type=click.Path(),
    metavar="FILE",
    help="File to write, such as replay.html.",
)
@click.option(
    "--results",
    type=click.Path(),
    help="Results file to show, with its verdicts.",
)
@_RESULTS_TASK
@cooperating_parameter("Agents to show", "available")
def replay(
    scenario: str | None,
    out: str,
    results: str | None,
    task: str | None,
    agents: tuple[str, ...],
    **release: Any,
) -> None:
    """Write one scenario of the release in DATAROOT as one HTML file that plays in any browser.

    It needs no network. Without SCENARIO the command takes the first accident, or if there is none,
    the first scenario. The file has at most 15 MB.
    """
    prediction = None if results is None else read_results(results)  # before the release is indexed
    dataset = open_release(**release)
    path = render_replay(
        dataset,
        scenario,
        out,
        prediction=prediction,
        task=task,
        agents=names_or_configuration(agents),
        progress=True,
    )
    click.echo(f"wrote {path} ({size_text(path.stat().st_size)}); open it in a browser")
