"""From a Sentinel-1 SLC folder to an image and an RPC that GDAL orthorectifies with.

The bursts of one swath are stitched into one amplitude image (overlaps cut at their middle), the
Range-Doppler model is fitted into an RPC and written beside it, and, with a DEM or a height, the image is
orthorectified by GDAL with nothing but that RPC:

    python examples/sentinel1_rpc.py S1A_IW_SLC__1SDV_....SAFE out --swath iw1 --pol vv --dem dem.tif
    gdalwarp -rpc -to RPC_DEM=dem.tif -t_srs EPSG:32633 out/iw1.tif iw1_ortho.tif     # the same by hand

A DEM must hold heights above the ellipsoid.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.warp import Resampling, reproject
from rasterio.windows import Window

from barpc import fit_rpc, write_rpc
from barpc.sensor.geometry import footprint
from barpc.sensor.sentinel1 import Annotation, RangeDoppler, burst_rows, open_product, read_annotation

STRIP = 512  # lines read at a time


def stitch(annotation: Annotation, measurement: Path, image: Path, size: tuple[int, int]) -> None:
    """Write the amplitude of a swath in the stitched frame: tiled, 32-bit, zero where nothing is valid."""
    profile = {"driver": "GTiff", "width": size[0], "height": size[1], "count": 1, "dtype": "float32"}
    with (
        rasterio.open(measurement) as source,
        rasterio.open(image, "w", **profile, tiled=True, compress="deflate", nodata=0) as target,
    ):
        for burst in burst_rows(annotation):
            for row in range(burst.start, burst.stop, STRIP):
                count = min(STRIP, burst.stop - row)
                line = burst.first_line + row - burst.first_row
                amplitude = np.abs(source.read(1, window=Window(0, line, size[0], count)))
                target.write(amplitude.astype(np.float32), 1, window=Window(0, row, size[0], count))


def orthorectify(image: Path, ortho: Path, model: RangeDoppler, pixel: float, **height: str) -> None:
    """Warp the image to longitude and latitude with the RPC that lies beside it."""
    ring = np.concatenate([footprint(model, model.size, alt) for alt in model.alt_range])
    (west, south), (east, north) = ring.min(axis=0), ring.max(axis=0)
    step = np.array([pixel / np.cos(np.radians(0.5 * (south + north))), pixel]) / 111_320.0
    width, rows = (int(np.ceil(n)) for n in np.array([east - west, north - south]) / step)
    profile = {"driver": "GTiff", "width": width, "height": rows, "count": 1, "dtype": "float32"}
    transform = rasterio.Affine(step[0], 0.0, west, 0.0, -step[1], north)
    with (
        rasterio.open(image) as source,
        rasterio.open(
            ortho, "w", **profile, crs=CRS.from_epsg(4326), transform=transform, nodata=0
        ) as target,
    ):
        reproject(
            rasterio.band(source, 1),
            rasterio.band(target, 1),
            rpcs=source.rpcs,
            src_crs=CRS.from_epsg(4326),
            resampling=Resampling.bilinear,
            **height,
        )


def run(args: argparse.Namespace) -> None:
    """The three steps."""
    found = sorted(args.safe.glob(f"annotation/*-{args.swath}-slc-{args.pol}-*.xml"))
    if len(found) != 1:
        raise SystemExit(f"{args.safe}: {len(found)} annotations of {args.swath} {args.pol}, expected one")
    measurement = args.safe / "measurement" / found[0].with_suffix(".tiff").name
    args.out.mkdir(parents=True, exist_ok=True)
    image = args.out / f"{args.swath}.tif"

    model = open_product(args.safe, swath=args.swath, polarisation=args.pol, orbit=args.orbit)
    fit = fit_rpc(model, model.size, model.alt_range)
    print(f"RPC: {fit.rmse_ckp[0]:.1e} px in range, {fit.rmse_ckp[1]:.1e} in azimuth on points not fitted")

    stitch(read_annotation(found[0]), measurement, image, model.size)
    write_rpc(fit.rpc, args.out / f"{args.swath}_RPC.TXT", overwrite=True)
    if args.dem or args.height is not None:
        height = {"RPC_DEM": str(args.dem)} if args.dem else {"RPC_HEIGHT": str(args.height)}
        orthorectify(image, args.out / f"{args.swath}_ortho.tif", model, args.pixel, **height)
    print(f"written to {args.out}")


def main(argv: list[str] | None = None) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("safe", type=Path, help="the .SAFE folder of an SLC product")
    parser.add_argument("out", type=Path, help="folder for the results")
    parser.add_argument("--swath", default="iw1", help="iw1, iw2, iw3, ew1 ... ew5")
    parser.add_argument("--pol", default="vv", help="vv, vh, hh, hv")
    parser.add_argument("--orbit", type=Path, help="precise orbit file (.EOF)")
    parser.add_argument("--dem", type=Path, help="heights above the ellipsoid")
    parser.add_argument("--height", type=float, help="one height [m above the ellipsoid] instead of a DEM")
    parser.add_argument("--pixel", type=float, default=20.0, help="of the orthoimage [m]")
    run(parser.parse_args(argv))


if __name__ == "__main__":
    main()
