"""Write the list of limits of docs/reliability.md from the constants of the code.

python docs/generate_limits.py            # writes it
python docs/generate_limits.py --print    # prints it
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from barpc import scene
from barpc.base import declarations, frozen, geodesy, options, safe_io
from barpc.base.remote import _CACHE_BYTES as HELD
from barpc.base.remote import _MAX_REQUEST_BYTES as REQUEST
from barpc.base.remote import REQUEST_BYTES, hosts
from barpc.pointio import names, third_party_matches
from barpc.rasters import dem, raster
from barpc.report import runfiles
from barpc.rpcio import images
from barpc.sensor import document as metadata
from barpc.sensor import sicd
from barpc.tie.pairing import area

PAGE = Path(__file__).with_name("reliability.md")
BEGIN = "<!-- Limits: written by docs/generate_limits.py. Edit the constants beside the readers, then run it again. -->"
END = "<!-- End of the limits. -->"


def size(value: int | None) -> str:
    """Bytes, in the largest unit that leaves a whole number."""
    assert value is not None
    for power, unit in ((30, "GiB"), (20, "MiB"), (10, "KiB")):
        if value >= 1 << power and value % (1 << power) == 0:
            return f"{value >> power} {unit}"
    return f"{value} bytes"


def many(value: float) -> str:
    """A number: counts with commas, sizes of numbers in powers of ten."""
    return f"{value:,}" if isinstance(value, int) else re.sub(r"e([+-])0*", r"e\1", f"{value:g}").replace("e+", "e")


def rows() -> list[tuple[str, str]]:
    """What is read, and what of it is refused beyond."""
    bounded = (safe_io.RPC_FILE, safe_io.GEOJSON, safe_io.OPTIONS, safe_io.CALIBRATION, safe_io.SUMMARY)
    unpacked = f"packed, unpacked, and as numbers of {safe_io.BYTES_PER_NUMBER} bytes"
    return [
        *((kind.words, size(kind.most)) for kind in bounded),
        (
            safe_io.XML.words,
            f"{size(safe_io.XML.most)}, {safe_io.MAX_DEPTH} levels, {many(safe_io.MAX_ELEMENTS)} elements",
        ),
        (
            safe_io.TABLE.words,
            f"{size(safe_io.TABLE.most)}, {many(safe_io.TABLE.lines or 0)} lines, "
            f"a line {size(safe_io.MAX_LINE_BYTES)}",
        ),
        (
            "JSON",
            f"{safe_io.MAX_DEPTH} levels, {many(safe_io.GEOJSON.values)} values, of a summary "
            f"{many(safe_io.SUMMARY.values)}",
        ),
        ("a key of TOML", f"{options._PARTS} parts"),
        (
            f"{safe_io.ARRAYS.words} (`.npz`)",
            f"{size(safe_io.ARRAYS.most)} {unpacked}; a member {many(frozen.DEFLATED)} times its stored bytes",
        ),
        (
            third_party_matches._CONTENT.words,
            f"{size(third_party_matches._CONTENT.most)} as numbers of {safe_io.BYTES_PER_NUMBER} bytes",
        ),
        ("a COLMAP database", f"{many(third_party_matches._MAX_SQLITE_STEPS)} times 100,000 instructions of SQLite"),
        (
            "an HDF5 file",
            f"{many(safe_io.MAX_ELEMENTS)} objects, groups {safe_io.MAX_DEPTH} deep; an array "
            f"{many(frozen.DEFLATED)} times its stored bytes",
        ),
        (
            "a localisation or correction grid",
            f"{size(safe_io.TABLE.most)} as numbers of {safe_io.BYTES_PER_NUMBER} bytes",
        ),
        (safe_io.NAMES.words, f"{size(safe_io.NAMES.most)}, {many(safe_io._MAX_NAME_LENGTH)} characters a line"),
        ("a VRT", size(safe_io.MB)),
        ("a raster read as a DEM or geoid", f"{many(dem._MAX_CELLS)} cells"),
        ("RPC tags of a TIFF", f"{many(images._MAX_ENTRIES)} entries, {size(images.SCANNED)} of values"),
        ("an RPC in a NITF", f"the first {size(images.SCANNED)}"),
        ("a file of acquisition metadata", f"the first {size(images.SCANNED)}"),
        ("a run's state", f"{size(safe_io.MAX_XML)}; larger ones count as missing"),
        (
            "a file of a web server or store",
            f"{size(REQUEST_BYTES)} to {size(REQUEST)} a request, {size(HELD)} held a process",
        ),
        (
            "an answer of a web server",
            f"{hosts.TIMEOUT:g} s, and 1 s for {hosts._SLOWEST:,} bytes; {hosts._MOVES} redirects; "
            f"{size(hosts._EXTRA)} beside the data",
        ),
        ("rasters open at a time", many(raster.GDAL_OPTIONS["GDAL_MAX_DATASET_POOL_SIZE"])),
        ("an image of a product's metadata", f"{many(metadata.MOST_PIXELS)} rows or columns"),
        ("a polynomial of a SICD", f"degree {sicd._ORDER}"),
        ("a name of an image", f"{names.MAX_NAME} bytes"),
        ("control points of a fit", many(options.MOST_POINTS)),
        ("an area", f"{many(area._MOST_CROSSED)} times that its outline crosses itself"),
        (
            "numbers of JSON and `block.npz`",
            f"{many(safe_io.MAX_NUMBER)}; whole ones of JSON {safe_io.MAX_DIGITS} digits",
        ),
        (
            "numbers of options",
            f"{many(1 / declarations._REAL)} to {many(declarations._REAL)}, and 0; "
            f"whole ones below {many(declarations._MAX_EXACT_INTEGER)}",
        ),
        ("numbers of metadata of a camera", many(geodesy.MAX_COORDINATE)),
        (
            "points of a fit, of a table, of a grid",
            f"{many(geodesy.MAX_COORDINATE)} px",
        ),
        ("numbers of a run's tables", many(runfiles._MAX_TABLE_VALUE)),
        ("coordinates of a DEM", many(geodesy.MAX_COORDINATE)),
        ("standard deviations of ground points", " to ".join(map(many, scene.SIGMA_RANGE))),
    ]


def table() -> str:
    """Return the list between its marks."""
    lines = [f"- {what}: {limit}" for what, limit in rows()]
    return "\n".join([BEGIN, "", *lines, "", END])


def page(text: str) -> str:
    """Return the page with the list in its place; ValueError where it has none."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{PAGE}: no place for the limits")
    return before + table() + after


def main() -> None:
    """Write or print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--print", action="store_true", dest="show", help="print instead of writing")
    if parser.parse_args().show:
        print(table())
    else:
        PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
