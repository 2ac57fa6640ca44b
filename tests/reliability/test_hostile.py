"""Files made to fetch, to read or to delete something else: nothing goes out, nothing outside is touched."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.rpcio import read_rpc, write_rpc
from tests.geotiffs import write_image
from tests.lanes import diagonal, rest_slow

from .conftest import Said, barpc, hashes
from .hostile_files import CONTENTS, Trap, served, write
from .test_faults import dem
from .trials import SIDE

SECRET = "moon-landing-7391"
IN_ACCESS, IN_OPEN, IN_DELETE_SELF, IN_MODIFY = 0x1, 0x20, 0x400, 0x2


@pytest.fixture
def trap(tmp_path: Path) -> Iterator[Trap]:
    outside = tmp_path / "outside"
    outside.mkdir()
    canary, raster = outside / "canary.txt", outside / "canary.tif"
    canary.write_text(SECRET)
    for path in (raster, outside / "good.tif"):
        write_image(path, np.full((SIDE, SIDE), 4242, np.uint16))
    with served(canary, raster) as found:
        libc = ctypes.CDLL(None, use_errno=True)
        watch = libc.inotify_init1(os.O_NONBLOCK) if hasattr(libc, "inotify_init1") else -1
        if watch >= 0:
            for path in (canary, raster):
                libc.inotify_add_watch(watch, bytes(path), IN_ACCESS | IN_OPEN | IN_MODIFY | IN_DELETE_SELF)

            def events() -> int:
                try:
                    return len(os.read(watch, 1 << 16)) // 16
                except BlockingIOError:
                    return 0

            found.events = events
        yield found
        if watch >= 0:
            os.close(watch)


class Evil:
    """What a pickle may do when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.unlink, (str(self.path),)


def evil_npz(path: Path, victim: Path, *names: str) -> Path:
    """An archive whose arrays are pickles."""
    header = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(f"{name}.npy", header + pickle.dumps(Evil(victim)))
    return path


def beside(crops: list[Path], suffix: str, content: str) -> list[object]:
    """A file beside the second image, by its full name and another suffix."""
    (crops[1].parent / (crops[1].name + suffix)).write_text(content)
    return [*crops]


def instead(crops: list[Path], content: str) -> list[object]:
    crops[1].write_text(content)
    return [*crops]


def with_xml(crops: list[Path], content: str) -> list[object]:
    crops[1].with_suffix(".XML").write_text(content)
    return [*crops]


def linked(crops: list[Path], target: Path, name: str) -> list[object]:
    (crops[1].parent / name).symlink_to(target)
    return [*crops]


def hidden_overview(trap: Trap, crops: list[Path], target: object) -> list[object]:
    pam = f'<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{target}</MDI></Metadata></PAMDataset>'
    (crops[1].parent / "evil.ovr").write_text(trap.wms())
    return [*beside(crops, ".aux.xml", pam), "--images", "copy"]


def entities(system: str) -> str:
    return f'<!DOCTYPE isd [<!ENTITY x SYSTEM "{system}">]><isd><RPB><IMAGE>&x;</IMAGE></RPB></isd>'


BOMB = (
    "<!DOCTYPE isd ["
    + '<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 12))
    + "]><isd><RPB><IMAGE>&a11;</IMAGE></RPB></isd>"
)


def foreign_state(crops: list[Path], trap: Trap) -> list[object]:
    """A run folder whose list of outputs names files elsewhere: an overwriting run takes away stale ones."""
    out = crops[0].parents[1] / "out"
    (out / ".barpc").mkdir(parents=True)
    names = ["../outside/canary.txt", str(trap.canary), str(trap.raster), "link/canary.tif"]
    (out / "link").symlink_to(trap.canary.parent)
    (out / ".barpc/state.json").write_text(json.dumps({"status": "done", "outputs": names}))
    return [*crops, "--overwrite"]


def option(*words: object) -> Callable[[Trap, list[Path]], list[object]]:
    return lambda trap, crops: [
        *crops,
        *(str(word).replace("URL", trap.url).replace("CANARY", str(trap.canary)) for word in words),
    ]


