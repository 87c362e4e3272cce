"""`V2XDataset`: cooperative samples of a release as a map-style torch dataset.

`AllEgosDataset` has all egos of a moment: a model that encodes each agent's sensors separately
learns from as many targets as there are egos, for one encoding.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import compress
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, MissingFileError, NotAvailableError
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig, bev_segmentation
from deepaccident_devkit.motion.sample_labels import motion_labels_of
from deepaccident_devkit.support.arrays import IntArray, checked_whole
from deepaccident_devkit.support.values import NamedValues
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
from deepaccident_devkit.v2x import WindowConfig, cooperative_boxes
from deepaccident_devkit.v2x.windows import configured_window

if TYPE_CHECKING:
    from torch import Tensor

    # Without torch's types mypy would see an Any here, and strict mode forbids Any as a base class.
    TorchDataset = object
else:
    from torch.utils.data import Dataset as TorchDataset


class V2XDataset(TorchDataset):
    """Samples of a release with the data of cooperating agents; an item is a dict of tensors.

    Everything is right-handed: x forward, y left, z up; metres, radians, seconds. With an
    augmentation G, all ego frames are augmented: a point p becomes G p, a pose W between ego frames
    becomes G W G⁻¹, and images do not change. In shapes, A is the number of agents (the sample's
    own agent is first), P the number of frames (the present is last), C the number of cameras, T
    and R are numbers of label frames (see `motion.MotionLabels`), and H × W are the rows and
    columns of a grid in its own orientation.

    Always:

    - `token`: str. `agents`: tuple of the names of the A agents.
    - `agent_valid` (A, P) bool: False if the link lost a message, if the frame is before the
      recording, or if sensor files are skipped. In these cases, clouds are empty, images are 0 and
      matrices are the identity.
    - `ego_from_agent` (A, P, 4, 4) float32: transform from the sender's ego frame at that frame to
      the present ego frame of the sample's agent, as this agent knows it: with pose noise. Entry
      [0, −1] is the identity, and entries [0, :] are the agent's own motion.
    - `agent_from_past` (A, P, 4, 4) float32: transform from the sender's ego frame at that frame to
      its ego frame at its last frame, by its own exact poses. A sender can use it to combine its
      own frames before it sends data.
    - `world_from_ego` (4, 4) float64: pose of the sample's agent at the present, as a transform
      from the augmented ego frame.
    - `augmentation` (4, 4) float32: the augmentation G.

    With `on_missing="skip"`: `files_missing` (A, P) int64, the number of requested sensor files
    that are missing.

    With `points`: `points`, a list of A lists of P clouds (N, 4) float32: x y z in the sender's own
    ego frame at that frame, and the intensity.

    With `images`:

    - `images` (A, P, C, 3, h, w), RGB, as described in `ImageConfig`.
    - `intrinsics` (A, P, C, 3, 3) float32, of the resized and cropped image; pixel centres are at
      0.5, 1.5, ….
    - `ego_from_camera` (A, P, C, 4, 4) float32: transform from the optical camera frame to the
      sender's augmented ego frame (with a scale it is not rigid, with a flip not right-handed).
    - `image_from_ego` (A, P, C, 4, 4) float32: projection of a point of the sender's ego frame to
      (u · d, v · d, d, 1), where d is the depth.

    With `boxes`, M of them in the ego frame of the sample's agent at the present:

    - `boxes` (M, 9) float32: x y z l w h yaw vx vy; z of the centre. `velocity_known` (M,) bool:
      False if vx and vy are 0 because they are unknown.
    - `categories` (M,) int64, indices into `taxonomy.CATEGORIES`; −1 must be ignored: it is a class
      of another source that the devkit does not have. `actor_ids` (M,) int64, as in the label (−100
      is the agent's own row) or, for cooperative boxes, CARLA's ids; −1 is an untracked actor.

    With `window`: `window`, a dict of the N actors' tracks in T steps (`v2x.TrackWindow`), in the
    ego frame of the sample's agent at the present. Floats are float32, and NaN where not `valid`;
    whole numbers are int64, masks uint8 and bool.

    With `labels`, where each map is in the present ego frame or in the ego frame of its own moment,
    depending on `to_present`:

    - `segmentation` (T, H, W) int64, `instance` (T, H, W) int64, `centerness` (T, 1, H, W) float32,
      `offset` and `flow` (T, 2, H, W) float32.
    - `future_egomotion` (R, 6) float32: `next_from_this` from the first past frame on, between
      augmented ego frames.
    - `label_valid` (T,) bool: whether each frame is in the recording.

    With `bev_segmentation`: `bev_segmentation` (5, H, W) bool, classes as `motion.BEV_CLASSES`, and
    `bev_known` (H, W) bool (`motion.BevSegmentation`).

    Items depend only on the configuration, the epoch and the index, not on workers. The dataset is
    quick to pickle and works in forked and in spawned workers.
    """

    # Whether an item requires the files of the sample's own agent.
    _needs_own: ClassVar[bool] = True

    def __init__(
        self, dataset: Dataset, tokens: Iterable[RowArgument], config: V2XConfig | None = None
    ) -> None:
        """Select samples, such as from `motion.training_samples`, and the contents of their items.

        Args:
            dataset: The release.
            tokens: Tokens or records of samples; each becomes an item, in this order.
            config: Contents of an item; None for the agent's own points and boxes.

        Raises:
            TokenError: If there is no such sample.
            ChoiceError: If the configuration names an agent that does not exist.
            NotAvailableError: If labels are requested for a sample without a label, or an agent is
                not in this (partial) release.
            ConfigError: If the link's latency is longer than the past of a sample, `tokens` is a
                single sample, `config` is not a V2XConfig, or the cache of images lacks something
                or was made of other images.
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
        self._cache = self._open_cache()
        # in shared memory, so that workers that live longer than an epoch know the next epoch
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._rows)

    def __repr__(self) -> str:
        """Return the number of samples, the cooperating agents, and the contents of an item."""
        config = self.config
        contents = ""
        for name in ("points", "images", "boxes", "window", "labels", "bev_segmentation"):
            if getattr(config, name):
                contents += f", {name}"
        plural = "s" * (len(self) != 1)
        return f"V2XDataset({len(self):,} sample{plural}, agents {config.agents!r}{contents})"

    def set_epoch(self, epoch: int) -> None:
        """Set the number of the next epoch, from 0, before its loader is iterated.

        Each epoch draws new augmentations.

        Raises:
            ConfigError: If the number is not a whole number from 0.
        """
        number = checked_whole("epoch", epoch, "a whole number from 0", ConfigError)
        if number < 0:
            raise ConfigError(f"epoch: expected a whole number from 0, found {epoch}")
        self._epoch.fill_(number)

    def __getitem__(self, index: int) -> V2XItem:
        """Return the item of a sample, as described for the class.

        Raises:
            IndexError: If there is no such item.
            MissingFileError: If a sensor file was not downloaded and may not be skipped
                (`V2XConfig.on_missing`).
            SensorFileError: If a sensor file cannot be read.
            ConfigError: If images have different sizes without `resize`, or are smaller than the
                crop, or the function that draws augmentations returns something else.
        """
        position = range(len(self))[operator.index(index)]
        row = int(self._rows[position])
        sample = self._dataset.sample[row]["token"]
        augmentation = self.config.augmentation_of(int(self._epoch), position)
        received_item = self._received_item(sample, augmentation)
        (target_item,) = self._target_items([sample], augmentation)
        return V2XItem(received_item | target_item)

    def senders(self) -> list[tuple[AgentName, ...]]:
        """Return the agents with data of the present in each item, the own agent first.

        Nothing is read; files are only looked up.

        Raises:
            MissingFileError: If a sensor file of a sample's own agent was not downloaded, or may
                not be skipped.
        """
        senders = []
        for row in self._rows.tolist():
            _, arrived, _ = self._arrived(self._dataset.sample[row]["token"])
            senders.append(tuple(arrived[-1]))
        return senders

    def _arrived(self, sample: str) -> tuple[tuple[AgentName, ...], sensor_data.Received, IntArray]:
        """Return the participants, the messages that arrived, and the numbers of missing files.

        The numbers are as in `sensor_data.with_files`.
        """
        dataset = self._dataset
        config = self.config
        names = sensor_data.participants(dataset, sample, config.agents)
        received = sensor_data.received_messages(dataset, sample, names, config)
        arrived, missing_counts = sensor_data.with_files(
            dataset, sample, names, received, config, self._cache, needs_own=self._needs_own
        )
        return names, arrived, missing_counts

    def _received_item(self, sample: str, augmentation: Augmentation) -> NamedValues:
        """Return the sample's own tensors, and the sensor data that arrived."""
        import torch

        dataset = self._dataset
        config = self.config
        names, arrived, missing_counts = self._arrived(sample)
        inverse_augmentation = np.linalg.inv(augmentation.matrix)
        world_from_ego = dataset.world_from(sample, "ego").matrix @ inverse_augmentation
        poses = sensor_data.relative_poses(dataset, sample, names, arrived, augmentation)
        motions = sensor_data.own_motions(dataset, names, arrived, augmentation)
        item: NamedValues = {
            "token": sample,
            "agents": names,
            "agent_valid": tensor(sensor_data.valid_mask(names, arrived)),
            "ego_from_agent": tensor(poses),
            "agent_from_past": tensor(motions),
            "world_from_ego": tensor(world_from_ego),
            "augmentation": tensor(augmentation.matrix, np.float32),
        }
        if config.on_missing == "skip":
            item["files_missing"] = tensor(missing_counts)
        if config.points:
            clouds = sensor_data.point_clouds(dataset, names, arrived, augmentation)
            item["points"] = [[tensor(cloud) for cloud in agent_clouds] for agent_clouds in clouds]
        if config.images is not None:
            arrays = sensor_data.camera_arrays(
                dataset, names, arrived, augmentation, config.images, self._cache
            )
            for name, array in arrays.items():
                item[name] = torch.from_numpy(array)  # not copied, because these arrays are new
        return item

    def _target_items(
        self, samples: Sequence[str], augmentation: Augmentation
    ) -> list[NamedValues]:
        """Return the tensors to be predicted, with each sample's agent as the ego."""
        grid = self.config.bev_segmentation
        items: list[NamedValues] = []
        label_items = self._label_items(samples, augmentation)
        for sample, label_item in zip(samples, label_items, strict=True):
            item: NamedValues = {}
            if self.config.boxes is not None:
                item.update(self._box_item(sample, augmentation))
            if self.config.window is not None:
                item["window"] = self._window_item(sample, self.config.window, augmentation)
            item.update(label_item)
            if grid is not None:
                target = bev_segmentation(self._dataset, sample, grid, augmentation=augmentation)
                item.update(bev_segmentation=tensor(target.masks), bev_known=tensor(target.known))
            items.append(item)
        return items

    def _box_item(self, sample: str, augmentation: Augmentation) -> dict[str, Tensor]:
        """Return the tensors of a sample's boxes."""
        visible = self.config.visible
        dataset = self._dataset.with_ignored
        if self.config.boxes == "cooperative":
            names = sensor_data.participants(self._dataset, sample, self.config.agents)
            boxes = cooperative_boxes(dataset, sample, agents=names, frame="ego", visible=visible)
        else:
            boxes = dataset.boxes(sample, "ego", visible)
        box_array = np.nan_to_num(augmented_boxes(boxes, augmentation))
        categories = np.where(boxes.actor_id < IGNORED_ID, boxes.category, -1)
        return {
            "boxes": tensor(box_array, np.float32),
            "velocity_known": tensor(np.isfinite(boxes.velocity).all(axis=1)),
            "categories": tensor(categories, np.int64),
            "actor_ids": tensor(boxes.actor_id),
        }

    def _window_item(
        self, sample: str, config: WindowConfig, augmentation: Augmentation
    ) -> dict[str, Tensor]:
        """Return the tensors of a sample's window of tracks."""
        window = configured_window(self._dataset, sample, config)
        tensors = {}
        for name, array in window.augmented(augmentation.matrix).arrays.items():
            item_types = {"f": np.float32, "i": np.int64}
            tensors[name] = tensor(array, item_types.get(array.dtype.kind, array.dtype))
        return tensors

    def _label_items(
        self, samples: Sequence[str], augmentation: Augmentation
    ) -> Iterator[dict[str, Tensor]]:
        """Yield the tensors of each sample's motion labels."""
        config = self.config.labels
        if not isinstance(config, MotionLabelConfig):
            yield from ({} for _ in samples)
            return
        if self.config.augmentation is not None:
            config = replace(config, augmentation=augmentation)
        for labels in motion_labels_of(self._dataset, samples, config):
            warped = labels
            if self.config.to_present is not None:
                warped = labels.to_present(centerness=self.config.to_present)
            egomotion = augmented_six_vectors(warped.future_egomotion, augmentation)
            yield {
                "segmentation": tensor(warped.segmentation, np.int64),
                "instance": tensor(warped.instance, np.int64),
                "centerness": tensor(warped.centerness),
                "offset": tensor(warped.offset),
                "flow": tensor(warped.flow),
                "future_egomotion": tensor(egomotion, np.float32),
                "label_valid": tensor(warped.label_valid),
            }

    def _open_cache(self) -> ImageCache | None:
        """Return the cache of images, if it is configured and has the images."""
        if self.config.images_cache is None or self.config.images is None:
            return None
        cache = ImageCache(self.config.images_cache)
        cache.check(self.config.images)
        agent_rows = self._dataset.columns("sample")["agent_row"][self._rows]
        _, indices = np.unique(agent_rows, return_index=True)
        agents: dict[str, None] = {}
        # one sample of each agent is enough, because its partners are always the same
        for row in self._rows[indices].tolist():
            sample = self._dataset.sample[row]["token"]
            scenario, _, _ = sample.rsplit("/", 2)
            for name in sensor_data.participants(self._dataset, sample, self.config.agents):
                agents[agent_token(scenario, name)] = None
        cache.check_release(self._dataset, list(agents))
        return cache

    def _check_agents(self) -> None:
        """Check `agents` with the first sample, because a mistake is the same for all samples."""
        if len(self):
            sample = self._dataset.sample[int(self._rows[0])]["token"]
            sensor_data.participants(self._dataset, sample, self.config.agents)

    def _check_labelled(self) -> None:
        """Check that all samples have labels, if targets need them; raises NotAvailableError."""
        if self.config.labels is None and self.config.window is None:
            return
        is_labelled = self._dataset.columns("sample")["labelled"][:][self._rows]
        unlabelled_rows = self._rows[~is_labelled]
        if len(unlabelled_rows):
            token = self._dataset.sample[int(unlabelled_rows[0])]["token"]
            raise NotAvailableError(
                f"{len(unlabelled_rows)} of the {len(self)} samples have no label, such as {token} "
                "(the test split has none); exclude them, or choose labels=None and window=None"
            )

    def _check_latency(self) -> None:
        """Check that partners' data are from the recording now, and not later in an epoch.

        Raises:
            ConfigError: If partners' data would be from before the recording.
        """
        frames = 0 if self.config.link is None else self.config.link.latency_frames
        samples = self._dataset.columns("sample")
        scenario_rows = samples["scenario_row"][self._rows]
        first_frame_rows = self._dataset.columns("scenario")["first_frame_row"][scenario_rows]
        frame_numbers = samples["frame_row"][self._rows] - first_frame_rows
        refused_tokens = []
        for row in self._rows[frame_numbers < frames].tolist():
            token = self._dataset.sample[row]["token"]
            names = sensor_data.participants(self._dataset, token, self.config.agents)
            if len(names) > 1:
                refused_tokens.append(token)
        if refused_tokens:
            raise ConfigError(
                f"latency: {len(refused_tokens)} of the {len(self)} samples are within the first "
                f"{frames / 10} s of their scenario, such as {refused_tokens[0]}, so partners' "
                "data would be from before its start; exclude these samples, or choose a "
                "shorter latency"
            )


