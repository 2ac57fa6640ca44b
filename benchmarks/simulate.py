"""Simulation: CPU seconds of blocks and of rendered scenes, and what the delivered cameras are worth.

python benchmarks/simulate.py --views 10000
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--views", type=int, default=1000, help="views of the largest block")
    arguments = parser.parse_args()

    from barpc.sensor.corrected import Corrected
    from barpc.simulate import simulate_block
    from tests.scenes import ImageOptions, write_scene

    print(f"{'block':>22}{'observations':>14}{'CPU s':>8}{'delivered px':>14}{'exact px':>10}")
    for views, tracks in ((3, 2_000), (10, 5_000), (100, 30_000), (arguments.views, 100 * arguments.views)):
        start = time.process_time()
        block = simulate_block(views, tracks)
        spent = time.process_time() - start
        line = f"{f'{views} views, {tracks} tracks':>22}{len(block.tracks):14d}{spent:8.2f}"
        if views <= 1000:
            pairs = zip(block.views, block.truth.corrections, strict=True)
            exact = block.held_out_rms([Corrected(view.sensor, c) for view, c in pairs])
            line += f"{block.held_out_rms([v.sensor for v in block.views]):14.2f}{exact:10.1e}"
        print(line)

    print(f"\n{'scene':>22}{'CPU s':>8}{'MB on disk':>12}{'peak MB':>9}")
    for side in (600, 1000, 2000):
        with tempfile.TemporaryDirectory() as name:
            start = time.process_time()
            write_scene(Path(name) / "scene", ImageOptions(size=(side, side)))
            spent = time.process_time() - start
            size = sum(path.stat().st_size for path in (Path(name) / "scene").iterdir()) / 1e6
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{f'3 views of {side} px':>22}{spent:8.2f}{size:12.1f}{peak:9.0f}")


if __name__ == "__main__":
    main()
