"""`barpc fit`: any camera into an RPC, with a certificate."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from barpc.base.options import GEOID_HELP
from barpc.cli.flags import flag, paper, run_options
from barpc.cli.terminal import echo, remark, say, tell_gate, wants_json

if TYPE_CHECKING:
    from barpc.fit import RpcFit

_MOSAIC_GRID = (20, 20, 10)  # three swaths, 250 km: coarser grids cost a third of the accuracy


@click.command("fit")
@click.argument("source", metavar="SOURCE")
@click.option("-o", "--output", metavar="RPC", help="Where to write; the name chooses the format. Else measure.")
@click.option(
    "--alt-range",
    type=(float, float),
    metavar="LOW HIGH",
    help="Altitudes [m above the ellipsoid] to fit over.  [default: the camera's own; of a radar all "
    "ground on Earth, -500 to 9000 m, where an RPC holds it]",
)
@click.option(
    "--dem",
    metavar="FILE",
    multiple=True,
    help="Take the altitudes of this DEM over the image, with a margin (repeatable).",
)
@click.option(
    "--dem-margin",
    type=click.FloatRange(0),
    default=500.0,
    show_default=True,
    metavar="M",
    help="Margin below and above the DEM.",
)
@click.option("--geoid", metavar="NAME|FILE", help=GEOID_HELP)
@flag("fit.tolerance")
@flag("fit.localisation")
@paper
@click.option("--options", "options_file", metavar="FILE", help="TOML file; its table [fit] counts here.")
@click.option("--keep-going", is_flag=True, help="Write the RPC although it misses the tolerance; exit 3.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@click.pass_obj
def fit(
    obj: dict[str, Any], /, source: str, output: str | None, keep_going: bool, overwrite: bool, **flags: Any
) -> int:
    r"""Fit an RPC to a camera or to points, and certify it on points that the fit has not seen.

    SOURCE is whatever 'barpc info' knows as a camera - an image with an RPC or an RPC file (refitted), a
    direct-localisation grid, a Sentinel-1 or TerraSAR-X product or annotation, a SICD image, a CSM state - or a table
    of points (CSV, npz, GeoJSON), or an image that has GCPs and no RPC. Choices stand behind it: 'barpc info --help'
    lists them.

    \b
    Examples:
      barpc fit image.tif -o new/image_RPC.TXT --alt-range -100 2500
      barpc fit points.csv,size=20000:19000 -o points.RPB --tolerance 1
      barpc fit S1A_IW_SLC__1SDV_....SAFE,swath=iw1,pol=vv -o iw1_RPC.TXT
      barpc fit image.tif,model=physical -o new/image_RPC.TXT --tolerance 0.5
    """
    from barpc.cameras import split_spec

    image = str(split_spec(source)[0])
    if output is not None:
        from barpc.cli.convert import check_target

        check_target(output, [image], overwrite)
    fit, tolerance, size = _fit_source(source, output, flags)
    written = False
    if output is not None and (keep_going or not fit.verdict(tolerance)):
        fit, written = _write_rpc_file(fit, image, output, overwrite, None if keep_going else tolerance, size)
    verdict = fit.verdict(tolerance)
    if wants_json():
        summary = {**fit.summary(), "verdict": verdict, "output": output if written else None}
        echo(json.dumps(summary, indent=1))
    elif not obj["quiet"]:
        echo(_certificate(fit, verdict))
        if written:
            echo(f"written       {output} (read back: these are its figures)")
    if flags["flag_fit_localisation"] and written and fit.rpc.direct is None:
        return tell_gate(f"{output} holds no localisation RPC: give a name in _RPC.TXT, .json or .vrt", [])
    if not verdict:
        return 0
    how = "written all the same" if written else "nothing written (--keep-going writes it all the same)"
    return tell_gate(f"{verdict}; {how}", [])


def _fit_source(source: str, output: str | None, flags: dict[str, Any]) -> tuple[RpcFit, float, tuple[int, int] | None]:
    """Return the fit, the tolerance [px] that it is to meet, and the image's width and height, if known."""
    from barpc.cameras import open_camera, read_points, split_spec
    from barpc.fit import FitOptions, fit_rpc, fit_rpc_points
    from barpc.fit.points import terrain_range
    from barpc.rasters.dem import Dem
    from barpc.rpcio import Carrier, format_for

    options = run_options(flags, flags["options_file"]).fit
    row = None if output is None else format_for(output)
    if isinstance(row, Carrier) and options.precision is None:
        options = replace(options, precision=row.precision)
    points, size = read_points(source)
    if points is not None:
        ground, image = points.ground, points.image
        if points.note:
            remark(points.note)
        if (alt := ground[:, 2]).min() == alt.max():
            say(f"all points are at {alt[0]:g} m: the RPC has no terms in height and is valid at that altitude only")
        fit = fit_rpc_points(ground, image, sigma=points.sigma, size=size, options=options, strict=False)
        return fit, options.tolerance, size
    camera = open_camera(source)
    if split_spec(source)[1].get("swath", "").lower() == "mosaic" and options.grid == FitOptions().grid:
        options = replace(options, grid=_MOSAIC_GRID)
    alt_range = flags["alt_range"] or camera.alt_range
    if flags["dem"] and not flags["alt_range"]:
        terrain = Dem.open(flags["dem"], flags["geoid"])
        alt_range = terrain_range(camera.model, camera.extent, alt_range, terrain, flags["dem_margin"])
    elif not flags["alt_range"] and (all_ground := getattr(camera.model, "all_ground", None)):
        fit = fit_rpc(camera.model, camera.extent, all_ground, options=options, strict=False)
        if not fit.verdict(options.tolerance):
            return fit, options.tolerance, camera.size
        low, high = alt_range
        remark(
            f"no RPC represents all altitudes on Earth here: fitted over the scene's altitudes, {low:g} to {high:g} m"
        )
    fit = fit_rpc(camera.model, camera.extent, alt_range, options=options, strict=False)
    return fit, options.tolerance, camera.size


