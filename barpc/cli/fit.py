"""`barpc fit`: any camera into an RPC, with a certificate; and a motion of the ground brought back into cameras."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from barpc.base.errors import FitError, InputError
from barpc.base.geodesy import Array, ecef_from_ground, enu_basis, ground_from_ecef
from barpc.base.options import GEOID_HELP
from barpc.cli.flags import flag, paper, run_options
from barpc.cli.terminal import echo, say, tell_gate, wants_json
from barpc.fit import FitOptions, fit_rpc
from barpc.pointio.tables import read_transform
from barpc.rpcio import CARRIERS
from barpc.scene import Camera
from barpc.sensor import SensorModel
from barpc.sensor.corrected import Corrected, correction_of
from barpc.sensor.geometry import image_border
from barpc.sensor.rpc import RPC

if TYPE_CHECKING:
    from barpc.fit import RpcFit

_DEEPEST, _HIGHEST = -12e3, 10e3
"""Altitudes between which all ground on Earth lies [m], that of the sea's bottom, too."""
_TOLD = 0.01  # m: rounding of a matrix that is told
_MOSAIC_GRID = (20, 20, 10)  # three swaths, 250 km: coarser grids cost a third of the accuracy


def read_move(_: click.Context, __: click.Parameter, text: str | None) -> Array | None:
    """Return the three numbers of --move, metres east, north and up."""
    if text is None:
        return None
    try:
        east, north, up = (float(word) for word in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not three numbers E,N,U [m] with commas between") from None
    move = np.array([east, north, up])
    if not (np.abs(move) < _HIGHEST - _DEEPEST).all():
        raise click.BadParameter(f"{text!r}: a motion of less than 22 km along each axis is expected [m]")
    return move


def moved(cameras: Sequence[Camera], move: Array | None, transform: str | None, carrier: str) -> list[Camera]:
    """Return cameras that show the moved ground where these show it unmoved, each refitted into an RPC and certified.

    The motion is `move` (3,) [m], east, north and up at the middle of all the images, or that of the file
    `transform`: it takes the points that these cameras make to their true place. One motion for all cameras: rays that
    met still meet, where the motion takes the point. FitError where no RPC holds a moved camera, InputError for a
    motion that leaves the Earth's surface or is a position.
    """
    corners = [_corners(camera) for camera in cameras]
    middle = np.mean([ecef_from_ground(ground).mean(axis=0) for ground in corners], axis=0)
    at = ground_from_ecef(middle)
    if transform is not None:
        matrix = read_transform(transform)
    else:
        assert move is not None
        _check_position(move, np.concatenate(corners))
        matrix = np.column_stack([np.eye(3), enu_basis(at).T @ move])
    out = []
    for camera, ground in zip(cameras, corners, strict=True):
        there = ground_from_ecef(ecef_from_ground(ground) @ matrix[:, :3].T + matrix[:, 3])
        low, high = float(there[:, 2].min()), float(there[:, 2].max())
        if not (low > _DEEPEST and high < _HIGHEST):
            what = "a matrix of other coordinates than ECEF?" if transform else "give metres"
            file, ends = transform or "--move", f"{low:.0f} to {high:.0f} m"
            raise InputError(f"{file}: takes the ground of {camera.path} to altitudes of {ends}: {what}")
        moving = Corrected(camera.model, correction_of(matrix, middle))
        direct = isinstance(camera.model, RPC) and camera.model.direct is not None
        options = replace(FitOptions(), precision=CARRIERS[carrier].precision, localisation=direct)
        out.append(refitted(camera, moving, (low, high), options, "moved and refitted"))
    _tell(matrix, middle)
    return out


def _corners(camera: Camera) -> Array:
    """Return ground (n, 3) along the border of a camera's image, at its lowest and highest altitude."""
    edge = image_border(camera.extent, 4)
    levels = (np.full(len(edge), alt) for alt in camera.alt_range)
    ground = np.concatenate([camera.model.localize(edge, level) for level in levels])
    found: Array = ground[np.isfinite(ground).all(axis=1)]
    if not len(found):
        raise InputError(f"{camera.path}: shows no ground along the border of its image")
    return found


def _check_position(move: Array, ground: Array) -> None:
    """Refuse metres east and north that are the longitude and latitude of a place in the images."""
    low, high = ground[:, :2].min(axis=0), ground[:, :2].max(axis=0)
    for place in (move[:2], move[1::-1]):
        if ((low <= place) & (place <= high)).all():
            raise InputError(
                f"--move {','.join(f'{value:g}' for value in move)}: is a longitude and latitude in the images; metres "
                "east, north and up are needed"
            )


def refitted(
    camera: Camera, model: SensorModel, alt_range: tuple[float, float], options: FitOptions, done: str
) -> Camera:
    """Return a camera with the RPC of a model, and say how near it comes; FitError where none holds it."""
    fit = fit_rpc(model, camera.extent, alt_range, options=options, strict=False)
    if wrong := fit.verdict(options.tolerance):
        raise FitError(f"{camera.path}: {wrong} ('barpc fit --keep-going' writes it all the same)")
    say(f"{camera.path}: {done} to {float(fit.max_ckp.max()):.1g} px")
    return replace(camera, model=fit.rpc, alt_range=alt_range)


def _tell(matrix: Array, middle: Array) -> None:
    """Say what the motion is at the middle of the images, and what the digits of its matrix are worth there."""
    at, stretch = ground_from_ecef(middle), np.linalg.svd(matrix[:, :3], compute_uv=False)
    rounding = float((stretch[0] - stretch[-1]) / stretch.mean() * np.linalg.norm(middle))
    if rounding > _TOLD:
        say(f"the matrix is written with few digits: it places the ground to some {rounding:.2g} m only")
    east, north, up = enu_basis(at) @ (matrix @ np.append(middle, 1.0) - middle)
    scale = float(stretch.mean())
    turn = float(np.arccos(np.clip((np.trace(matrix[:, :3]) / scale - 1.0) / 2.0, -1.0, 1.0)))
    more = f", turned by {1e6 * turn:.3g} urad, scaled by {scale:.9g}"
    more *= bool((matrix[:, :3] != np.eye(3)).any())
    say(f"the ground moves by {east:+.3f} m east, {north:+.3f} m north, {up:+.3f} m up at its middle{more}")


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
@click.option("--dem", metavar="FILE", help="Take the altitudes of this DEM over the image, with a margin.")
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
    of points (CSV, npz, GeoJSON). Choices stand behind it: 'barpc info --help' lists them.

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
    fit, tolerance = _fit(source, output, flags)
    written = False
    if output is not None and (keep_going or not fit.verdict(tolerance)):
        fit, written = _write(fit, image, output, overwrite, None if keep_going else tolerance)
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


def _fit(source: str, output: str | None, flags: dict[str, Any]) -> tuple[RpcFit, float]:
    """Return the fit and the tolerance [px] that it is to meet."""
    from barpc.cameras import open_camera, read_points, split_spec
    from barpc.fit import FitOptions, fit_rpc, fit_rpc_points
    from barpc.fit.points import terrain_range
    from barpc.rasters.dem import Dem
    from barpc.rpcio import Carrier, row_of

    options = run_options(flags, flags["options_file"]).fit
    row = None if output is None else row_of(output)
    if isinstance(row, Carrier) and options.precision is None:
        options = replace(options, precision=row.precision)
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
    elif not flags["alt_range"] and (all_ground := getattr(camera.model, "all_ground", None)):
        fit = fit_rpc(camera.model, camera.extent, all_ground, options=options, strict=False)
        if not fit.verdict(options.tolerance):
            return fit, options.tolerance
        low, high = alt_range
        say(f"no RPC holds all ground on Earth here: fitted over the scene's altitudes, {low:g} to {high:g} m")
    fit = fit_rpc(camera.model, camera.extent, alt_range, options=options, strict=False)
    return fit, options.tolerance


class _Missed(Exception):  # noqa: N818 - it never leaves this page
    """What was written does not hold the fit: it goes again."""


def _write(fit: RpcFit, source: str, output: str, overwrite: bool, tolerance: float | None) -> tuple[RpcFit, bool]:
    """Write the RPC and read it back: the fit as its file holds it, and whether it stays there (within a tolerance)."""
    from barpc.base.atomic import replacing
    from barpc.rpcio import read_rpc, write_camera

    stays = False
    with suppress(_Missed), replacing(output, overwrite=overwrite) as partial:
        write_camera(fit.rpc, partial, source, place=output, overwrite=True)
        fit = fit.as_written(read_rpc(partial))
        if tolerance is not None and fit.verdict(tolerance):
            raise _Missed
        stays = True
    return fit, stays


def _certificate(fit: RpcFit, verdict: str) -> str:
    rows = {"control rmse": fit.rmse_cnp, "control max": fit.max_cnp}
    rows |= {"check rmse": fit.rmse_ckp, "check max": fit.max_ckp}
    beyond = f"beyond        {fit.beyond:.2%} of the image may miss by more, at most (95 % confidence)"
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
        f"denominators  at least {fit.min_denominator:.3g} over the image's ground and around it",
        f"round trip    {fit.roundtrip:.1g} px" + f"; the camera's own {fit.contradiction:.1g}" * (fit.beyond < 1),
        *more,
        f"verdict       {verdict or 'within tolerance'}",
    ]
    return "\n".join(lines)
