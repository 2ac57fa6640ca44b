"""Files on other hosts: only where they are allowed, only the parts that are needed, one line where it goes wrong."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import socket
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window

import barpc
from barpc.base.declarations import schema
from barpc.base.errors import BarpcError, ImageError, InputError, RpcError
from barpc.base.frozen import from_arrays, to_arrays
from barpc.base.identity import fingerprint
from barpc.base.options import RunOptions, TieOptions, read_options
from barpc.base.remote import REQUEST_BYTES, Remote, RemoteFile, located, pinned
from barpc.base.safe_io import IMAGE, RPC_FILE, read_bytes, read_head, versioned
from barpc.cameras import open_camera, open_split, split_spec
from barpc.pipeline import load_views
from barpc.pipeline.inputs import input_files, with_located
from barpc.rasters.dem import Dem
from barpc.rasters.raster import open_raster
from barpc.rpcio import write_rpc_copy
from barpc.tie.patches.channels import Sheet
from tests.geotiffs import write_image
from tests.remote.conftest import Web, drip

SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
NAMES = ("view_00.tif", "view_01.tif", "view_02.tif")


@pytest.fixture
def samples(server: Web) -> Web:
    for name in NAMES:
        shutil.copy(SAMPLES / name, server.folder / name)
    return server


def one_line(error: BaseException, *words: str) -> None:
    assert "\n" not in str(error)
    assert len(str(error)) < 500
    for word in words:
        assert word in str(error)


# --- what is allowed --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "hosts"),
    [
        ("https://a.org/x.tif", ()),
        ("https://a.org/x.tif", ("b.org", "http://a.org", "s3://a.org", "org", "xa.org")),
        ("https://a.org:444/x.tif", ("a.org",)),
        ("http://a.org/x.tif", ("a.org",)),
        ("s3://bucket/x.tif", ("bucket", "https://bucket", "gs://bucket", "s3://bucket2")),
        ("https://a.org@b.org/x.tif", ("a.org", "b.org@a.org")),
        ("https://user:secret@a.org/x.tif", ("a.org",)),
        ("https://a.org/x.tif?token=secret", ("a.org",)),
        ("https://a.org/x.tif#y", ("a.org",)),
        ("https://a.org/", ("a.org",)),
        ("https://a.org\\@b.org/x.tif", ("a.org",)),
    ],
)
def test_a_url_is_refused_unless_its_very_host_is_allowed(url: str, hosts: tuple[str, ...]) -> None:
    with pytest.raises(ImageError) as caught:
        located(url, hosts)
    one_line(caught.value, url)


@pytest.mark.parametrize(
    ("url", "host"),
    [
        ("https://a.org/b/x.tif", "a.org"),
        ("https://A.org/b/x.tif", "a.ORG"),
        ("https://a.org:444/x.tif", "a.org:444"),
        ("http://127.0.0.1:8000/x.tif", "http://127.0.0.1:8000"),
        ("https://[::1]:8000/x.tif", "[::1]:8000"),
        ("s3://bucket/a/x.tif", "s3://bucket"),
        ("az://box/a/x.tif", "az://box"),
    ],
)
def test_a_url_of_an_allowed_host_keeps_both_its_slashes(url: str, host: str) -> None:
    found = located(url, RunOptions(allow_remote=("other.org", host)).allow_remote)
    assert isinstance(found, Remote)
    assert (str(found), found.name, found.stem, found.suffix) == (url, "x.tif", "x", ".tif")
    assert str(found.parent / "y.RPB") == url.replace("x.tif", "y.RPB")


def test_a_path_that_was_a_url_says_what_became_of_it() -> None:
    with pytest.raises(ImageError, match="as text"):
        located(Path("https://a.org/x.tif"), ("a.org",))


@pytest.mark.parametrize("host", ["", "https://", "a.org/b", "*.org", "user@a.org", "ftp://a.org", "a.org "])
def test_an_entry_that_is_no_host_is_refused(host: str) -> None:
    with pytest.raises(InputError, match="allow_remote"):
        RunOptions(allow_remote=(host,))


def test_an_options_file_opens_no_network(tmp_path: Path) -> None:
    path = tmp_path / "options.toml"
    path.write_text('allow_remote = ["a.org"]\n')
    with pytest.raises(InputError) as caught:
        read_options(path)
    one_line(caught.value, str(path), "allow_remote")
    assert "allow_remote" not in json.dumps(schema(RunOptions))


def test_without_leave_nothing_is_asked(samples: Web, tmp_path: Path) -> None:
    urls = [samples.url(name) for name in NAMES]
    for allowed in ((), ("http://127.0.0.1", "localhost")):
        with pytest.raises(ImageError, match="allow_remote") as caught:
            barpc.adjust(urls, tmp_path / "out", RunOptions(allow_remote=allowed))
        one_line(caught.value)
    with pytest.raises(ImageError, match="remote"):
        open_camera(urls[0])
    with pytest.raises(BarpcError), open_raster(urls[0]):
        pass
    with pytest.raises(BarpcError):
        options = RunOptions(dem=samples.url("dem.tif"), images="none")
        barpc.adjust([SAMPLES / name for name in NAMES], tmp_path / "out", options)
    assert samples.counts["requests"] == 0


def test_a_vrt_a_kept_result_and_a_text_open_nothing_even_where_the_host_is_allowed(
    samples: Web, tmp_path: Path
) -> None:
    url = samples.url(NAMES[0])
    text = (
        '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        '<SourceFilename relativeToVRT="0">{}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>'
    )
    for name in (url, f"/vsicurl/{url}"):
        (tmp_path / "x.vrt").write_text(text.format(name))
        with pytest.raises(ImageError, match="no plain local file"):
            load_views([tmp_path / "x.vrt"], min_views=1, hosts=(samples.host,))
    (samples.folder / "x.vrt").write_text(text.format("view_00.tif"))
    with pytest.raises(ImageError, match="from disk only"):
        load_views([samples.url("x.vrt")], min_views=1, hosts=(samples.host,))
    assert not any("view_00" in path for path in samples.seen)
    assert type(from_arrays(to_arrays(str.__str__(url)))) is str


# --- what is read -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_files_come_out_and_every_byte_is_asked_once(samples: Web, tmp_path: Path) -> None:
    given, names = {"stop_after": "matching", "tie": TieOptions(points_per_image=160)}, NAMES[:2]
    urls = [samples.url(name) for name in names]
    remote = barpc.adjust(urls, tmp_path / "a", RunOptions(allow_remote=(samples.host,), **given))  # type: ignore[arg-type]
    barpc.adjust([SAMPLES / name for name in names], tmp_path / "b", RunOptions(**given))  # type: ignore[arg-type]
    for file in ("matches.csv", "matches.npz", "asp/view_00__view_01.txt"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    for name in names:
        assert 0.5 < samples.counts[f"/{name}"] / (SAMPLES / name).stat().st_size <= 1
    assert samples.counts["requests"] <= 40 * len(names)
    assert [view.path for view in remote.views] == urls
    assert [view["path"] for view in remote.summary["views"]] == urls


def test_workers_read_by_themselves_and_the_same_version(samples: Web) -> None:
    at = pinned(located(samples.url(NAMES[0]), (samples.host,)))  # type: ignore[arg-type]
    again = pickle.loads(pickle.dumps(at))
    assert (again, again.size, again.tag) == (at, (SAMPLES / NAMES[0]).stat().st_size, '"one"')
    sent = from_arrays(to_arrays((at, np.zeros(3))), sent=True)[0]
    assert isinstance(sent, Remote)
    assert (sent, sent.size, sent.tag) == (at, at.size, at.tag)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert pool.submit(read_head, at, IMAGE, 100).result() == (SAMPLES / NAMES[0]).read_bytes()[:100]
        samples.tag = '"two"'  # replaced on the server
        with pytest.raises(ImageError, match="changed on its host"):
            pool.submit(read_bytes, at, IMAGE).result()


def test_a_window_of_a_large_image_costs_its_blocks_alone(server: Web) -> None:
    pixels = np.random.default_rng(0).integers(0, 4000, (2048, 3072), np.uint16)
    tiled = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    write_image(server.folder / "large.tif", pixels, **tiled)
    at, window = versioned(located(server.url("large.tif"), (server.host,)), IMAGE), Window(600, 700, 300, 200)
    with open_raster(at) as dataset:
        assert (dataset.read(1, window=window) == pixels[700:900, 600:900]).all()
    tiles, tile = 2 * 2, 256 * 256 * 2
    assert tiles * tile * 0.7 < server.counts["bytes"] < tiles * (tile + 2 * REQUEST_BYTES) + 2 * REQUEST_BYTES
    before = server.counts["requests"]
    with open_raster(at) as dataset:  # what the process holds is not asked again
        dataset.read(1, window=window)
    assert server.counts["requests"] == before


def test_a_file_is_read_as_any_file_is(server: Web) -> None:
    content = np.random.default_rng(1).integers(0, 256, 5 * REQUEST_BYTES + 77, np.uint8).tobytes()
    (server.folder / "x").write_bytes(content)
    file = RemoteFile(located(server.url("x"), (server.host,)))  # type: ignore[arg-type]
    rng = np.random.default_rng(2)
    for start, length in [(0, 10), (REQUEST_BYTES - 1, 2), (len(content) - 5, 99), (len(content) + 9, 4), (3, 0)] + [
        (int(rng.integers(len(content))), int(rng.integers(3 * REQUEST_BYTES))) for _ in range(50)
    ]:
        file.seek(start)
        assert file.read(length) == content[start : start + length]
    assert file.seek(-7, os.SEEK_END) == len(content) - 7
    assert file.read() == content[-7:]
    assert server.counts["bytes"] == len(content)


def test_an_empty_file_and_a_name_with_a_blank(server: Web) -> None:
    (server.folder / "empty").write_bytes(b"")
    with pytest.raises(ImageError, match="empty"), open_raster(located(server.url("empty"), (server.host,))):
        pass
    with pytest.raises(ImageError, match="no such file"):
        read_bytes(located(server.url("my image.tif"), (server.host,)), IMAGE)
    assert server.seen[-1] == "/my%20image.tif"


@pytest.mark.parametrize("name", ["view_00.RPB", "view_00.rpb", "view_00_RPC.TXT", "view_00_rpc.txt", "view_00.geom"])
def test_a_file_beside_an_image_is_found_as_on_disk(samples: Web, tmp_path: Path, name: str) -> None:
    rpc = open_camera(SAMPLES / NAMES[1]).rpc
    shutil.copy(SAMPLES / NAMES[0], tmp_path / NAMES[0])
    barpc.write_rpc(rpc, tmp_path / name, format={".rpb": "rpb", ".txt": "txt"}.get(Path(name).suffix.lower(), "geom"))
    shutil.copy(tmp_path / name, samples.folder / name)
    here = open_camera(tmp_path / NAMES[0])
    there = open_split(*split_spec(samples.url(NAMES[0]), (samples.host,)))
    assert (there.format, there.path.name, there.notes) == (here.format, here.path.name, here.notes)
    assert there.rpc == here.rpc
    named = f"{samples.url(NAMES[2])},camera={samples.url(name)}"
    assert open_split(*split_spec(named, (samples.host,))).path == samples.url(name)
    with pytest.raises(ImageError, match="--allow-remote"):
        split_spec(f"{SAMPLES / NAMES[2]},camera=https://a.org/x.RPB", (samples.host,))


def test_results_belong_to_the_version_that_a_host_names(samples: Web) -> None:
    def of(name: str) -> str:
        return fingerprint(pinned(located(samples.url(name), (samples.host,)))).key  # type: ignore[arg-type]

    first = of(NAMES[0])
    assert of(NAMES[0]) == first != of(NAMES[1])
    assert samples.counts["bytes"] <= 3 * REQUEST_BYTES  # no content
    samples.tag = '"two"'
    second = of(NAMES[0])
    assert second != first
    samples.tag = ""
    with pytest.raises(ImageError, match="no version"):
        read_head(located(samples.url(NAMES[0]), (samples.host,)), IMAGE, 9)


@pytest.mark.filterwarnings("ignore::barpc.base.errors.BarpcWarning")
def test_heights_and_a_reference_are_read_where_they_are_wanted(server: Web) -> None:
    heights = np.random.default_rng(4).normal(500, 100, (1500, 1600)).astype(np.float32)
    forward = rasterio.Affine(1e-3, 0, 5.0, 0, -1e-3, 45.0)
    tiled = {"tiled": True, "blockxsize": 128, "blockysize": 128}
    for name in ("dem.tif", "ortho.tif"):
        write_image(server.folder / name, heights, transform=forward, crs="EPSG:4326", **tiled)
    urls = {"dem": server.url("dem.tif"), "reference": (server.url("ortho.tif"),)}
    for allowed in ((), ("http://127.0.0.1:1",)):
        with pytest.raises(BarpcError):
            Dem.open(with_located(RunOptions(allow_remote=allowed, **urls)).dem)
    assert server.counts["requests"] == 0
    options = with_located(RunOptions(allow_remote=(server.host,), **urls))
    lon, lat = np.random.default_rng(5).uniform((5.7, 44.3), (5.75, 44.35), (50, 2)).T
    assert len(options.dem) == 1
    assert np.array_equal(Dem.open(options.dem)(lon, lat), Dem.open(server.folder / "dem.tif")(lon, lat))
    here, there = Sheet.read(str(server.folder / "ortho.tif")), Sheet.read(options.reference[0])
    assert vars(replace(there, path=here.path)) == vars(here)
    assert server.counts["bytes"] < 0.2 * sum(path.stat().st_size for path in server.folder.iterdir())
    assert isinstance(replace(options, keep_going=True).dem[0], Remote)  # leave is not lost on the way
    assert [str(path) for path in input_files(options)] == []


def test_names_come_from_the_last_parts_of_urls(samples: Web) -> None:
    for folder, name in (("a", NAMES[0]), ("b", NAMES[1])):
        (samples.folder / folder).mkdir()
        shutil.copy(SAMPLES / name, samples.folder / folder / "img.tif")
    urls = [samples.url("a/img.tif"), samples.url("b/img.tif"), str(SAMPLES / NAMES[2])]
    loaded = load_views(urls, hosts=(samples.host,))
    assert [view.name for view in loaded.views] == ["a_img", "b_img", "view_02"]
    with pytest.raises(InputError, match="same file"):
        load_views([urls[0], urls[0]], hosts=(samples.host,))


def test_copies_are_written_and_a_vrt_is_refused_before_any_work(samples: Web, tmp_path: Path) -> None:
    urls, allowed = [samples.url(name) for name in NAMES[:2]], (samples.host,)
    with pytest.raises(ImageError, match="images copy") as caught:
        barpc.adjust(urls, tmp_path / "a", RunOptions(allow_remote=allowed))
    one_line(caught.value, urls[0])
    assert not (tmp_path / "a").exists()
    at = located(urls[0], allowed)
    write_rpc_copy(open_camera(SAMPLES / NAMES[1]).rpc, at, tmp_path / "copy.tif")  # type: ignore[arg-type]
    with rasterio.open(tmp_path / "copy.tif") as copy, rasterio.open(SAMPLES / NAMES[0]) as image:
        assert (copy.read() == image.read()).all()
    assert open_camera(tmp_path / "copy.tif").rpc != open_camera(SAMPLES / NAMES[0]).rpc


# --- hosts that misbehave ---------------------------------------------------------------------------------

Mood = Callable[..., Any]


def status(code: int, **headers: str) -> Mood:
    return lambda handler, *_: handler.answer(code, b"x" * 100, **headers) or True


MOODS: dict[str, tuple[Mood, str, int]] = {  # what it does, what is said, how often it is asked; more: test_parts
    "403": (status(403), "403", 1),
    "500": (status(500), "500; asked 4 times", 4),
    "other scheme": (status(302, Location="file:///etc/passwd"), "file:///etc/passwd", 1),
    "nowhere": (status(301), "on and on", 3),
}


@pytest.mark.parametrize("mood", MOODS)
def test_a_host_that_misbehaves_costs_one_line(samples: Web, mood: str) -> None:
    costs_one_line(samples, *MOODS[mood])


@pytest.mark.usefixtures("hasty")
def test_a_host_that_sends_a_byte_now_and_then_costs_one_line(samples: Web) -> None:
    costs_one_line(samples, drip, "more than 0.566 s for 65536 bytes", 4)
    assert samples.counts["dripped"] < 200  # of 400: it is cut off


def costs_one_line(samples: Web, mood: Mood, said: str, times: int) -> None:
    samples.mood = mood
    at = located(samples.url(NAMES[0]), (samples.host,))
    with pytest.raises(ImageError) as caught, open_raster(at):
        pass
    one_line(caught.value, samples.url(NAMES[0]), said)
    assert samples.counts["requests"] == times


@pytest.mark.parametrize("failing", [1, 3])
def test_what_passes_is_asked_again(samples: Web, failing: int) -> None:
    left = [500, 503, 429][:failing]
    samples.mood = lambda handler, *_: bool(left) and (handler.answer(left.pop()) or True)
    assert read_bytes(located(samples.url(NAMES[0]), (samples.host,)), IMAGE) == (SAMPLES / NAMES[0]).read_bytes()
    assert not left


def test_a_move_within_the_host_is_followed(samples: Web) -> None:
    def mood(handler: Any, *_: object) -> bool:
        if moved := handler.path == "/old.tif":
            handler.answer(302, Location="view_00.tif")
        return moved

    samples.mood = mood
    assert read_bytes(located(samples.url("old.tif"), (samples.host,)), IMAGE) == (SAMPLES / NAMES[0]).read_bytes()


@pytest.mark.parametrize("kind", ["GTiff", "JPEG", "PNG", "JP2OpenJPEG"])
def test_no_pixels_are_made_of_a_file_whose_host_dies(server: Web, kind: str) -> None:
    """Some drivers fill what is missing, and none hears of an exception."""
    pixels = np.random.default_rng(3).integers(0, 255, (1, 800, 800), np.uint8)
    options = {"REVERSIBLE": "YES", "QUALITY": "100"} if kind.startswith("JP2") else {}
    write_image(server.folder / "x", pixels, driver=kind, **options)
    at = located(server.url("x"), (server.host,))
    with open_raster(at) as dataset:
        assert abs(dataset.read(1).astype(float) - pixels[0]).mean() < 20
    other = server.folder / "y"
    shutil.copy(server.folder / "x", other)
    size = other.stat().st_size
    server.mood = lambda handler, part, start, stop, _size: stop > size // 2 and (handler.answer(500) or True)
    with pytest.raises(ImageError, match="500") as caught:
        with open_raster(located(server.url("y"), (server.host,))) as dataset:
            dataset.read(1)
    one_line(caught.value, server.url("y"))


def test_a_side_file_that_never_ends_is_refused_by_its_size(server: Web) -> None:
    def mood(handler: Any, part: bytes, start: int, _stop: int, _size: int) -> bool:
        handler.answer(
            206, b"x" * REQUEST_BYTES, ETag="x", Content_Range=f"bytes {start}-{start + REQUEST_BYTES - 1}/{10**15}"
        )
        return True

    server.mood = mood
    with pytest.raises(RpcError, match="too large"):
        read_bytes(located(server.url("x.RPB"), (server.host,)), RPC_FILE)
    assert server.counts["requests"] == 1


def test_a_host_that_does_not_say_what_lies_beside_an_image_is_not_guessed_about(samples: Web) -> None:
    def mood(handler: Any, *_: object) -> bool:
        if hidden := handler.path.endswith("RPB"):
            handler.answer(403)
        return hidden or (not handler.path.endswith("tif") and (handler.answer(404) or True))

    samples.mood = mood
    with pytest.raises(ImageError, match="camera=URL") as caught:
        load_views([samples.url(NAMES[0])], min_views=1, hosts=(samples.host,))
    one_line(caught.value, samples.url(NAMES[0]), "403")


@pytest.mark.usefixtures("server")  # which shortens the waits
def test_nobody_there() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        host = f"http://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ImageError, match="no answer") as caught:
            read_bytes(located(f"{host}/x", (host,)), IMAGE)
    one_line(caught.value, host)


def test_keep_going_leaves_out_what_does_not_answer(samples: Web) -> None:
    urls = [*(samples.url(name) for name in NAMES[:2]), samples.url("missing.tif")]
    loaded = load_views(urls, keep_going=True, hosts=(samples.host,))
    assert [view.name for view in loaded.views] == ["view_00", "view_01"]
    assert loaded.left_out[0][0] == urls[2]
    assert "no such file" in loaded.left_out[0][1]
