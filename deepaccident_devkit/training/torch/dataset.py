"""`V2XDataset`: cooperative samples of a release as a map-style torch dataset; `AllEgosDataset`: all egos of a moment.

A model that encodes each agent's sensors by themselves learns from as many targets as there are egos, for one encoding.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, MissingFileError, NotAvailableError
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig, bev_segmentation
from deepaccident_devkit.motion.sample_labels import motion_labels_of
from deepaccident_devkit.support.arrays import IntArray, checked_whole
from deepaccident_devkit.tables.tables import token_of
from deepaccident_devkit.tables.tokens import agent_token
from deepaccident_devkit.taxonomy import IGNORED_ID, AgentName
from deepaccident_devkit.training.image_cache import ImageCache
from deepaccident_devkit.training.torch import sensor_data
from deepaccident_devkit.training.torch.collate import V2XItem
from deepaccident_devkit.training.torch.config import (
    V2XConfig,
    augmented_boxes,
    augmented_six_vectors,
)
from deepaccident_devkit.v2x import cooperative_boxes

if TYPE_CHECKING:
    from torch import Tensor

    # without torch's types mypy would see an Any here, and strict mode forbids Any as a base class
    TorchDataset = object
else:
    from torch.utils.data import Dataset as TorchDataset


class V2XDataset(TorchDataset):
    """Samples of a release with the data of cooperating agents; an item is a dict of tensors.

    Everything is right-handed: x forward, y left, z up; metres, radians, seconds. With an augmentation A, each agent's
    ego frame is the augmented one: points are A p, poses between ego frames A W A⁻¹, and so on; images do not change.
    In shapes, A is the number of agents (the sample's own is first), P of frames (the present is last), C of cameras,
    T and R of label frames (`motion.MotionLabels`), H × W a grid's rows and columns in its own orientation.

    Always:

    - `token`: str. `agents`: their names, a tuple of A.
    - `agent_valid` (A, P) bool: False if the link lost a message, if the frame is before the recording, or if sensor
      files are skipped. Then clouds are empty, images are 0 and matrices are the identity.
    - `ego_from_agent` (A, P, 4, 4) float32: the sender's ego frame at that frame → the present ego frame of the
      sample's agent, as this agent believes, with pose noise. [0, −1] is the identity, [0, :] the agent's own motion.
    - `agent_from_past` (A, P, 4, 4) float32: the sender's ego frame at that frame → its ego frame at its last one, by
      its own exact poses: with it, senders can join their own frames before they send anything.
    - `world_from_ego` (4, 4) float64: of the sample's agent at the present; for augmented coordinates.
    - `augmentation` (4, 4) float32: A.

    With `on_missing="skip"`: `files_missing` (A, P) int64, how many of the sensor files asked for are not there.

    With `points`: `points`, a list of A lists of P clouds (N, 4) float32: x y z in the sender's own ego frame at that
    frame, and the intensity.

    With `images`:

    - `images` (A, P, C, 3, h, w), RGB, as `ImageConfig` says.
    - `intrinsics` (A, P, C, 3, 3) float32, of the resized and cropped image; pixel centres are at 0.5, 1.5, ….
    - `ego_from_camera` (A, P, C, 4, 4) float32: optical camera frame → the sender's augmented ego frame (so neither
      rigid with a scale nor right-handed with a flip).
    - `image_from_ego` (A, P, C, 4, 4) float32: point of the sender's ego frame → (u · d, v · d, d, 1), depth d.

    With `boxes`, M of them in the ego frame of the sample's agent at the present:

    - `boxes` (M, 9) float32: x y z l w h yaw vx vy; z of the centre. `velocity_known` (M,) bool: False where vx and vy
      are 0 because they are not known.
    - `categories` (M,) int64, positions in `taxonomy.CATEGORIES`; −1 is to be ignored: a class of another source that
      we do not have. `actor_ids` (M,) int64, as in the label (−100 is the agent's own row) or, for cooperative boxes,
      CARLA's ids; −1 is untracked.

    With `labels`, all at the present or each frame in its own ego frame, as `to_present` says:

    - `segmentation` (T, H, W) int64, `instance` (T, H, W) int64, `centerness` (T, 1, H, W) float32, `offset` and
      `flow` (T, 2, H, W) float32.
    - `future_egomotion` (R, 6) float32: `next_from_this` from the first past frame on, between augmented ego frames.
    - `label_valid` (T,) bool: the frames that are in the recording.

    With `bev_segmentation`: `bev_segmentation` (5, H, W) bool, classes as `motion.BEV_CLASSES`, and `bev_known`
    (H, W) bool (`motion.BevSegmentation`).

    Items depend only on the configuration, the epoch and the index, not on workers. The dataset is quick to pickle and
    works in forked and in spawned workers.
    """

    # Whether an item cannot be made without the files of the sample's own agent.
    _needs_own: ClassVar[bool] = True

    def __init__(
        self, dataset: Dataset, tokens: Iterable[RowArgument], config: V2XConfig | None = None
    ) -> None:
        """Choose samples, such as those of `motion.training_samples`, and the contents of their items.

        Args:
            dataset: the release.
            tokens: tokens or records of samples; one item for each, in this order.
            config: the contents of an item; None for the agent's own points and boxes.

        Raises:
            TokenError: no such sample.
            ChoiceError: the configuration names an agent that does not exist.
            NotAvailableError: labels are wanted for a sample without a label, or an agent is not in this (partial)
                release.
            ConfigError: the link's latency is longer than the past of a sample; `tokens` is a single sample, or
                `config` no V2XConfig; or the cache of images lacks something, or is of other images.
        """
        import torch

        if config is not None and not isinstance(config, V2XConfig):
            raise ConfigError(
                f"config: expected a V2XConfig, such as V2XConfig(agents='all'), found {config!r}"
            )
        self.config = V2XConfig() if config is None else config
        self._dataset = dataset
        self._rows = np.array(_sample_rows(dataset, tokens), dtype=np.int64)
        self._check_agents()
        self._check_labelled()
        self._check_latency()
        self._cache = self._opened_cache()
        # shared memory, so that workers that live longer than an epoch know the next one
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def __len__(self) -> int:
        """Number of samples."""
        return len(self._rows)

    def __repr__(self) -> str:
        """The number of samples, who cooperates, and what an item has."""
        config = self.config
        wanted = {
            name: getattr(config, name)
            for name in ("points", "images", "boxes", "labels", "bev_segmentation")
        }
        contents = "".join(f", {name}" for name, value in wanted.items() if value)
        return f"V2XDataset({len(self):,} sample{'s' * (len(self) != 1)}, agents {config.agents!r}{contents})"

    def set_epoch(self, epoch: int) -> None:
        """Set the number of the next epoch, from 0, before its loader is iterated: each epoch draws new augmentations.

        Raises:
            ConfigError: it is no whole number from 0.
        """
        number = checked_whole("epoch", epoch, "a whole number from 0", ConfigError)
        if number < 0:
            raise ConfigError(f"epoch: expected a whole number from 0, found {epoch}")
        self._epoch.fill_(number)

    def __getitem__(self, index: int) -> V2XItem:
        """The item of a sample, as described for the class.

        Raises:
            IndexError: no such item.
            MissingFileError: a sensor file was not downloaded, and may not be skipped (`V2XConfig.on_missing`).
            SensorFileError: a sensor file cannot be read.
            ConfigError: images have different sizes without `resize`, or are smaller than the crop; or the function
                that draws augmentations returns something else.
        """
        position = range(len(self))[operator.index(index)]
        sample = self._dataset.sample[int(self._rows[position])]["token"]
        augmentation = self.config.augmentation_of(int(self._epoch), position)
        return V2XItem(
            self._received_item(sample, augmentation)
            | self._target_items([sample], augmentation)[0]
        )

    def senders(self) -> list[tuple[AgentName, ...]]:
        """For each item the agents whose data of the present it has, its own first; nothing is read but what is there.

        Raises:
            MissingFileError: a sensor file of a sample's own agent was not downloaded, or may not be skipped.
        """
        tokens = (self._dataset.sample[row]["token"] for row in self._rows.tolist())
        return [tuple(self._arrived(token)[1][-1]) for token in tokens]

    def _arrived(self, sample: str) -> tuple[tuple[AgentName, ...], sensor_data.Received, IntArray]:
        """Who takes part, the messages that arrived, and how many files are lacking (`sensor_data.with_files`)."""
        names = sensor_data.participants(self._dataset, sample, self.config.agents)
        received = sensor_data.received(self._dataset, sample, names, self.config)
        return names, *sensor_data.with_files(
            self._dataset,
            sample,
            names,
            received,
            self.config,
            self._cache,
            needs_own=self._needs_own,
        )

    def _received_item(self, sample: str, augmentation: Augmentation) -> dict[str, Any]:
        """The sample's own tensors, and the sensor data that arrived."""
        import torch

        dataset, config = self._dataset, self.config
        names, arrived, lacking = self._arrived(sample)
        world_from_ego = dataset.world_from(sample, "ego").matrix @ np.linalg.inv(
            augmentation.matrix
        )
        item: dict[str, Any] = {
            "token": sample,
            "agents": names,
            "agent_valid": tensor(sensor_data.valid_mask(names, arrived)),
            "ego_from_agent": tensor(
                sensor_data.relative_poses(dataset, sample, names, arrived, augmentation)
            ),
            "agent_from_past": tensor(
                sensor_data.own_motions(dataset, names, arrived, augmentation)
            ),
            "world_from_ego": tensor(world_from_ego),
            "augmentation": tensor(augmentation.matrix, np.float32),
        }
        if config.on_missing == "skip":
            item["files_missing"] = tensor(lacking)
        if config.points:
            clouds = sensor_data.point_clouds(dataset, names, arrived, augmentation)
            item["points"] = [[tensor(cloud) for cloud in of_agent] for of_agent in clouds]
        if config.images is not None:
            arrays = sensor_data.camera_arrays(
                dataset, names, arrived, augmentation, config.images, self._cache
            )
            item |= {
                name: torch.from_numpy(array) for name, array in arrays.items()
            }  # new arrays: no copy
        return item

    def _target_items(
        self, samples: Sequence[str], augmentation: Augmentation
    ) -> list[dict[str, Any]]:
        """The tensors to be predicted, with each sample's agent as the ego."""
        items: list[dict[str, Any]] = [{} for _ in samples]
        for item, sample, labels in zip(
            items, samples, self._label_items(samples, augmentation), strict=True
        ):
            if self.config.boxes is not None:
                item.update(self._box_item(sample, augmentation))
            item.update(labels)
            if (grid := self.config.bev_segmentation) is not None:
                target = bev_segmentation(self._dataset, sample, grid, augmentation=augmentation)
                item.update(bev_segmentation=tensor(target.masks), bev_known=tensor(target.known))
        return items

    def _box_item(self, sample: str, augmentation: Augmentation) -> dict[str, Tensor]:
        visible, dataset = self.config.visible, self._dataset.with_ignored
        if self.config.boxes == "cooperative":
            names = sensor_data.participants(self._dataset, sample, self.config.agents)
            boxes = cooperative_boxes(dataset, sample, agents=names, frame="ego", visible=visible)
        else:
            boxes = dataset.boxes(sample, "ego", visible)
        return {
            "boxes": tensor(np.nan_to_num(augmented_boxes(boxes, augmentation)), np.float32),
            "velocity_known": tensor(np.isfinite(boxes.velocity).all(axis=1)),
            "categories": tensor(
                np.where(boxes.actor_id < IGNORED_ID, boxes.category, -1), np.int64
            ),
            "actor_ids": tensor(boxes.actor_id),
        }

    def _label_items(
        self, samples: Sequence[str], augmentation: Augmentation
    ) -> Iterator[dict[str, Tensor]]:
        config = self.config.labels
        if not isinstance(config, MotionLabelConfig):
            yield from ({} for _ in samples)
            return
        if self.config.augmentation is not None:
            config = replace(config, augmentation=augmentation)
        for labels in motion_labels_of(self._dataset, samples, config):
            shown = labels
            if self.config.to_present is not None:
                shown = labels.to_present(centerness=self.config.to_present)
            yield {
                "segmentation": tensor(shown.segmentation, np.int64),
                "instance": tensor(shown.instance, np.int64),
                "centerness": tensor(shown.centerness),
                "offset": tensor(shown.offset),
                "flow": tensor(shown.flow),
                "future_egomotion": tensor(
                    augmented_six_vectors(shown.future_egomotion, augmentation), np.float32
                ),
                "label_valid": tensor(shown.label_valid),
            }

    def _opened_cache(self) -> ImageCache | None:
        """The cache of images, if one is wanted and has them."""
        if self.config.images_cache is None or self.config.images is None:
            return None
        cache = ImageCache(self.config.images_cache)
        cache.check(self.config.images)
        _, first = np.unique(
            self._dataset.columns("sample")["agent_row"][self._rows], return_index=True
        )
        asked: dict[str, None] = {}
        for row in self._rows[
            first
        ].tolist():  # one sample of each agent: its partners are always the same
            sample = self._dataset.sample[row]["token"]
            scenario = sample.rsplit("/", 2)[0]
            names = sensor_data.participants(self._dataset, sample, self.config.agents)
            asked.update(dict.fromkeys(agent_token(scenario, name) for name in names))
        cache.check_release(self._dataset, list(asked))
        return cache

    def _check_agents(self) -> None:
        """Check `agents` with the first sample: a mistake is the same for all samples."""
        if len(self):
            first = self._dataset.sample[int(self._rows[0])]["token"]
            sensor_data.participants(self._dataset, first, self.config.agents)

    def _check_labelled(self) -> None:
        if self.config.labels is None:
            return
        bare = self._rows[~self._dataset.columns("sample")["labelled"][:][self._rows]]
        if len(bare):
            raise NotAvailableError(
                f"{len(bare)} of the {len(self)} samples have no label, such as "
                f"{self._dataset.sample[int(bare[0])]['token']} (the test split ships without them); leave them out, "
                "or choose labels=None"
            )

    def _check_latency(self) -> None:
        """Raise now, and not later in an epoch, if partners' data would be from before the recording."""
        frames = 0 if self.config.link is None else self.config.link.latency_frames
        samples, scenarios = self._dataset.columns("sample"), self._dataset.columns("scenario")
        first = scenarios["first_frame_row"][samples["scenario_row"][self._rows]]
        early = self._rows[samples["frame_row"][self._rows] - first < frames]
        tokens = [self._dataset.sample[row]["token"] for row in early.tolist()]
        alone = [
            len(sensor_data.participants(self._dataset, token, self.config.agents)) == 1
            for token in tokens
        ]
        refused = [token for token, without in zip(tokens, alone, strict=True) if not without]
        if refused:
            raise ConfigError(
                f"latency: {len(refused)} of the {len(self)} samples are within the first {frames / 10} s of their "
                f"scenario, such as {refused[0]}, so that partners' data would be from before it; leave them out, or "
                "choose a shorter latency"
            )


def _sample_rows(dataset: Dataset, tokens: Iterable[RowArgument]) -> list[int]:
    """Return the rows of samples; raises ConfigError and TokenError."""
    if not isinstance(dataset, Dataset):
        raise ConfigError(
            f"dataset: expected an open release, DeepAccident(dataroot=…), found {dataset!r}"
        )
    if isinstance(tokens, str | Mapping):
        raise ConfigError(
            "tokens: expected a list of samples, such as da.training_samples('train') or [sample], found "
            f"{token_of(tokens)!r}"
        )
    return [dataset.getind("sample", token) for token in tokens]


def tensor(values: ArrayLike, dtype: DTypeLike | None = None) -> Tensor:
    """A tensor with memory of its own: the devkit's arrays are read-only, and torch has no read-only tensors."""
    import torch

    return torch.from_numpy(np.array(values, dtype=dtype, order="C"))


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

    def __init__(
        self, dataset: Dataset, tokens: Iterable[RowArgument], config: V2XConfig | None = None
    ) -> None:
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
            raise ConfigError(
                "link: each ego receives its own messages; use V2XDataset for data that came over a link"
            )
        moments: dict[tuple[str, str], list[str]] = {}
        for row in _sample_rows(dataset, tokens):
            sample = dataset.sample[row]["token"]
            scenario, _, frame = sample.rsplit("/", 2)
            moments.setdefault((scenario, frame), []).append(sample)
        self.egos = list(moments.values())
        self._agents = config.agents
        super().__init__(dataset, [egos[0] for egos in self.egos], replace(config, agents=None))
        for ego in (
            ego for egos in self.egos[:1] for ego in egos
        ):  # a mistake is the same for all moments
            sensor_data.participants(dataset, ego, config.agents)

    def __getitem__(self, index: int) -> V2XItem:
        """The item of a moment, as described for the class; the errors are those of `V2XDataset`."""
        return self.item(index, int(self._epoch))

    def item(self, index: int, epoch: int) -> V2XItem:
        """The same in an epoch that is given here, and not by `set_epoch`: for loaders that run on through epochs."""
        position = range(len(self))[operator.index(index)]
        augmentation = self.config.augmentation_of(epoch, position)
        item = self._received_item(self.egos[position][0], augmentation)
        there = [
            name
            for name, valid in zip(item["agents"], item["agent_valid"][:, -1], strict=True)
            if valid
        ]
        egos = [ego for ego in self.egos[position] if ego.rsplit("/", 2)[1] in there]
        if not egos:
            raise MissingFileError(
                f"{self.egos[position][0]}: no agent has all its sensor files at this moment; take scenarios that "
                "have them, by a split file (deepaccident split … --where … --out FILE.txt), or choose fewer cameras"
            )
        heard = [sensor_data.participants(self._dataset, ego, self._agents) for ego in egos]
        item["egos"] = tuple(egos)
        item["partners"] = tensor(
            np.array([[name in names for name in item["agents"]] for names in heard])
        )
        item["targets"] = self._target_items(egos, augmentation)
        return V2XItem(item)
