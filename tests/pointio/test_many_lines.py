"""Tables by the million lines, read by batches: the numbers of a reader of single lines, lean, and soon."""

from __future__ import annotations

import csv
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.pointio import tables
from barpc.pointio.gcps import read_gcps
from barpc.pointio.matches import read_links
from barpc.pointio.tables import read_table
from tests.pointio.stages import read_matches

ROOT = Path(__file__).resolve().parents[2]
BATCH = tables._BATCH

MEASURED = """
import sys, time
from barpc.pointio.correspondences import read_altimetry, read_correspondences
from barpc.pointio.gcps import read_gcps
from barpc.pointio.third_party_matches import read_pair_files
from barpc.pointio.matches import read_links
from barpc.tie.pairing.area import read_area
from barpc.cameras import open_camera
from barpc.cli.project import given_points
from barpc.base.errors import BarpcError

def most():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM")) / 1024

before, start = most(), time.process_time()
try:
    found = {read}
    said = "read"
except BarpcError as error:
    said = str(error)
print(time.process_time() - start, most() - before, said, sep="\\n")
"""


def measured(path: Path, read: str) -> tuple[float, float, str]:
    """CPU seconds, more memory than before [MB] and the outcome of reading a file in a process of its own."""
    code = MEASURED.replace("{read}", read.replace("PATH", repr(str(path))))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    seconds, memory, said = done.stdout.strip().split("\n")
    return float(seconds), float(memory), said


# --- the same as line by line -----------------------------------------------------------------------------


