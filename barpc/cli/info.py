"""`barpc info`: camera and coverage of an image or RPC file."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import click

from barpc.base.verb_options import InfoOptions
from barpc.cli.flags import flags_of, given_flags
from barpc.cli.terminal import echo, wants_json
from barpc.verbs.describe import described, outlines_geojson
from barpc.verbs.images import every
from barpc.verbs.points import terrain_of


@click.command("info")
@click.argument("images", nargs=-1, metavar="IMAGE...")
@flags_of(InfoOptions)
@click.option("--footprint", "outlines", is_flag=True, help="Print outlines on the ground as GeoJSON instead.")
def info(images: tuple[str, ...], at: tuple[float, float, float] | None, outlines: bool, **flags: Any) -> int:
    r"""Print the source of a camera, its coverage and view angles; of several, each pair's angle.

    The azimuth is that of the direction from the ground to the sensor, clockwise from north. A pair's convergence
    angle is taken at the first image's centre, or at --at. An IMAGE is a file with an RPC, a Sentinel-1 or TerraSAR-X
    product or annotation, a SICD image (XML or NITF), a CSM state, or a localisation grid; choices stand behind:
    ",size=W:H" and ",camera=FILE" (all); ",first_pixel=0.5" and ",band=2" (RPC); ",swath=iw1" (or mosaic),
    ",pol=vv", ",burst=3", ",orbit=X.EOF", ",atmosphere=yes", ",bistatic=full" (Sentinel-1); ",altitudes=0:500"
    (grid, CSM).
    ",model=physical" takes the orbit and attitude in Maxar's or Airbus' XML, given or beside an image, in place of the
    RPC; with it ",aberration=no", ",refraction=no", ",band=N", ",altitudes=0:500". SPOT 1 to 5 (METADATA.DIM) need no
    choice; of 1 to 4 ",attitudes=raw".

    \b
    Examples:
      barpc info left.tif right.tif
      barpc info vendor.RPB,size=20000:19000
      barpc info --footprint scene/*.tif > footprints.geojson
    """
    if not images:
        raise click.UsageError("give at least one IMAGE")
    found, alt, terrain = every(images), flags["alt"], terrain_of(**given_flags(flags))
    if outlines:
        echo(json.dumps(outlines_geojson(found, alt, terrain)))
        return 0
    reports = described(found, at, alt, terrain)
    if wants_json():
        echo(json.dumps(reports))
    else:
        for image, report in zip(found, reports, strict=True):
            echo("\n".join([image, *(f"  {label:<13}{line}" for label, line in _labelled_sentences(report))]))
    return 0


_CENTRE_METHODS = {
    "line": "where the rays of an image line meet",
    "stated": "by its orbit",
    "nominal": "assumed, as the rays of an image line meet in no orbit",
}


def _labelled_sentences(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the label and sentence of each line on a camera."""
    is_rpc = "domain" in report
    yield "camera", f"RPC ({report['rpc'].replace(' in ', ') in ', 1)}" if is_rpc else report["rpc"]
    yield from (("note", note) for note in report["notes"])
    if "size_px" not in report:
        yield "image", "size unknown: give FILE,size=WIDTH:HEIGHT for angles and positions"
    else:
        yield "image", "{} x {} px; (0, 0) is the centre of the first pixel".format(*report["size_px"])
    yield "altitudes", "{:.5g} to {:.5g} m above the ellipsoid".format(*report["altitude_range_m"])
    if is_rpc:
        yield from _lines_of_rpc(report)
    if "problem" in report:
        yield "problem", report["problem"]
    elif "size_px" in report:
        yield from _lines_of_geometry(report)
    for pair in report.get("pairs", ()):
        angle = "with {with}: {convergence_deg:.2f} deg between the rays, B/H {b_over_h:.3f}"
        yield "pair", angle.format(**pair)


def _lines_of_rpc(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield (
        "made for",
        "lon {0[0]:.5f} to {0[1]:.5f}, lat {1[0]:.5f} to {1[1]:.5f} deg".format(*report["domain"].values()),
    )
    stated = {"common to the image": report["err_bias_m"], "of each point": report["err_rand_m"]}
    known = [f"{value:.3g} m {what}" for what, value in stated.items() if value is not None]
    yield "accuracy", ", ".join(known) or "not stated"
    least = report["smallest_denominator"]
    pole = "no pole" if least > 0 else "a pole may lie in or near these bounds"
    yield "denominators", f"at least {least:.3g} of their value at the centre: {pole}"


def _lines_of_geometry(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield (
        "centre",
        "lon {:.6f}, lat {:.6f} deg".format(*report["center_deg"]) + f" at {report['center_alt_m']:.5g} m",
    )
    yield "pixel", "{col:.3f} m a column, {row:.3f} m a row on the ground".format(**report["gsd_m"])
    yield (
        "looks",
        "{incidence_deg:.2f} deg off the vertical, from {azimuth_deg:.2f} deg (north is 0)".format(**report),
    )
    stand = report["camera_altitude_m"]
    yield "sensor", f"{stand['value'] / 1e3:.1f} km high, {_CENTRE_METHODS[stand['method']]}"
