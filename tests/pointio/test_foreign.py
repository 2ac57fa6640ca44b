"""Matches as other programs write them: the same points whoever wrote them, and one line where a file lies."""

from __future__ import annotations

import sqlite3
import struct
import sys
import types
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from barpc.base.errors import InputError
from barpc.base.safe_io import Kind
from barpc.pointio.matches import read_links
from tests.pointio.stages import read_matches

NAMES = ["a", "b", "c"]
KEYPOINTS = {
    "a": np.array([[0.0, 0.0], [10.25, 3.5], [7.0, 99.75]]),
    "b": np.array([[1.5, 1.5], [11.5, 4.25], [8.0, 8.0], [3.0, 2.0]]),
    "c": np.array([[40.5, 2.0], [20.0, 30.0]]),
}
MATCHES = {("a", "b"): [[0, 1], [1, 3], [2, 2]], ("b", "c"): [[1, 0]]}
"""One of three views, a(0) - b(1) - c(0), and two of two."""


def partners(first: str, rows: list[list[int]]) -> np.ndarray:
    """The partner of each keypoint of the first image; -1: none."""
    found = np.full(len(KEYPOINTS[first]), -1)
    found[np.array(rows)[:, 0]] = np.array(rows)[:, 1]
    return found


def colmap(folder: Path, geometries: bool = True, shift: float = 0.5, names: str = "sub/{}.tif") -> Path:
    """A database of COLMAP's: it counts from the corner of the first pixel; more columns than two, raw matches too."""
    path = folder / "database.db"
    with closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER)")
        for table, key in (
            ("keypoints", "image_id"),
            ("matches", "pair_id"),
            ("two_view_geometries", "pair_id"),
        ):
            db.execute(f"CREATE TABLE {table} ({key} INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
        ids = {"b": 3, "a": 5, "stranger": 6, "c": 8}
        for name, number in ids.items():
            xy = KEYPOINTS.get(name, np.zeros((1, 2)))
            table = np.hstack([xy + shift, np.ones((len(xy), 2))]).astype("<f4")
            db.execute("INSERT INTO images VALUES (?, ?, 1)", (number, names.format(name)))
            db.execute("INSERT INTO keypoints VALUES (?, ?, 4, ?)", (number, len(xy), table.tobytes()))
        for (first, second), rows in {**MATCHES, ("a", "stranger"): [[0, 0]]}.items():
            found, ends = np.array(rows, "<u4"), (ids[first], ids[second])
            found, ends = (found, ends) if ends[0] < ends[1] else (found[:, ::-1], ends[::-1])
            pair = ends[0] * 2147483647 + ends[1]
            raw = np.vstack([found, [[0, 0]]]).astype("<u4") if geometries else found
            db.execute("INSERT INTO matches VALUES (?, ?, 2, ?)", (pair, len(raw), raw.tobytes()))
            if geometries:
                db.execute("INSERT INTO two_view_geometries VALUES (?, ?, 2, ?)", (pair, len(found), found.tobytes()))
        db.commit()
    return path


def dictionaries(folder: Path, kind: str = "matches") -> Path:
    for (first, second), rows in MATCHES.items():
        one, two, found = KEYPOINTS[first], KEYPOINTS[second], np.array(rows)
        arrays = {"keypoints0": one.astype(np.float32), "keypoints1": two, "scores": np.ones(len(found))}
        if kind == "rows":
            arrays |= {"keypoints0": one[found[:, 0]], "keypoints1": two[found[:, 1]]}
        elif kind == "matches0":
            arrays |= {"matches0": partners(first, rows), "matches": found}
        else:
            arrays |= {"matches": found}
        name = f"{first}_{second}_matches" if kind == "rows" else f"{first}__{second}"
        np.savez(folder / f"{name}.npz", **arrays)
    return folder


def binary(left: np.ndarray, right: np.ndarray, length: int = 0) -> bytes:
    data = struct.pack("<QQ", len(left), len(right))
    for x, y in [*left, *right]:
        data += struct.pack("<ffiifff?IIQ", x, y, int(x), int(y), 0, 1, 0.5, True, 0, 0, length)
        data += np.arange(length, dtype="<f4").tobytes()
    return data


def asp(folder: Path, length: int = 0) -> Path:
    for (first, second), rows in MATCHES.items():
        found = np.array(rows)
        ends = KEYPOINTS[first][found[:, 0]], KEYPOINTS[second][found[:, 1]]
        (folder / f"run-{first}__{second}.match").write_bytes(binary(ends[0] + 1, ends[1] + 1))
        (folder / f"run-{first}__{second}-clean.match").write_bytes(binary(*ends, length))
    return folder


def hdf5_arrays(kind: str) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Keypoints and matches by their places in files of HDF5, beside other arrays, as two programs call them."""
    if kind == "plain":
        keypoints = {f"{name}.tif": xy.astype(np.float32) for name, xy in KEYPOINTS.items()}
        others = {"more/descriptors": np.ones((4, 3), np.float16), "scores": np.ones(4)}
        return keypoints | others, {f"{a}.tif/{b}.tif": np.array(rows) for (a, b), rows in MATCHES.items()}
    keypoints = {f"sub/{name}.tif/keypoints": xy.astype(np.float32) for name, xy in KEYPOINTS.items()}
    matches = {}
    for (a, b), rows in MATCHES.items():
        matches[f"sub-{a}.tif/sub-{b}.tif/matches0"] = found = partners(a, rows)
        matches[f"sub-{a}.tif/sub-{b}.tif/matching_scores0"] = np.ones(len(found))
    return keypoints | {"sub/a.tif/descriptors": np.ones((4, 3), np.float16)}, matches


def hloc(folder: Path, kind: str = "hloc") -> Path:
    h5py = pytest.importorskip("h5py")
    path = folder / "feats_matches-lightglue.h5"
    beside = folder / ("feats.h5" if kind == "hloc" else "keypoints.h5")
    for name, arrays in zip((beside, path), hdf5_arrays(kind), strict=True):
        with h5py.File(name, "w") as file:
            for place, array in arrays.items():
                file[place] = array
    return path


WRITTEN = {
    "colmap": colmap,
    "colmap, raw matches": lambda folder: colmap(folder, geometries=False),
    "lightglue": dictionaries,
    "superglue": lambda folder: dictionaries(folder, "matches0"),
    "points alone": lambda folder: dictionaries(folder, "rows"),
    "asp": asp,
    "asp with descriptors": lambda folder: asp(folder, 128),
    "hloc": hloc,
    "one array a pair": lambda folder: hloc(folder, "plain"),
}


@pytest.mark.parametrize("kind", WRITTEN)
def test_whoever_wrote_them_the_matches_are_the_same(tmp_path: Path, kind: str) -> None:
    path = WRITTEN[kind](tmp_path)
    links = read_links(path, NAMES)
    found = {
        tuple((NAMES[links.view[row]], *links.xy[row].tolist()) for row in sorted(ends, key=lambda r: links.view[r]))
        for ends in links.ends.tolist()
    }
    assert found == {
        tuple((name, *KEYPOINTS[name][row].tolist()) for name, row in zip(pair, rows, strict=True))
        for pair, listed in MATCHES.items()
        for rows in listed
    }
    tracks = read_matches(path, NAMES)
    assert sorted(np.bincount(tracks.point).tolist()) == [2, 2, 3]


def test_pixels_count_from_where_their_program_counts_them(tmp_path: Path) -> None:
    """COLMAP's first pixel has its centre at 0.5, as the documentation of its database says."""
    links = read_links(colmap(tmp_path, shift=0.0), NAMES)
    assert links.xy.min() == -0.5


def rewritten(statement: str, *more: str):
    def prepare(folder: Path) -> Path:
        path = colmap(folder)
        with closing(sqlite3.connect(path)) as db:
            for one in (statement, *more):
                db.execute(one)
            db.commit()
        return path

    return prepare


def file(name: str, content: bytes):
    def prepare(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return prepare


def cut(folder: Path) -> Path:
    path = colmap(folder)
    path.write_bytes(path.read_bytes()[:9000])
    return path


def unfinished(folder: Path) -> Path:
    path = colmap(folder)
    (folder / "database.db-wal").write_bytes(b"x")
    return path


def npz(**arrays: object):
    def prepare(folder: Path) -> Path:
        np.savez(folder / "a__b.npz", **{"keypoints0": np.ones((2, 2)), "keypoints1": np.ones((2, 2)), **arrays})
        return folder / "a__b.npz"

    return prepare


def h5(fill, features: bool = True):
    def prepare(folder: Path) -> Path:
        h5py = pytest.importorskip("h5py")
        path = hloc(folder)
        if not features:
            (folder / "feats.h5").unlink()
        with h5py.File(path, "a") as file:
            fill(h5py, file, folder)
        return path

    return prepare


def outside(h5py, file, folder: Path) -> None:
    """The matches of a pair are a link to, or the bytes of, a file elsewhere."""
    del file["sub-a.tif"], file["sub-b.tif"]
    (folder / "secret").write_bytes(bytes(24))
    group = file.create_group("sub-a.tif/sub-b.tif")
    group.create_dataset("matches0", (3,), "i8", external=[(str(folder / "secret"), 0, 24)])


def odd(shape: tuple[int, ...], kind: str = "f4"):
    """The keypoints of an image are another array."""

    def fill(h5py, file, folder: Path) -> None:
        with h5py.File(folder / "feats.h5", "a") as features:
            del features["sub/a.tif/keypoints"]
            features["sub/a.tif/keypoints"] = np.ones(shape, kind)

    return fill


def hollow(h5py, file, folder: Path) -> None:
    """The keypoints of an image are said to be many, and none was written."""
    with h5py.File(folder / "feats.h5", "a") as features:
        del features["sub/a.tif/keypoints"]
        features.create_dataset("sub/a.tif/keypoints", (600, 2), "f4", chunks=(100, 2))


def linked(h5py, file, folder: Path) -> None:
    del file["sub-a.tif"], file["sub-b.tif"]
    (folder / "other").mkdir()
    file["sub-a.tif"] = h5py.ExternalLink(str(hloc(folder / "other")), "sub-a.tif")


def computed(size: int):
    """The matches are a column that computes so many zeros."""
    return rewritten(
        "DROP TABLE matches",
        "CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, blob BLOB, "
        f"data BLOB GENERATED ALWAYS AS (zeroblob({size})) VIRTUAL)",
        "DELETE FROM two_view_geometries",
        "INSERT INTO matches (pair_id, rows, cols) SELECT 3 * 2147483647 + 5, 1, 2",
    )


LIES = {
    "a text for a database": (file("d.db", b"SQLite format 3\0 and no more"), "not a COLMAP database"),
    "a database cut short": (cut, "not a COLMAP database"),
    "a database of something else": (rewritten("DROP TABLE keypoints"), "no table keypoints"),
    "a database still written": (unfinished, "close it first"),
    "a view for a table": (
        rewritten("DROP TABLE matches", "CREATE VIEW matches AS SELECT 1 pair_id, 1 rows, 2 cols, x'00' data"),
        "matches is a view",
    ),
    "a column that computes": (computed(900), "not a COLMAP database"),
    "a column that computes a gigabyte": (computed(900_000_000), "not a COLMAP database"),
    "a blob of another length": (rewritten("UPDATE keypoints SET rows = 1000000"), "not a COLMAP database"),
    "a keypoint that is not there": (rewritten("UPDATE keypoints SET rows = 1, data = zeroblob(16)"), "beyond the"),
    "words for numbers": (rewritten("UPDATE keypoints SET rows = 'many'"), "not a COLMAP database"),
    "no keypoints": (rewritten("DELETE FROM keypoints"), "no keypoints of image"),
    "coordinates that are not finite": (
        rewritten("UPDATE keypoints SET data = x'0000c07f0000c07f', rows = 1, cols = 2",
                  "UPDATE two_view_geometries SET rows = 1, data = zeroblob(8)"),
        "not finite",
    ),
    "names of other images": (
        rewritten("UPDATE images SET name = 'x' || image_id"),
        "it names x3, x5, x6, and the images are a, b",
    ),
    "matches of a keypoint too many": (npz(matches=np.array([[0, 2]])), "beyond the 2 and 2"),
    "matches in numbers with a point": (npz(matches=np.ones((1, 2))), "not whole numbers"),
    "keypoints in three dimensions": (npz(keypoints0=np.ones((2, 3))), "keypoints of shape"),
    "keypoints of no partners": (npz(keypoints0=np.ones((3, 2))), "no matches0"),
    "matches without keypoints": (npz(keypoints1=np.array("a")), "not an npz of keypoints0"),
    "a pickle among them": (npz(matches=np.array([{}], dtype=object)), "Python objects"),
    "places that are not finite": (npz(keypoints0=np.full((2, 2), np.nan)), "not finite"),
    "a pair of others": (lambda f: npz()(f).rename(f / "x__y.npz"), "it names x, y, and the images are a, b"),
    "counts and no points": (file("a__b.match", struct.pack("<QQ", 2**62, 2**62)), "not an ASP match file"),
    "more points than bytes": (file("a__b.match", binary(np.ones((2, 2)), np.ones((2, 2)))[:-1]), "not 2 and 2"),
    "a descriptor without end": (
        file("a__b.match", binary(np.ones((1, 2)), np.ones((1, 2))).replace(bytes(8), b"\xff" * 8)),
        "not an ASP match file",
    ),
    "text for an HDF5 file": (file("m.h5", b"\x89HDF\r\n\x1a\n and no more"), "HDF5|superblock"),
    "no keypoints beside an HDF5 file": (h5(lambda *_: None, features=False), r"looked for beside it as feats\.h5"),
    "matches that lie elsewhere": (h5(outside), "in another file"),
    "keypoints of another shape": (h5(odd((2, 3, 2))), r"keypoints of sub-a\.tif of shape \(2, 3, 2\)"),
    "keypoints of one number": (h5(odd((3, 1))), r"keypoints of sub-a\.tif of shape \(3, 1\)"),
    "keypoints that are complex": (h5(odd((3, 2), "c16")), "and type complex128"),
    "keypoints that are not there": (h5(hollow), "keypoints claims more bytes than it can hold"),
    "groups without end": (h5(lambda _, file, __: file.create_group("/".join("g" * 105))), "groups nested more than"),
    "a link to another file": (h5(linked), "no track is seen in two"),
}  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if "gigabyte" in n else n for n in LIES])
def test_a_file_that_lies_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    prepare, says = LIES[name]
    path = prepare(tmp_path)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(InputError, match=says) as caught:
        read_links(path, NAMES)
    assert str(path.parent) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_two_images_of_a_database_are_enough(tmp_path: Path) -> None:
    found = read_matches(colmap(tmp_path), ["a", "b"])
    assert np.bincount(found.view).tolist() == [3, 3]
    assert sorted(found.xy[found.view == 0].tolist()) == sorted(KEYPOINTS["a"].tolist())


