"""`AllEgosDataset`: one item a moment, with the sensor data of all agents once and the targets of each as the ego.

A model that encodes each agent's sensors by themselves learns from as many targets as there are egos, for one encoding.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, MissingFileError
from deepaccident_devkit.export.torch import sensor_data
from deepaccident_devkit.export.torch.collate import V2XItem
from deepaccident_devkit.export.torch.config import V2XConfig
from deepaccident_devkit.export.torch.dataset import V2XDataset, tensor


class AllEgosDataset(V2XDataset):
    """Moments of a release; an item is a dict of tensors.

    An item has what a `V2XDataset` item has of sensor data, for the first ego of the moment and all agents that the
    release has there, all with the same augmentation, and:

    - `egos`: tokens of the E samples of this moment, without agents whose own sensor files are skipped.
    - `partners` (E, A) bool: the agents that cooperate with each ego, as the configuration's `agents` says, itself
      included.
    - `targets`: E dicts with the boxes, labels and segmentation of a `V2XDataset` item, each in its ego's own frame.

    `collate_all_egos` makes batches of them.

    Attributes:
        egos: the samples of each item.
    """

    _needs_own = False

    def __init__(self, dataset: Dataset, tokens: Iterable[RowArgument], config: V2XConfig | None = None) -> None:
        """Choose the egos' samples, in any order; those of one moment become one item.

        Args:
            dataset: the release.
            tokens: tokens or records of samples.
            config: the contents; None for those of `V2XConfig()`. `agents` says who cooperates with each ego.

        Raises:
            DeepAccidentError: as of `V2XDataset`.
            ConfigError: also if there is a link, which is not the same for all egos.
        """
        config = V2XConfig() if config is None else config
        if config.link is not None:
            raise ConfigError("link: each ego receives its own messages; use V2XDataset for data that came over a link")
        moments: dict[tuple[str, str], list[str]] = {}
        for token in tokens:
            sample = dataset.get("sample", token)["token"]
            scenario, _, frame = sample.rsplit("/", 2)
            moments.setdefault((scenario, frame), []).append(sample)
        self.egos = list(moments.values())
        self._agents = config.agents
        super().__init__(dataset, [egos[0] for egos in self.egos], replace(config, agents=None))
        for ego in (ego for egos in self.egos[:1] for ego in egos):  # a mistake is the same for all moments
            sensor_data.participants(dataset, ego, config.agents)

    def __getitem__(self, index: int) -> V2XItem:
        """The item of a moment, as described for the class; the errors are those of `V2XDataset`."""
        return self.item(index, int(self._epoch))

    def item(self, index: int, epoch: int) -> V2XItem:
        """The same in an epoch that is given here, and not by `set_epoch`: for loaders that run on through epochs."""
        position = range(len(self))[operator.index(index)]
        augmentation = self.config.augmentation_of(epoch, position)
        item = self._received_item(self.egos[position][0], augmentation)
        there = [name for name, valid in zip(item["agents"], item["agent_valid"][:, -1], strict=True) if valid]
        egos = [ego for ego in self.egos[position] if ego.rsplit("/", 2)[1] in there]
        if not egos:
            raise MissingFileError(
                f"{self.egos[position][0]}: no agent has all its sensor files at this moment; leave it out, or "
                "choose fewer cameras"
            )
        heard = [sensor_data.participants(self._dataset, ego, self._agents) for ego in egos]
        item["egos"] = tuple(egos)
        item["partners"] = tensor(np.array([[name in names for name in item["agents"]] for names in heard]))
        item["targets"] = [self._target_item(ego, augmentation) for ego in egos]
        return V2XItem(item)
