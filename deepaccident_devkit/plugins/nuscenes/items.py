"""`NuScenesDataset`: the keyframes of a nuScenes split as items of a `V2XDataset` (the extra `torch` too)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from deepaccident_devkit.plugins.nuscenes.source import NuScenesRelease, release_of
from deepaccident_devkit.training.torch import V2XConfig, V2XDataset


class NuScenesDataset(V2XDataset):
    """The keyframes of a split, each of one vehicle without partners; items are those of `V2XDataset`.

    Categories are ours (`nuscenes.CLASSES`), −1 for boxes that are to be ignored.
    """

    def __init__(
        self,
        nusc: Any,
        split: str,
        config: V2XConfig | None = None,
        *,
        index_dir: Path | None = None,
    ) -> None:
        """Choose a split.

        Args:
            nusc: what the nuScenes devkit has opened, a `nuscenes.NuScenes`; or a `NuScenesRelease`.
            split: `train`, `val` or `test`; of the small version and of our export its own of that name.
            config: the contents; None for those of `V2XConfig()`.
            index_dir: of `open_nuscenes`.

        Raises:
            DeepAccidentError: as of `open_nuscenes`, `motion.samples` and `V2XDataset`.
        """
        release = nusc if isinstance(nusc, NuScenesRelease) else release_of(nusc, index_dir)
        super().__init__(release, release.samples(split, "all"), config)