class Stored:
    """An array as h5py shows it, at a place of a file, or, by more fields, as it is not."""

    def __init__(self, array: np.ndarray, name: str, **lie: object) -> None:
        self.array, self.name = array, name
        self.shape, self.ndim, self.size, self.dtype = array.shape, array.ndim, array.size, array.dtype
        self.is_virtual, self.external, self.nbytes = False, None, array.nbytes
        self.id = types.SimpleNamespace(get_storage_size=lambda: array.nbytes)
        vars(self).update(lie)

    def __getitem__(self, _: object) -> np.ndarray:
        return self.array


def shelf(
    monkeypatch: pytest.MonkeyPatch,
    contents: dict[str, dict[str, np.ndarray]],
    lies: dict[str, dict[str, object]] | None = None,
) -> None:
    """In place of h5py, which may be missing, one that finds these arrays by what stands behind the first bytes."""

    class Link: ...

    class Group:
        def __init__(self, arrays: dict[str, np.ndarray], place: str = "") -> None:
            self.arrays, self.place = arrays, place

        def __iter__(self):
            return iter(dict.fromkeys(path.split("/")[0] for path in self.arrays))

        def __getitem__(self, name: str):
            if name in self.arrays:
                place = f"{self.place}/{name}"
                return Stored(self.arrays[name], place, **(lies or {}).get(place[1:], {}))
            below = {p.partition("/")[2]: a for p, a in self.arrays.items() if p.startswith(f"{name}/")}
            return Group(below, f"{self.place}/{name}")

        def get(self, name: str, getlink: bool) -> Link:
            return Link()

    class File(Group):
        def __init__(self, file, _mode: str) -> None:
            super().__init__(contents[file.read()[8:].decode()])

        def __enter__(self):
            return self

        def __exit__(self, *_: object) -> None: ...

    fake = types.SimpleNamespace(File=File, Dataset=Stored, Group=Group, HardLink=Link)
    monkeypatch.setitem(sys.modules, "h5py", fake)


