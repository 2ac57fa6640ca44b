"""`barpc info --doctor`: what is installed, and whether it works."""

from __future__ import annotations

import importlib
import json
import platform
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from barpc.cli.terminal import echo

REQUIRED = (
    "numpy",
    "scipy",
    "opencv-python-headless",
    "rasterio",
    "shapely",
    "click",
    "filelock",
    "fastjsonschema",
)
OPTIONAL = {"jinja2": "report", "distributed": "cluster"}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _fit_an_rpc() -> str:
    import numpy as np

    from barpc.fit import fit_rpc
    from barpc.simulate import Look, fly

    camera = fly(np.array([5.4, 43.3, 250.0]), Look(10.0, 30.0), (500, 400), 0.5)
    fit = fit_rpc(camera, (500, 400), (0.0, 500.0))
    return f"{float(fit.max_ckp.max()):.0e} px"


def _write_and_read_a_raster() -> str:
    import numpy as np
    import rasterio

    from barpc.raster import open_raster

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pixels.tif"
        transform = rasterio.Affine(1, 0, 0, 0, -1, 8)
        shape = {"width": 8, "height": 8, "count": 1, "dtype": "uint16", "transform": transform}
        with rasterio.open(path, "w", driver="GTiff", **shape) as out:
            out.write(np.arange(64, dtype=np.uint16).reshape(1, 8, 8))
        with open_raster(path) as image:
            total = int(image.read(1).sum())
    if total != 2016:
        raise RuntimeError(f"read back {total}, expected 2016")
    return f"GDAL {rasterio.__gdal_version__}"


def _detect_keypoints() -> str:
    cv2: Any = importlib.import_module("cv2")
    import numpy as np

    noise = np.random.default_rng(0).integers(0, 255, (64, 64)).astype(np.uint8)
    found = cv2.SIFT_create().detect(cv2.GaussianBlur(noise, (0, 0), 2.0), None)
    return f"{len(found)} SIFT keypoints in noise"


CHECKS: dict[str, Callable[[], str]] = {
    "read and write a raster": _write_and_read_a_raster,
    "detect keypoints": _detect_keypoints,
    "fit an RPC to a simulated camera": _fit_an_rpc,
}


def doctor(as_json: bool) -> int:
    """Print the versions of what barpc stands on, try each part once, and give the exit code."""
    from barpc import __version__

    versions = {"barpc": __version__, "python": platform.python_version()}
    versions |= {name: _version(name) or "MISSING" for name in REQUIRED}
    versions |= {
        name: _version(name) or f"not installed (pip install 'barpc[{extra}]')"
        for name, extra in OPTIONAL.items()
    }
    results = {}
    for name, check in CHECKS.items():
        try:
            results[name] = {"ok": True, "found": check()}
        except Exception as error:  # noqa: BLE001  whatever is broken is what this is there to show
            results[name] = {"ok": False, "found": f"{type(error).__name__}: {error}"}
    good = all(result["ok"] for result in results.values()) and "MISSING" not in versions.values()
    if as_json:
        echo(json.dumps({"versions": versions, "checks": results, "ok": good}, indent=1))
    else:
        for name, found in versions.items():
            echo(f"{name:<24} {found}")
        for name, result in results.items():
            echo(f"{'ok  ' if result['ok'] else 'FAIL'} {name}: {result['found']}")
        echo(f"platform: {platform.platform()}, {sys.executable}", err=True)
    return 0 if good else 1
