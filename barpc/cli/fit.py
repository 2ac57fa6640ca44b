"""`barpc fit`: any camera into an RPC, with a certificate."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click

from barpc.base.options import GEOID_HELP
from barpc.cli.flags import flag, paper, run_options
from barpc.cli.terminal import echo, tell_gate, wants_json

if TYPE_CHECKING:
    from barpc.fit import RpcFit


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
    from barpc.verbs.fitting import fitted

    options = run_options(flags, flags["options_file"])
    keywords = {name: value for name, value in flags.items() if name in ("alt_range", "dem", "dem_margin", "geoid")}
    done = fitted(source, output, options, {**keywords, "keep_going": keep_going, "overwrite": overwrite})
    verdict = done.verdict
    if wants_json():
        summary = {**done.fit.summary(), "verdict": verdict, "output": output if done.written else None}
        echo(json.dumps(summary, indent=1))
    elif not obj["quiet"]:
        echo(_certificate(done.fit, verdict))
        if done.written:
            echo(f"written       {output} (read back: these are its figures)")
    if flags["flag_fit_localisation"] and done.written and done.fit.rpc.direct is None:
        return tell_gate(f"{output} holds no localisation RPC: give a name in _RPC.TXT, .json or .vrt", [])
    if not verdict:
        return 0
    how = "written all the same" if done.written else "nothing written (--keep-going writes it all the same)"
    return tell_gate(f"{verdict}; {how}", [])


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