def random_table(rng: random.Random, delimiter: str, lines: int) -> tuple[str, list[tuple[str, float, str]]]:
    """A text with comments, empty lines, quotes and blanks, and what it says: image, number, label."""
    rows, text = [], [delimiter.join(("image", "col", "other", "track"))]
    for n in range(lines):
        image = rng.choice(("left", "right", "a b", "'=x"))
        number = rng.choice((rng.uniform(-1e5, 1e5), float(rng.randrange(100)), 1e-300, 5e-324))
        label = rng.choice((str(rng.randrange(50)), "007", "7", "t7", "+7", "é7")) if n > 2 * BATCH else str(n // 2)
        cells = [f'"{image}"' if " " in image or rng.random() < 0.1 else image, repr(number), "x", label]
        if delimiter == ";":
            cells[1] = cells[1].replace(".", ",")
        blank = "" if delimiter == " " else rng.choice(("", "", " "))
        text.append(delimiter.join(blank + cell for cell in cells))
        rows.append((image.replace("'=x", "=x"), number, label))
        if rng.random() < 0.01:
            text.append(rng.choice(("", "   ", "# a comment, 1, 2, 3", "\t")))
    return "\n".join(text) + rng.choice(("", "\n")), rows


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
@pytest.mark.parametrize("lines", [1, BATCH - 1, 3 * BATCH + 5])
def test_batches_say_what_lines_say(tmp_path: Path, delimiter: str, lines: int) -> None:
    text, rows = random_table(random.Random(lines), delimiter, lines)
    (tmp_path / "a.csv").write_text(text)
    columns = {name: (name,) for name in ("image", "col", "track")}
    _, found = read_table(tmp_path / "a.csv", columns, list(columns), texts=("image", "track"))
    assert found["image"].per_row() == [image for image, _, _ in rows]
    assert found["col"].tolist() == [number for _, number, _ in rows]
    assert found["track"].per_row() == [label for _, _, label in rows]
    for column in (found["image"], found["track"]):
        numbers = column.index.tolist()
        assert list(dict.fromkeys(numbers)) == list(range(len(column.different)))  # in the order of their first rows


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize(
    "odd", ["1.5", " 1.5 ", "1_0", "+1", "1e400", "nan", "-inf", "0x10", "1,5", "", "\u0661", "1d5", "1 2"]
)
def test_numbers_read_at_once_are_those_of_single_cells(tmp_path: Path, delimiter: str, odd: str) -> None:
    """Quotes make a reader of cells of it, whatever numpy takes for a number."""
    found = []
    for quote in ("", '"'):
        cells = [(f"{quote}left{quote}", "t1", "1", "2.5"), (f"{quote}left{quote}", "t2", odd, "-3", "more")]
        text = "\n".join(map(delimiter.join, [("image", "track", "col", "row"), *cells]))
        (tmp_path / "a.csv").write_text(text, encoding="utf-8")
        columns = {name: (name,) for name in ("image", "track", "col", "row")}
        try:
            _, table = read_table(tmp_path / "a.csv", columns, list(columns), texts=("image", "track"))
            found.append([repr(table["col"].tolist()), table["row"].tolist(), table["track"].per_row()])
        except InputError as error:
            found.append([str(error)])
    assert found[0] == found[1]


@pytest.mark.parametrize("label", ["{}", "t{}", "0{}", "{}.0"])
def test_tracks_are_told_by_their_labels_as_they_are_written(tmp_path: Path, label: str) -> None:
    """12, 012, +12 and 1_2 are four; they are numbered as they come."""
    rows = [f"{image},{k}.5,{k},{label.format(k)}" for k in (9, 3, 12) for image in ("left", "right")]
    rows += [f"{image},{k},0,{text}" for k, text in enumerate(("012", "+12", "1_2")) for image in ("left", "right")]
    (tmp_path / "a.csv").write_text("\n".join(["image,col,row,track", *rows]))
    found = read_matches(tmp_path / "a.csv", ["left", "right"])
    same = label == "0{}"  # 012 is written so already
    assert len(found.view) == (10 if same else 12) or same
    assert found.xy[found.point == 0].tolist() == [[9.5, 9.0]] * 2
    assert found.xy[found.point == 1].tolist() == [[3.5, 3.0]] * 2
    assert len(np.unique(found.point)) == (4 if same else 6)


@pytest.mark.parametrize("line", [2, BATCH - 1, BATCH, BATCH + 1, BATCH + 2, 2 * BATCH + 7])
@pytest.mark.parametrize("wrong", ["left,x,1,1", "left,1,1", '"left,1,1,1'])
def test_the_line_that_is_wrong_is_named_wherever_it_stands(tmp_path: Path, line: int, wrong: str) -> None:
    lines = ["image,col,row,track", *(f"left,{k},1,{k}" for k in range(2 * BATCH + 20))]
    lines[line - 1] = wrong
    lines[4] = "# no line of numbers" if line != 5 else wrong
    (tmp_path / "a.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match=rf"a\.csv, line {line}: expected image, col, row, track"):
        read_links(tmp_path / "a.csv", ["left"])


def test_many_ground_points_are_those_of_a_plain_reader(tmp_path: Path) -> None:
    rng = random.Random(2)
    head = ["id", "lon", "lat", "alt", "col", "row", "image", "sigma_xy", "sigma_z", "sigma_px"]
    rows = []
    for _ in range(3000):
        point, image = rng.randrange(1000), rng.choice(("left", "right", "elsewhere"))
        stated = [rng.choice(("", "2.5")), rng.choice(("", "3")), rng.choice(("", "0.25"))]
        rows.append(
            [rng.choice((f"p{point}", "")), str(point / 500), "43", str(100 + point), str(point), "7", image, *stated]
        )
    with (tmp_path / "g.csv").open("w", newline="") as file:
        csv.writer(file).writerows([head, *rows])
    found = read_gcps(tmp_path / "g.csv", ["left", "right"])
    seen = [row for row in rows if row[6] != "elsewhere"]
    first = list({(row[0], row[1]): row for row in reversed(seen)}.items())
    first = sorted(((key, seen.index(row)) for key, row in first), key=lambda pair: pair[1])
    assert found.names == tuple(key[0] or f"gcp_{n}" for n, (key, _) in enumerate(first, 1))
    assert found.lonlatalt.tolist() == [[float(key[1]), 43.0, 100.0 + round(500 * float(key[1]))] for key, _ in first]
    flat = [float(seen[i][7] or 1) for _, i in first]
    assert found.sigma.tolist() == [[s, s, float(seen[i][8] or 1)] for s, (_, i) in zip(flat, first, strict=True)]
    number = {key: n for n, (key, _) in enumerate(first)}
    assert found.point.tolist() == [number[row[0], row[1]] for row in seen]
    assert found.view.tolist() == [("left", "right").index(row[6]) for row in seen]
    assert found.xy_sigma.tolist() == [float(row[9] or 0.5) for row in seen]
    assert found.strangers == ("elsewhere",)


# --- lean, and soon ---------------------------------------------------------------------------------------

N = 200_000
LEAN = {
    "matches": ("m.csv", "image,col,row,track,sigma\n", "{v},{x!r},{y!r},{k},0.5\n", "read_links(PATH, ['a', 'b'])"),
    "labels": ("m.csv", "image,col,row,track\n", "{v},{x!r},{y!r},t{k}\n", "read_links(PATH, ['a', 'b'])"),
    "points": ("p.csv", "lon,lat,alt,col,row\n", "5.1,43.2,{y!r},{x!r},7\n", "read_correspondences(PATH)"),
    "to project": ("p.csv", "lon,lat,alt\n", "5.1,43.2,{y!r}\n", "given_points((), PATH, ('lon', 'lat', 'alt'))"),
    "heights": ("h.csv", "lon,lat,alt,sigma\n", "5.1,43.2,100.5,\n", "read_altimetry(PATH)"),
    "control": ("g.csv", "id,lon,lat,alt,col,row,image\n", "g{n},5.1,43.2,{y!r},7,8,a\n", "read_gcps(PATH, ['a'])"),
    "asp": ("g.gcp", "", "g{n} 43.2 5.1 {y!r} 1 1 1 a.tif {x!r} 8 1 1\n", "read_gcps(PATH, ['a'])"),
    "pair": ("a__b.txt", f"{N // 2} {N // 2}\n", "{x!r} {y!r} 1 2 0 1 1 0 0 0 0\n", "read_links(PATH, ['a', 'b'])"),
}
"""File, head, a line, and how it is read."""


@pytest.mark.landing(1)
@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is told by /proc")
@pytest.mark.parametrize("kind", LEAN)
def test_a_table_of_many_lines_is_read_lean_and_soon(tmp_path: Path, kind: str) -> None:
    """3,000,000 lines of matches took 12 s and 1.3 GB, 1,000,000 of control 14 s and 0.9 GB."""
    name, head, line, read = LEAN[kind]
    rng = np.random.default_rng(1)
    with (tmp_path / name).open("w") as file:
        file.write(head)
        for n, (x, y) in enumerate(rng.uniform(0, 5000, (N, 2)).tolist()):
            file.write(line.format(n=n, k=n // 2, v="ab"[n % 2], x=x, y=y))
    seconds, memory, said = measured(tmp_path / name, read)
    assert said == "read"
    assert memory * 2**20 / N < 700  # bytes a line: 150 to 400
    assert seconds * 1e6 / N < 20  # microseconds a line: 2 to 6


DENSE = {
    "JSON, levels": (
        "a.geojson",
        lambda: '{"features":[' + "[" * 90 + "]" * 90 + ("," + "[" * 90 + "]" * 90) * 90_000 + "]}",
    ),
    "JSON, names": ("a.geojson", lambda: '{"features":{' + ",".join(f'"{k:x}":1' for k in range(4_100_000)) + "}}"),
    "JSON, texts": ("a.geojson", lambda: '{"features":[' + ",".join(f'"{k:x}"' for k in range(8_300_000)) + "]}"),
    "CSV, a line": ("a.csv", lambda: "image,col,row,track" + ",x" * 4_000_000 + "\n"),
    "CSV, wide": (
        "a.csv",
        lambda: f"image,col,row,track\n{'a,1,2,3' + ',x' * 400_000}\n" + f"b,1,2,3{',x' * 400_000}\n" * 9,
    ),
    "CSV, empty lines": ("a.csv", lambda: "image,col,row,track\n" + "\n" * 16_000_000),
    "CSV, lines": ("a.csv", lambda: "image,col,row,track\n" + "a,1,2,3\n" * 16_800_000),
    "XML, elements": ("a.xml", lambda: "<?xml version='1.0'?><a>" + "<b c='1'/>" * 2_000_000 + "</a>"),
    "XML, attributes": (
        "a.xml",
        lambda: "<?xml version='1.0'?><a " + " ".join(f"b{k}=''" for k in range(2_000_000)) + "/>",
    ),
    "text": ("a_RPC.TXT", lambda: "LINE_OFF: 1\nSAMP_OFF: 1\n" + "\n".join(f"K{k}: 1" for k in range(2_000_000))),
}


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is told by /proc")
@pytest.mark.parametrize("kind", DENSE)
def test_the_densest_file_of_a_kind_takes_a_gigabyte_and_seconds_at_most(tmp_path: Path, kind: str) -> None:
    name, text = DENSE[kind]
    (tmp_path / name).write_text(text())
    readers = {".geojson": ["read_gcps(PATH, ['a'])", "read_area(PATH)"], ".csv": ["read_links(PATH, ['a', 'b'])"]}
    for read in readers.get((tmp_path / name).suffix, ["open_camera(PATH)"]):
        seconds, memory, said = measured(tmp_path / name, read)
        assert said == "read" or name in said
        assert memory < 1024
        assert seconds < 20
