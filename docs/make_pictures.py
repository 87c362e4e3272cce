"""Draw the README's picture from a synthetic release: `python docs/make_pictures.py`."""

import tempfile
from pathlib import Path

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.synth import SynthConfig, make_release

IMAGES = Path(__file__).parent / "images"
RELEASE = SynthConfig(scenarios=1, frames=40, image_size=(640, 360), seed=19)
FRAMES_BEFORE = 8


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        release = DeepAccident(dataroot=make_release(Path(folder) / "release", RELEASE, progress=True))
        frame = release.frame[len(release.frame) - 1 - FRAMES_BEFORE]
        figure = release.render_frame(frame, fig=detached_figure((20, 6.5)))
        IMAGES.mkdir(exist_ok=True)
        figure.savefig(IMAGES / "five_agents.png", dpi=72)


if __name__ == "__main__":
    main()
