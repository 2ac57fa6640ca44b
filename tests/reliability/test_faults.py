"""What can be wrong with what a user gives: one line, the documented exit code, every input as it was.

`FAULTS` is a table: a name, how to bring the fault about, the exit code, words of the message.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.rpcio import read_rpc, write_rpc
from tests.geotiffs import write_image

from .conftest import assert_one_line, barpc, hashes, rewrite
from .trials import SIDE

Args = list[object]
RNG = np.random.default_rng(5)


@dataclass(frozen=True)
class Scene:
    """Two good crops in a folder of their own."""

    folder: Path
    a: Path
    b: Path

    def file(self, name: str, content: str | bytes = "") -> Path:
        path = self.folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def third(self, name: str = "third.tif") -> Path:
        return Path(shutil.copy(self.b, self.folder / name))


Prepare = Callable[[Scene], Args]


def damaged(change: Callable[[Path], object]) -> Prepare:
    """The second image is changed."""

    def prepare(scene: Scene) -> Args:
        change(scene.b)
        return [scene.a, scene.b]

    return prepare


def given(*more: object, **files: str | bytes) -> Prepare:
    """Two good images, with options; `files` are written, and options that name one become its path."""

    def prepare(scene: Scene) -> Args:
        paths = {
            name.replace("__", "."): scene.file(name.replace("__", "."), content) for name, content in files.items()
        }
        return [scene.a, scene.b, *(paths.get(str(word), word) for word in more)]

    return prepare


def pixels(change: Callable[[np.ndarray], np.ndarray], **how: object) -> Prepare:
    return damaged(lambda path: rewrite(path, pixels=change, **how))


def camera(**changes: float) -> Prepare:
    """Fields of the second image's RPC are moved."""

    def change(rpcs: rasterio.rpc.RPC) -> None:
        for name, by in changes.items():
            setattr(rpcs, name, getattr(rpcs, name) + by)

    return damaged(lambda path: rewrite(path, camera=change))


def tag(index: int, value: float) -> Callable[[Path], object]:
    """One of the 92 numbers of an image's RPC tag, in the file itself."""

    def change(path: Path) -> object:
        with rasterio.open(path) as image:
            rpcs = image.rpcs
        start = struct.pack("<3d", rpcs.line_off, rpcs.samp_off, rpcs.lat_off)
        data = bytearray(path.read_bytes())
        at = data.index(start) + 8 * (index - 2)
        data[at : at + 8] = struct.pack("<d", value)
        return path.write_bytes(data)

    return change


def cut(share: float) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def corrupt_tile(path: Path) -> None:
    rewrite(path, compress="deflate", tiled=True, blockxsize=128, blockysize=128)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 3000] = b"\xff" * 3000
    path.write_bytes(data)


def empty(folder: Path) -> Path:
    """A folder with nothing in it."""
    folder.mkdir()
    return folder


def moved_away(scene: Scene, degrees: float = 1.0) -> list[Path]:
    """Copies of both images, far to the east of them."""
    found = []
    for path in (scene.a, scene.b):
        copy = Path(shutil.copy(path, scene.folder / f"far_{path.name}"))
        rewrite(copy, camera=lambda rpcs: setattr(rpcs, "long_off", rpcs.long_off + degrees))
        found.append(copy)
    return found


def dem(path: Path, west: float, north: float, height: float, crs: str | None = "EPSG:4979") -> Path:
    place = rasterio.Affine(0.01, 0, west, 0, -0.01, north)
    return write_image(path, np.full((50, 50), height, np.float32), transform=place, crs=crs)


def terrain(height: float, shift: float = 0.0, crs: str | None = "EPSG:4979", *more: object) -> Prepare:
    def prepare(scene: Scene) -> Args:
        with rasterio.open(scene.a) as image:
            lon, lat = image.rpcs.long_off + shift, image.rpcs.lat_off
        path = dem(scene.folder / "dem.tif", lon - 0.25, lat + 0.25, height, crs)
        return [scene.a, scene.b, "--dem", path, *more]

    return prepare


def matches(rows: list[tuple[str, float, float, int]]) -> Prepare:
    text = "image,col,row,track\n" + "".join(f"{n},{c},{r},{t}\n" for n, c, r, t in rows)
    return given("--matches", "ties.csv", ties__csv=text)


