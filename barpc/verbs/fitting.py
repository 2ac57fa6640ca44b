"""`fit`: any camera or points into an RPC, written, read back and certified."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from barpc.base.atomic import replacing
from barpc.base.declarations import declared
from barpc.base.errors import FitError, Remark
from barpc.base.options import FitOptions, RunOptions
from barpc.base.tasks import Progress
from barpc.base.verb_options import RefitOptions
from barpc.cameras import ImageLike, file_of, open_camera, read_points, split_spec
from barpc.fit import RpcFit, fit_rpc, fit_rpc_points
from barpc.fit.points import terrain_range
from barpc.rpcio import read_rpc, write_camera
from barpc.scene import Camera, Doubt
from barpc.sensor import SensorModel
from barpc.verbs.converting import check_target
from barpc.verbs.images import place_of
from barpc.verbs.options import OptionsLike, run_options
from barpc.verbs.points import terrain_of

if TYPE_CHECKING:
    from typing import Unpack

    from barpc.base.keywords import PathLike, RefitKeywords

_MOSAIC_GRID = (20, 20, 10)  # three swaths, 250 km: coarser grids cost a third of the accuracy


@dataclass(frozen=True)
class Fitted:
    """A fit as its file holds it, the tolerance [px] asked for, whether it was written, and doubts on its camera."""

    fit: RpcFit
    tolerance: float
    written: bool = False
    doubts: tuple[Doubt, ...] = ()

    @property
    def fault(self) -> str:
        """Reason why it is not written: the fit misses the tolerance, or its camera is not its image's; else empty."""
        return self.fit.verdict(self.tolerance) or "; ".join(one.sentence for one in self.doubts)

    @property
    def verdict(self) -> str:
        """Its fault, or the model that few points carry; empty without either."""
        return self.fault or self.fit.few


def fit(
    source: ImageLike | SensorModel,
    output: PathLike | None = None,
    options: OptionsLike | FitOptions = None,
    *,
    progress: Progress | None = None,
    **keywords: Unpack[RefitKeywords],
) -> RpcFit:
    """Fit an RPC to a camera or to points, and certify it on points that the fit has not seen.

    Parameters
    ----------
    source : path, open rasterio dataset, View, Camera, or a SensorModel that has a size
        A camera (see `barpc.open_camera`), a table of points (CSV, npz, GeoJSON), or an image with GCPs and no RPC.
    output : path, optional, where to write; the name chooses the format. Without: measure only
    options : FitOptions, RunOptions, mapping or path of a TOML file, optional
    progress : callable, optional, `progress(stage, done, total)`
    **keywords : fields of `FitOptions` and of `RefitOptions`: alt_range, dem, dem_margin, geoid,
        keep_going, overwrite

    Returns
    -------
    RpcFit, as the file holds it: `rpc`, `rmse_ckp` and `max_ckp` [px], `verdict(tolerance)`

    Raises
    ------
    FitError
        The RPC misses the tolerance, or its camera may be another image's, and nothing is written; with `keep_going`,
        or without `output`, it is returned.
    InputError, OutputError
        See `barpc.base.errors`.

    Examples
    --------
    >>> found = barpc.fit("data_samples/view_00.tif", "fitted_RPC.TXT", alt_range=(0, 400))
    >>> bool(found.max_ckp.max() < 0.01), found.rpc == barpc.read_rpc("fitted_RPC.TXT")
    (True, True)
    """
    done = fitted(source, None if output is None else os.fspath(output), options, keywords, progress)
    if output is not None and not done.written:
        raise FitError(f"{done.verdict}; nothing written (keep_going=True writes it all the same)")
    return done.fit


