"""Measure making synthetic releases: a scenario with images and point clouds, and only labels;
starting the workers is included.
"""

from pathlib import Path

from benchmarks.measure import Figure, best_of, temporary_folder
from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import find_release

LABELS = SynthConfig(scenarios=12, frames=None, sensors=False, designed=True)
"""Scenarios of natural length, 40 to 100 frames."""
SENSORS = SynthConfig(scenarios=1, frames=60, image_size=(800, 450), designed=True)
REPEATS = 2
LABELS_BOUND, SENSORS_BOUND = 200, 60.0


def measure() -> list[Figure]:
    figures = []
    for workers, bound in ((1, None), (2, LABELS_BOUND)):
        seconds, samples = time_release(LABELS, workers)
        figures.append(
            Figure(
                f"synth_labels_per_s_{workers}_worker{'s' * (workers > 1)}",
                samples / seconds,
                "samples/s",
                bound=bound,
                higher_is_better=True,
            )
        )
    seconds, samples = time_release(SENSORS, workers=2)
    return [
        *figures,
        Figure("synth_scenario_samples", samples),
        Figure("synth_scenario_s_2_workers", seconds, "s", bound=SENSORS_BOUND),
    ]


def time_release(config: SynthConfig, workers: int) -> tuple[float, int]:
    """Return the seconds to make a release, and the number of its samples."""
    with temporary_folder() as folder:
        roots = [folder / str(number) for number in range(REPEATS)]
        unused = iter(roots)
        seconds = best_of(REPEATS, lambda: make_release(next(unused), config, workers=workers))
        return seconds, count_samples(roots[0])


def count_samples(root: Path) -> int:
    samples = 0
    for scenario in find_release(root).scenarios:
        for agent in scenario.agents:
            samples += len(list(scenario.kind_folder(agent, "calib").iterdir()))
    return samples