def outliers(scene: Scene) -> Args:
    """Nine in ten rows of a tie-point table have nothing to do with the scene."""
    done = barpc("adjust", scene.a, scene.b, "-o", scene.folder / "good")
    assert done.code == 0, done
    rows = ["image,col,row,track"]
    for line in (scene.folder / "good/tables/observations.csv").read_text().splitlines()[1:]:
        view, track, *xy = line.split(",")[:4]
        wrong = int(track) % 10 and view == "view_01"
        rows.append(",".join([view, *(map(str, RNG.uniform(0, SIDE, 2)) if wrong else xy), track]))
    shutil.rmtree(scene.folder / "good")
    return [scene.a, scene.b, "--matches", scene.file("ties.csv", "\n".join(rows)), "--matches-only"]


def smooth(values: np.ndarray) -> np.ndarray:
    rows, cols = np.indices(values.shape)
    return 3000 + 500 * np.sin(rows / 90) * np.cos(cols / 70)


def linked(scene: Scene) -> Args:
    (scene.folder / "link.tif").symlink_to(scene.a)
    return [scene.a, scene.folder / "link.tif"]


def other_rpc(scene: Scene) -> Args:
    third = rewrite(scene.third(), pixels=lambda values: values[::-1, ::-1])
    write_rpc(read_rpc(scene.a), scene.folder / "third_RPC.TXT")
    return [scene.a, third]


OPTIONS = {
    "not TOML": ("[adjust\n", ("TOML",)),
    "an unknown option": ("colour = 3\n", ("unknown option 'colour'",)),
    "an unknown table": ("[ties]\nband = 1\n", ("unknown option 'ties'",)),
    "a value of another type": ('[tie]\nband = "one"\n', ("band", "whole number")),
    "a value that is none": ('[adjust]\nmodel = "magic"\n', ("magic", "rotation")),
    "a negative count": ("tiles = -1\n", ("tiles",)),
    "a list for a number": ("tiles = [1]\n", ("tiles",)),
    "a number for a path": ("matches = 3\n", ("matches",)),
    "a number for a list": ("gcp = 3\n", ("gcp",)),
    "a number for a table": ("tie = 3\n", ("[tie]",)),
    "no finite number": ("[adjust]\nsigma_attitude = nan\n", ("sigma_attitude",)),
    "not text": (b"\xff\xfe\x00", ("options file",)),
}

