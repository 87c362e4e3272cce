"""Measure pictures and videos of a synthetic scenario with five agents, at 1280×720."""

from functools import partial
from pathlib import Path

from benchmarks.measure import Figure, best_of, one_core, temporary_folder
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.render.video import VideoScene, views_of

FRAMES, SIZE = 40, (1280, 720)
REPEATS = 3
RELEASE = SynthConfig(scenarios=1, frames=FRAMES, image_size=(480, 270), seed=7, designed=True)
PICTURES = ("frame", "sample", "accident", "bev", "visibility")


def measure() -> list[Figure]:
    with temporary_folder() as folder:
        release = make_release(folder / "release", RELEASE, workers=2)
        dataset = DeepAccident(dataroot=release, verbose=False)
        return [*pictures_s(dataset), *video_s(dataset, folder)]


def pictures_s(dataset: DeepAccident) -> list[Figure]:
    token = dataset.frame[FRAMES * 3 // 4]["token"]
    figures = []
    with one_core():
        for name in PICTURES:
            scene = VideoScene(
                dataset=dataset,
                views=views_of(name, None),
                agents=None,
                width=SIZE[0],
                height=SIZE[1],
            )
            seconds = best_of(REPEATS, partial(scene.picture, token))
            bound = 1.0 if name == "frame" else None
            figures.append(Figure(f"render_{name}_s", seconds, "s", bound=bound))
    return figures


def video_s(dataset: DeepAccident, folder: Path) -> list[Figure]:
    scenario = dataset.scenario[0]
    figures = []
    for name, bound in (("frame", 60.0), ("accident", None)):
        write = partial(
            dataset.render_scenario_video,
            scenario,
            folder / f"{name}.mp4",
            views=name,
            size=SIZE,
            workers=2,
            progress=False,
        )
        seconds = best_of(1, write)
        figures.append(Figure(f"render_video_{name}_s", seconds, "s", bound=bound))
    return figures