HOSTILE: dict[str, Callable[[Trap, list[Path]], list[object]]] = {
    "a web service as overviews": lambda t, c: beside(c, ".ovr", t.wms()),
    "a fetching VRT as overviews": lambda t, c: beside(c, ".ovr", t.vrt(f"/vsicurl/{t.url}.tif")),
    "a web service as mask": lambda t, c: beside(c, ".msk", t.wms()),
    "another image as mask": lambda t, c: beside(c, ".msk", t.vrt(t.raster)),
    "overviews that are named elsewhere": lambda t, c: hidden_overview(t, c, ":::BASE:::evil.ovr"),
    "overviews on the network": lambda t, c: hidden_overview(t, c, f"/vsicurl/{t.url}.ovr"),
    "overviews that are another image": lambda t, c: hidden_overview(t, c, t.raster),
    "an XML sidecar that includes a file": lambda t, c: with_xml(c, entities(f"file://{t.canary}")),
    "an XML sidecar that fetches": lambda t, c: with_xml(c, entities(t.url)),
    "an XML sidecar that is a bomb": lambda t, c: with_xml(c, BOMB),
    "a web address for an image": option("URL.tif"),
    "a virtual path for an image": option("/vsicurl/URL.tif"),
    "a bucket for an image": option("s3://bucket/x.tif"),
    "a nested virtual path": option("/vsizip//vsicurl/URL.zip/x.tif"),
    "a connection string for an image": option("WMS:URL"),
    "a web address for a DEM": option("--dem", "/vsicurl/URL.tif"),
    "a web address for GCPs": option("--gcp", "URL.gcp"),
    "a web address for tie points": option("--matches", "URL.csv"),
    "a web service for a DEM": lambda t, c: [
        *c,
        "--dem",
        shutil.copy(instead(c[:1] * 2, t.wms())[0], c[0].parent / "dem.tif"),
    ],
    "tie points that are a pickle": lambda t, c: [
        *c,
        "--matches",
        evil_npz(c[0].parent / "t.npz", t.canary, "names", "view", "track", "xy"),
    ],
    "an earlier run that is a pickle": lambda t, c: [
        *c,
        "--add-to",
        evil_npz(c[0].parent / "block.npz", t.canary, "names", "model", "drift", "params").parent,
    ],
    "a run folder that lists files elsewhere": lambda t, c: foreign_state(c, t),
}


WHOLE_RUN = (  # a run goes on to its end: two are enough before a commit
    "a fetching VRT as overviews", "a web service as overviews", "a web service as mask", "another image as mask",
    "overviews that are named elsewhere",
    "overviews on the network", "overviews that are another image", "an XML sidecar that includes a file",
    "an XML sidecar that fetches", "an XML sidecar that is a bomb", "a run folder that lists files elsewhere",
)  # fmt: skip


@pytest.mark.landing(6)
@pytest.mark.few(4)
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in WHOLE_RUN[1:-1])) for name in HOSTILE],
)
def test_a_hostile_file_reaches_nothing(name, crops, tmp_path, trap, monkeypatch):
    monkeypatch.chdir(crops[0].parent)
    args = HOSTILE[name](trap, crops)
    before = hashes([tmp_path / "in", tmp_path / "outside"])
    trap.events()
    said = barpc("adjust", *args, "-o", tmp_path / "out")
    assert trap.requests == []
    assert trap.events() == 0
    assert hashes([tmp_path / "in", tmp_path / "outside"]) == before
    assert said.code in (0, 1)
    assert_says_nothing_of_it(said, tmp_path / "out")
    if said.code:
        assert said.err.startswith("barpc: ")
        assert len(said.err.strip().splitlines()) == 1
        assert "unexpected" not in said.err


def assert_says_nothing_of_it(said: Said, out: Path) -> None:
    """Neither the messages nor the results hold the canary's content."""
    assert SECRET not in said.out + said.err
    for path in out.rglob("*"):
        assert path.is_symlink() or path.is_dir() or SECRET.encode() not in path.read_bytes()


@pytest.mark.parametrize(
    "name", rest_slow(["view_01.tif", "view_01_RPC.TXT", "view_01.XML", "view_01.RPB", "view_01.geom"], 2)
)
def test_a_link_to_a_secret_file_does_not_show_it(crops, tmp_path, trap, name):
    """Links are followed, as users expect; what is behind them is not repeated."""
    if name == "view_01.tif":
        crops[1].unlink()
    linked(crops, trap.canary, name)
    said = barpc("adjust", *crops, "-o", tmp_path / "out")
    assert said.code in (0, 1)
    assert_says_nothing_of_it(said, tmp_path / "out")
    assert trap.canary.read_text() == SECRET