FAULTS: dict[str, tuple[Prepare, int, tuple[str, ...]]] = {
    "a missing image": (damaged(Path.unlink), 1, ("view_01.tif", "no such file")),
    "an empty image": (damaged(lambda p: p.write_bytes(b"")), 1, ("view_01.tif", "empty")),
    "a text that is called .tif": (damaged(lambda p: p.write_text("hello")), 1, ("view_01.tif", "not a raster")),
    "a header that is noise": (damaged(lambda p: p.write_bytes(b"II*\0" + RNG.bytes(4000))), 1, ("view_01.tif",)),
    "a truncated image": (damaged(cut(0.5)), 1, ("view_01.tif",)),
    "an image cut in its header": (damaged(cut(0.0005)), 1, ("view_01.tif",)),
    "a corrupt tile": (damaged(corrupt_tile), 1, ("view_01.tif",)),
    "a folder that holds an image, and the image": (lambda s: [s.a, s.folder], 1, ("is the same file",)),
    "a folder without images": (lambda s: [s.a, empty(s.folder / "nothing")], 1, ("a folder without images",)),
    "a device for an image": (lambda s: [s.a, "/dev/null"], 1, ("/dev/null", "device")),
    "an empty name": (lambda s: [s.a, ""], 1, ("an empty name",)),
    "a name with a zero byte": (lambda s: [s.a, "a\0b.tif"], 1, ("the character", "rename it")),
    "no RPC": (damaged(lambda p: rewrite(p, camera=None) and strip_rpc(p)), 1, ("view_01.tif", "no RPC")),
    "an unparsable sidecar": (given(view_01_RPC__TXT="LINE_OFF: x\n"), 1, ("view_01_RPC.TXT",)),
    "an empty sidecar": (given(view_01__RPB=""), 1, ("view_01.RPB",)),
    "the RPC of another image": (other_rpc, 1, ("third.tif", "same RPC")),
    "an RPC that is wrong by 500 px": (camera(samp_off=500.0), 3, ("less accurate than stated",)),
    "an RPC that is wrong by 5 km": (
        camera(samp_off=10_000.0),
        1,
        ("view_01.tif", "outside of the ground that its RPC was made for"),
    ),
    "an RPC of a place far away": (camera(long_off=20.0), 1, ("overlap",)),
    "a zero scale": (damaged(tag(7, 0.0)), 1, ("view_01.tif", "scale")),
    "a zero height scale": (damaged(tag(11, 0.0)), 1, ("view_01.tif", "scale")),
    "NaN in the coefficients": (damaged(tag(20, np.nan)), 1, ("view_01.tif", "finite")),
    "an infinite offset": (damaged(tag(4, np.inf)), 1, ("view_01.tif", "finite")),
    "a latitude offset of 200 degrees": (damaged(tag(4, 200.0)), 1, ("view_01.tif",)),
    "one image": (lambda s: [s.a], 1, ("view_00.tif", "at least 2")),
    "no image": (lambda s: [], 1, ("at least 2",)),
    "the same image twice": (lambda s: [s.a, s.a], 1, ("the same file", "view_00.tif")),
    "a link to the same image": (linked, 1, ("the same file",)),
    "a copy of the same image": (
        lambda s: [s.a, shutil.copy(s.a, s.folder / "copy.tif")],
        1,
        ("the same RPC", "copy.tif"),
    ),
    "the same pixels under another RPC": (
        lambda s: [s.a, twin(s, None, dtype="float32", tiled=True, compress="deflate")],
        1,
        ("same pixels", "twin.tif", "view_00.tif"),
    ),
    "no overlap": (lambda s: [s.a, moved_away(s)[1]], 1, ("view_00", "far_view_01", "overlap")),
    "two groups": (lambda s: [s.a, s.b, *moved_away(s)], 1, ("view_00", "far_view_00")),
    "images from nearly the same place": (lambda s: [s.a, twin(s, lambda v: v + 1)], 3, ()),
    "images from the same place, where that is refused": (
        lambda s: [
            *given("--options", "o.toml", o__toml=b"[tie]\nangles = [1.0, 60.0]\n")(s)[2:],
            s.a,
            twin(s, lambda v: v + 1),
        ],
        1,
        ("1 to 60 deg",),
    ),
    "nothing but nodata": (pixels(np.zeros_like), 1, ("view_00", "view_01", "keypoints")),
    "nothing but declared nodata": (pixels(lambda v: np.full_like(v, 7), nodata=7), 1, ("view_01", "keypoints")),
    "a constant image": (
        pixels(lambda v: np.full_like(v, 700)),
        1,
        ("view_00", "no detail in view_01", "one value", "keypoints"),
    ),
    "nothing but cloud": (pixels(smooth), 1, ("view_01", "keypoints")),
    "nothing but noise": (pixels(lambda v: RNG.uniform(300, 3000, v.shape)), 1, ("view_00", "view_01", "keypoints")),
    "only NaN": (pixels(lambda v: np.full_like(v, np.nan), dtype="float32"), 1, ("no detail in view_01",)),
    "an image of one pixel": (pixels(lambda v: v[:1, :1]), 1, ("view_01",)),
    "an image of one row": (pixels(lambda v: v[:1]), 1, ("view_01",)),
    "a complex image": (pixels(lambda v: v, dtype="complex64"), 1, ("view_01.tif", "complex")),
    "a band that is not there": (given("--band", 3), 1, ("view_00.tif", "band 3")),
    "an image list that is missing": (given("--image-list", "gone.txt"), 1, ("gone.txt",)),
    "an image list that is no text": (given("--image-list", "l.txt", l__txt=b"\xff\xfe\0"), 1, ("l.txt",)),
    "an options file that is missing": (given("--options", "gone.toml"), 1, ("gone.toml",)),
    "an unknown flag": (given("--colour", "red"), 2, ("--colour",)),
    "a flag that is nearly one": (given("--overwrit"), 2, ("--overwrite",)),
    "a flag without its value": (given("NO -o", "--dem"), 2, ("--dem",)),
    "no output folder": (lambda s: [s.a, s.b, "NO -o"], 2, ("--out-dir",)),
    "zero workers": (given("-j", 0), 2, ("0",)),
    "a number that is none": (given("--drift", "far"), 2, ("far",)),
    "a choice that is none": (given("--images", "jpeg"), 2, ("jpeg",)),
    "an unknown solver": (
        given("--options", "o.toml", o__toml=b"[adjust]\nsolver = 'magic'\n"),
        1,
        ("magic", "auto, sparse"),
    ),
    "an unknown model": (given("--model", "magic"), 2, ("magic", "rotation")),
    "an unknown matcher": (given("--options", "o.toml", o__toml=b"[tie]\nmatcher = 'magic'\n"), 1, ("magic", "guided")),
    "an unknown RPC format": (given("--rpc-format", "doc"), 2, ("doc", "txt")),
    "a fixed view that is not there": (given("--fixed", "nobody"), 1, ("nobody",)),
    "all views fixed": (given("--fixed", "view_00", "--fixed", "view_01"), 3, ()),
    "a negative drift": (given("--drift", "-1"), 2, ("drift",)),
    "a share above one": (given("--options", "o.toml", o__toml=b"[tie]\nmin_overlap = 2.0\n"), 1, ("min_overlap",)),
    "a tolerance that cannot be met": (
        given("--options", "o.toml", o__toml=b"[fit]\ntolerance = 1e-30\n"),
        1,
        ("view_00", "1e-30"),
    ),
    "a geoid without a DEM": (given("--geoid", "g.gtx", g__gtx=b""), 1, ("geoid", "dem")),
    "no scheduler at the address": (given("-j", "tcp://127.0.0.1:9"), 1, ("127.0.0.1:9",)),
    "a scheduler address that is none": (given("-j", "nonsense://x"), 1, ("nonsense",)),
    "GCPs that are missing": (given("--gcp", "gone.gcp"), 1, ("gone.gcp",)),
    "GCPs that are no numbers": (given("--gcp", "g.gcp", g__gcp="1 a b c d e f view_00 1 2 3 4\n"), 1, ("g.gcp",)),
    "GCPs of other images": (given("--gcp", "g.gcp", g__gcp="1 43 5 100 1 1 1 other.tif 5 5 1 1\n"), 1, ("g.gcp",)),
    "GCPs with a zero sigma": (given("--gcp", "g.gcp", g__gcp="1 43 5 100 0 0 0 view_00.tif 5 5 0 0\n"), 1, ("g.gcp",)),
    "GCPs that are not finite": (
        given("--gcp", "g.gcp", g__gcp="1 nan 5 100 1 1 1 view_00.tif 5 5 1 1\n"),
        1,
        ("g.gcp",),
    ),
    "a GeoJSON that is cut": (given("--gcp", "g.geojson", g__geojson='{"features": ['), 1, ("g.geojson",)),
    "a GeoJSON of a list": (given("--gcp", "g.geojson", g__geojson='{"features": [3]}'), 1, ("g.geojson",)),
    "GCPs that are no text": (given("--gcp", "g.gcp", g__gcp=b"\xff\xfe1 2 3"), 1, ("g.gcp",)),
    "a DEM that is missing": (given("--dem", "gone.tif"), 1, ("gone.tif",)),
    "a DEM that is a text": (given("--dem", "d.tif", d__tif="x"), 1, ("d.tif",)),
    "a DEM without CRS": (terrain(200.0, 0.0, None), 1, ("dem.tif", "CRS")),
    "a DEM that does not cover": (terrain(200.0, 40.0), 1, ("dem.tif",)),
    "a geoid for ellipsoidal heights": (
        lambda s: [*terrain(200.0)(s), "--geoid", dem(s.folder / "geoid.tif", 0, 60, 48.0)],
        1,
        ("ellipsoidal already",),
    ),
    "a geoid that is a text": (
        lambda s: [*terrain(200.0, 0.0, "EPSG:4326")(s), "--geoid", s.file("g.gtx", "x")],
        1,
        ("g.gtx",),
    ),
    "an SRTM tile of the wrong size": (given("--dem", "N44E005.hgt", N44E005__hgt=b"\0" * 100), 1, (".hgt",)),
    "tie points that are missing": (given("--matches", "gone.csv"), 1, ("gone.csv",)),
    "a tie-point table without columns": (given("--matches", "t.csv", t__csv="a,b\n1,2\n"), 1, ("t.csv", "track")),
    "a tie-point table of letters": (
        given("--matches", "t.csv", t__csv="image,col,row,track\nview_00,x,y,z\n"),
        1,
        ("t.csv",),
    ),
    "a tie-point table that is empty": (matches([]), 1, ("ties.csv",)),
    "tie points that are not finite": (
        matches([(f"view_0{v}", np.nan, 1.0, t) for t in range(50) for v in (0, 1)]),
        1,
        ("ties.csv",),
    ),
    "an npz that is none": (given("--matches", "t.npz", t__npz=b"PK\3\4 cut"), 1, ("t.npz",)),
    "an npz that is a text": (given("--matches", "t.npz", t__npz="hello"), 1, ("t.npz",)),
    "too few tie points": (
        lambda s: [
            *matches([(f"view_0{v}", 10.0 + 20 * t, 50.0, t) for t in range(3) for v in (0, 1)])(s),
            "--matches-only",
        ],
        1,
        ("too few", "view_00"),
    ),
    "nine wrong tie points in ten": (outliers, 3, ()),
    "an earlier run that is none": (given("--add-to", "/nowhere"), 1, ("/nowhere",)),
    "an earlier run that is damaged": (
        lambda s: [s.a, s.b, "--add-to", s.file("block.npz", "PK\3\4x").parent],
        1,
        ("summary.json",),
    ),
    "a VRT of nothing": (
        lambda s: [s.a, s.file("x.vrt", '<VRTDataset rasterXSize="9" rasterYSize="9"></VRTDataset>')],
        1,
        ("x.vrt",),
    ),
    **{
        f"an options file with {name}": (given("--options", "run.toml", run__toml=text), 1, ("run.toml", *words))
        for name, (text, words) in OPTIONS.items()
    },
}