def _sample_rows(dataset: Dataset, tokens: Iterable[RowArgument]) -> list[int]:
    """Return the rows of samples.

    Raises:
        ConfigError: If the dataset is not a release, or a single sample is given.
        TokenError: If there is no such sample.
    """
    if not isinstance(dataset, Dataset):
        raise ConfigError(
            f"dataset: expected an open release, DeepAccident(dataroot=…), found {dataset!r}"
        )
    if isinstance(tokens, str | Mapping):
        raise ConfigError(
            "tokens: expected a list of samples, such as da.training_samples('train') or [sample], "
            f"found {token_of(tokens)!r}"
        )
    return [dataset.getind("sample", token) for token in tokens]


def tensor(values: ArrayLike, dtype: DTypeLike | None = None) -> Tensor:
    """Return a tensor with its own memory.

    The devkit's arrays are read-only, and torch has no read-only tensors.
    """
    import torch

    return torch.from_numpy(np.array(values, dtype=dtype, order="C"))


class AllEgosDataset(V2XDataset):
    """Moments of a release; an item is a dict of tensors.

    An item has the sensor data of a `V2XDataset` item, for the first ego of the moment and all
    agents of the release at this moment, all with the same augmentation, and:

    - `egos`: tokens of the E samples of this moment, without agents with skipped sensor files.
    - `partners` (E, A) bool: whether each agent cooperates with each ego, as configured by
      `agents`; an ego cooperates with itself.
    - `targets`: E dicts with the boxes, labels and segmentation of a `V2XDataset` item, each in the
      frame of its ego.

    `collate_all_egos` makes batches of them.

    Attributes:
        egos: The samples of each item.
    """

    _needs_own = False

    def __init__(
        self, dataset: Dataset, tokens: Iterable[RowArgument], config: V2XConfig | None = None
    ) -> None:
        """Select the egos' samples, in any order; samples of one moment become one item.

        Args:
            dataset: The release.
            tokens: Tokens or records of samples.
            config: Contents of an item; None for `V2XConfig()`. Its `agents` cooperate with each
                ego.

        Raises:
            DeepAccidentError: As in `V2XDataset`.
            ConfigError: Also if there is a link, which is not the same for all egos.
        """
        config = V2XConfig() if config is None else config
        if config.link is not None:
            raise ConfigError(
                "link: each ego receives its own messages; use V2XDataset for data that came over "
                "a link"
            )
        moments: dict[tuple[str, str], list[str]] = {}
        for row in _sample_rows(dataset, tokens):
            sample = dataset.sample[row]["token"]
            scenario, _, frame = sample.rsplit("/", 2)
            moments.setdefault((scenario, frame), []).append(sample)
        self.egos = list(moments.values())
        self._agents = config.agents
        first_egos = [egos[0] for egos in self.egos]
        super().__init__(dataset, first_egos, replace(config, agents=None))
        # a mistake is the same for all moments, so the first moment is enough
        for egos in self.egos[:1]:
            for ego in egos:
                sensor_data.participants(dataset, ego, config.agents)

    def __getitem__(self, index: int) -> V2XItem:
        """Return the item of a moment, as described for the class; errors as in `V2XDataset`."""
        return self.item(index, int(self._epoch))

    def item(self, index: int, epoch: int) -> V2XItem:
        """Return the item of a moment in a given epoch, instead of the one that `set_epoch` set.

        It is for loaders that continue through epochs.
        """
        position = range(len(self))[operator.index(index)]
        moment_egos = self.egos[position]
        augmentation = self.config.augmentation_of(epoch, position)
        item = self._received_item(moment_egos[0], augmentation)
        has_data = item["agent_valid"][:, -1]
        present_names = set(compress(item["agents"], has_data))
        egos = []
        for ego in moment_egos:
            _, name, _ = ego.rsplit("/", 2)
            if name in present_names:
                egos.append(ego)
        if not egos:
            raise MissingFileError(
                f"{moment_egos[0]}: no agent has all its sensor files at this moment; choose "
                "scenarios that have these files with a split file (deepaccident split … "
                "--where … --out FILE.txt), or choose fewer cameras"
            )
        is_partner = []
        for ego in egos:
            partner_names = sensor_data.participants(self._dataset, ego, self._agents)
            is_partner.append([name in partner_names for name in item["agents"]])
        item["egos"] = tuple(egos)
        item["partners"] = tensor(is_partner)
        item["targets"] = self._target_items(egos, augmentation)
        return V2XItem(item)
