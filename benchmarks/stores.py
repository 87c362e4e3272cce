"""Sensor files in folders, zips and memory; and opening archives of as many members as the release
has files.
"""

import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.measure import Figure, best_of, one_core
from deepaccident_devkit.release import find_release, read_image
from deepaccident_devkit.release.store import ReleasePath, StorePath, index_places, open_dataroot
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
    with tempfile.TemporaryDirectory() as folder:
        figures = _reading(Path(folder))
    with tempfile.TemporaryDirectory() as folder:
        return figures + _opening(Path(folder))


def _reading(folder: Path) -> list[Figure]:
    """Microseconds to read an image's bytes, and milliseconds to decode it, by where it lies; pages
    are cached.
    """
    import fsspec

    names = _write_images(folder / "files")
    for name, method in (("stored", zipfile.ZIP_STORED), ("deflated", zipfile.ZIP_DEFLATED)):
        with zipfile.ZipFile(folder / f"{name}.zip", "w", method) as archive:
            for each in names:
                archive.write(folder / "files" / each, each)
    memory = fsspec.filesystem("memory")
    memory.put(f"{folder}/files/", "/benchmark", recursive=True)
    roots: dict[str, ReleasePath] = {
        "file": folder / "files",
        "zip_stored": open_dataroot(folder / "stored.zip", folder / "index1", workers=1),
        "zip_deflated": open_dataroot(folder / "deflated.zip", folder / "index2", workers=1),
        "memory": open_dataroot("memory://benchmark", folder / "index3"),
    }
    order = np.random.default_rng(0).permutation(names).tolist()
    raw, decoded = {}, {}
    with one_core():
        for name, root in roots.items():
            paths = [root / each for each in order]
            # a label's kind is not kept in the cache of a URL's files, so that the store itself is
            # timed
            raw[name] = (
                1e6 / IMAGES * best_of(15, _all(lambda path: read_bytes(path, "label"), paths))
            )
            decoded[name] = 1e3 / 8 * best_of(5, _all(read_image, paths[:8]))
    contents = {
        name: [read_bytes(root / each, "label") for each in names] for name, root in roots.items()
    }
    if any(content != contents["file"] for content in contents.values()):
        raise AssertionError("the stores disagree")
    memory.rm("/benchmark", recursive=True)
    size = IMAGE_BYTES / 1000
    figures = [
        Figure(name=f"stores_{name}_us", value=raw[name], unit=f"µs for {size:.0f} kB")
        for name in raw
    ]
    figures += [
        Figure(name=f"stores_{name}_image_ms", value=decoded[name], unit="ms") for name in decoded
    ]
    ratios = (
        ("stores_zip_stored_ratio", raw["zip_stored"] / raw["file"], 1.15),
        ("stores_zip_stored_image_ratio", decoded["zip_stored"] / decoded["file"], 1.15),
        ("stores_zip_deflated_image_ratio", decoded["zip_deflated"] / decoded["file"], 1.10),
    )
    return [
        *figures,
        *(
            Figure(name=name, value=value, unit="of a file", bound=most)
            for name, value, most in ratios
        ),
    ]


def _write_images(root: Path) -> list[str]:
    """JPEG files of 1600×900 with the detail of real ones, by their size."""
    import cv2

    random = np.random.default_rng(0)
    small = random.integers(0, 255, (90, 160, 3), dtype=np.uint8)
    picture = cv2.resize(small, (1600, 900), interpolation=cv2.INTER_CUBIC).astype(np.int16)
    names = []
    (root / FOLDER).mkdir(parents=True)
    for number in range(1, IMAGES + 1):
        noisy = np.clip(picture + random.normal(0, 5, picture.shape), 0, 255).astype(np.uint8)
        quality = next(
            each for each in range(90, 0, -5) if len(_jpeg(noisy, each)) < 1.3 * IMAGE_BYTES
        )
        names.append(f"{FOLDER}/Town01_type001_subtype0001_scenario00001_{number:03d}.jpg")
        (root / names[-1]).write_bytes(_jpeg(noisy, quality))
    return names


def _jpeg(picture: np.ndarray, quality: int) -> bytes:
    import cv2

    content: np.ndarray = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return content.tobytes()


def _opening(folder: Path) -> list[Figure]:
    """Opening 14 archives whose members are listed already, and finding a member; the archives are
    empty files.
    """
    archives = [folder / f"{number:02d}.zip" for number in range(14)]
    for archive in archives:
        archive.touch()
    states = {archive.name: state_of(archive) for archive in archives}
    place = next(index_places(folder))
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
        places = np.arange(len(names))
        numbers = {
            "offset": places * 200_000,
            "stored": places,
            "size": places,
            "version": places,
            "deflated": places * 0,
        }
        of_folder = np.repeat(np.arange(len(folders)), FRAMES)
        listings.append(
            Listing(
                archive=archive.name,
                folders=folders,
                folder=of_folder,
                names=names,
                numbers=numbers,
            )
        )
    place.mkdir()
    write_members(place / list_name(sorted(states.items())), listings, {})
    count = sum(len(listing.names) for listing in listings)
    wanted = [f"{listing.folders[0]}/{listing.names[40]}" for listing in listings] * 100

    def opened() -> StorePath:
        opened_store.cache_clear()
        root = open_dataroot(folder)
        layout = find_release(root)
        folder_digest(layout.scenarios, layout.split_files.values())
        return root

    seconds = best_of(5, opened)
    members = opened().store.members
    found = best_of(5, _all(members.find, wanted)) / len(wanted)
    return [
        Figure(name="stores_members", value=count, unit="members, simulated"),
        Figure(name="stores_opening_s", value=seconds, unit="s", bound=0.5),
        Figure(name="stores_finding_us", value=1e6 * found, unit="µs a member"),
    ]


def _all(work: Callable[..., object], items: list) -> Callable[[], object]:
    return lambda: [work(item) for item in items]
