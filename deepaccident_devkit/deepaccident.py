"""`DeepAccident`: the facade that binds functions of all lower layers to one release."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import IndexStoreError, escaped
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.store import Dataroot, open_dataroot
from deepaccident_devkit.support.nuscenes_names import with_keywords_named
from deepaccident_devkit.support.text import PathType, counted, path_of
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.tables import open_index
from deepaccident_devkit.taxonomy import OnError


class _LazyMethod:
    """A function of a package that is slow to import, imported and stored at its first use.

    `DeepAccident` binds functions of all layers, and a user who only reads tables should not wait
    until rendering is imported.
    """

    def __init__(self, load: Callable[[], Any]) -> None:
        self._load = load

    def __set_name__(self, owner: type, name: str) -> None:
        self._owner = owner
        self._name = name

    def __get__(self, instance: object, owner: type) -> Any:
        function = self._load()
        setattr(self._owner, self._name, function)
        return function.__get__(instance, owner)


class _LazyPackage:
    """A run-time stand-in for a slow package, whose attributes are resolved at their first use.

    Type checkers see the real package, and so every signature; no function has to be named twice.
    """

    def __init__(self, name: str) -> None:
        self._name = f"{__package__}.{name}"

    def __getattr__(self, name: str) -> _LazyMethod:
        # Tools probe any object for private names.
        if name.startswith("_"):
            raise AttributeError(name)
        return _LazyMethod(lambda: getattr(import_module(self._name), name))


if TYPE_CHECKING:
    from concurrent.futures import Executor

    from deepaccident_devkit import descriptions, maps, motion, render, selection, v2x, validation
    from deepaccident_devkit import interactions as interactions_of_pairs
    from deepaccident_devkit.selection import samples as sample_lists
else:
    descriptions, maps, motion, render, selection, v2x, validation = map(
        _LazyPackage,
        ("descriptions", "maps", "motion", "render", "selection", "v2x", "validation"),
    )
    interactions_of_pairs = _LazyPackage("interactions")
    sample_lists = _LazyPackage("selection.samples")


class DeepAccident(Dataset):
    """A DeepAccident release with its tables, sensor data, boxes and transforms.

    The first call reads all label, calib and meta files and stores an index of them; later calls
    open the index in milliseconds. Sensor files are only needed when they are read. An instance is
    cheap to pickle, so each worker of a PyTorch DataLoader can have one.

    Examples:
        >>> da = DeepAccident(version="v1", dataroot="data/DeepAccident")  # doctest: +SKIP
        >>> da.get_boxes(da.sample[0], frame="ego")  # doctest: +SKIP
    """

    @with_keywords_named
    def __init__(
        self,
        version: str = "v1",
        dataroot: Dataroot = "data/DeepAccident",
        index_dir: PathType | None = None,
        workers: int | None = None,
        on_error: OnError = "raise",
        verbose: bool = True,  # noqa: FBT001, FBT002 - the nuScenes devkit's signature
        *,
        executor: Executor | None = None,
    ) -> None:
        """Open a release; index it first if necessary.

        Args:
            version: `v1` (train, val and test, or the flat layout) or `v1-mini`.
            dataroot: Folder that the release was unpacked into; or a zip, a folder of zips, or a
                URL that fsspec can list, such as `s3://bucket/DeepAccident` (docs/reading.md).
            index_dir: Folder for the index of this release only; by default
                `<dataroot>/.deepaccident`, or the user's cache folder if that folder cannot be
                written.
            workers: Number of processes for indexing; None chooses by the amount of work.
            on_error: What to do about broken scenarios and unreadable archives: `raise` an error
                that lists all of them, or `skip` and log them.
            verbose: Whether to show a progress bar while indexing.
            executor: A `concurrent.futures` executor that indexes; None starts worker processes.

        Raises:
            DatarootError: If the folder does not exist or contains no release, or if an archive or
                a URL cannot be read.
            VersionError: If the version is unknown, or is not under this folder.
            BrokenReleaseError: If scenarios are broken; the message lists them all.
            IndexStoreError: If the index cannot be written.
            MissingExtraError: If the dataroot is a URL, and the extra `cloud` is not installed.
        """
        engine: NamedValues = {"workers": workers, "executor": executor, "progress": verbose}
        index_path: Path | None = None
        if index_dir is not None:
            path = path_of(index_dir, "index_dir: expected a path")
            index_path = Path(os.path.abspath(path))  # noqa: PTH100
        store = open_dataroot(dataroot, index_path, on_error=on_error, **engine)
        layout = find_release(store, version)
        for is_last_attempt in (False, True):
            index = open_index(layout, index_dir=index_path, on_error=on_error, **engine)
            try:
                super().__init__(
                    dataroot=layout.root,
                    version=layout.version,
                    layout=layout.layout,
                    split_files=layout.split_files,
                    tables_folder=index.tables_folder,
                    problems=index.problems,
                )
                break
            except IndexStoreError:
                # Another process may have just replaced the tables with newer ones: try once more.
                if is_last_attempt or index.tables_folder.is_dir():
                    raise

    find = selection.find
    transform = v2x.transform
    aggregate_point_cloud = v2x.aggregate_point_cloud
    cooperative_boxes = v2x.cooperative_boxes
    visible_instances = v2x.visible_instances
    project_to_image = v2x.project_to_image
    map_pointcloud_to_image = v2x.map_pointcloud_to_image
    trajectory = v2x.trajectory
    agent_motion = v2x.agent_motion
    window = v2x.window
    windows = v2x.windows
    collision = v2x.collision
    message_sizes = v2x.message_sizes
    interactions = interactions_of_pairs.interactions
    town_map = maps.town_map
    describe = descriptions.describe
    motion_labels = motion.motion_labels
    motion_labels_of = motion.motion_labels_of
    bev_segmentation = motion.bev_segmentation
    samples = sample_lists.samples
    training_samples = sample_lists.training_samples
    evaluation_samples = sample_lists.evaluation_samples
    findings = validation.findings
    render_sample = render.render_sample
    render_frame = render.render_frame
    render_sample_data = render.render_sample_data
    render_annotation = render.render_annotation
    render_instance = render.render_instance
    render_pointcloud_in_image = render.render_pointcloud_in_image
    render_bev = render.render_bev
    render_calibration = render.render_calibration
    render_motion_labels = render.render_motion_labels
    render_visibility = render.render_visibility
    render_visibility_matrix = render.render_visibility_matrix
    render_accident = render.render_accident
    render_teaser = render.render_teaser
    render_link = render.render_link
    render_evaluation = render.render_evaluation
    render_scenario_video = render.render_scenario_video
    render_replay = render.render_replay
    render_town_map = render.render_town_map

    def list_scenarios(self) -> None:
        """Print a line for each scenario."""
        from deepaccident_devkit.statistics.overview import scenario_lines

        _print_lines(scenario_lines(self.scenario))

    def list_agents(self) -> None:
        """Print the number of scenarios that each agent recorded."""
        from deepaccident_devkit.statistics.overview import agent_lines

        _print_lines(agent_lines(self))

    def list_categories(self) -> None:
        """Print each category's index, name and counts."""
        from deepaccident_devkit.statistics.overview import category_lines

        _print_lines(category_lines(self))

    @with_keywords_named
    def list_sample(self, sample: RowArgument) -> None:
        """Print the files and boxes of a sample; raise TokenError if it is unknown."""
        from deepaccident_devkit.statistics.overview import sample_lines

        _print_lines(sample_lines(self, sample))

    def __repr__(self) -> str:
        """Return version, dataroot and size."""
        return (
            f"{type(self).__name__}(version={self.version!r}, dataroot={str(self.dataroot)!r}): "
            f"{counted(len(self.scenario), 'scenario')}, {counted(len(self.sample), 'sample')}, "
            f"{counted(len(self.annotation), 'annotation')}"
        )


def _print_lines(lines: Sequence[str]) -> None:
    print(escaped("\n".join(lines)))  # noqa: T201 - the `list_*` methods print
