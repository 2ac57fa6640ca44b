"""Sentinel-1: barpc against eos-sar (model) and rpcfit (RPC), on annotation files, in one run.

Accuracy is measured against each product's own geolocation grid, cost in CPU seconds, the programs taking
turns. The peers run in interpreters of their own:

    python benchmarks/sentinel1.py sar/*.xml --ew --eos /venv-eos/bin/python --rpcfit /venv-rpcfit/bin/python

`--ew` adds an EW swath, 60 s and 24,600 samples of IW's size, of a satellite on a circular orbit: no real one is at
hand.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.pushbroom import cpu

POINTS = 25_000


def peer_eos(annotation: str, data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What eos-sar makes of an annotation: runs in its interpreter."""
    from eos.products.sentinel1 import metadata, proj_model
    from eos.sar.orbit import Orbit

    xml = Path(annotation).read_text()
    if "<productType>GRD" in xml:
        meta = metadata.extract_grd_metadata(xml)
        model = proj_model.grd_model_from_meta(meta, Orbit(meta.state_vectors))
    else:
        bursts = metadata.extract_bursts_metadata(xml)
        model = proj_model.swath_model_from_bursts_meta(bursts, Orbit(bursts[0].state_vectors))
    grid_time, grid_range, _ = model.projection(*data["grid"].T, as_azt_rng=True)
    row, col, _ = model.projection(*data["control"].T)
    ground = data["ground"]
    rows, cols, _ = model.projection(*ground.T)
    return {
        "grid": np.stack([grid_time, grid_range * 2 / 299792458.0], axis=1),
        "control": np.stack([col, row], axis=1),
        "project": np.array(cpu(lambda: model.projection(*ground.T), 3)),
        "localize": np.array(cpu(lambda: model.localization(rows, cols, ground[:, 2]), 1)),
    }


def peer_rpcfit(annotation: str, data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The RPC that rpcfit fits to points, on check points: runs in its interpreter."""
    from rpcfit import rpc_fit

    result = {}
    for separate in (True, False):
        start = time.process_time()
        fit = rpc_fit.calibrate_rpc(data["target"], data["locs"], separate=separate)
        rpc = fit[0] if isinstance(fit, tuple) else fit
        result[f"cpu_{separate}"] = np.array(time.process_time() - start)
        check = data["check"]
        col, row = rpc.projection(lon=check[:, 0], lat=check[:, 1], alt=check[:, 2])
        error = np.stack([col, row], axis=1) - data["check_image"]
        result[f"rmse_{separate}"] = np.sqrt((error**2).mean(axis=0))
    return result


def ask(python: str, peer: str, annotation: Path, data: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Run one of the peers in its own interpreter."""
    with tempfile.TemporaryDirectory() as folder:
        np.savez(f"{folder}/in.npz", **data)
        command = [python, __file__, "--as-peer", peer, str(annotation), folder]
        one = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env={**os.environ, **one})
        with np.load(f"{folder}/out.npz") as out:
            return dict(out)


def line(name: str, ours: float, peer: float | None) -> None:
    """One figure of both, and the ratio."""
    ratio = "" if peer is None else f"{peer:12.3g}{peer / ours:10.3g}x"
    print(f"  {name:44s}{ours:12.3g}{ratio}")


def measure(path: Path, eos: str | None, rpcfit: str | None) -> None:
    """All figures of one product."""
    from barpc.fit import FitOptions
    from barpc.fit.points import control_points
    from barpc.sensor.sentinel1 import RangeDoppler, read_annotation

    annotation = read_annotation(path)
    model = RangeDoppler.from_annotation(annotation)
    rng = np.random.default_rng(0)
    image, alt = rng.uniform(0, 1, (POINTS, 2)) * model.size, rng.uniform(*model.alt_range, POINTS)
    ground = model.localize(image, alt)
    options = FitOptions(space="ground", grid=(50, 50, 10), tolerance=100.0)
    control, control_image = control_points(model, model.size, model.alt_range, options)
    data = {"grid": annotation.grid.ground, "ground": ground, "control": control.reshape(-1, 3)}
    peer = ask(eos, "eos", path, data) if eos else None
    print(f"{path.name[:32]}, {annotation.states.source} orbit, {model.size[0]} x {model.size[1]} px")
    print(f"  {'':44s}{'barpc':>12s}{'eos-sar' if eos else '':>12s}")
    measure_grid(annotation, model, peer)
    line(
        "CPU, 25,000 points projected [s]",
        cpu(lambda: model.project(ground)),
        peer and float(peer["project"]),
    )
    line(
        "CPU, 25,000 points localised [s]",
        cpu(lambda: model.localize(image, alt)),
        peer and float(peer["localize"]),
    )
    line("round trip, max [px]", float(np.abs(model.project(ground) - image).max()), None)
    if annotation.product_type == "SLC":
        measure_floor(control, control_image, options, peer)
        other = None
        if rpcfit:
            points = {"target": control_image.reshape(-1, 2), "locs": control.reshape(-1, 3)}
            other = ask(rpcfit, "rpcfit", path, {**points, **check_data(model, control)})
        measure_rpc(model, ground, image, options, other)


