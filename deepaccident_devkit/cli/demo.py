"""`deepaccident demo`: everything once, on a small synthetic release."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from deepaccident_devkit.baselines import demo_table
from deepaccident_devkit.dataset import RowArgument
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.overview import overview
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.synth import SynthConfig, make_release

_RELEASE = SynthConfig(scenarios=2, frames=40, image_size=(320, 180), view="hidden")
_SECONDS_BEFORE = 1.0
_LABELS = MotionLabelConfig(future_frames=2)
"""The released labels, but they end at the impact."""
_HIDDEN = """\
A house hides the other car from the ego vehicle. This table shows how well one car, and five agents together, predict
the crash. The predictor is a baseline: each actor that is seen keeps its speed (docs/baselines.md). "warning" is the
time before the impact from which every moment has the right alarm:
"""


@click.command()
@click.argument("out", type=click.Path(path_type=Path), default="deepaccident_demo")
@click.option("--workers", type=click.IntRange(min=1), help="Number of processes to use.")
def demo(out: Path, workers: int | None) -> None:
    """Make a small synthetic release in the folder OUT and show what the devkit does with it.

    The demo makes an index, prints an overview, renders pictures of the accident, and compares what one car and five
    agents predict.
    """
    root = out / "release"
    if root.is_dir():
        click.echo(f"using the release that is in {root}")
    else:
        click.echo(f"making an accident and its normal twin, {_RELEASE.frames} frames, five agents …")
        make_release(root, _RELEASE, workers=workers or 2, progress=True)
    release = DeepAccident("v1", root, workers=workers)
    click.echo(f"\n{overview(release).to_text()}\n")
    for path in draw_accident(release, out):
        click.echo(f"rendered: {path}")
    click.echo(_what_next(out, root))
    click.echo(f"\n{_HIDDEN}\n{demo_table(release)[1]}")


def draw_accident(release: DeepAccident, out: Path) -> list[Path]:
    """Render the first accident: the five agents a second before the impact and at it, the ego's cameras and labels.

    Returns:
        The pictures written.
    """
    accident = next(scenario for scenario in release.scenario if scenario["collision"])
    impact = release.get("frame", accident["last_frame_token"])
    before = release.frame[release.getind("frame", impact) - round(_SECONDS_BEFORE * 10)]
    ego = release.samples_of(before)[0]
    drawings: dict[str, tuple[tuple[float, float], Callable[..., Any], RowArgument]] = {
        "five_agents_1s_before.png": ((20.0, 6.5), release.render_frame, before),
        "five_agents_impact.png": ((20.0, 6.5), release.render_frame, impact),
        "ego_cameras_1s_before.png": ((16.0, 5.5), release.render_sample, ego),
        "motion_labels_1s_before.png": ((11.0, 12.0), partial(release.render_motion_labels, config=_LABELS), ego),
    }
    paths = []
    for name, (size, render, record) in drawings.items():
        figure = render(record, fig=detached_figure(size))
        path = out / name
        figure.savefig(path, dpi=80)
        paths.append(path)
    return paths


def _what_next(out: Path, root: Path) -> str:
    return f"""
Look at the pictures in {out}{"/" if str(out) != "." else ""}: the colliding pair is red.
Try next:
  deepaccident info {root} --where collision=true
  deepaccident validate {root} --deep
  deepaccident baseline predict {root} --split train --agents all --out {out}/results
  deepaccident evaluate accident {root} --results {out}/results/accident.json --split train --protocol boxes
  python -c "from deepaccident_devkit import DeepAccident; DeepAccident(dataroot='{root}').list_scenarios()"
  deepaccident synth my_release --scenarios 6 --layout B"""
