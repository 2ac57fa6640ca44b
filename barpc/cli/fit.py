"""`barpc fit`: any camera into an RPC, with a certificate."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from barpc.cli.terminal import echo, tell_gate

if TYPE_CHECKING:
    from barpc.fit import RpcFit
    from barpc.sensor import SensorModel

_DEFAULT = " [default: {}]".format
_MOSAIC_GRID = (20, 20, 10)  # three swaths, 250 km: coarser grids cost a third of the accuracy


@click.command("fit")
@click.argument("source", metavar="SOURCE")
@click.option(
    "-o",
    "--output",
    metavar="RPC",
    help="Where to write; the name chooses the format. Without it, only measure.",
)
@click.option(
    "--size", nargs=2, type=click.IntRange(1), metavar="W H", help="Image size, where SOURCE has no pixels."
)
@click.option(
    "--alt-range",
    nargs=2,
    type=float,
    metavar="LOW HIGH",
    help="Altitudes [m above the ellipsoid] to fit over." + _DEFAULT("the camera's own"),
)
@click.option("--dem", metavar="FILE", help="Take the altitudes of this DEM over the image, with a margin.")
@click.option(
    "--dem-margin",
    type=click.FloatRange(0),
    default=500.0,
    show_default=True,
    metavar="M",
    help="Margin below and above the DEM.",
)
@click.option("--geoid", metavar="FILE", help="Geoid grid for a DEM of orthometric heights.")
@click.option(
    "--grid-altitudes",
    metavar="A,B,...",
    help="Altitudes of the layers of a localisation grid that does not state them.",
)
@click.option("--swath", metavar="NAME", help="Sentinel-1: swath (iw1, ..., s3), or mosaic for all of them.")
@click.option("--pol", metavar="NAME", help="Sentinel-1: polarisation (vv, vh, hh, hv).")
@click.option(
    "--burst", type=click.IntRange(0), metavar="N", help="Sentinel-1: one burst of the swath, from 0."
)
@click.option("--orbit", metavar="EOF", help="Sentinel-1: precise orbit file.")
@click.option("--atmosphere", is_flag=True, help="Sentinel-1: add the path delay of the atmosphere.")
@click.option(
    "--bistatic",
    type=click.Choice(["annotated", "full"]),
    help="Sentinel-1: add a bistatic correction of the lines.",
)
@click.option(
    "--method",
    type=click.Choice(["auto", "ridge", "lcurve", "vendor-denominators"]),
    default="auto",
    show_default=True,
    help="Solver.",
)
@click.option("--joint", is_flag=True, help="One regularisation for col and row (lcurve).")
@click.option(
    "--grid",
    nargs=3,
    type=click.IntRange(4),
    metavar="NX NY NZ",
    help="Control points along col, row, altitude." + _DEFAULT("12 12 7; 20 20 10 for a mosaic"),
)
@click.option(
    "--space",
    type=click.Choice(["image", "ground"]),
    default="image",
    show_default=True,
    help="Grid regular in the image, or in a lon/lat box.",
)
@click.option(
    "--nodes",
    type=click.Choice(["chebyshev", "uniform"]),
    default="chebyshev",
    show_default=True,
    help="Spacing of the grid.",
)
@click.option(
    "--for-format",
    "precision",
    type=click.Choice(["nitf", "rpcm"]),
    help="Fit numbers that this format can hold.",
)
@click.option(
    "--tolerance",
    type=click.FloatRange(0, min_open=True),
    default=0.01,
    show_default=True,
    metavar="PX",
    help="Largest error allowed on check points.",
)
@click.option("--allow-mirrored", is_flag=True, help="Points of a radar image: mirrored is right.")
@click.option("--force", is_flag=True, help="Write the RPC although it misses the tolerance; exit 3.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.option("--json", "as_json", is_flag=True, help="Print the certificate as JSON on stdout.")
@click.pass_obj
def command(
    obj: dict[str, Any],
    /,
    source: str,
    output: str | None,
    force: bool,
    overwrite: bool,
    as_json: bool,
    **flags: Any,
) -> int:
    r"""Fit an RPC to a camera or to points, and certify it on points that the fit has not seen.

    SOURCE is an image with an RPC or an RPC file (refitted), a table of points (CSV, npz, GeoJSON), a
    direct-localisation grid (GeoTIFF), or a Sentinel-1 product or annotation.

    \b
    Examples:
      barpc fit image.tif -o new/image_RPC.TXT --alt-range -100 2500
      barpc fit points.csv -o points.RPB --tolerance 1
      barpc fit S1A_IW_SLC__1SDV_....SAFE --swath iw1 --pol vv -o iw1_RPC.TXT
    """
    if output is not None:
        from barpc.cli.points import check_target

        check_target(output, [source], overwrite)
    fit = _fit(Path(source), flags)
    verdict = fit.verdict(flags["tolerance"])
    reread = None
    if output is not None and (force or not verdict):
        reread = _write(fit, source, output, overwrite)
    if as_json:
        echo(
            json.dumps({**fit.summary(), "verdict": verdict, "output": output if reread else None}, indent=1)
        )
    elif not obj["quiet"]:
        echo(_certificate(fit, verdict))
        if reread:
            echo(f"written       {reread}")
    if verdict:
        written = "written all the same" if reread else "nothing written (--force writes it all the same)"
        return tell_gate(f"{verdict}; {written}", [])
    return 0


def _fit(source: Path, flags: dict[str, Any]) -> RpcFit:
    from barpc.errors import InputError
    from barpc.fit import FitOptions, fit_rpc, fit_rpc_points
    from barpc.pointio.tables import correspondence_kind, read_correspondences

    names = ("method", "joint", "space", "nodes", "precision", "tolerance", "allow_mirrored")
    grid = flags["grid"] or (_MOSAIC_GRID if (flags["swath"] or "").lower() == "mosaic" else None)
    options = FitOptions(**{name: flags[name] for name in names}, grid=grid or FitOptions.grid)
    try:
        altitudes = (
            [float(a) for a in flags["grid_altitudes"].split(",")] if flags["grid_altitudes"] else None
        )
    except ValueError as error:
        raise InputError(
            f"--grid-altitudes {flags['grid_altitudes']}: not numbers separated by commas"
        ) from error
    if not _is_sentinel1(source) and correspondence_kind(source, altitudes) is not None:
        points = read_correspondences(source, altitudes=altitudes)
        return fit_rpc_points(
            points.ground,
            points.image,
            sigma=points.sigma,
            size=flags["size"] or None,
            options=options,
            strict=False,
        )
    model, size, alt_range = _camera(source, flags)
    if flags["dem"]:
        alt_range = _dem_range(model, size, alt_range, flags)
    return fit_rpc(model, size, flags["alt_range"] or alt_range, options=options, strict=False)


def _is_sentinel1(source: Path) -> bool:
    """A product folder or zip, its manifest, or an annotation."""
    if source.is_dir() or source.suffix.lower() in (".safe", ".zip"):
        return True
    if source.suffix.lower() != ".xml" or not source.is_file():
        return False
    from barpc.sidefile import IMAGE, read_head

    return b"<adsHeader>" in read_head(source, IMAGE, 4096)


def _camera(source: Path, flags: dict[str, Any]) -> tuple[SensorModel, tuple[int, int], tuple[float, float]]:
    """The camera of a product, an image or an RPC file, its image size and its altitudes."""
    from barpc.errors import ImageError, InputError
    from barpc.raster import open_raster
    from barpc.rpcio import read_rpc
    from barpc.sensor.geometry import altitude_range

    if _is_sentinel1(source):
        from barpc.sensor.sentinel1 import open_product

        names = ("swath", "burst", "orbit", "atmosphere", "bistatic")
        radar = open_product(source, polarisation=flags["pol"], **{name: flags[name] for name in names})
        return radar, flags["size"] or radar.size, radar.alt_range
    rpc = read_rpc(source)
    size = flags["size"]
    if not size:
        try:
            with open_raster(source) as dataset:
                size = (dataset.width, dataset.height)
        except ImageError as error:
            raise InputError(f"{source}: an RPC without its image; give the image's --size W H") from error
    return rpc, size, altitude_range(rpc)


def _dem_range(
    model: SensorModel, size: tuple[int, int], alt_range: tuple[float, float], flags: dict[str, Any]
) -> tuple[float, float]:
    from barpc.dem import Dem
    from barpc.fit.points import terrain_range

    return terrain_range(model, size, alt_range, Dem.open(flags["dem"], flags["geoid"]), flags["dem_margin"])


def _write(fit: RpcFit, source: str, output: str, overwrite: bool) -> str:
    """Write the RPC, read it back as a consumer does, and say what is lost."""
    import numpy as np

    from barpc.rpcio import read_rpc, write_rpc, write_rpc_copy, write_rpc_vrt

    suffix = Path(output).suffix.lower()
    if suffix in (".tif", ".tiff"):
        write_rpc_copy(fit.rpc, source, output, overwrite=overwrite)
    elif suffix == ".vrt":
        write_rpc_vrt(fit.rpc, source, output, overwrite=overwrite)
    else:
        write_rpc(fit.rpc, output, overwrite=overwrite)
    corners = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1)
    ground = fit.rpc.ground_offset + corners * fit.rpc.ground_scale
    lost = float(np.abs(read_rpc(output).project(ground) - fit.rpc.project(ground)).max())
    return f"{output} (read back: {lost:.1g} px)"


def _certificate(fit: RpcFit, verdict: str) -> str:
    lines = [
        f"method        {fit.method}, {fit.iterations} passes, h {fit.h[0]:.2g} {fit.h[1]:.2g}",
        f"points        {fit.num_cnp} control, {fit.num_ckp} check, {fit.coverage:.0%} of the image covered",
        "              col [px]     row [px]",
    ]
    rows = (
        ("control rmse", fit.rmse_cnp),
        ("control max", fit.max_cnp),
        ("check rmse", fit.rmse_ckp),
        ("check max", fit.max_ckp),
    )
    lines += [f"{name:14s}{col:<13.3g}{row:.3g}" for name, (col, row) in rows]
    lines += [
        f"denominators  at least {fit.min_denominator:.3g} over the box and 25 % around it",
        f"round trip    {fit.roundtrip:.1g} px",
        f"verdict       {verdict or 'within tolerance'}",
    ]
    return "\n".join(lines)