def measure_grid(annotation, model, peer) -> None:
    """The model against the product's own grid."""
    from barpc.sensor.sentinel1 import grid_residuals
    from barpc.sensor.sentinel1.annotation import seconds

    ours, theirs = grid_residuals(annotation, model).T, None
    if peer:
        unix = seconds(annotation.grid.time, np.datetime64(0, "ns"))
        theirs = (
            (peer["grid"][:, 1] - annotation.grid.range_time) * annotation.range_sampling_rate,
            (peer["grid"][:, 0] - unix) / annotation.azimuth_time_interval,
        )
    for name, index, figure in (
        ("range against the grid, max [px]", 0, lambda x: np.abs(x).max()),
        ("azimuth against the grid, |mean| [line]", 1, lambda x: abs(x.mean())),
        ("azimuth against the grid, std [line]", 1, np.std),
        ("azimuth, farthest from its median [line]", 1, lambda x: np.abs(x - np.median(x)).max()),
    ):
        line(name, figure(ours[index]), figure(theirs[index]) if theirs else None)


def measure_floor(control, control_image, options, peer) -> None:
    """What the rounding of a model's rows leaves of an RPC fit."""
    from barpc.fit import fit_rpc_points

    def residual(image: np.ndarray) -> float:
        fit = fit_rpc_points(control.reshape(-1, 3), image.reshape(-1, 2), options=options, strict=False)
        return fit.rmse_cnp[1]

    line("RPC, rows: residual floor [px]", residual(control_image), peer and residual(peer["control"]))


def check_data(model, control) -> dict[str, np.ndarray]:
    """Check points in the box of the control points."""
    flat = control.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1)]
    check = np.random.default_rng(1).uniform(flat.min(axis=0), flat.max(axis=0), (len(flat), 3))
    return {"check": check, "check_image": model.project(check)}


def measure_rpc(model, ground, image, options, other) -> None:
    """RPCs on points that they have not seen."""
    from barpc.fit import fit_rpc

    box = fit_rpc(model, model.size, model.alt_range, options=options)
    fit = fit_rpc(model, model.size, model.alt_range, strict=False)
    error = fit.rpc.project(ground) - image
    print(f"  {'':44s}{'barpc':>12s}{'rpcfit' if other else '':>12s}")
    line("RPC, 50x50x10 box, columns, check RMSE [px]", box.rmse_ckp[0], other and float(other["rmse_True"][0]))
    line("RPC, 50x50x10 box, rows, check RMSE [px]", box.rmse_ckp[1], other and float(other["rmse_True"][1]))
    line("RPC, image grid, columns, inside RMSE [px]", float(np.sqrt((error[:, 0] ** 2).mean())), None)
    line("RPC, image grid, largest error certified [px]", float(fit.max_ckp.max()), None)
    if model.all_ground is not None:
        fit = fit_rpc(model, model.size, model.all_ground, strict=False)
        line("RPC, -500 to 9000 m, largest error certified [px]", float(fit.max_ckp.max()), None)


def main() -> None:
    """Read the command line; as a peer, answer the other interpreter."""
    if "--as-peer" in sys.argv:
        peer, annotation, folder = sys.argv[2:]
        with np.load(f"{folder}/in.npz") as data:
            result = {"eos": peer_eos, "rpcfit": peer_rpcfit}[peer](annotation, dict(data))
        np.savez(f"{folder}/out.npz", **result)
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("annotations", nargs="*", type=Path, help="annotation XML files")
    parser.add_argument("--ew", action="store_true", help="also a synthetic EW swath")
    parser.add_argument("--eos", default=os.environ.get("BARPC_EOS_PYTHON"), help="interpreter that has eos-sar")
    parser.add_argument("--rpcfit", default=os.environ.get("BARPC_RPCFIT_PYTHON"), help="one that has rpcfit")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        for path in [*args.annotations, *([ew_swath(Path(folder))] if args.ew else [])]:
            measure(path, args.eos, args.rpcfit)


def ew_swath(folder: Path) -> Path:
    """The annotation of a synthetic EW swath."""
    from tests.sensor.s1_product import Product

    product = Product(swath="EW1", first_range_time=5.0e-3, samples=24_600, num_bursts=22, num_states=19)
    path = folder / product.name
    path.write_bytes(product.xml())
    return path


if __name__ == "__main__":
    main()