def fitted(
    source: ImageLike | SensorModel,
    output: str | None,
    options: OptionsLike | FitOptions,
    keywords: Mapping[str, Any],
    progress: Progress | None = None,
) -> Fitted:
    """Return the fit of a source, written where it meets its tolerance or is to `keep_going`."""
    own = declared(RefitOptions)
    choices = RefitOptions(**{name: value for name, value in keywords.items() if name in own})
    more, tell = {name: value for name, value in keywords.items() if name not in own}, progress or (lambda *_: None)
    if isinstance(options, FitOptions):
        options = replace(RunOptions(), fit=options)
    of_fit = run_options(options, **more).fit
    source = file_of(source)
    if output is not None:
        check_target(output, [place_of(source)], choices.overwrite)
    tell("fit", 0, 1)
    found, size, doubts = _fit_source(source, of_fit, choices)
    tell("fit", 1, 1)
    done = Fitted(found, of_fit.tolerance, doubts=doubts)
    if output is None or (done.fault and not choices.keep_going):
        return done
    return _write_rpc_file(done, os.fspath(place_of(source)), output, choices, size)


def _fit_source(
    source: ImageLike | SensorModel, options: FitOptions, choices: RefitOptions
) -> tuple[RpcFit, tuple[int, int] | None, tuple[Doubt, ...]]:
    """Return the fit, the image's width and height, if known, and the doubts on its camera."""
    spec = os.fspath(source) if isinstance(source, (str, os.PathLike)) else ""
    points, size = read_points(spec) if spec else (None, None)
    if points is not None:
        if points.note:
            warnings.warn(points.note, Remark, stacklevel=5)
        if (alt := points.ground[:, 2]).min() == alt.max():
            flat = f"all points are at {alt[0]:g} m"
            valid = f"{flat}: the RPC has no terms in height and is valid at that altitude only"
            warnings.warn(valid, Remark, stacklevel=5)
        ground, image, sigma = points.ground, points.image, points.sigma
        return fit_rpc_points(ground, image, sigma=sigma, size=size, options=options, strict=False), size, ()
    camera = open_camera(source)
    camera.require_usable(place_of(source))
    if spec and split_spec(spec)[1].get("swath", "").lower() == "mosaic" and options.grid == FitOptions().grid:
        options = replace(options, grid=_MOSAIC_GRID)
    return _refit_camera(camera, options, choices), camera.size, camera.doubts


def _refit_camera(camera: Camera, options: FitOptions, choices: RefitOptions) -> RpcFit:
    """Return the fit of a camera over the altitudes given, of a DEM, of all ground on Earth, or its own."""
    low, high = camera.alt_range
    if choices.alt_range is not None:
        low, high = choices.alt_range
    elif (terrain := terrain_of(choices.dem, choices.geoid)) is not None:
        low, high = terrain_range(camera.model, camera.extent, (low, high), terrain.covering, choices.dem_margin)
    elif all_ground := getattr(camera.model, "all_ground", None):
        found = fit_rpc(camera.model, camera.extent, all_ground, options=options, strict=False)
        if not found.verdict(options.tolerance):
            return found
        over = f"fitted over the scene's altitudes, {low:g} to {high:g} m"
        warnings.warn(f"no RPC represents all altitudes on Earth here: {over}", Remark, stacklevel=6)
    return fit_rpc(camera.model, camera.extent, (low, high), options=options, strict=False)


class _Missed(Exception):  # noqa: N818 - it never leaves this page
    """The written file does not reproduce the fit: it is removed."""


def _write_rpc_file(
    done: Fitted, source: str, output: str, choices: RefitOptions, size: tuple[int, int] | None
) -> Fitted:
    """Write the RPC and read it back: the fit as its file holds it, and whether it stays there (within a tolerance)."""
    with suppress(_Missed), replacing(output, overwrite=choices.overwrite) as partial:
        write_camera(done.fit.rpc, partial, source, place=output, overwrite=True, size=size)
        done = replace(done, fit=done.fit.as_written(read_rpc(partial)))
        if done.fault and not choices.keep_going:
            raise _Missed
        done = replace(done, written=True)
    return done
