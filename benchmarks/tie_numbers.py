"""What each number of the tie points is worth: doubled and halved, what becomes of real and disguised pairs.

    python benchmarks/tie_numbers.py DATA                                every number of `barpc.tie`
    python benchmarks/tie_numbers.py DATA --only patches.register        those of modules with this in their names
    python benchmarks/tie_numbers.py DATA --numbers _INNER _FINE          these

A number of several (a tuple) is changed as a whole. Pairs: two of the Pleiades triplet, Ventoux, the multispectral
image with the other view's panchromatic one, and the triplet's in another season; of each the tracks, the robust spread
across the epipolar lines [px] and the CPU seconds, beside those of the number as it is.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import pkgutil
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402  (the thread counts come first)

import barpc.tie  # noqa: E402
from barpc.base.errors import BarpcError  # noqa: E402
from barpc.pipeline.loading import load_views  # noqa: E402
from barpc.scene import View  # noqa: E402
from barpc.tie import TieOptions, find_tracks  # noqa: E402
from benchmarks.seasons import CASES, write  # noqa: E402
from benchmarks.ties import spread  # noqa: E402
from tests.tie.stages import common_tracks  # noqa: E402

warnings.simplefilter("ignore")
MODULES = [importlib.import_module(found.name) for found in pkgutil.walk_packages(barpc.tie.__path__, "barpc.tie.")]


def numbers() -> Iterator[tuple[Any, str]]:
    """Modules and names of numbers, of numbers in tuples, too."""
    for module in MODULES:
        assert module.__file__ is not None
        for line in ast.parse(Path(module.__file__).read_text()).body:
            if isinstance(line, ast.Assign):
                targets = line.targets[0]
                names = targets.elts if isinstance(targets, ast.Tuple) else [targets]
                for name in names:
                    if isinstance(name, ast.Name) and _number(getattr(module, name.id)):
                        yield module, name.id


def _number(value: object) -> bool:
    if isinstance(value, tuple):
        return all(_number(one) for one in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def times(value: Any, factor: float) -> Any:
    """A number, or each of several, times a factor; whole ones stay whole and at least 1, odd ones odd."""
    if isinstance(value, tuple):
        return tuple(times(one, factor) for one in value)
    if isinstance(value, int):
        return max(1, int(value * factor)) | (value % 2)
    return value * factor


@contextmanager
def changed(module: Any, name: str, value: object) -> Iterator[None]:
    """Set a number in all modules that hold it under its name."""
    was = getattr(module, name)
    places = [m for m in MODULES if getattr(m, name, None) is was and (m is module or not name.startswith("_"))]
    for place in places:
        setattr(place, name, value)
    try:
        yield
    finally:
        for place in places:
            setattr(place, name, was)


def pairs(data: Path, folder: Path) -> dict[str, tuple[list[View], TieOptions]]:
    """The pairs by name."""
    triplet, optical = data / "optical/phr_triplet_north", data / "optical/phr_ventoux"
    other = folder / "img_03_x.tif"
    write(triplet / "img_03.tif", other, CASES["winter"][0], 0, 1)
    ventoux = [optical / f"{side}_image.tif" for side in ("left", "right")]
    files = {
        "triplet": [triplet / "img_02.tif", triplet / "img_03.tif"],
        "Ventoux": ventoux,
        "XS": [data / "cross_sensor/phr_ventoux_xs/left_xs.tif", ventoux[1]],
        "winter": [triplet / "img_02.tif", other],
    }
    return {
        name: (
            list(load_views(both).views),
            TieOptions(matcher="structure" if name == "winter" else "guided"),
        )
        for name, both in files.items()
    }


def figures(views: list[View], options: TieOptions) -> str:
    """Tracks, spread [px], CPU seconds."""
    start = time.process_time()
    try:
        result = find_tracks(views, options)
    except BarpcError as error:
        return f"refused ({type(error).__name__})"
    except Exception as error:  # noqa: BLE001  (a number may be none that works at all)
        return f"{type(error).__name__}"
    seconds = time.process_time() - start
    across = spread(views[0], views[1], *common_tracks(result.tracks, 0, 1))
    return f"{result.tracks.num_points}, {across:.3f}, {seconds:.1f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--only", default="", help="modules with this in their names")
    parser.add_argument("--numbers", nargs="*", help="only these names")
    parser.add_argument("--pairs", nargs="*", help="only these pairs")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        chosen = {k: p for k, p in pairs(given.data, Path(folder)).items() if k in (given.pairs or [k])}
        print(f"| number | value | {' | '.join(chosen)} |\n|---|---|{'---|' * len(chosen)}")
        print(f"| as they are | | {' | '.join(figures(*pair) for pair in chosen.values())} |", flush=True)
        for module, name in numbers():
            if given.only not in module.__name__ or name not in (given.numbers or [name]):
                continue
            value = getattr(module, name)
            for other in dict.fromkeys((times(value, 2.0), times(value, 0.5))):
                if other == value:
                    continue
                with changed(module, name, other):
                    row = " | ".join(figures(*pair) for pair in chosen.values())
                print(f"| {module.__name__.removeprefix('barpc.tie.')}.{name} | {other} | {row} |", flush=True)


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
