"""Numbers at the ends of what doubles hold, archives that grow when they are opened, hosts that are none: one line."""

from __future__ import annotations

import io
import sqlite3
import time
import zipfile
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from barpc.ba import AdjustOptions, adjust_tracks
from barpc.base.declarations import declared
from barpc.base.errors import AdjustError, BarpcError, FitError, ImageError, InputError
from barpc.base.frozen import load_npz
from barpc.base.remote import Remote, is_url, located
from barpc.fit import fit_rpc_points
from barpc.pointio.matches import read_links
from barpc.pointio.names import unique_names
from barpc.simulate import simulate_block
from tests.fit.cameras import synthetic

NUMBERS = (0.0, 1e-30, 1e-12, 1e-3, 0.5, 1.0, 1e3, 1e12, 1e20, 1e30)


@pytest.fixture(scope="module")
def block():
    return simulate_block(3, 200, seed=1, num_checks=0, num_gcps=4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "draws"),
    [
        (0, 3),
        pytest.param(0, 12, marks=pytest.mark.slow),
        *(pytest.param(seed, 12, marks=pytest.mark.nightly) for seed in range(1, 20)),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_options_at_their_ends_give_a_result_or_one_line(block, seed, draws) -> None:
    rng, known = np.random.default_rng(seed), declared(AdjustOptions)
    ended = 0
    for _ in range(draws):
        numbers = [name for name, one in known.items() if one.kind is float and rng.random() < 0.25]
        given = {name: float(rng.choice(NUMBERS)) for name in numbers}
        gcps = block.gcps if rng.random() < 0.5 else None
        try:
            found = adjust_tracks(block.views, block.tracks, AdjustOptions(**given), gcps)
        except BarpcError:
            continue
        ended += 1
        assert np.isfinite([sensor.project([[5.4, 43.3, 100.0]]) for sensor in found.sensors]).all()
    assert ended > 0


@pytest.mark.parametrize("number", [1e31, 1e308, 5e-324, -1e-31])
def test_no_option_is_a_number_whose_square_is_none(number) -> None:
    with pytest.raises(InputError, match=r"noise_floor|dem_sigma"):
        AdjustOptions(noise_floor=abs(number), dem_sigma=number)


def test_equations_that_cannot_be_solved_are_one_line(block, monkeypatch) -> None:
    def singular(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("barpc.ba.adjustment.solve_block", singular)
    with pytest.raises(AdjustError, match=r"cannot be solved \(Singular matrix\): is a standard deviation"):
        adjust_tracks(block.views, block.tracks)


ENDS = (1e308, -1e308, 1e155, 1e30, 5e-324, 1e-300, 0.0, np.inf, np.nan)


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("what", ["ground", "image", "sigma"])
@pytest.mark.filterwarnings("ignore")
def test_points_beyond_any_image_are_one_line(what, end) -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0, [20000, 19000], (60, 2))
    ground = synthetic().rpc.localize(image, rng.uniform(0, 1000, 60))
    sigma = np.ones(60)
    {"ground": ground[:, 2], "image": image[:, 0], "sigma": sigma}[what][7] = end
    fit = None
    with suppress(FitError):
        fit = fit_rpc_points(ground, image, sigma=sigma, strict=False)
    assert fit is None or np.isfinite(fit.rpc.coeffs).all()
    assert (fit is None) == (not np.isfinite(end) or abs(end) > 1e29 or (what == "sigma" and end < 1e-29))


def test_an_inverse_that_does_not_converge_is_no_crash(monkeypatch) -> None:
    """LAPACK's SVD may end without a result on coefficients at the ends of what doubles hold."""
    image, alt = np.array([[500.0, 700.0], [9000.0, 12000.0]]), np.array([100.0, 300.0])
    known = synthetic().rpc.localize(image, alt)

    def never(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(np.linalg, "lstsq", never)
    found = synthetic().rpc.localize(image, alt)
    assert np.isnan(found).all() or np.allclose(found, known, atol=1e-9)


# --- files that grow --------------------------------------------------------------------------------------


@pytest.mark.nightly
def test_an_archive_counts_what_its_numbers_become(tmp_path: Path) -> None:
    """510 kB of bytes that are all alike would be 3.9 GB of doubles."""
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": "|u1", "fortran_order": False, "shape": (300_000_000,)})
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive, archive.open("xy.npy", "w") as file:
        file.write(data.getvalue())
        for _ in range(300):
            file.write(bytes(1_000_000))
    assert (tmp_path / "a.npz").stat().st_size < 1_000_000
    with pytest.raises(InputError, match="as numbers: 2400000000 bytes, too large"):
        load_npz(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", xy=np.zeros(1000, np.uint8))
    assert load_npz(tmp_path / "b.npz")["xy"].shape == (1000,)


def test_hdf5_that_claims_more_than_it_holds_or_nests_without_end_is_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a.tif/keypoints", shape=(100_000_000, 2), chunks=(100_000, 2), dtype="f8")
        file["b.tif/keypoints"] = np.zeros((5, 2))
        file["a.tif/b.tif/matches0"] = np.zeros(5, np.int64)
    with pytest.raises(InputError, match="more bytes than it can hold"):
        read_links(tmp_path / "a.h5", ["a", "b"])
    with h5py.File(tmp_path / "deep.h5", "w") as file:
        group = file
        for _ in range(1000):
            group = group.create_group("g")
    start = time.process_time()
    with pytest.raises(InputError, match="nested more than 100 deep"):
        read_links(tmp_path / "deep.h5", ["a", "b"])
    assert time.process_time() - start < 2.0


def _colmap(path: Path) -> None:
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT)")
        database.execute("CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
        database.execute("CREATE TABLE matches (pair_id INTEGER PRIMARY KEY, rows INTEGER, cols INTEGER, data BLOB)")
        xy = np.arange(20, dtype="<f4").reshape(10, 2)
        for number, name in enumerate(("a.tif", "b.tif"), start=1):
            database.execute("INSERT INTO images VALUES (?, ?)", (number, name))
            database.execute("INSERT INTO keypoints VALUES (?, 10, 2, ?)", (number, xy.tobytes()))
        pairs = np.repeat(np.arange(10, dtype="<u4")[:, None], 2, axis=1)
        database.execute("INSERT INTO matches VALUES (?, 10, 2, ?)", (2147483647 + 2, pairs.tobytes()))
    database.close()


def test_a_database_with_a_journal_that_counts_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    _colmap(path)
    writer = sqlite3.connect(path, isolation_level=None)
    writer.execute("PRAGMA cache_size = 1")
    writer.execute("BEGIN IMMEDIATE")
    writer.execute("DELETE FROM matches")
    writer.execute("PRAGMA cache_spill = 1")
    journal = tmp_path / "database.db-journal"
    if not journal.exists():
        pytest.skip("this SQLite keeps its journal in memory")
    if any(journal.read_bytes()[:8]):
        with pytest.raises(InputError, match=r"another program has not finished writing it \(database\.db-journal\)"):
            read_links(path, ["a", "b"])
    writer.execute("ROLLBACK")
    writer.close()
    assert len(read_links(path, ["a", "b"]).ends) == 10
    journal.write_bytes(bytes(512))  # one that is over, kept by journal_mode = PERSIST
    assert len(read_links(path, ["a", "b"]).ends) == 10
    journal.write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(504))
    with pytest.raises(InputError, match="has not finished writing it"):
        read_links(path, ["a", "b"])


# --- names ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["..tif", ".hidden.tif"])
def test_a_name_whose_files_would_be_hidden_is_refused(name) -> None:
    with pytest.raises(InputError, match="begins with a dot"):
        unique_names([Path("in") / name, Path("in/b.tif")])


@pytest.mark.parametrize(
    "host", ["a..b", f"{'a' * 64}.org", ".org", "[::1::2]", "[12345::]", "a.org:99999", "a.org:0", "[::1]:70000"]
)
def test_a_host_that_is_none_is_refused_before_it_is_asked(host) -> None:
    with pytest.raises(ImageError, match="a URL is SCHEME://HOST/PATH"):
        located(f"https://{host}/a.tif", [host])


def test_a_scheme_may_be_written_in_any_case() -> None:
    assert is_url("HTTPS://a.org/x.tif")
    found = located("HTTPS://a.org/X.tif", ["a.org"])
    assert isinstance(found, Remote)
    assert str(found) == "https://a.org/X.tif"
    assert str(located("http://a.org:8080/x.tif", ["http://a.org:8080"])) == "http://a.org:8080/x.tif"
    assert str(located("https://[::1]:8080/x.tif", ["[::1]:8080"])) == "https://[::1]:8080/x.tif"


@pytest.mark.parametrize("reader", ["matches", "gcp", "points", "asp"])
def test_no_reader_shows_lines_of_a_text_that_is_none_of_its_files(tmp_path, reader) -> None:
    """A link in a folder of somebody else's may lead anywhere that this user may read."""
    from barpc.pointio.correspondences import read_correspondences
    from barpc.pointio.gcps import read_gcps

    secret = tmp_path / "secret"
    secret.write_text("the-key-of-the-house is under, the, stone, 42\nand the gate is open on mondays, 1, 2, 3\n")
    name = {"matches": "m.csv", "gcp": "g.csv", "points": "p.csv", "asp": "g.gcp"}[reader]
    (tmp_path / name).symlink_to(secret)
    read = {"matches": lambda path: read_links(path, ["a", "b"]), "points": read_correspondences}.get(
        reader, lambda path: read_gcps(path, ["a", "b"])
    )
    with pytest.raises(BarpcError) as caught:
        read(tmp_path / name)
    assert not {"key", "house", "stone", "gate", "mondays"} & set(str(caught.value).replace("-", " ").split())
