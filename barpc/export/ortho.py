"""For maps: the commands of GDAL that make an orthoimage of every image of a run."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from barpc.export.neural import Files
from barpc.export.scene import Scene, Shot, link

_HEAD = """#!/bin/sh
# Orthoimages of the corrected cameras: gdalwarp is of GDAL ({about}).
set -e
cd "$(dirname "$0")"
"""


def ortho(scene: Scene, out: Path) -> Files:
    """``ortho.sh``: a line of gdalwarp an image, in the scene's UTM zone, at the image's own resolution.

    On the run's DEM, made ellipsoidal where it had a geoid; without one at the altitude of the tie points.
    """
    dem, geoid = (_option(scene, name) for name in ("dem", "geoid"))
    lines, heights, about = (
        [],
        f"RPC_HEIGHT={scene.origin[2]:.0f}",
        "all ground at one altitude; give a DEM to adjust",
    )
    if dem:
        heights, about = f"RPC_DEM={link(dem, out)}", f"heights of {Path(dem).name}"
    if dem and geoid:
        heights = "RPC_DEM=dem_ellipsoidal.tif"
        above = f"+proj=longlat +datum=WGS84 +geoidgrids={os.path.abspath(geoid)} +vto_meter=1"  # noqa: PTH100
        lines.append(
            _words("gdalwarp", "-s_srs", above, "-t_srs", "EPSG:4979", link(dem, out), "dem_ellipsoidal.tif")
        )
    lon, lat, _ = scene.origin
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    crs = f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"
    lines += [_warp(shot, heights, crs, out) for shot in scene.shots]
    return {"ortho.sh": (_HEAD.format(about=about) + "\n".join(lines) + "\n").encode()}


def _warp(shot: Shot, heights: str, crs: str, out: Path) -> str:
    side = f"{shot.entry.gsd_m:.2g}" if shot.entry.gsd_m else None
    pixel = ("-tr", side, side) if side else ()
    image = link(shot.carrier or shot.file, out)
    return _words("gdalwarp", "-rpc", "-to", heights, "-t_srs", crs, *pixel, image, f"{shot.name}.tif")


def _words(*words: str) -> str:
    return shlex.join(words)


def _option(scene: Scene, name: str) -> str | None:
    """A file of the run's options."""
    found = (scene.summary.options or {}).get(name)
    return found if isinstance(found, str) else None


ORTHO: Mapping[str, Any] = {"ortho": ortho}
