"""Read a release on S3: bytes, worker processes, credentials and errors."""

import logging
import os
import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
from support.zipped_releases import image_sum

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import DatarootError, SensorFileError

LOCATIONS = ("data/DeepAccident", "zips/all.zip", "zips")


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEEPACCIDENT_CACHE", str(tmp_path / "copies"))


@pytest.fixture(scope="module", params=LOCATIONS)
def remote(
    request: pytest.FixtureRequest, bucket: str, tmp_path_factory: pytest.TempPathFactory
) -> DeepAccident:
    index = tmp_path_factory.mktemp("index")
    return DeepAccident(
        dataroot=f"{bucket}/{request.param}", index_dir=index, workers=1, verbose=False
    )


def test_tables_and_files_have_the_same_bytes(remote: DeepAccident, da: DeepAccident) -> None:
    tables = [path for path in da.tables_folder.iterdir() if path.is_file()]
    for path in tables:  # another test may have stored folders beside them
        assert (remote.tables_folder / path.name).read_bytes() == path.read_bytes()

    for sample in (da.sample[0]["token"], da.sample[40]["token"]):
        for channel in ("Camera_Back", "lidar01", "BEV_instance_camera"):
            path = da.get_sample_data_path(sample, channel)
            assert remote.local_path(sample, channel).read_bytes() == path.read_bytes()
        assert image_sum(remote, sample) == image_sum(da, sample)
    assert remote.split_scenarios("train") == da.split_scenarios("train")


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_workers_read_the_same_bytes(remote: DeepAccident, da: DeepAccident, method: str) -> None:
    samples = [da.sample[number]["token"] for number in (0, 3, 9, 30)]
    expected = [image_sum(da, sample) for sample in samples]
    copy = pickle.loads(pickle.dumps(remote))
    assert image_sum(copy, samples[0]) == expected[0]
    with ProcessPoolExecutor(2, mp_context=get_context(method)) as pool:
        assert list(pool.map(image_sum, [remote] * 4, samples)) == expected


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_loader_with_two_workers_gives_the_same_batches(
    remote: DeepAccident, da: DeepAccident, method: str
) -> None:
    torch = pytest.importorskip("torch")
    from deepaccident_devkit.training.torch import ImageConfig, V2XConfig, V2XDataset, collate

    tokens = [da.sample[number]["token"] for number in (1, 4, 8)]
    config = V2XConfig(agents="+infrastructure", images=ImageConfig(resize=(18, 32)))
    batches = []
    for dataset, workers in ((da, 0), (remote, 2)):
        loader = torch.utils.data.DataLoader(
            V2XDataset(dataset, tokens, config),
            collate_fn=collate,
            num_workers=workers,
            multiprocessing_context=method if workers else None,
        )
        batches.append(list(loader))

    for local, remote_batch in zip(*batches, strict=True):
        assert torch.equal(local["images"], remote_batch["images"])
        assert torch.equal(local["points"][0][1][0], remote_batch["points"][0][1][0])


def test_no_file_or_message_contains_a_credential(
    bucket: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level(logging.INFO)
    dataset = DeepAccident(
        dataroot=f"{bucket}/zips",
        index_dir=tmp_path / "index",
        workers=1,
    )
    image_sum(dataset, dataset.sample[0]["token"])

    texts = [
        caplog.text,
        *capfd.readouterr(),
        repr(dataset),
        repr(pickle.dumps(dataset)),
    ]
    for path in tmp_path.rglob("*"):
        if path.is_file():
            texts.append(repr(path.read_bytes()))

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        assert not [text for text in texts if os.environ[name] in text]


def test_missing_credentials_are_a_clear_error(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3fs

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", os.devnull)
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(
        DatarootError, match=r"s3://bucket/zips: cannot be read \(.*credentials.*\); check the URL"
    ):
        DeepAccident(dataroot=f"{bucket}/zips", index_dir=tmp_path)
    assert list(tmp_path.glob("*")) == []

    s3fs.S3FileSystem.clear_instance_cache()


@pytest.mark.parametrize("location", ["nothing/here", "zips/none.zip"])
def test_a_wrong_url_is_a_clear_error(bucket: str, location: str, tmp_path: Path) -> None:
    url = f"{bucket}/{location}"
    with pytest.raises(DatarootError, match=rf"{url}: (no file of a release found|does not exist)"):
        DeepAccident(dataroot=url, index_dir=tmp_path)


def test_an_unreachable_server_is_a_clear_error(
    bucket: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3fs

    dataset = DeepAccident(dataroot=f"{bucket}/zips", index_dir=tmp_path, workers=1, verbose=False)
    pickled = pickle.dumps(dataset)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    s3fs.S3FileSystem.clear_instance_cache()
    from deepaccident_devkit.release.store.store import opened_store

    opened_store.cache_clear()
    reopened = pickle.loads(pickled)

    with pytest.raises(SensorFileError, match="Could not connect"):
        reopened.load_image(reopened.sample[0], "Camera_Front")

    s3fs.S3FileSystem.clear_instance_cache()