@pytest.mark.parametrize(
    ("verb", "name"),
    diagonal(
        ["info", "check", "convert --window", "convert -o", "convert"],
        ["a web service as overviews", "overviews on the network"],
    ),
)
def test_no_verb_fetches_anything(crops, tmp_path, trap, verb, name):
    HOSTILE[name](trap, crops)
    more = {
        "convert --window": [crops[1], tmp_path / "c.tif", "--window", 0, 0, 100, 100],
        "convert -o": [crops[1], "--rpc", crops[0], "-o", tmp_path / "applied"],
        "convert": [crops[1], tmp_path / "x.vrt"],
        "check": [*crops],
    }.get(verb, [crops[1]])
    said = barpc(verb.split()[0], *more)
    assert trap.requests == []
    assert said.code in (0, 1, 3), said
    assert "Traceback" not in said.err


def commands(image: Path, out: Path, *, slow: bool = False) -> list[list[object]]:
    """Whatever opens an image."""
    found: list[list[object]] = [
        ["info", image],
        ["info", "--footprint", image],
        ["localize", image, 100, 100],
        ["convert", image, out / "c.tif", "--window", 0, 0, 60, 60],
        ["convert", image, out / "x.vrt"],
        ["convert", image, out / "x.tif"],
        ["convert", image, "--rpc", image, "-o", out / "applied", "--images", "copy"],
        ["fit", image, "-o", out / "f_RPC.TXT"],
    ]
    other = image.with_name("view_00.tif")
    more: list[list[object]] = [
        ["check", other, image],
        ["adjust", other, image, "--gcp", image, "-o", out / "run"],
    ]
    return found + more if slow else found


def assert_silent(trap: Trap, said: Said, folder: Path) -> None:
    """Nothing was asked for, opened or repeated, and an error is one line."""
    assert trap.requests == [], said
    assert trap.events() == 0, said
    assert said.code in (0, 1, 2, 3), said
    assert "Traceback" not in said.err, said
    assert "unexpected" not in said.err, said
    if said.code == 1:
        assert len([line for line in said.err.splitlines() if line.startswith("barpc: ")]) == 1, said
    assert_says_nothing_of_it(said, folder)


KINDS = (
    "source, element", "source, attribute, without vsicurl", "a mask, attribute", "a web service",
    "a TIFF with overviews elsewhere",
)  # fmt: skip
EVERY = [pytest.param(name, marks=[pytest.mark.nightly] * (name not in KINDS)) for name in CONTENTS]
"""All of `CONTENTS`; one of each kind before a commit."""


@pytest.mark.parametrize("name", EVERY)
def test_a_hostile_image_fetches_nothing(name, crops, tmp_path, trap):
    """As image, as the pixels of an RPC, and as source of a VRT; every verb that opens images."""
    write_rpc(read_rpc(crops[1]), crops[1].with_name("view_01_RPC.TXT"))
    write_rpc(read_rpc(crops[1]), crops[1].with_name("over_RPC.TXT"))
    write(trap, name, crops[1])
    (crops[1].with_name("over.vrt")).write_text(trap.vrt(crops[1]))
    before = hashes([tmp_path / "in", tmp_path / "outside"])
    trap.events()
    for args in commands(crops[1], tmp_path / "out", slow=True) + [["info", crops[1].with_name("over.vrt")]]:
        assert_silent(trap, barpc(*args), tmp_path / "out")
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
    assert hashes([tmp_path / "in", tmp_path / "outside"]) == before


@pytest.mark.parametrize("name", EVERY)
def test_a_hostile_dem_fetches_nothing(name, crops, tmp_path, trap):
    path = write(trap, name, crops[0].with_name("dem.tif"))
    trap.events()
    for args in (
        ["localize", crops[0], 100, 100, "--dem", path],
        ["localize", crops[0], 100, 100, "--dem", path, "--geoid", path],
        ["fit", crops[0], "-o", tmp_path / "out" / "f_RPC.TXT", "--dem", path],
        ["adjust", *crops, "--dem", path, "-o", tmp_path / "out"],
    ):
        assert_silent(trap, barpc(*args), tmp_path / "out")


