"""Size and CPU seconds of everything that a run leaves for people, on simulated blocks.

Prints one row a block: tie points, CPU seconds of the summary, of the tables and of the page, size of
report.html; then the page against the bounds of 5 s and 3 MB at 50 views.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from barpc.ba import adjust_tracks
from barpc.fit import fit_rpc
from barpc.report import Run, Summary, summarize
from barpc.report.page import report_html
from barpc.report.tables import TABLES
from barpc.simulate import simulate_block


def block_run(num_views: int, num_tracks: int) -> Run:
    block = simulate_block(num_views, num_tracks, seed=1, outliers=0.05, attitude=3e-6)
    adjustment = adjust_tracks(block.views, block.tracks)
    fits = tuple(fit_rpc(s, v.size, v.alt_range) for s, v in zip(adjustment.sensors, block.views, strict=True))
    return Run("adjust", block.views, (), block.tracks, adjustment=adjustment, fits=fits)


def seconds(function: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Median CPU seconds of a call, and what it returns."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return statistics.median(times), result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="+", default=[3, 30, 50, 200], help="views of each block")
    parser.add_argument("--tracks", type=int, default=400, help="tracks a view")
    parser.add_argument("--repeats", type=int, default=3, help="the median of so many runs is printed")
    options = parser.parse_args()
    print(" views   tracks  observations    pairs  summary [s]  tables [s]  page [s]  report.html [MB]")
    for num_views in options.views:
        run = block_run(num_views, options.tracks * num_views)
        summary_seconds, summary = seconds(lambda run=run: summarize(run), 1)
        with tempfile.TemporaryDirectory() as folder:
            Path(folder, "tables").mkdir()

            def write(run: Run = run, summary: Summary = summary, folder: str = folder) -> None:
                for name, content in TABLES.items():
                    Path(folder, "tables", name).write_bytes(b"".join(content(run, summary)))

            tables_seconds, _ = seconds(write, options.repeats)
            page_seconds, html = seconds(lambda s=summary, f=folder: report_html(s, f), options.repeats)
        megabytes = len(html.encode()) / 1e6
        print(
            f"{num_views:6d}  {run.tracks.num_points:7d}  {len(run.tracks):12d}  {len(summary.pairs):7d}"
            f"  {summary_seconds:11.2f}  {tables_seconds:10.2f}  {page_seconds:8.2f}  {megabytes:16.2f}"
        )
        if num_views == 50:
            everything = tables_seconds + page_seconds
            print(f"        page {megabytes / 3:.2f} of the 3 MB, tables and page {everything / 5:.2f} of the 5 s")


if __name__ == "__main__":
    main()