class _Missed(Exception):  # noqa: N818 - it never leaves this page
    """The written file does not reproduce the fit: it is removed."""


def _write_rpc_file(
    fit: RpcFit,
    source: str,
    output: str,
    overwrite: bool,
    tolerance: float | None,
    size: tuple[int, int] | None,
) -> tuple[RpcFit, bool]:
    """Write the RPC and read it back: the fit as its file holds it, and whether it stays there (within a tolerance)."""
    from barpc.base.atomic import replacing
    from barpc.rpcio import read_rpc, write_camera

    stays = False
    with suppress(_Missed), replacing(output, overwrite=overwrite) as partial:
        write_camera(fit.rpc, partial, source, place=output, overwrite=True, size=size)
        fit = fit.as_written(read_rpc(partial))
        if tolerance is not None and fit.verdict(tolerance):
            raise _Missed
        stays = True
    return fit, stays


def _certificate(fit: RpcFit, verdict: str) -> str:
    rows = {"control rmse": fit.rmse_cnp, "control max": fit.max_cnp}
    rows |= {"check rmse": fit.rmse_ckp, "check max": fit.max_ckp}
    beyond = f"beyond        {fit.beyond:.2%} of the image at most may have larger errors (95 % confidence)"
    more = []
    if (found := fit.localisation) is not None:
        again = f"projected again {found.rmse_px:.3g} and {found.max_px:.3g} px"
        least = f"denominators at least {found.min_denominator:.3g}"
        more = [f"localisation  rmse {found.rmse_m:.3g} m, max {found.max_m:.3g} m; {again}; {least}"]
    lines = [
        f"method        {fit.method}, {fit.iterations} passes, h {fit.h[0]:.2g} {fit.h[1]:.2g}",
        f"points        {fit.num_cnp} control, {fit.num_ckp} check, {fit.coverage:.0%} of the image covered",
        "              col [px]     row [px]",
        *(f"{name:14s}{col:<13.3g}{row:.3g}" for name, (col, row) in rows.items()),
        *([beyond] if fit.beyond < 1 else []),  # given points say nothing of the rest
        f"denominators  at least {fit.min_denominator:.3g} of their value at the centre, over the ground and a margin",
        f"round trip    {fit.roundtrip:.1g} px" + f"; the camera's own {fit.contradiction:.1g}" * (fit.beyond < 1),
        *more,
        f"verdict       {verdict or 'within tolerance'}",
    ]
    return "\n".join(lines)
