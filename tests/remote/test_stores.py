"""Object stores: against a server that speaks S3 on this machine."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import barpc
from barpc.cameras import open_camera
from barpc.errors import ImageError, InputError, OutputError
from barpc.options import RunOptions, TieOptions, read_options
from barpc.pipeline import executor, load_views
from barpc.raster import open_raster
from barpc.remote import located, stores
from barpc.sidefile import IMAGE, read_bytes, versioned
from barpc.tie.store import Bucket

pytest.importorskip("moto.server")
pytest.importorskip("s3fs")
boto3 = pytest.importorskip("boto3")
pytestmark = pytest.mark.filterwarnings("ignore")
SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
NAMES = ("view_00.tif", "view_01.tif", "view_02.tif")
HOSTS = ("s3://scenes",)


@dataclass
class Store:
    client: Any
    counts: Counter[str]

    def put(self, key: str, data: bytes) -> None:
        self.client.put_object(Bucket="scenes", Key=key, Body=data)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    from moto.server import ThreadedMotoServer

    found = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    found.start()
    try:
        yield "http://{}:{}".format(*found.get_host_and_port())
    finally:
        found.stop()


@pytest.fixture
def store(server: str, monkeypatch: pytest.MonkeyPatch) -> Store:
    names = {"AWS_ENDPOINT_URL": server, "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "y"}
    for name, value in {**names, "AWS_DEFAULT_REGION": "us-east-1"}.items():
        monkeypatch.setenv(name, value)
    for cached in (stores._store, stores._pinned, stores._listed):
        cached.cache_clear()
    client = boto3.client("s3")
    if not any(bucket["Name"] == "scenes" for bucket in client.list_buckets()["Buckets"]):
        client.create_bucket(Bucket="scenes")
    for item in client.list_objects_v2(Bucket="scenes").get("Contents", ()):
        client.delete_object(Bucket="scenes", Key=item["Key"])
    counts: Counter[str] = Counter()
    fetch = stores.fetch

    def counted(*args: Any) -> Any:
        part = fetch(*args)
        counts["requests"] += 1
        counts["bytes"] += len(part.data)
        return part

    monkeypatch.setattr(stores, "fetch", counted)
    found = Store(client, counts)
    for name in NAMES:
        found.put(f"a/{name}", (SAMPLES / name).read_bytes())
    return found


@pytest.mark.slow
def test_a_bucket_is_read_by_itself_and_by_workers(store: Store, tmp_path: Path) -> None:
    options = RunOptions(
        images="copy", allow_remote=HOSTS, tie=TieOptions(keypoints_per_image=3000), stop_after="all"
    )
    urls = [f"s3://scenes/a/{name}" for name in NAMES[:2]]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        barpc.adjust(urls, tmp_path / "a", options, executor=pool)
    barpc.adjust([SAMPLES / name for name in NAMES[:2]], tmp_path / "b", options)
    for name in ("view_00.tif", "view_01_RPC.TXT", "observations.csv", "block.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


class Blind(Executor):
    """Workers to which nothing is sent that names a place on this disk."""

    def __init__(self, pool: Executor, places: Sequence[Path]) -> None:
        self._pool, self._places, self._max_workers = pool, [str(place).encode() for place in places], 1
        self.sent = Counter[str]()

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        data = pickle.dumps((fn, args, kwargs))
        assert not [place for place in self._places if place in data], args
        self.sent[(args[0] if callable(args[0]) else fn).__name__] += 1  # tasks of a batch; files to hash
        return self._pool.submit(fn, *args, **kwargs)


def keys(store: Store) -> list[str]:
    return [item["Key"] for item in store.client.list_objects_v2(Bucket="scenes").get("Contents", ())]


@pytest.mark.slow
def test_workers_without_the_callers_disk_give_the_same_bytes(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executor, "LARGE", 1 << 12)
    tie = TieOptions(keypoints_per_image=3000, tile=256)
    options = RunOptions(images="none", allow_remote=HOSTS, store="s3://scenes/runs/one", tie=tie)
    urls = [f"s3://scenes/a/{name}" for name in NAMES[:2]]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        blind = Blind(pool, [tmp_path, SAMPLES])
        barpc.adjust(urls, tmp_path / "a", options, executor=blind)
    barpc.adjust([SAMPLES / name for name in NAMES[:2]], tmp_path / "b", RunOptions(images="none", tie=tie))
    for name in ("observations.csv", "block.npz", "view_01_RPC.TXT"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    assert blind.sent["keep_tile"] > 1
    assert blind.sent["match_pair"] == 1
    left = [key for key in keys(store) if key.startswith("runs/")]
    assert left
    assert all(
        key.startswith("runs/one/detect_tile/") for key in left
    )  # what serves the next run, and no more


def test_what_workers_keep_for_each_other_comes_back(store: Store) -> None:
    bucket = Bucket("s3://scenes/runs", "x")
    arrays = {"a": np.arange(5.0), "b": np.zeros((2, 0), np.uint8)}
    bucket.write("detect/1", arrays)
    bucket.write(f"{bucket.scratch}/1", arrays)
    found = pickle.loads(pickle.dumps(bucket)).need("detect/1")
    assert found.keys() == arrays.keys()
    assert all(np.array_equal(found[name], arrays[name]) for name in arrays)
    assert bucket.read("detect/2") is None
    with pytest.raises(InputError, match="detect/2") as caught:
        bucket.need("detect/2")
    assert "disk" not in str(caught.value)
    store.put("runs/detect/3.npz", b"PK damaged")
    assert bucket.read("detect/3") is None
    other = Bucket("s3://scenes/runs", "y")
    other.clear()
    assert bucket.need(f"{bucket.scratch}/1")
    bucket.clear()
    assert bucket.read(f"{bucket.scratch}/1") is None
    assert bucket.need("detect/1")
    with pytest.raises(OutputError, match="cannot be written") as refused:
        Bucket("s3://nobody", "x").write("1", arrays)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("url", ["/disk/x", "https://a.org/x", "s3://", "s3://a/../b?c", "s3://user@a/b"])
def test_a_store_is_a_bucket_and_is_said_by_a_person(url: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="store"):
        RunOptions(store=url)
    (tmp_path / "x.toml").write_text('store = "s3://scenes/x"\n')
    with pytest.raises(InputError, match="not taken from a file"):
        read_options(tmp_path / "x.toml")


def test_a_file_beside_an_image_is_found_whatever_its_case(store: Store, tmp_path: Path) -> None:
    rpc = open_camera(SAMPLES / NAMES[1]).rpc
    barpc.write_rpc(rpc, tmp_path / "x.RPB")
    store.put("a/View_00.rpB", (tmp_path / "x.RPB").read_bytes())
    loaded = load_views([f"s3://scenes/a/{NAMES[0]}"], min_views=1, hosts=HOSTS)
    assert loaded.views[0].sensor == rpc
    assert str(loaded.sources[0].path) == "s3://scenes/a/View_00.rpB"
    assert store.counts["bytes"] < 3 * (SAMPLES / NAMES[0]).stat().st_size


def test_an_object_that_is_replaced_while_it_is_read_is_noticed(store: Store) -> None:
    store.put("a/replaced.tif", (SAMPLES / NAMES[0]).read_bytes())
    at = versioned(located("s3://scenes/a/replaced.tif", HOSTS), IMAGE)
    store.put("a/replaced.tif", (SAMPLES / NAMES[1]).read_bytes())
    with pytest.raises(ImageError, match="changed in its store") as caught:
        read_bytes(at, IMAGE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "hosts", "said"),
    [
        ("s3://scenes/a/missing.tif", HOSTS, "no such file"),
        ("s3://other/a.tif", ("s3://other",), "no such file|NoSuchBucket|not exist"),
        ("s3://other/a.tif", HOSTS, "--allow-remote s3://other"),
        ("s3://scenes/a", HOSTS, "folder|no such file"),
    ],
)
def test_what_cannot_be_read_costs_one_line(
    store: Store, url: str, hosts: tuple[str, ...], said: str
) -> None:
    with pytest.raises(ImageError, match=said) as caught, open_raster(located(url, hosts)):
        pass
    assert url in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_store_that_does_not_answer_costs_one_line(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    stores._store.cache_clear()
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(ImageError, match="its store answers") as caught:
        read_bytes(located("s3://scenes/a/x.tif", HOSTS), IMAGE)
    assert "\n" not in str(caught.value)
    stores._store.cache_clear()
    s3fs.S3FileSystem.clear_instance_cache()