@pytest.mark.parametrize(
    ("kind", "beside"), [("hloc", "feats.h5"), ("plain", "keypoints.h5"), ("plain", "features.h5")]
)
def test_keypoints_and_matches_of_two_files_are_found_by_their_places(tmp_path, monkeypatch, kind, beside) -> None:
    keypoints, matches = hdf5_arrays(kind)
    matches["a.tif/stranger.tif/matches0"] = np.array([0, 0, 0])
    path = tmp_path / "feats_matches-lightglue.h5"
    for name in (path.name, beside):
        (tmp_path / name).write_bytes(b"\x89HDF\r\n\x1a\n" + name.encode())
    shelf(monkeypatch, {path.name: matches, beside: keypoints})
    found = read_matches(path, NAMES)
    expected = read_matches(colmap(tmp_path), NAMES)
    for name in ("view", "point", "xy", "sigma"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert len(read_links(path, NAMES[:2]).ends) == 3
    (tmp_path / beside).unlink()
    with pytest.raises(InputError, match=r"holds no keypoints; they are looked for beside it as feats\.h5, features"):
        read_matches(path, NAMES)


def test_keypoints_may_lie_beside_their_matches_in_one_file(tmp_path, monkeypatch) -> None:
    path, matches = tmp_path / "all.h5", hdf5_arrays("plain")[1]
    path.write_bytes(b"\x89HDF\r\n\x1a\nall.h5")
    within = {f"{name}.tif/keypoints": xy for name, xy in KEYPOINTS.items()}
    shelf(monkeypatch, {"all.h5": within | matches})
    assert len(read_links(path, NAMES).ends) == 4
    pair = "a.tif/b.tif"
    for arrays, lie, words in (
        ({pair: np.array([[0, 9]])}, {}, r"not an HDF5 file of matches .*beyond the 3 and 4"),
        ({"a.tif/a.tif": np.array([[0, 1]])}, {}, "no track is seen in two"),
        (matches, {"is_virtual": True}, "lies in another file"),
        (matches, {"external": [("other", 0, 8)]}, "lies in another file"),
        # of 8 bytes each
        (matches, {"size": 1 << 28}, "too large for the keypoints and matches of a COLMAP or HDF5 file"),
    ):
        shelf(monkeypatch, {"all.h5": within | arrays}, {pair: lie})
        with pytest.raises(InputError, match=words):
            read_links(path, NAMES)


def test_a_trigger_is_not_run_and_nothing_is_left_beside_the_file(tmp_path: Path) -> None:
    path = rewritten(
        "PRAGMA journal_mode = WAL", "CREATE TRIGGER t AFTER INSERT ON images BEGIN DELETE FROM images; END"
    )(tmp_path)
    path = path.rename(tmp_path / "été ?mode=rwc&#%41.db")
    path.chmod(0o444)
    assert len(read_links(path, NAMES).ends) == 4
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_without_h5py_it_is_said_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "m.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(InputError, match=r"m\.h5: HDF5 is read with h5py, .*pip install h5py$"):
        read_links(tmp_path / "m.h5", NAMES)


def test_a_database_is_held_to_what_its_numbers_become(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Coordinates and numbers are kept in four bytes and worked on in eight."""
    path = colmap(tmp_path)
    keypoints = sum(4 * len(KEYPOINTS[name]) for name in "ab")
    most = 8 * (keypoints + 2 * len(MATCHES["a", "b"]))
    for limit, refused in ((most, False), (most - 1, True)):
        monkeypatch.setattr("barpc.pointio.third_party_matches._CONTENT", Kind("what it holds", limit))
        if refused:
            with pytest.raises(InputError, match=f"{most} bytes, too large for what it holds"):
                read_matches(path, ["a", "b"])
        else:
            assert len(read_matches(path, ["a", "b"])) > 0
