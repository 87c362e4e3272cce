"""Render the README's pictures and its animation from a synthetic release: `python docs/make_pictures.py`."""

import tempfile
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.pictures import save_picture
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.v2x import Link

IMAGES = Path(__file__).parent / "images"
RELEASE = SynthConfig(scenarios=1, frames=40, image_size=(640, 360), seed=19, view="hidden")
FRAMES_BEFORE = 8
HIDDEN_BEFORE = 10
"""When the house on the corner still hides the other car from the ego."""


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        release = DeepAccident(dataroot=make_release(Path(folder) / "release", RELEASE, progress=True))
        scenario = release.scenario[0]
        draw_pictures(release, scenario["token"])
        release.render_scenario_video(scenario, IMAGES / "accident.webp", what="accident", size=(1024, 576))


def save(drawn: Axes | Figure, name: str, *, dpi: float) -> None:
    """Into docs/images; the resolution keeps each below 250 kB."""
    save_picture(drawn, IMAGES / f"{name}.png", dpi=dpi)


def draw_pictures(release: DeepAccident, scenario: str) -> None:
    frames = release.field2token("frame", "scenario_token", scenario)
    frame = frames[-1 - FRAMES_BEFORE]
    ego = release.samples_of(frame)[0]
    save(release.render_frame(frame, fig=detached_figure((18, 6.9))), "five_agents", dpi=64)
    save(release.render_sample(ego, fig=detached_figure((16, 5.6))), "six_cameras", dpi=72)

    above = detached_figure((6.4, 7)).add_subplot()
    layers = ("bev", "points", "boxes", "trajectories", "grid")
    save(release.render_bev(ego, agents="all", view_range=40, layers=layers, ax=above), "from_above", dpi=80)
    seen = detached_figure((6.4, 7.2)).add_subplot()
    save(release.render_visibility(frames[-1 - HIDDEN_BEFORE], view_range=40, ax=seen), "who_sees_whom", dpi=80)

    agents = ["ego_vehicle", "other_vehicle"]
    countdown = release.render_accident(
        scenario, seconds=(1.0, 0.5, 0.0), agents=agents, fig=detached_figure((10, 7.4))
    )
    save(countdown, "countdown", dpi=72)
    late = Link(latency=0.3, pose_noise=0.5)
    link = release.render_link(ego, late, agents="all", view_range=40, fig=detached_figure((15, 5.8)))
    save(link, "link", dpi=72)


if __name__ == "__main__":
    main()
