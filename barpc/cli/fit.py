"""`barpc fit`: any camera into an RPC, with a certificate."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from barpc.cli.options import flag, run_options
from barpc.cli.terminal import as_json, echo, tell_gate

if TYPE_CHECKING:
    from barpc.fit import RpcFit

_MOSAIC_GRID = (20, 20, 10)  # three swaths, 250 km: coarser grids cost a third of the accuracy


@click.command("fit")
@click.argument("source", metavar="SOURCE")
@click.option(
    "-o", "--output", metavar="RPC", help="Where to write; the name chooses the format. Else measure."
)
@click.option(
    "--alt-range",
    type=(float, float),
    metavar="LOW HIGH",
    help="Altitudes [m above the ellipsoid] to fit over.  [default: the camera's own]",
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
@flag("fit.tolerance")
@click.option("--options", "options_file", metavar="FILE", help="TOML file; its table [fit] counts here.")
@click.option("--keep-going", is_flag=True, help="Write the RPC although it misses the tolerance; exit 3.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@as_json
@click.pass_obj
def fit(
    obj: dict[str, Any],
    /,
    source: str,
    output: str | None,
    keep_going: bool,
    overwrite: bool,
    as_json: bool,
    **flags: Any,
) -> int:
    r"""Fit an RPC to a camera or to points, and certify it on points that the fit has not seen.

    SOURCE is whatever 'barpc info' knows as a camera - an image with an RPC or an RPC file (refitted), a
    direct-localisation grid, a Sentinel-1 product or annotation - or a table of points (CSV, npz, GeoJSON). Choices
    stand behind it: 'barpc info --help' lists them.

    \b
    Examples:
      barpc fit image.tif -o new/image_RPC.TXT --alt-range -100 2500
      barpc fit points.csv,size=20000:19000 -o points.RPB --tolerance 1
      barpc fit S1A_IW_SLC__1SDV_....SAFE,swath=iw1,pol=vv -o iw1_RPC.TXT
    """
    from barpc.cameras import split_spec

    image = str(split_spec(source)[0])
    if output is not None:
        from barpc.cli.convert import check_target

        check_target(output, [image], overwrite)
    fit, tolerance = _fit(source, flags)
    verdict = fit.verdict(tolerance)
    reread = None
    if output is not None and (keep_going or not verdict):
        reread = _write(fit, image, output, overwrite)
    if as_json:
        summary = {**fit.summary(), "verdict": verdict, "output": output if reread else None}
        echo(json.dumps(summary, indent=1))
    elif not obj["quiet"]:
        echo(_certificate(fit, verdict))
        if reread:
            echo(f"written       {reread}")
    if not verdict:
        return 0
    written = "written all the same" if reread else "nothing written (--keep-going writes it all the same)"
    return tell_gate(f"{verdict}; {written}", [])


def _fit(source: str, flags: dict[str, Any]) -> tuple[RpcFit, float]:
    """The fit and the tolerance [px] that it is to meet."""
    from barpc.cameras import open_camera, read_points, split_spec
    from barpc.dem import Dem
    from barpc.fit import FitOptions, fit_rpc, fit_rpc_points
    from barpc.fit.points import terrain_range

    options = run_options(flags, flags["options_file"]).fit
    points, size = read_points(source)
    if points is not None:
        ground, image = points.ground, points.image
        fit = fit_rpc_points(ground, image, sigma=points.sigma, size=size, options=options, strict=False)
        return fit, options.tolerance
    camera = open_camera(source)
    if split_spec(source)[1].get("swath", "").lower() == "mosaic" and options.grid == FitOptions().grid:
        options = replace(options, grid=_MOSAIC_GRID)
    alt_range = flags["alt_range"] or camera.alt_range
    if flags["dem"] and not flags["alt_range"]:
        terrain = Dem.open(flags["dem"], flags["geoid"])
        alt_range = terrain_range(camera.model, camera.extent, alt_range, terrain, flags["dem_margin"])
    fit = fit_rpc(camera.model, camera.extent, alt_range, options=options, strict=False)
    return fit, options.tolerance


def _write(fit: RpcFit, source: str, output: str, overwrite: bool) -> str:
    """Write the RPC, read it back as a consumer does, and say what is lost."""
    import numpy as np

    from barpc.rpcio import read_rpc, write_camera

    write_camera(fit.rpc, output, source, overwrite=overwrite)
    corners = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1)
    ground = fit.rpc.ground_offset + corners * fit.rpc.ground_scale
    lost = float(np.abs(read_rpc(output).project(ground) - fit.rpc.project(ground)).max())
    return f"{output} (read back: {lost:.1g} px)"


def _certificate(fit: RpcFit, verdict: str) -> str:
    rows = {"control rmse": fit.rmse_cnp, "control max": fit.max_cnp}
    rows |= {"check rmse": fit.rmse_ckp, "check max": fit.max_ckp}
    more = f"beyond        {fit.beyond:.2%} of the image may miss by more, at most (95 % confidence)"
    lines = [
        f"method        {fit.method}, {fit.iterations} passes, h {fit.h[0]:.2g} {fit.h[1]:.2g}",
        f"points        {fit.num_cnp} control, {fit.num_ckp} check, {fit.coverage:.0%} of the image covered",
        "              col [px]     row [px]",
        *(f"{name:14s}{col:<13.3g}{row:.3g}" for name, (col, row) in rows.items()),
        *([more] if fit.beyond < 1 else []),  # given points say nothing of the rest
        f"denominators  at least {fit.min_denominator:.3g} over the box and 25 % around it",
        f"round trip    {fit.roundtrip:.1g} px",
        f"verdict       {verdict or 'within tolerance'}",
    ]
    return "\n".join(lines)
