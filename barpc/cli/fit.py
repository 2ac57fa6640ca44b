"""`barpc fit`: any camera into an RPC, with a certificate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from barpc.base.declarations import declared
from barpc.base.verb_options import RefitOptions
from barpc.cli.flags import flag, flags_of, given_flags, options_of_flags, paper
from barpc.cli.terminal import at_work, tell, tell_gate, wants_json

if TYPE_CHECKING:
    from barpc.fit import RpcFit


@click.command("fit")
@click.argument("source", metavar="SOURCE")
@click.option("-o", "--output", metavar="RPC", help="Where to write; the name chooses the format. Else measure.")
@flags_of(RefitOptions, keep_going="Write the RPC although it misses the tolerance; exit 3.")
@flag("fit.tolerance")
@paper
@click.option("--options", "options_file", metavar="FILE", help="TOML file; its table [fit] counts here.")
def fit(source: str, output: str | None, **flags: Any) -> int:
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

    options = options_of_flags(flags, flags["options_file"])
    own = {name: flags[name] for name in declared(RefitOptions)}
    with at_work() as progress:
        done = fitted(source, output, options, given_flags(own), progress)
    verdict = done.verdict
    written = [f"written       {output} (read back: these are its figures)"] * done.written
    more = {"verdict": verdict, "output": output if done.written else None}
    tell({**done.fit.summary(), **more} if wants_json() else None, _certificate(done.fit, verdict), *written)
    if not verdict:
        return 0
    how = "written all the same" if done.written else "nothing written (--keep-going writes it all the same)"
    if not done.fault:  # few points
        how = "written" if done.written else "nothing written without -o"
    return tell_gate(f"{verdict}; {how}", [])


def _certificate(fit: RpcFit, verdict: str) -> str:
    rows = {"control rmse": fit.rmse_cnp, "control max": fit.max_cnp}
    rows |= {"check rmse": fit.rmse_ckp, "check max": fit.max_ckp}
    beyond = f"beyond        {fit.beyond:.2%} of the image at most may have larger errors (95 % confidence)"
    lines = [
        f"method        {fit.method}, {fit.iterations} passes, h {fit.h[0]:.2g} {fit.h[1]:.2g}",
        f"points        {fit.num_cnp} control, {fit.num_ckp} check, {fit.coverage:.0%} of the image covered",
        "              col [px]     row [px]",
        *(f"{name:14s}{col:<13.3g}{row:.3g}" for name, (col, row) in rows.items()),
        *([beyond] if fit.beyond < 1 else []),  # given points say nothing of the rest
        f"denominators  at least {fit.min_denominator:.3g} of their value at the centre, over the ground and a margin",
        f"round trip    {fit.roundtrip:.1g} px" + f"; the camera's own {fit.contradiction:.1g}" * (fit.beyond < 1),
        f"verdict       {verdict or 'within tolerance'}",
    ]
    return "\n".join(lines)
