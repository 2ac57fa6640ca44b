"""A disk that fills up is always noticed: a run that says it is done has written what it should."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio

from barpc.rpcio import read_rpc, write_rpc
from tests.geotiffs import write_image

from .conftest import assert_one_line, barpc, hashes
from .trials import outputs

KIB = 1024


@pytest.fixture
def small_disk(tmp_path) -> Iterator:
    """A function that mounts a file system of so many KiB; one needs to be root for that."""
    mounted: list[Path] = []

    def mount(kib: int) -> Path:
        place = tmp_path / f"disk_{kib}_{len(mounted)}"
        place.mkdir()
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", place], capture_output=True, check=False
        )
        if done.returncode:
            pytest.skip(f"no small disk: mount says {done.stderr.decode().strip()!r} (it takes root)")
        mounted.append(place)
        return place

    if shutil.which("mount") is None:
        pytest.skip("no small disk: there is no mount command here")
    yield mount
    for place in mounted:
        subprocess.run(["umount", "-l", place], check=False, capture_output=True)


def size_of(folder: Path) -> int:
    """Pages that the files of a folder take [KiB]."""
    return sum(-(-path.stat().st_size // 4096) * 4 for path in folder.rglob("*") if path.is_file())


def as_jp2(path: Path) -> Path:
    """The same image as JPEG 2000, with its RPC beside it: a copy of it is written by GDAL."""
    with rasterio.open(path) as image:
        pixels = image.read()
    write_rpc(read_rpc(path), path.with_name(f"{path.stem}_RPC.TXT"))
    path.unlink()
    return write_image(path.with_suffix(".jp2"), pixels, driver="JP2OpenJPEG", QUALITY="100", REVERSIBLE="YES")


@pytest.mark.parametrize(
    ("images", "levels"),
    [
        pytest.param("vrt", 3, marks=pytest.mark.slow),
        *(pytest.param(how, 9, marks=pytest.mark.nightly) for how in ("vrt", "copy", "converted")),
    ],
)
def test_a_disk_that_is_full_at_any_point_is_told_in_one_line(crops, tmp_path, small_disk, images, levels):
    if images == "converted":
        crops = [as_jp2(path) for path in crops]
    how = ("--images", "vrt" if images == "vrt" else "copy")
    assert barpc("adjust", *crops, "-o", tmp_path / "enough", *how).code == 0
    truth, most = outputs(tmp_path / "enough"), size_of(tmp_path / "enough")
    before = hashes(crops)
    refused = 0
    for kib in np.unique(np.linspace(16, most + 64, levels).astype(int) // 4 * 4):
        out = small_disk(int(kib)) / "out"
        said = barpc("adjust", *crops, "-o", out, *how)
        if said.code == 0:
            assert names_and_pixels(out, truth) == names_and_pixels(tmp_path / "enough", truth)
        else:
            assert_one_line(said, 1, "No space left on device")
            assert not (out / "summary.json").exists()
            refused += 1
        assert hashes(crops) == before
    assert refused >= min(4, levels - 1)


def names_and_pixels(folder: Path, names: dict[str, bytes]) -> dict[str, object]:
    """What is compared over folders at other places: images are named relative to them."""
    found: dict[str, object] = {}
    for name in names:
        if name.endswith((".vrt", ".tif")):
            with rasterio.open(folder / name) as image:
                found[name] = (image.read().tobytes(), image.rpcs.to_dict())
        elif name not in (
            "summary.json",
            "report.html",
            "SHA256SUMS",
            "map.gpkg",
            "tables/footprints.geojson",
            "tables/images.json",
        ):
            found[name] = (folder / name).read_bytes()
    return found


@pytest.mark.slow
def test_a_run_that_met_a_full_disk_goes_on_when_there_is_room(crops, tmp_path, small_disk):
    assert barpc("adjust", *crops, "-o", tmp_path / "enough").code == 0
    disk = small_disk(size_of(tmp_path / "enough") // 2)
    said = barpc("adjust", *crops, "-o", disk / "out")
    assert_one_line(said, 1, "No space left on device")
    subprocess.run(["mount", "-o", "remount,size=64m", disk], check=True)
    assert barpc("adjust", *crops, "-o", disk / "out").code == 0
    truth = outputs(tmp_path / "enough")
    assert names_and_pixels(disk / "out", truth) == names_and_pixels(tmp_path / "enough", truth)


def test_a_read_only_disk_is_named(crops, small_disk):
    disk = small_disk(1024)
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    assert_one_line(barpc("adjust", *crops, "-o", disk / "out"), 1, str(disk), "Read-only")


@pytest.mark.parametrize("verb", ["convert --window", "convert", "convert -o"])
def test_other_verbs_notice_a_full_disk_too(crops, tmp_path, small_disk, verb):
    disk = small_disk(8)
    (disk / "filler").write_bytes(b"\1" * 8 * KIB)
    before = hashes(crops)
    said = {
        "convert --window": lambda: barpc("convert", crops[0], disk / "crop.tif", "--window", 0, 0, 120, 120),
        "convert": lambda: barpc("convert", crops[0], disk / "x_RPC.TXT"),
        "convert -o": lambda: barpc("convert", crops[0], "--rpc", crops[1], "-o", disk / "applied"),
    }[verb]()
    assert_one_line(said, 1)
    assert [path.name for path in disk.rglob("*") if path.is_file()] == ["filler"]
    assert hashes(crops) == before
