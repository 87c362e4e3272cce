"""Pictures of the pages that no command makes: the colour key, the designs, the sketch of a
junction, the labels.

`python docs/make_pictures.py` renders them.
"""

import tempfile
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from benchmarks.pages.labels import ACTORS, CLEAN, COLLIDING, RELEASE, RELEASED, STEP, turn
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.plugins.nuscenes import open_nuscenes
from deepaccident_devkit.plugins.nuscenes.sensor_setup_figures import sensor_setups_figure
from deepaccident_devkit.plugins.nuscenes.sensor_setups import sensor_setup_report
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.plan import RigName
from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD
from deepaccident_devkit.plugins.synth.spec import DESIGN_NUMBERS, read_design
from deepaccident_devkit.plugins.synth.traffic.driving import middle_of, road_crossing
from deepaccident_devkit.render import detached_figure, draw_motion_map, styles
from deepaccident_devkit.render.boxes import draw_boxes_from_above
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.figures import save_picture, write_figure
from deepaccident_devkit.render.motion_maps import direction_colors
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, short_name
from deepaccident_devkit.v2x import Contact

SIZES = {
    "car": (4.6, 2.0),
    "truck": (8.0, 2.6),
    "van": (5.4, 2.2),
    "cyclist": (1.8, 0.7),
    "motorcycle": (2.2, 0.9),
    "pedestrian": (0.6, 0.6),
}
"""Metres."""
KEY_STEP, KEY_ROW = 15.0, 7.0
"""Metres from one column of the key to the next, and from row to row."""
SEEDS = {1: 1, 2: 7, 3: 7, 4: 5, 5: 3, 6: 4, 7: 6, 8: 11, 9: 12, 10: 3, 11: 7, 12: 2}
"""Of a draw of each design in the daytime."""
DESIGN_FRAMES = 25
RIGS: tuple[RigName, ...] = ("released", "road")
BOTH = SynthConfig(
    scenarios=2, frames=31, image_size=(480, 270), sensor_step=5, seed=4, designed=True
)
"""Shown as it is, and as nuScenes: from its first frame to its last, each fifth one has images."""
FRAMES_BEFORE = 7
"""Of the impact, when the pictures are taken."""
COLUMNS = 4
AROUND_EGO = 26.0
"""Metres shown to each side of the ego."""
SPEC = RoadSpec(lanes=2)
AROUND = 50.0
"""Metres shown to each side of the junction's middle."""
START, PARKED, STEP_OUT = 40.0, 33.5, 27.0
"""Distances to the junction's middle that are shown: of ego, of parked vehicles, of a pedestrian;
metres.
"""
ROAD, STRIP, LINE = "0.82", "0.9", "white"
SHOWN = {"xlim": (-6, 40), "ylim": (-15, 13)}
"""Metres, of the pictures of the turn."""


def render_all(images: Path) -> None:
    """Render all of them into a folder."""
    save_picture(draw_key(detached_figure((9, 3.0))), images / "colour_key.png", dpi=120)
    save_picture(draw_sketch(), images / "scenario_sketch.png", dpi=100)
    save_picture(draw_designs(), images / "designs.jpg", dpi=100)
    with tempfile.TemporaryDirectory() as folder:
        release = DeepAccident(
            dataroot=make_release(Path(folder) / "release", RELEASE), verbose=False
        )
        draw_labels(release, images / "motion_labels.png")
        draw_rigs(Path(folder), images / "rigs.webp")
        if (
            find_spec("nuscenes") is not None
        ):  # which has an environment of its own (docs/nuscenes.md)
            draw_both_sources(Path(folder), images / "road.webp")
    draw_turn("instance", range(5), images / "labels_released_clean.png")
    draw_turn("flow", range(4), images / "labels_released_clean_flow.png")
    draw_half_cell(images / "labels_half_cell.png")


