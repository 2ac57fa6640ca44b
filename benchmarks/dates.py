"""Blocks of many dates, each with its own season: which choice of pairs ties them.

    python benchmarks/dates.py                      forty views of forty dates; today's choice and the one before
    python benchmarks/dates.py --dates 12 --neighbours 2 --seeds 3
    python benchmarks/dates.py --dates 100 --seasons 4 --size 400 --neighbours 8 --only now

Rendered with known cameras (`tests/scenes/dates.py`); the delivered RPCs are shifted and stretched in the image, which
no rotation or translation makes up for. Judged on exact places of ground points: the RMS distance in each view from
where all views together say that they are. "before": pairs by overlap and angle, and none in place of those that fail.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np  # noqa: E402  (the thread counts come first)

from barpc.base.errors import BarpcError  # noqa: E402
from barpc.base.options import RunOptions, TieOptions  # noqa: E402
from barpc.pipeline import adjust  # noqa: E402
from barpc.scene import View  # noqa: E402
from barpc.tie import tracks  # noqa: E402
from tests.scenes.dates import Years  # noqa: E402

warnings.simplefilter("ignore")


def block(dates: int, twice: int, seed: int, size: int, growth: float, seasons: int = 0) -> Years:
    """A scene of so many dates at random times of the year, some with two views.

    Or about the middles of so many seasons in turn, every third date under 40 % of clouds.
    """
    phases, clouds = np.random.default_rng(seed + 100).uniform(0, 1, dates), np.zeros(dates)
    if seasons:
        phases = (np.arange(dates) % seasons / seasons + 0.12 * (phases - 0.5)) % 1.0
        clouds[1::3] = 0.4
    views = sorted([*range(dates), *range(twice)])
    return Years(
        tuple(phases.tolist()),
        tuple(views),
        (size, size),
        seed,
        growth,
        snow=0.6,
        clouds=tuple(clouds.tolist()),
    )


def run(years: Years, views: list[View], out: Path, neighbours: int) -> str:
    """A row of the table."""
    start, reports = time.process_time(), []
    options = RunOptions(keep_going=True, overwrite=True, tie=TieOptions(neighbours=neighbours))
    try:
        result = adjust(views, out, options)
    except BarpcError as error:
        return f"{' '.join(str(error).split())[:60]} | | | | | {time.process_time() - start:.0f}"
    seconds = time.process_time() - start
    reports = result.run.matched
    tied = sum(report.status == "ok" for report in reports)
    sensors = {view.name: view.sensor for view in result.views}
    left = [view.name in sensors for view in views]
    errors = years.errors([sensors[v.name] for v in views if v.name in sensors], np.array(left))
    return (
        f"{len(reports)} | {tied} | {sum(left)} of {len(views)} | {(errors > 1).sum()} | "
        f"{errors.max():.2f}, {np.median(errors):.3f} | {seconds:.0f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dates", type=int, default=40)
    parser.add_argument("--twice", type=int, default=0, help="dates with two views")
    parser.add_argument("--neighbours", type=int, nargs="+", default=[3])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--size", type=int, default=256, help="side of the images [px]")
    parser.add_argument("--growth", type=float, default=0.3, help="share of the ground that is its season's own")
    parser.add_argument(
        "--seasons", type=int, default=0, help="so many seasons in turn, and clouds on every third date"
    )
    parser.add_argument("--only", default="", help="choices with this in their name")
    given = parser.parse_args()
    print(
        "| neighbours | seed | choice | pairs tried | tied | views in block | above 1 px | worst, median [px] | CPU s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    rounds = tracks.TRIES
    for seed in given.seeds:
        years = block(given.dates, given.twice, seed, given.size, given.growth, given.seasons)
        days = [date(2015 + k % 5, 1, 1) + timedelta(int(365 * phase)) for k, phase in enumerate(years.phases)]
        with tempfile.TemporaryDirectory() as name:
            views = years.write(Path(name))
            dated = [replace(view, date=str(days[k])) for view, k in zip(views, years.views, strict=True)]
            for neighbours in given.neighbours:
                for choice, some, tracks.TRIES in (("now", dated, rounds), ("before", views, ())):
                    if given.only in choice:
                        row = run(years, some, Path(name) / choice, neighbours)
                        print(f"| {neighbours} | {seed} | {choice} | {row} |", flush=True)


if __name__ == "__main__":
    main()
