"""Measure what several agents see at a moment: five agents and about fifty actors, from the tables
of a synthetic release.
"""

from collections.abc import Callable

from benchmarks.measure import Figure, best_of, milliseconds, one_core, temporary_folder
from benchmarks.releases import labels_only_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.v2x import Link

REPEATS, CALLS = 5, 50
BOUND_MS = 2.0


def measure() -> list[Figure]:
    with temporary_folder() as folder, one_core():
        release = labels_only_release(folder, scenarios=1, frames=6)
        da = DeepAccident(dataroot=release, verbose=False)
        sample = da.get_sample(da.scenario[0], "ego_vehicle", 5)["token"]
        link = Link(latency=0.2, pose_noise=0.3, packet_loss=0.1)
        works = {
            "cooperative_boxes_ms": lambda: da.cooperative_boxes(sample, frame="ego"),
            "cooperative_boxes_released_ms": lambda: da.cooperative_boxes(
                sample, frame="ego", visible="released"
            ),
            "cooperative_boxes_link_ms": lambda: da.cooperative_boxes(
                sample, frame="ego", link=link
            ),
            "visible_instances_ms": lambda: da.visible_instances(sample),
        }
        return [
            milliseconds(name, _seconds_per_call(work), bound=BOUND_MS)
            for name, work in works.items()
        ]


def _seconds_per_call(work: Callable[[], object]) -> float:
    def run_calls() -> None:
        for _ in range(CALLS):
            work()

    return best_of(REPEATS, run_calls) / CALLS
