"""Measure sensor files in folders, zips and memory; and opening archives of as many members as the
release has files.
"""

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.measure import Figure, best_of, one_core, temporary_folder
from deepaccident_devkit.release import find_release, read_image
from deepaccident_devkit.release.store import StorePath, index_places, open_dataroot
from deepaccident_devkit.release.store.members import Listing, write_members
from deepaccident_devkit.release.store.opening import list_name, state_of
from deepaccident_devkit.release.store.store import opened_store
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.tables.scan import folder_digest
from deepaccident_devkit.taxonomy import AGENTS, CHANNEL_FORMAT

IMAGES, IMAGE_BYTES = 64, 190_000
SCENARIOS, FRAMES = 691, 83
FOLDER = "type1_subtype1_accident/ego_vehicle/Camera_Front/Town01_type001_subtype0001_scenario00001"


def measure() -> list[Figure]:
    with temporary_folder() as folder:
        figures = _measure_reading(folder)
    with temporary_folder() as folder:
        return figures + _measure_opening(folder)


def _measure_reading(folder: Path) -> list[Figure]:
    """Return the microseconds to read an image's bytes, and the milliseconds to decode it, for each
    kind of store; pages are cached.
    """
    import fsspec

    names = _write_images(folder / "files")
    for name, method in (("stored", zipfile.ZIP_STORED), ("deflated", zipfile.ZIP_DEFLATED)):
        with zipfile.ZipFile(folder / f"{name}.zip", "w", method) as archive:
            for image in names:
                archive.write(folder / "files" / image, image)
    memory = fsspec.filesystem("memory")
    memory.put(f"{folder}/files/", "/benchmark", recursive=True)
    roots = {
        "file": folder / "files",
        "zip_stored": open_dataroot(folder / "stored.zip", folder / "index1", workers=1),
        "zip_deflated": open_dataroot(folder / "deflated.zip", folder / "index2", workers=1),
        "memory": open_dataroot("memory://benchmark", folder / "index3"),
    }
    order = np.random.default_rng(0).permutation(names).tolist()
    reading_us = {}
    decoding_ms = {}
    with one_core():
        for name, root in roots.items():
            paths = [root / image for image in order]
            # the cache of a URL's files does not keep labels, so that the store itself is timed
            read_all = _for_all(lambda path: read_bytes(path, "label"), paths)
            reading_us[name] = 1e6 / IMAGES * best_of(15, read_all)
            decoding_ms[name] = 1e3 / 8 * best_of(5, _for_all(read_image, paths[:8]))
    for image in names:
        content = read_bytes(folder / "files" / image, "label")
        if any(read_bytes(root / image, "label") != content for root in roots.values()):
            raise AssertionError("the stores disagree")
    memory.rm("/benchmark", recursive=True)
    unit = f"µs for {IMAGE_BYTES / 1000:.0f} kB"
    figures = [Figure(f"stores_{name}_us", value, unit) for name, value in reading_us.items()]
    figures += [
        Figure(f"stores_{name}_image_ms", value, "ms") for name, value in decoding_ms.items()
    ]
    ratios = (
        ("zip_stored", reading_us["zip_stored"] / reading_us["file"], 1.15),
        ("zip_stored_image", decoding_ms["zip_stored"] / decoding_ms["file"], 1.15),
        ("zip_deflated_image", decoding_ms["zip_deflated"] / decoding_ms["file"], 1.10),
    )
    figures += [
        Figure(f"stores_{name}_ratio", value, "of a file", bound=bound)
        for name, value, bound in ratios
    ]
    return figures


def _write_images(root: Path) -> list[str]:
    """Write JPEG files of 1600×900 with about as much detail and as many bytes as real ones; return
    their names.
    """
    import cv2

    random = np.random.default_rng(0)
    small = random.integers(0, 255, (90, 160, 3), dtype=np.uint8)
    picture = cv2.resize(small, (1600, 900), interpolation=cv2.INTER_CUBIC).astype(np.int16)
    names = []
    (root / FOLDER).mkdir(parents=True)
    for number in range(1, IMAGES + 1):
        noise = random.normal(0, 5, picture.shape)
        noisy = np.clip(picture + noise, 0, 255).astype(np.uint8)
        contents = (_jpeg(noisy, quality) for quality in range(90, 0, -5))
        content = next(content for content in contents if len(content) < 1.3 * IMAGE_BYTES)
        name = f"{FOLDER}/Town01_type001_subtype0001_scenario00001_{number:03d}.jpg"
        (root / name).write_bytes(content)
        names.append(name)
    return names


def _jpeg(picture: np.ndarray, quality: int) -> bytes:
    import cv2

    content = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return content.tobytes()


def _measure_opening(folder: Path) -> list[Figure]:
    """Measure opening 14 archives with members that are listed already, and finding a member; the
    archives are empty files.
    """
    archives = [folder / f"{number:02d}.zip" for number in range(14)]
    for archive in archives:
        archive.touch()
    states = {archive.name: state_of(archive) for archive in archives}
    index = next(index_places(folder))
    kinds = [*CHANNEL_FORMAT, "calib", "label"]
    listings = []
    for number, archive in enumerate(archives):
        scenarios = range(number, SCENARIOS, len(archives))
        folders, names = [], []
        for scenario in scenarios:
            stem = f"Town{scenario % 10:02d}_type001_subtype0001_scenario{scenario:05d}"
            folders += [
                f"type1_subtype1_accident/{agent}/{kind}/{stem}"
                for agent in AGENTS
                for kind in kinds
            ]
            files = [f"{stem}_{frame:03d}.jpg" for frame in range(1, FRAMES + 1)]
            names += files * (len(AGENTS) * len(kinds))
        rows = np.arange(len(names))
        numbers = {
            "offset": rows * 200_000,
            "stored": rows,
            "size": rows,
            "version": rows,
            "deflated": rows * 0,
        }
        folder_of_member = np.repeat(np.arange(len(folders)), FRAMES)
        listings.append(
            Listing(
                archive=archive.name,
                folders=folders,
                folder=folder_of_member,
                names=names,
                numbers=numbers,
            )
        )
    index.mkdir()
    write_members(index / list_name(sorted(states.items())), listings, {})
    count = sum(len(listing.names) for listing in listings)
    paths = [f"{listing.folders[0]}/{listing.names[40]}" for listing in listings] * 100

    def open_archives() -> StorePath:
        opened_store.cache_clear()
        root = open_dataroot(folder)
        layout = find_release(root)
        folder_digest(layout.scenarios, layout.split_files.values())
        return root

    opening_s = best_of(5, open_archives)
    members = open_archives().store.members
    finding_s = best_of(5, _for_all(members.find, paths)) / len(paths)
    return [
        Figure("stores_members", count, "members, simulated"),
        Figure("stores_opening_s", opening_s, "s", bound=0.5),
        Figure("stores_finding_us", 1e6 * finding_s, "µs a member"),
    ]


def _for_all(work: Callable[..., object], items: list) -> Callable[[], object]:
    return lambda: [work(item) for item in items]
