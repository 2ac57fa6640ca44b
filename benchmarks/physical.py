"""Maxar's physical models against the RPC in the same file, with every assumption about light.

python benchmarks/physical.py FILE.XML...
"""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from barpc.base.geodesy import Array
from barpc.fit import fit_rpc
from barpc.rpcio import read_rpc
from barpc.sensor.corrected import Corrected, Correction
from barpc.sensor.linescan import read_linescan
from barpc.sensor.rpc import altitude_range


def words(values: Array) -> str:
    """Two numbers, of columns and rows."""
    return " / ".join(f"{value:.2f}" for value in values)


def rotated(model: Corrected, ground: Array, image: Array) -> Array:
    """RMSE (2,) [px] after the one rotation of the model that fits the image points best."""

    def miss(turn: Array) -> Array:
        correction = Correction(turn * 1e-6, np.zeros(3), model.correction.center)
        return np.asarray((Corrected(model.sensor, correction).project(ground) - image).ravel())

    return np.sqrt((least_squares(miss, np.zeros(3)).fun.reshape(-1, 2) ** 2).mean(axis=0))


def report(path: Path) -> None:
    """A line for each assumption, and what no RPC of the model can hold."""
    rpc, found = read_rpc(path), read_linescan(path)
    low, high = altitude_range(rpc)
    width, height = found.size
    cols, rows = np.linspace(0, width - 1, 15), np.linspace(0, height - 1, 25)
    grid = np.stack(np.meshgrid(cols, rows, np.linspace(low, high, 5)), axis=-1).reshape(-1, 3)
    image, alt = grid[:, :2], grid[:, 2]
    seen = rpc.localize(image, alt)
    print(f"{path.name}: {width} x {height} px, priors {words(np.array(found.model.accuracy))} m")
    for aberration, refraction in product((False, True), repeat=2):
        model = read_linescan(path, aberration=aberration, refraction=refraction).model
        off = rpc.project(model.localize(image, alt)) - image
        fixed = Correction(np.zeros(3), np.zeros(3), model.position((height - 1) / 2))
        print(
            f"  aberration {aberration!s:5} refraction {refraction!s:5}  mean {words(off.mean(axis=0))}"
            f"  rmse {words(np.sqrt((off**2).mean(axis=0)))}"
            f"  rotated {words(rotated(Corrected(model, fixed), seen, image))}"
        )
    best = fit_rpc(found.model, found.size, (low, high), strict=False)
    print(f"  the best RPC of the model misses it by {words(best.rmse_ckp)} RMSE, {best.max_ckp.max():.2f} at most")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    for path in parser.parse_args().files:
        report(path)


if __name__ == "__main__":
    main()
