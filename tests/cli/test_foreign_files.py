"""Every option that takes a file, given a file of another kind: one line that names it, and a documented exit code."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from barpc.base.declarations import declared
from barpc.base.options import RunOptions
from barpc.cli.flags import flag_name
from tests.geotiffs import write_image
from tests.pointio.test_gcp_formats import geopackage_of, shapefile_of
from tests.reliability.conftest import barpc
from tests.reliability.trials import SAMPLES

IMAGES = [str(path) for path in SAMPLES]
RNG = np.random.default_rng(1)


def picture(driver: str) -> Callable[[Path], object]:
    return lambda path: write_image(path, np.full((64, 64), 7, np.uint8), driver=driver)


def written(data: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(data)


FOREIGN: dict[str, tuple[str, Callable[[Path], object]]] = {
    "raster": ("a.tif", picture("GTiff")),
    "shapefile": ("left.shp", lambda path: shapefile_of(path.parent, kind=0)),
    "empty": ("empty.csv", written(b"")),
    "folder": ("folder", lambda path: path.mkdir()),
    "JPEG": ("a.jpg", picture("JPEG")),
    "random": ("a.bin", written(RNG.bytes(30_000))),
    "pipe": ("pipe", os.mkfifo),
    "letter": ("letter.txt", written(b"To whom it may concern:\nnothing is here.\n")),
    "polygons": ("left.gpkg", lambda path: path.write_bytes(geopackage_of()[:9000])),
    "heights": ("n44e005.hgt", written(RNG.integers(0, 900, 1201**2).astype(">i2").tobytes())),
    "low heights": ("n45e006.hgt", written(RNG.integers(120, 255, 1201**2).astype(">i2").tobytes())),
    "voids": ("n43e006.hgt", written(struct.pack(">h", -32768) * 1201**2)),
    "zeros": ("zeros", written(bytes(5000))),
    "JSON": ("a.json", written(b'{"a": [1, 2, {"b": null}]}')),
    "list": ("list.json", written(b"[1, 2]")),
    "GeoJSON without geometry": (
        "g.geojson",
        written(json.dumps({"features": [{"type": "Feature", "geometry": None, "properties": {}}]}).encode()),
    ),
    "XML": ("a.xml", written(b"<?xml version='1.0'?><a><b/></a>")),
    "archive": ("a.zip", written(b"PK\x05\x06" + bytes(18))),
    "table": ("t.csv", written(b"a,b,c\n1,2,3\n4,5,6\n")),
    "wide text": ("u.csv", written("a;b\n1;2\n".encode("utf-16"))),
    "broken database": ("b.gpkg", written(b"SQLite format 3\0" + RNG.bytes(4000))),
    "nul": ("n.csv", written(b"id,lon,lat,alt,col,row\n\0\0\0\n")),
}  # fmt: skip
"""Kind -> name and how it is made."""

ADJUST = [
    flag_name(f"{table}.{name}" if table else name)
    for table, record in (("", RunOptions), ("tie", type(declared(RunOptions)["tie"].default)))
    for name, one in declared(record).items()
    if one.rule.unit in ("file", "dir") and name not in ("work_dir",)
]
_DEM = "--dem", "{dem}"
COMMANDS: dict[str, list[str]] = {
    **{f"adjust {flag}": ["adjust", *IMAGES, flag, "{file}", *(_DEM if flag in ("--geoid", "--reference") else ())]
       for flag in ADJUST if flag != "--heights"},
    "adjust": ["adjust", *IMAGES[:2], "{file}"],
    "info": ["info", "{file}"],
    "fit": ["fit", "{file}"],
    "convert": ["convert", "{file}"],
    "ortho --dem": ["ortho", IMAGES[0], "--dem", "{file}"],
    "project --dem": ["project", IMAGES[0], "5.4", "43.3", "--dem", "{file}"],
    "localize --dem": ["localize", IMAGES[0], "500", "500", "--dem", "{file}"],
    "fit --dem": ["fit", IMAGES[0], "--dem", "{file}"],
    "project --points": ["project", IMAGES[0], "--points", "{file}"],
    "dsm": ["dsm", "{file}"],
    "verify": ["verify", "{file}"],
    "export": ["export", "{file}", "{file}.out", "--to", "colmap"],
    "calibrate": ["calibrate", "{file}", "{file}", "{file}"],
}  # fmt: skip

OUTPUT = ("adjust", "fit", "convert", "ortho", "dsm", "calibrate")
FAST = {("adjust --gcp", "heights"), ("adjust --gcp", "random"), ("adjust --check-points", "shapefile"),
        ("adjust --matches", "JPEG"), ("adjust --dem", "empty"), ("adjust --geoid", "folder"),
        ("adjust --reference", "letter"), ("adjust --calibration", "raster"), ("adjust --altimetry", "zeros"),
        ("adjust --gcp", "pipe"), ("adjust --gcp", "GeoJSON without geometry"),
        ("adjust --matches", "empty")}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(name, kind, marks=() if (name, kind) in FAST else pytest.mark.nightly, id=f"{name}: {kind}")
        for name in COMMANDS
        for kind in FOREIGN
        if not (kind in ("heights", "voids") and ("--dem" in name or "--geoid" in name))  # which they are
        if (name, kind) != ("project --points", "empty")  # no points
    ],
)
def test_a_file_of_another_kind_is_one_line(name: str, kind: str, tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    path = tmp_path / "left" / FOREIGN[kind][0]
    FOREIGN[kind][1](path)
    if "{dem}" in COMMANDS[name]:
        (tmp_path / "N43E005.hgt").write_bytes(struct.pack(">h", 100) * 1201**2)
    words = [word.format(file=path, dem=tmp_path / "N43E005.hgt") for word in COMMANDS[name]]
    words += ["-o", str(tmp_path / "out")] if words[0] in OUTPUT else []
    before = None if path.is_dir() or path.is_fifo() else path.read_bytes()
    ended = barpc(*words)
    said = ended.err.strip()
    assert ended.code in (1, 2), said
    *above, line = said.splitlines()
    assert line.startswith("barpc: "), said
    assert not [one for one in above if not one.startswith("barpc: ")], said
    assert str(path) in said or path.name in said
    for word in ("bug", "Traceback", "object", "NoneType", "unexpected"):
        assert word not in said.replace(str(tmp_path), "")
    assert kind != "empty" or "empty" in said or name in ("adjust --add-to", "dsm", "verify", "export", "calibrate")
    assert before is None or path.read_bytes() == before
