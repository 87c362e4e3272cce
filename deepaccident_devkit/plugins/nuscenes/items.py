"""Keyframes of a nuScenes split as items of a `V2XDataset`, which needs the extra `torch`."""

from pathlib import Path
from typing import Any

from deepaccident_devkit.plugins.nuscenes.source import NuScenesRelease, release_of
from deepaccident_devkit.training.torch import V2XConfig, V2XDataset


class NuScenesDataset(V2XDataset):
    """The keyframes of a split, each seen by one vehicle without partners.

    Items are the same as in `V2XDataset`. Categories are ours (`nuscenes.CLASSES`), and −1 for
    ignored boxes.
    """

    def __init__(
        self,
        nusc: Any,
        split: str,
        config: V2XConfig | None = None,
        *,
        index_dir: Path | None = None,
    ) -> None:
        """Open a split of nuScenes.

        Args:
            nusc: A `nuscenes.NuScenes` that the nuScenes devkit has opened, or a `NuScenesRelease`.
            split: Name of the split, `train`, `val` or `test`; the small version and our export
                have their own splits of these names.
            config: Contents of items; None for `V2XConfig()`.
            index_dir: Folder in which the tables are stored, as in `open_nuscenes`.

        Raises:
            DeepAccidentError: If `open_nuscenes`, `motion.samples` or `V2XDataset` raises it.
        """
        release = nusc
        if not isinstance(nusc, NuScenesRelease):
            release = release_of(nusc, index_dir)
        tokens = release.samples(split, "all")
        super().__init__(release, tokens, config)
