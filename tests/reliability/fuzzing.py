"""What a fuzzer throws at options, control points and tie points: a value, or one `InputError` in one line.

::

    python -m tests.reliability.fuzzing 100000                 # mutations of samples, one process
    pip install atheris
    python -m tests.reliability.fuzzing --atheris CORPUS -atheris_runs=1000000 -max_len=4000
"""

from __future__ import annotations

import argparse
import io
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

if "--atheris" in sys.argv:
    import atheris

    with atheris.instrument_imports(include=["barpc"]):
        from barpc.errors import BarpcError, FitError, ImageError, InputError
        from barpc.pipeline.options import read_options
        from barpc.pointio.gcp import read_gcps
        from barpc.pointio.matches import read_matches
        from barpc.pointio.tables import read_correspondences
else:
    from barpc.errors import BarpcError, FitError, ImageError, InputError
    from barpc.pipeline.options import read_options
    from barpc.pointio.gcp import read_gcps
    from barpc.pointio.matches import read_matches
    from barpc.pointio.tables import read_correspondences

NAMES = ("left", "right")


def _npz(**arrays: object) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


SAMPLES: dict[str, tuple[str, Callable[[Path], object], bytes]] = {
    "options": (
        "run.toml",
        read_options,
        b'images = "none"\nrpc_formats = ["txt", "rpb"]\nnum_passes = 2\nkeep_going = true\ngcp = ["a.gcp"]\n'
        b'[tie]\nband = 2\nmin_overlap = 0.1\ndetector = "sift"\n[adjust]\nmodel = "rotation"\nfixed = ["left"]\n'
        b"sigma_attitude = 3.0\nview_weights = {left = 0.5}\n[fit]\ngrid = [12, 12, 7]\ntolerance = 1e-3\n",
    ),
    "gcp": (
        "a.gcp",
        lambda path: read_gcps(path, NAMES),
        b"# WGS84\n1 43.2 5.4 120.5 1 1 1 left.tif 10.5 20.25 0.5 0.5 right.tif 30 40 0.5 0.5\n"
        b"2, 43.3, 5.5, 99, 0.1, 0.1, 0.2, left, 5, 6, 1, 1\n",
    ),
    "geojson": (
        "a.geojson",
        lambda path: read_gcps(path, NAMES),
        b'{"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": {"type": "Point",'
        b' "coordinates": [5.4, 43.2, 120.5]}, "properties": {"ji": [10.5, 20.25], "filename": "left.tif",'
        b' "id": "one"}}]}',
    ),
    "csv": (
        "t.csv",
        lambda path: read_matches(path, NAMES),
        b"image,col,row,track,sigma\nleft,1.5,2.5,0,0.5\nright,3,4,0,0.5\nleft,7,8,b,1\nright.tif,9,1e1,b,1\n",
    ),
    "npz": (
        "t.npz",
        lambda path: read_matches(path, NAMES),
        _npz(names=np.array(NAMES), view=np.array([0, 1]), track=np.array([0, 0]), xy=np.ones((2, 2))),
    ),
    "asp": (
        "run-left__right.txt",
        lambda path: read_matches(path, NAMES),
        b"2 2\n1 2 0 0\n3 4 0 0\n5 6 0 0\n7 8 0 0\n",
    ),
    "points": (
        "p.csv",
        read_correspondences,
        b"lon,lat,alt,col,row\n5.4,43.2,100,1,2\n5.5;43.3;101;3;4\n",
    ),
    "points geojson": (
        "p.json",
        read_correspondences,
        b'{"type": "FeatureCollection", "features": [{"geometry": {"coordinates": [5.4, 43.2, 1]},'
        b' "properties": {"ji": [1, 2]}}]}',
    ),
    "points npz": (
        "p.npz",
        read_correspondences,
        _npz(ground=np.ones((3, 3)), image=np.ones((3, 2))),
    ),
}
"""Kind -> file name, reader, a good file."""

TOKENS = (
    b"nan",
    b"inf",
    b"-",
    b"1e999",
    b"0",
    b"\x00",
    b"[",
    b"]",
    b"{",
    b"}",
    b'"',
    b",",
    b"\n",
    b"=",
    b"\xff",
    b"9" * 30,
)


def check(kind: str, data: bytes, folder: Path) -> bool:
    """Whether the reader takes the bytes; anything but one InputError that names the file is a bug."""
    name, read, _ = SAMPLES[kind]
    path = folder / name
    path.write_bytes(data)
    refused: BarpcError | None = None
    try:
        read(path)
    except BarpcError as error:
        refused = error
    if refused is None:
        return True
    named = name in str(refused) or kind == "options"  # an option's own check does not know the file
    if not (named and isinstance(refused, (InputError, FitError, ImageError))):
        raise AssertionError(f"{kind}: {refused!r} of {data!r}")
    return False


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four edits: a flipped bit, a part cut out, doubled or moved, a token put in."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not out:
            break
        at, length = int(rng.integers(0, len(out))), int(rng.geometric(0.1))
        match rng.integers(0, 5):
            case 0:
                out[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                del out[at : at + length]
            case 2:
                out[at:at] = out[at : at + length]
            case 3:
                out[at : at + length] = TOKENS[int(rng.integers(0, len(TOKENS)))]
            case _:
                other = int(rng.integers(0, len(out)))
                out[at : at + length] = out[other : other + length]
    return bytes(out)


def scratch() -> tempfile.TemporaryDirectory[str]:
    """A folder in memory where there is one: a million files are written."""
    shm = Path("/dev/shm")
    return tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None)


def sweep(kind: str, runs: int, seed: int) -> int:
    """So many mutations of one sample; how many were accepted."""
    rng = np.random.default_rng(seed)
    with scratch() as folder:
        return sum(check(kind, mutate(SAMPLES[kind][2], rng), Path(folder)) for _ in range(runs))


def _with_atheris() -> None:
    argv = [arg for arg in sys.argv if arg != "--atheris"]
    kinds = list(SAMPLES)
    if len(argv) > 1 and not argv[1].startswith("-"):
        corpus = Path(argv[1])
        corpus.mkdir(parents=True, exist_ok=True)
        for number, kind in enumerate(kinds):
            (corpus / kind.replace(" ", "_")).write_bytes(bytes([number]) + SAMPLES[kind][2])
    folder = Path(scratch().name)
    folder.mkdir(exist_ok=True)

    def one(data: bytes) -> None:
        if data:
            with suppress(RecursionError):
                check(kinds[data[0] % len(kinds)], data[1:], folder)

    atheris.Setup(argv, one)
    atheris.Fuzz()


def main() -> None:
    """Parse, run, print executions a second."""
    if "--atheris" in sys.argv:
        _with_atheris()
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=int, nargs="?", default=100_000, help="in all")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    began = time.process_time()
    each = -(-given.runs // len(SAMPLES))
    for kind in SAMPLES:
        print(f"{kind:15} {each} executions, {sweep(kind, each, given.seed)} accepted", flush=True)
    seconds = time.process_time() - began
    print(f"{each * len(SAMPLES)} executions, no unexpected exception, {seconds:.0f} CPU s")


if __name__ == "__main__":
    main()