def draw_key(fig: Figure) -> Figure:
    """A row for each rule of the grammar, and the colour maps to their right."""
    parts = fig.subplot_mosaic(
        [["rows", "depth"], ["rows", "height"], ["rows", "flow"]], width_ratios=(5.2, 1)
    )
    rows = parts["rows"]
    rows.set(xlim=(-22, 6 * KEY_STEP - 4), ylim=(-4.3 * KEY_ROW, 0.6 * KEY_ROW), aspect="equal")
    rows.set_axis_off()
    vehicles = [agent for agent in AGENTS if agent != "infrastructure"]
    hues = [styles.AGENT_COLORS[agent] for agent in vehicles]
    draw_row(
        rows,
        0,
        "agents",
        [(short_name(agent), "car", hue) for agent, hue in zip(vehicles, hues, strict=True)],
    )
    place = (len(vehicles) * KEY_STEP, 0.0)
    rows.plot(*place, "o", color=styles.AGENT_COLORS["infrastructure"], markersize=9)
    write(rows, "infrastructure", *place)
    red = styles.COLLIDER_COLOR
    draw_row(
        rows, 1, "colliding pair", [("a car", "car", red), ("a pedestrian", "pedestrian", red)]
    )
    draw_row(
        rows, 2, "other actors", [(name, name, styles.CATEGORY_COLORS[name]) for name in SIZES]
    )
    draw_patches(
        rows, 3, "predictions", {**styles.OUTCOME_COLORS, "no verdict": styles.PREDICTED_COLOR}
    )
    draw_patches(
        rows,
        4,
        "charts",
        dict(zip(("first", "second", "third", "fourth"), styles.SERIES_COLORS, strict=True)),
    )
    for name, colormap in (("depth", styles.DEPTH_COLORMAP), ("height", styles.HEIGHT_COLORMAP)):
        parts[name].imshow(
            np.linspace(0, 1, 256)[None], cmap=colormap, aspect="auto", extent=(0, 1, 0, 1)
        )
        parts[name].set(xticks=(0, 1), yticks=(), box_aspect=0.16)
        parts[name].set_xticks(
            (0, 1), ("near", "far") if name == "depth" else ("low", "high"), fontsize=8
        )
        parts[name].set_title(f"points by {name}", fontsize=8)
    draw_wheel(parts["flow"])
    return fig


def draw_row(ax: Axes, row: int, title: str, entries: list[tuple[str, str, str]]) -> None:
    """Boxes of one rule: their words, classes and colours."""
    ax.text(-22, -row * KEY_ROW, title, va="center", fontsize=9, fontweight="bold")
    names = [name for _, name, _ in entries]
    center = [(number * KEY_STEP, -row * KEY_ROW, 0.0) for number in range(len(entries))]
    boxes = Boxes.from_arrays(
        center,
        [(*SIZES[name], 1.5) for name in names],
        [0.0] * len(names),
        frame="ego",
        category=names,
    )
    draw_boxes_from_above(boxes, ax, [color for _, _, color in entries])
    for (words, _, _), (x, y, _) in zip(entries, center, strict=True):
        write(ax, words, x, y)


def draw_patches(ax: Axes, row: int, title: str, meanings: dict[str, str]) -> None:
    """Filled rectangles of one rule."""
    ax.text(-22, -row * KEY_ROW, title, va="center", fontsize=9, fontweight="bold")
    for number, (words, color) in enumerate(meanings.items()):
        x, y = number * KEY_STEP, -row * KEY_ROW
        ax.fill([x - 2.3, x + 2.3, x + 2.3, x - 2.3], [y - 1, y - 1, y + 1, y + 1], color=color)
        write(ax, words, x, y)


def write(ax: Axes, words: str, x: float, y: float) -> None:
    ax.annotate(
        words, (x, y), (0, -10), textcoords="offset points", ha="center", va="top", fontsize=8
    )


def draw_wheel(ax: Axes) -> None:
    """The colours of directions."""
    left, along = np.mgrid[-1:1:101j, -1:1:101j]
    inside = (np.hypot(left, along) <= 1)[..., None]
    ax.imshow(
        np.where(inside, direction_colors(left, along, longest=1.0), 1.0),
        origin="lower",
        extent=(-1, 1, -1, 1),
    )
    ax.set_axis_off()
    ax.set_title("flow: forward to the right", fontsize=8)


