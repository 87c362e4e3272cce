"""What several agents see at a moment: five agents of some fifty actors, from the tables of a
synthetic release.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.measure import Figure, best_of, one_core
from benchmarks.releases import labels_only_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.v2x import Link

REPEATS, CALLS = 5, 50
BOUND_MS = 2.0


def measure() -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder, one_core():
        da = DeepAccident(
            dataroot=labels_only_release(Path(folder), scenarios=1, frames=6), verbose=False
        )
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
            Figure(name=name, value=_milliseconds(work), unit="ms", bound=BOUND_MS)
            for name, work in works.items()
        ]


def _milliseconds(work: Callable[[], object]) -> float:
    return 1000 / CALLS * best_of(REPEATS, lambda: [work() for _ in range(CALLS)])
