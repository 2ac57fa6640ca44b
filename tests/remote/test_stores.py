"""Object stores: against a server that speaks S3 on this machine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

import barpc
from barpc.base.errors import ImageError
from barpc.base.options import RunOptions, TieOptions
from barpc.base.remote import hosts, located
from barpc.base.safe_io import IMAGE, read_bytes, versioned
from barpc.cameras import open_camera
from barpc.pipeline import load_views
from barpc.rasters.raster import open_raster
from tests.remote.conftest import forget

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
def store(server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    names = {"AWS_ENDPOINT_URL": server, "AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "y"}
    for name, value in {**names, "AWS_DEFAULT_REGION": "us-east-1"}.items():
        monkeypatch.setenv(name, value)
    forget()
    client = boto3.client("s3")
    if not any(bucket["Name"] == "scenes" for bucket in client.list_buckets()["Buckets"]):
        client.create_bucket(Bucket="scenes")
    for item in client.list_objects_v2(Bucket="scenes").get("Contents", ()):
        client.delete_object(Bucket="scenes", Key=item["Key"])
    counts: Counter[str] = Counter()
    fetch = hosts.fetch

    def counted(*args: Any) -> Any:
        part = fetch(*args)
        counts["requests"] += 1
        counts["bytes"] += len(part.data)
        return part

    monkeypatch.setattr(hosts, "fetch", counted)
    found = Store(client, counts)
    for name in NAMES:
        found.put(f"a/{name}", (SAMPLES / name).read_bytes())
    yield found
    forget()


@pytest.mark.nightly
def test_a_bucket_is_read_by_itself_and_by_workers(store: Store, tmp_path: Path) -> None:
    options = RunOptions(images="copy", allow_remote=HOSTS, tie=TieOptions(points_per_image=600), stop_after="all")
    urls = [f"s3://scenes/a/{name}" for name in NAMES[:2]]
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        barpc.adjust(urls, tmp_path / "a", options, executor=pool)
    barpc.adjust([SAMPLES / name for name in NAMES[:2]], tmp_path / "b", options)
    for name in ("view_00.tif", "view_01_RPC.TXT", "tables/observations.csv", "tables/block.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


@pytest.mark.slow
def test_a_file_beside_an_image_is_found_whatever_its_case(store: Store, tmp_path: Path) -> None:
    rpc = open_camera(SAMPLES / NAMES[1]).rpc
    barpc.write_rpc(rpc, tmp_path / "x.RPB")
    store.put("a/View_00.rpB", (tmp_path / "x.RPB").read_bytes())
    loaded = load_views([f"s3://scenes/a/{NAMES[0]}"], min_views=1, hosts=HOSTS)
    assert loaded.views[0].sensor == rpc
    assert str(loaded.sources[0].path) == "s3://scenes/a/View_00.rpB"
    assert store.counts["bytes"] < 3 * (SAMPLES / NAMES[0]).stat().st_size


@pytest.mark.slow
def test_an_object_that_is_replaced_while_it_is_read_is_noticed(store: Store) -> None:
    store.put("a/replaced.tif", (SAMPLES / NAMES[0]).read_bytes())
    at = versioned(located("s3://scenes/a/replaced.tif", HOSTS), IMAGE)
    store.put("a/replaced.tif", (SAMPLES / NAMES[1]).read_bytes())
    with pytest.raises(ImageError, match="changed in its store") as caught:
        read_bytes(at, IMAGE)
    assert "\n" not in str(caught.value)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("url", "hosts", "said"),
    [
        ("s3://scenes/a/missing.tif", HOSTS, "no such file"),
        ("s3://other/a.tif", ("s3://other",), "no such file|NoSuchBucket|not exist"),
        ("s3://other/a.tif", HOSTS, "--allow-remote s3://other"),
        ("s3://scenes/a", HOSTS, "folder|no such file"),
    ],
)
def test_what_cannot_be_read_costs_one_line(store: Store, url: str, hosts: tuple[str, ...], said: str) -> None:
    with pytest.raises(ImageError, match=said) as caught, open_raster(located(url, hosts)):
        pass
    assert url in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_store_that_does_not_answer_costs_one_line(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(ImageError, match="its store answers") as caught:
        read_bytes(located("s3://scenes/a/x.tif", HOSTS), IMAGE)
    assert "\n" not in str(caught.value)