def draw_designs() -> Figure:
    """A contact sheet of the paper's twelve designs, of synthetic accidents."""
    rows = len(DESIGN_NUMBERS) // COLUMNS
    fig = detached_figure((16, 6.9 * rows))
    axes = fig.subplots(2 * rows, COLUMNS, height_ratios=[1, 9 / 16] * rows)
    for place, number in enumerate(DESIGN_NUMBERS):
        row, column = divmod(place, COLUMNS)
        with tempfile.TemporaryDirectory() as folder:
            release = DeepAccident(dataroot=make_design(number, Path(folder) / "release"))
            draw_design(release, axes[2 * row, column], axes[2 * row + 1, column])
        axes[2 * row, column].set_title(title_of(number), fontsize=13)
    return fig


def make_design(number: int, folder: Path) -> Path:
    """A release of one accident of a design."""
    config = SynthConfig(
        scenarios=1,
        frames=DESIGN_FRAMES,
        image_size=(640, 360),
        designs=(number,),
        seed=SEEDS[number],
        unplanned=0,
        designed=True,
    )
    return make_release(folder, config, progress=True)


def title_of(number: int) -> str:
    name = read_design(number).name.partition(",")[0]
    junction = "three-way" if "three-way" in read_design(number).name else "four-way"
    lights = "signalised" if number <= len(DESIGN_NUMBERS) // 2 else "unsignalised"
    return f"{number}  {name},\n{junction}, {lights}"


def draw_design(release: DeepAccident, above: Axes, image: Axes) -> None:
    """From above with the paths of those who collide, the impact a cross; and the camera that shows
    both best.
    """
    token = release.scenario[0]["token"]
    contact = release.collision(token)
    if contact is None:
        raise SystemExit(f"{token}: nobody collides in it; choose another seed")
    frame = release.field2token("frame", "scenario_token", token)[-1 - FRAMES_BEFORE]
    samples = [sample["token"] for sample in release.samples_of(frame)]
    release.render_bev(
        samples[0], agents="all", view_range=AROUND_EGO, layers=("bev", "boxes"), ax=above
    )
    draw_meeting(release, samples[0], contact, above)
    boxes = release.cooperative_boxes(samples[0], agents="all", frame="world")
    witnesses = [
        sample for sample in samples if "behind" not in sample
    ]  # followers see one of the two hide the other
    view = best_view(release, witnesses, boxes.select(np.isin(boxes.actor_id, contact.actor_ids)))
    camera = f"{samples[0]}/Camera_Front" if view is None else view.camera
    release.render_sample_data(camera, layers=("image",), ax=image)
    for ax in (above, image):
        ax.set(title="", xlabel="", ylabel="", xticks=[], yticks=[])
        if (legend := ax.get_legend()) is not None:
            legend.remove()


def draw_meeting(release: DeepAccident, ego: str, contact: Contact, ax: Axes) -> None:
    """The ways of ego and other in their hues and a red cross where they meet, in the ego frame of
    a sample (token).
    """
    own = release.get("agent", ego.rsplit("/", 1)[0])["actor_id"]
    for instance, actor in zip(contact.instances, contact.actor_ids, strict=True):
        color = AGENT_COLORS["ego_vehicle" if actor == own else "other_vehicle"]
        way = release.trajectory(instance, ego, "ego").center
        ax.plot(way[:, 0], way[:, 1], color=color, linewidth=4, zorder=4)
    x, y, _ = release.world_from(ego, "ego").inverse().apply(contact.point[None])[0]
    ax.plot(x, y, "x", color=COLLIDER_COLOR, markersize=16, markeredgewidth=4, zorder=6)


def draw_sketch() -> Figure:
    """The sketch of a junction: arms, lanes, sides and distances, as scenario files name them."""
    fig = detached_figure((8, 8))
    ax = fig.subplots()
    render_roads(ax)
    render_lanes(ax)
    render_distances(ax)
    render_sides(ax)
    ax.set(xlim=(-AROUND, AROUND), ylim=(-AROUND, AROUND), xticks=[], yticks=[], aspect="equal")
    return fig