def nudge(rpcs: rasterio.rpc.RPC) -> None:
    """A camera of its own, nearly where the other is."""
    rpcs.samp_off += 0.25
    rpcs.samp_num_coeff = [c + 2e-3 * (k == 3) for k, c in enumerate(rpcs.samp_num_coeff)]  # a pixel, by altitude


def twin(scene: Scene, change: Callable[[np.ndarray], np.ndarray] | None, **how: object) -> Path:
    """The first image again, from nearly the same place."""
    copy = Path(shutil.copy(scene.a, scene.folder / "twin.tif"))
    return rewrite(copy, pixels=change, camera=nudge, **how)


def strip_rpc(path: Path) -> None:
    with rasterio.open(path) as image:
        values = image.read(1)
    path.unlink()
    write_image(path, values)


@pytest.fixture
def scene(crops, tmp_path) -> Scene:
    return Scene(tmp_path / "in", *crops)


NOISE = "nothing but noise"
AT_WORK = (  # told or borne after much work or waiting, or after dask is imported
    "nine wrong tie points in ten", "an RPC that is wrong by 500 px", "images from nearly the same place",
    "all views fixed", NOISE, "no scheduler at the address", "a scheduler address that is none",
)  # fmt: skip


@pytest.mark.few(44)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in AT_WORK) + [pytest.mark.costs(4)] * (name == NOISE))
        for name in FAULTS
    ],
)
def test_a_fault_is_one_line_and_leaves_nothing(name, scene, tmp_path, monkeypatch):
    prepare, code, words = FAULTS[name]
    monkeypatch.chdir(scene.folder)
    args = prepare(scene)
    out = [] if "NO -o" in args else ["-o", tmp_path / "out"]
    before = hashes([scene.folder])
    said = barpc("adjust", *(arg for arg in args if arg != "NO -o"), *out)
    assert hashes([scene.folder]) == before
    if code in (1, 2):
        assert_one_line(said, code, *words)
        if (tmp_path / "out").exists():  # of a run that took long: what the next one need not do again
            assert (name, [path.name for path in (tmp_path / "out").iterdir()]) == (NOISE, [".barpc"])
    else:
        assert said.code == code
        assert said.err.startswith("barpc: needs review (exit code 3): ") if code == 3 else said.err == ""
        assert (tmp_path / "out/view_00_RPC.TXT").exists()
