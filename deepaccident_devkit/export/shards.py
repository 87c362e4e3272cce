"""What formats in shards share: which scenarios a shard holds, and the README.md by which `datasets` finds them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.bulk import Format

README: Final = "README.md"
SPLIT_NAMES: Final[Mapping[str | None, str]] = {"train": "train", "val": "validation", "test": "test", None: "unknown"}
"""A scenario's split → what files are called by it; `datasets` expects these words."""

_TEXT: Final = """\
---
{head}---

# {title}

Made by `deepaccident export {name}` of the DeepAccident devkit {devkit} from version {version} of DeepAccident
(https://deepaccident.github.io/). {selection}

Please cite the paper: Wang et al., DeepAccident: A Motion and Accident Prediction Benchmark for V2X Autonomous Driving,
AAAI 2024, https://arxiv.org/abs/2304.01168. The data are those of its authors, and their terms hold. The licence of the
devkit, Apache-2.0, is that of its code alone.

Everything is right-handed: x forward, y left, z up, yaw counter-clockwise; metres, seconds, radians. Quaternions are
w, x, y, z. Cameras have optical axes: x right, y down, z forward. Frames are numbered from 1 and 0.1 s apart. The
impact of an accident is the last frame of its scenario.

{body}"""


def shards(dataset: Dataset, sizes: Mapping[str, int], limit: int) -> dict[str, list[tuple[str, ...]]]:
    """Name of a split → its shards: consecutive scenarios up to the limit, but at least one.

    Args:
        dataset: the release.
        sizes: scenario, by token → its size.
        limit: size of a shard.
    """
    found: dict[str, list[tuple[str, ...]]] = {name: [] for name in SPLIT_NAMES.values()}
    room = dict.fromkeys(found, 0)
    for scenario, size in sizes.items():
        split = SPLIT_NAMES[dataset.scenario.get(scenario)["split"]]
        if not found[split] or size > room[split]:
            found[split].append(())
            room[split] = limit
        found[split][-1] = (*found[split][-1], scenario)
        room[split] -= size
    return {split: groups for split, groups in found.items() if groups}


def readme(form: Format, dataset: Dataset, title: str, head: Mapping[str, Any], body: str) -> bytes:
    """A README.md with a head in YAML, what is in the export and where it is from, and a body."""
    import yaml

    selection = [f"split {form.split}"] if form.split is not None else []
    selection += [f"scenarios where {text}" for text in form.where]
    return _TEXT.format(
        head=yaml.safe_dump({"pretty_name": title, **head}, sort_keys=False, allow_unicode=True),
        title=title,
        name=form.name,
        devkit=__version__,
        version=dataset.version,
        selection=f"It holds {', '.join(selection) or 'all scenarios'}, as recorded by {', '.join(form.agents)}.",
        body=body,
    ).encode()
