"""Making synthetic releases: a scenario with images and point clouds, and labels alone; starting
workers included.
"""

import tempfile
from pathlib import Path

from benchmarks.measure import Figure, best_of
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import find_release

LABELS = SynthConfig(scenarios=12, frames=None, sensors=False, designed=True)
"""Of natural length, 40 to 100 frames."""
SENSORS = SynthConfig(scenarios=1, frames=60, image_size=(800, 450), designed=True)
REPEATS = 2
LABELS_BOUND, SENSORS_BOUND = 200, 60.0


def measure() -> list[Figure]:
    figures = []
    for workers, bound in ((1, None), (2, LABELS_BOUND)):
        seconds, samples = made(LABELS, workers)
        figures += [
            Figure(
                name=f"synth_labels_per_s_{workers}_worker{'s' * (workers > 1)}",
                value=samples / seconds,
                unit="samples/s",
                bound=bound,
                higher_is_better=True,
            )
        ]
    seconds, samples = made(SENSORS, workers=2)
    return [
        *figures,
        Figure(name="synth_scenario_samples", value=samples),
        Figure(name="synth_scenario_s_2_workers", value=seconds, unit="s", bound=SENSORS_BOUND),
    ]


def made(config: SynthConfig, workers: int) -> tuple[float, int]:
    """Seconds to make a release, and how many samples it has."""
    with tempfile.TemporaryDirectory() as folder:
        places = [Path(folder) / str(number) for number in range(REPEATS)]
        left = iter(places)
        seconds = best_of(REPEATS, lambda: make_release(next(left), config, workers=workers))
        return seconds, samples_of(places[0])


def samples_of(root: Path) -> int:
    return sum(
        len(list(scenario.kind_folder(agent, "calib").iterdir()))
        for scenario in find_release(root).scenarios
        for agent in scenario.agents
    )
