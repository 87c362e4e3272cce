"""Render a contact sheet of the paper's twelve designs from synthetic accidents: `python docs/make_design_sheet.py`."""

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.camera import best_view
from deepaccident_devkit.render.figures import save_picture
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.synth.spec import DESIGN_NUMBERS, read_design
from deepaccident_devkit.v2x import Contact

PICTURE = Path(__file__).parent / "images" / "designs.jpg"
SEEDS = {1: 1, 2: 7, 3: 7, 4: 5, 5: 3, 6: 4, 7: 6, 8: 11, 9: 12, 10: 3, 11: 7, 12: 2}
"""Of a draw of each design in the daytime."""
FRAMES = 25
FRAMES_BEFORE = 7
"""Of the impact, when the pictures are taken."""
COLUMNS = 4
AROUND = 26.0
"""Metres shown to each side of the ego."""


def main() -> None:
    PICTURE.parent.mkdir(exist_ok=True)
    rows = len(DESIGN_NUMBERS) // COLUMNS
    fig = detached_figure((16, 6.9 * rows))
    axes = fig.subplots(2 * rows, COLUMNS, height_ratios=[1, 9 / 16] * rows)
    for place, number in enumerate(DESIGN_NUMBERS):
        row, column = divmod(place, COLUMNS)
        with tempfile.TemporaryDirectory() as folder:
            release = DeepAccident(dataroot=make_design(number, Path(folder) / "release"))
            draw_design(release, axes[2 * row, column], axes[2 * row + 1, column])
        axes[2 * row, column].set_title(title_of(number), fontsize=13)
    save_picture(fig, PICTURE, dpi=100)


def make_design(number: int, folder: Path) -> Path:
    """A release of one accident of a design."""
    config = SynthConfig(
        scenarios=1, frames=FRAMES, image_size=(640, 360), designs=(number,), seed=SEEDS[number], unplanned=0
    )
    return make_release(folder, config, progress=True)


def title_of(number: int) -> str:
    name = read_design(number).name.partition(",")[0]
    junction = "three-way" if "three-way" in read_design(number).name else "four-way"
    lights = "signalised" if number <= len(DESIGN_NUMBERS) // 2 else "unsignalised"
    return f"{number}  {name},\n{junction}, {lights}"


def draw_design(release: DeepAccident, above: Axes, image: Axes) -> None:
    """From above with the paths of those who collide, the impact a cross; and the camera that shows both best."""
    token = release.scenario[0]["token"]
    contact = release.collision(token)
    if contact is None:
        raise SystemExit(f"{token}: nobody collides in it; choose another seed")
    frame = release.field2token("frame", "scenario_token", token)[-1 - FRAMES_BEFORE]
    samples = [sample["token"] for sample in release.samples_of(frame)]
    release.render_bev(samples[0], agents="all", view_range=AROUND, layers=("bev", "boxes"), ax=above)
    draw_meeting(release, samples[0], contact, above)
    boxes = release.cooperative_boxes(samples[0], agents="all", frame="world")
    witnesses = [sample for sample in samples if "behind" not in sample]  # followers see one of the two hide the other
    view = best_view(release, witnesses, boxes.select(np.isin(boxes.actor_id, contact.actor_ids)))
    camera = f"{samples[0]}/Camera_Front" if view is None else view.camera
    release.render_sample_data(camera, layers=("image",), ax=image)
    for ax in (above, image):
        ax.set(title="", xlabel="", ylabel="", xticks=[], yticks=[])
        if (legend := ax.get_legend()) is not None:
            legend.remove()


def draw_meeting(release: DeepAccident, ego: str, contact: Contact, ax: Axes) -> None:
    """The ways of ego and other in their hues and a red cross where they meet, in the ego frame of a sample (token)."""
    own = release.get("agent", ego.rsplit("/", 1)[0])["actor_id"]
    for instance, actor in zip(contact.instances, contact.actor_ids, strict=True):
        color = AGENT_COLORS["ego_vehicle" if actor == own else "other_vehicle"]
        way = release.trajectory(instance, ego, "ego").center
        ax.plot(way[:, 0], way[:, 1], color=color, linewidth=4, zorder=4)
    x, y, _ = release.world_from(ego, "ego").inverse().apply(contact.point[None])[0]
    ax.plot(x, y, "x", color=COLLIDER_COLOR, markersize=16, markeredgewidth=4, zorder=6)


if __name__ == "__main__":
    main()
