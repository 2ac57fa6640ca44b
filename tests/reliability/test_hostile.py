"""Files made to fetch, to read or to delete something else: nothing goes out, nothing outside is touched."""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import shutil
import socket
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import rasterio

from .conftest import Said, barpc, hashes

SECRET = "moon-landing-7391"
IN_ACCESS, IN_OPEN, IN_DELETE_SELF, IN_MODIFY = 0x1, 0x20, 0x400, 0x2


@dataclass
class Trap:
    """A server that must hear nothing, and files that nobody may open."""

    url: str
    canary: Path
    raster: Path
    requests: list[bytes] = field(default_factory=list)
    events: Callable[[], int] = lambda: 0

    def wms(self) -> str:
        """A web map service as GDAL reads it."""
        return (
            f'<GDAL_WMS><Service name="TMS"><ServerUrl>{self.url}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service>'
            "<DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>0</UpperLeftY><LowerRightX>300</LowerRightX>"
            "<LowerRightY>300</LowerRightY><TileLevel>0</TileLevel><SizeX>300</SizeX><SizeY>300</SizeY>"
            "</DataWindow><BandsCount>1</BandsCount></GDAL_WMS>"
        )

    def vrt(self, source: object, more: str = "", kind: str = "SimpleSource") -> str:
        """A VRT of the crops' size over any source."""
        return (
            f'<VRTDataset rasterXSize="300" rasterYSize="300">{more}<VRTRasterBand dataType="UInt16" band="1">'
            f'<{kind}><SourceFilename relativeToVRT="0">{source}</SourceFilename><SourceBand>1</SourceBand>'
            f"</{kind}></VRTRasterBand></VRTDataset>"
        )


@pytest.fixture
def trap(tmp_path: Path) -> Iterator[Trap]:
    server = socket.create_server(("127.0.0.1", 0))
    outside = tmp_path / "outside"
    outside.mkdir()
    canary, raster = outside / "canary.txt", outside / "canary.tif"
    canary.write_text(SECRET)
    with rasterio.open(raster, "w", driver="GTiff", width=300, height=300, count=1, dtype="uint16") as out:
        out.write(np.full((1, 300, 300), 4242, np.uint16))
    found = Trap(f"http://127.0.0.1:{server.getsockname()[1]}/x", canary, raster)

    def listen() -> None:
        while True:
            try:
                peer, _ = server.accept()
            except OSError:
                return
            with peer:
                found.requests.append(b"connected")
                peer.settimeout(1)
                peer.sendall(b"HTTP/1.0 404 gone\r\nContent-Length: 0\r\n\r\n")

    threading.Thread(target=listen, daemon=True).start()
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
    server.close()
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
    header = (
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }".ljust(117)
        + b"\n"
    )
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
    "a VRT that fetches": lambda t, c: instead(c, t.vrt(f"/vsicurl/{t.url}.tif")),
    "a VRT that fetches without vsicurl": lambda t, c: instead(c, t.vrt(t.url)),
    "a VRT of a file without header": lambda t, c: instead(
        c,
        t.vrt(t.canary, ' subClass="VRTRawRasterBand"').replace("SimpleSource", "SourceFilename"),
    ),
    "a VRT that runs Python": lambda t, c: instead(
        c, t.vrt(t.raster, "<PixelFunctionLanguage>Python</PixelFunctionLanguage>")
    ),
    "a VRT that warps": lambda t, c: instead(
        c, t.vrt(t.raster).replace("<VRTDataset ", '<VRTDataset subClass="VRTWarpedDataset" ')
    ),
    "a VRT whose source is a subdataset": lambda t, c: instead(c, t.vrt(f"GTIFF_DIR:1:{t.raster}")),
    "a VRT with an entity": lambda t, c: instead(
        c, f'<!DOCTYPE V [<!ENTITY x SYSTEM "file://{t.canary}">]>' + t.vrt("&x;")
    ),
    "a web service called .tif": lambda t, c: instead(c, t.wms()),
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
        "--fixed-run",
        evil_npz(c[0].parent / "block.npz", t.canary, "names", "model", "drift", "params").parent,
    ],
    "a run folder that lists files elsewhere": lambda t, c: foreign_state(c, t),
}


@pytest.mark.parametrize("name", HOSTILE)
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
    "name", ["view_01.tif", "view_01_RPC.TXT", "view_01.XML", "view_01.RPB", "view_01.geom"]
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


@pytest.mark.parametrize("verb", ["info", "footprint", "check", "crop", "apply", "convert"])
@pytest.mark.parametrize(
    "name", ["a web service called .tif", "a web service as overviews", "a VRT that fetches"]
)
def test_no_verb_fetches_anything(crops, tmp_path, trap, verb, name):
    HOSTILE[name](trap, crops)
    more = {
        "crop": [crops[1], tmp_path / "c.tif", "--window", 0, 0, 100, 100],
        "apply": [crops[1], "--rpc", crops[0], "-o", tmp_path / "applied"],
        "convert": [crops[1], tmp_path / "x.vrt"],
        "check": [*crops],
    }.get(verb, [crops[1]])
    said = barpc(verb, *more)
    assert trap.requests == []
    assert said.code in (0, 1, 3), said
    assert "Traceback" not in said.err


def test_the_trap_hears_what_gdal_fetches_on_its_own(crops, trap):
    """The tests above can fail: without barpc's defence the same file does go out."""
    beside(crops, ".ovr", trap.wms())
    with rasterio.Env(GDAL_HTTP_TIMEOUT=2), rasterio.open(crops[1]) as image:
        with pytest.raises(rasterio.errors.RasterioIOError):
            image.read(1, out_shape=(20, 20))
    assert trap.requests
    trap.events()
    np.load(evil_npz(crops[0].parent / "t.npz", trap.canary, "names"), allow_pickle=True)["names"]
    assert not trap.canary.exists()
    if Path("/proc/self").exists():
        assert trap.events() > 0