BESIDE = ".ovr", ".msk", ".aux.xml", ".msk.ovr", ".aux", ".prj", ".tfw", ".imd", ".rpb", "_RPC.TXT", ".xml", ".geom"


def surrounded(trap: Trap, name: str, file: Path, suffixes: Sequence[str] = BESIDE) -> None:
    """The same hostile content under every name that may belong to a file."""
    for suffix in suffixes:
        for stem in (file.name, file.stem):
            if not file.with_name(stem + suffix).exists():
                write(trap, name, file.with_name(stem + suffix))


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_a_hostile_file_beside_another_fetches_nothing(name, crops, tmp_path, trap):
    """Beside an image (of which the RPC is readable, else no pixel would be asked for), a DEM and an output."""
    surrounded(trap, name, crops[1], BESIDE[:8])
    bounds = read_rpc(crops[0]).ground_offset
    terrain = dem(crops[0].with_name("dem.tif"), bounds[0] - 0.25, bounds[1] + 0.25, 230.0)
    surrounded(trap, name, terrain)
    (tmp_path / "out").mkdir()
    surrounded(trap, name, tmp_path / "out" / "x.tif", BESIDE[:4])
    trap.events()
    for args in [*commands(crops[1], tmp_path / "out"), ["localize", crops[1], 100, 100, "--dem", terrain]]:
        assert_silent(trap, barpc(*args), tmp_path / "out" / "applied")
    surrounded(trap, name, crops[0])
    assert_silent(trap, barpc("info", crops[0]), tmp_path / "out" / "applied")


@pytest.mark.landing(2)
@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_a_hostile_file_beside_another_fetches_nothing_in_a_whole_run(name, crops, tmp_path, trap):
    for crop in crops:
        surrounded(trap, name, crop, BESIDE[:8])
    for path in ("view_00.tif", "view_01.tif", "view_01.vrt"):
        (tmp_path / "out").mkdir(exist_ok=True)
        surrounded(trap, name, tmp_path / "out" / path, BESIDE[:4])
    trap.events()
    assert_silent(trap, barpc("check", *crops), tmp_path / "in")
    for images in ("vrt", "copy"):
        said = barpc("adjust", *crops, "-o", tmp_path / "out", "--images", images, "--overwrite")
        assert trap.requests == [], said
        assert trap.events() == 0, said


def test_gdal_on_its_own_fetches_what_these_files_name(trap, tmp_path):
    """The tests above can fail. (Of all of `CONTENTS` GDAL 3.10 goes out for 43 of 60.)"""
    for name in (
        "source, element",
        "source, attribute",
        "source, attribute, without vsicurl",
        "source, tags in lower case",
        "source, raw data",
        "source, behind a comment that one parser ends",
        "a mark in front",
        "a mask, attribute",
        "a derived band",
        "a warped raster",
        "a web service",
        "a VRT in a NITF",
    ):
        before = len(trap.requests)
        path = write(trap, name, tmp_path / "h.tif")
        fresh = rasterio.Env(GDAL_HTTP_TIMEOUT=2, CPL_VSIL_CURL_NON_CACHED=f"/vsicurl/{trap.url}")
        with fresh, contextlib.suppress(rasterio.errors.RasterioError):
            with rasterio.open(path) as image:
                image.read(1)
                image.read_masks(1)
        assert len(trap.requests) > before, name


def test_the_trap_hears_what_gdal_fetches_on_its_own(crops, trap):
    """The tests above can fail: without barpc's defence the same file does go out."""
    beside(crops, ".ovr", trap.wms())
    with rasterio.Env(GDAL_HTTP_TIMEOUT=2), rasterio.open(crops[1]) as image:
        with contextlib.suppress(rasterio.errors.RasterioIOError):
            image.read(1, out_shape=(20, 20))
    assert trap.requests
    trap.events()
    np.load(evil_npz(crops[0].parent / "t.npz", trap.canary, "names"), allow_pickle=True)["names"]
    assert not trap.canary.exists()
    if Path("/proc/self").exists():
        assert trap.events() > 0