def render_roads(ax: Axes) -> None:
    """The two roads with their parking strips, stop lines and names."""
    for half, color in ((SPEC.road_edge, STRIP), (SPEC.lanes_edge, ROAD)):
        for corner, width, height in (
            ((-AROUND, -half), 2 * AROUND, 2 * half),
            ((-half, -AROUND), 2 * half, 2 * AROUND),
        ):
            ax.add_patch(Rectangle(corner, width, height, color=color, linewidth=0))
    near, edge = SPEC.stop_line[0], SPEC.lanes_edge
    for arm, (x, y) in OUTWARD.items():
        out, left = np.array([x, y]), np.array([-y, x])
        for across, style in ((0.0, "-"), (edge / 2, "--"), (-edge / 2, "--")):
            ends = np.stack([near * out + across * left, AROUND * out + across * left])
            ax.plot(*ends.T, style, color=LINE, linewidth=2)
        ax.plot(*np.stack([near * out, near * out + edge * left]).T, color=LINE, linewidth=5)
        ax.text(
            *(46 * out - 13 * np.abs(left)),
            arm,
            fontsize=15,
            fontweight="bold",
            ha="center",
            va="center",
        )
    ax.plot(0, 0, "+", color="black", markersize=14)
    ax.text(1, 1, "middle", fontsize=10)


def render_lanes(ax: Axes) -> None:
    """Each lane's number before the junction, and an arrow in the direction of its traffic."""
    junction = Junction(SPEC)
    for arm in junction.arms:
        for lane in range(SPEC.lanes):
            route = junction.route(arm, "straight", lane)
            x, y, yaw, _ = (float(value) for value in route.path.at(route.stop_s - 4.0))
            ahead = 3.5 * np.array([np.cos(yaw), np.sin(yaw)])
            ax.annotate(
                "",
                (x + ahead[0], y + ahead[1]),
                (x, y),
                arrowprops={"arrowstyle": "-|>", "color": "0.3"},
            )
            ax.text(*((x, y) - ahead / 3), str(lane), fontsize=12, ha="center", va="center")


def render_distances(ax: Axes) -> None:
    """Ego, which turns left from the south, and its start distance along its path."""
    route = Junction(SPEC).route("south", "left", 1)
    along = np.linspace(middle_of(route) - START, middle_of(route) + 30, 200)
    x, y, _, _ = route.path.at(along)
    before = along <= middle_of(route)
    ax.plot(x[before], y[before], color="C0", linewidth=3)
    ax.plot(x[~before], y[~before], color="C0", linewidth=1.5, linestyle=":")
    ax.plot(x[0], y[0], "o", color="C0", markersize=12)
    ax.annotate(
        f"ego: from: south, turn: left, lane: 1,\nstart_distance: {START:g}\n(the solid line, {START:g} m)",
        (x[0], y[0]), (-AROUND + 1, -38), color="C0", fontsize=10, arrowprops={"arrowstyle": "-", "color": "C0"},
    )  # fmt: skip


def render_sides(ax: Axes) -> None:
    """Parked vehicles and a pedestrian on either side of the south arm."""
    for side, sign in (("left", -1), ("right", 1)):
        middle = sign * (SPEC.lanes_edge + SPEC.road_edge) / 2
        ax.add_patch(Rectangle((middle - 0.9, -PARKED - 2.2), 1.8, 4.4, color="C2"))
        label = f"parked: from: south,\nside: {side},\nstart_distance: {PARKED:g}"
        if side == "right":
            ax.text(middle + 3, -PARKED, label, color="C2", fontsize=10, va="center")
        else:
            ax.text(
                middle - 2,
                -PARKED + 4,
                f"the same,\nside: {side}",
                color="C2",
                fontsize=10,
                va="center",
                ha="right",
            )
    path = road_crossing(SPEC, "south", STEP_OUT, "right").xy
    ax.annotate(
        "", path[-1], path[0], arrowprops={"arrowstyle": "-|>", "color": "C3", "linewidth": 2}
    )
    label = f"pedestrian: from: south,\nside: right,\nstart_distance: {STEP_OUT:g}"
    ax.text(path[0, 0] + 1, path[0, 1] + 1, label, color="C3", fontsize=10)


def draw_labels(release: DeepAccident, path: Path) -> None:
    """The ego's labels 2 s before the accident, the earliest whose last frame is the impact."""
    accident = next(scenario for scenario in release.scenario if scenario["collision"])
    sample = release.get_sample(accident, "ego_vehicle", frame=RELEASE.frames - 20)
    figure = release.render_motion_labels(sample, fig=detached_figure((16.5, 12)))
    figure.axes[0].set(xlim=(-22, 33), ylim=(-28, 27))
    figure.savefig(path, dpi=72)


def draw_rigs(folder: Path, path: Path) -> None:
    """The two rigs of the generator."""
    made = [
        make_release(
            folder / name, SynthConfig(rig=name, frames=3, image_size=(64, 36), designed=True)
        )
        for name in RIGS
    ]
    report = sensor_setup_report(*(DeepAccident(dataroot=each, verbose=False) for each in made))
    write_figure(sensor_setups_figure(report), path, dpi=110)


def draw_both_sources(folder: Path, path: Path) -> None:
    """The same moment of a release, and of its export as the nuScenes devkit reads it."""
    release = DeepAccident(dataroot=make_release(folder / "ours", BOTH), verbose=False)
    export_release(release, folder / "nuscenes", NuScenes(agents=AGENTS[:1], lidar_axes="nuscenes"))
    accident = next(scenario["token"] for scenario in release.scenario if scenario["collision"])
    sources = {
        accident: release,
        f"nuscenes/{accident.replace('/', '-')}-ego_vehicle": open_nuscenes(folder / "nuscenes"),
    }
    pictures = []
    for scenario, source in sources.items():
        content = BytesIO()
        source.render_sample(
            source.get_sample(scenario, "ego_vehicle", frame=BOTH.frames - 10)
        ).savefig(content, dpi=60)
        pictures.append(np.asarray(Image.open(content).convert("RGB")))
    Image.fromarray(np.concatenate(pictures)).save(path, quality=85)


def draw_turn(name: Any, frames: range, path: Path) -> None:
    """A map of the turn under both protocols, a column a frame, all warped to the present."""
    figure = detached_figure((3.5 * len(frames) + 0.4, 5.0))
    panels = figure.subplots(2, len(frames), sharex=True, sharey=True)
    for row, config in zip(panels, (RELEASED, CLEAN), strict=True):
        labels = turn(config).to_present()
        for frame, ax in zip(frames, row, strict=True):
            draw_motion_map(labels, name, frame, marked=COLLIDING, ax=ax)
            _draw_outlines(frame, ax)
            ax.set(**SHOWN)
            ax.tick_params(labelsize=12)
        row[0].set_ylabel(config.protocol, fontsize=18)
    for frame, ax in zip(frames, panels[0], strict=True):
        ax.set_title(f"+{frame * STEP:.1f} s" if frame else "present", fontsize=18)
    figure.savefig(path, dpi=80)


def draw_half_cell(path: Path) -> None:
    """Some cells of the present frame of the turn under both protocols, with the grid's lines."""
    figure = detached_figure((14, 4.4))
    for ax, config in zip(figure.subplots(1, 2, sharey=True), (RELEASED, CLEAN), strict=True):
        draw_motion_map(turn(config), "instance", 0, marked=COLLIDING, ax=ax)
        _draw_outlines(0, ax)
        ax.set(xlim=(-3.5, 13), ylim=(-8.5, 2.5))
        ax.set_xticks(np.arange(-3, 13.1, 0.5), minor=True)
        ax.set_yticks(np.arange(-8.5, 2.6, 0.5), minor=True)
        ax.grid(which="both", color="#b0b0b0", linewidth=0.5)
        ax.set_title(config.protocol, fontsize=18)
        ax.set_xlabel("x forward (m)", fontsize=14)
        ax.set_ylabel("y left (m)", fontsize=14)
        ax.tick_params(labelsize=12)
    figure.savefig(path, dpi=80)


def _draw_outlines(frame: int, ax: Any) -> None:
    """What is really there, in the present ego frame."""
    for actor in ACTORS:
        length, width, _ = actor.size
        corners = (
            np.array([[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
            * (length, width, 0)
            / 2
        )
        x, y, _ = (actor.pose(frame) @ corners).T
        ax.plot(x, y, color="#f5a000", linewidth=1.2, zorder=2)
