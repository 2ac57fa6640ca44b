"""Write the tables of docs/formats.md from the tables of formats of the code.

python docs/generate_formats.py            # writes them
python docs/generate_formats.py --print    # prints them
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from barpc.pointio.columns import COLUMNS
from barpc.pointio.gcp_formats import GCP_FORMATS
from barpc.pointio.gcp_tables import KNOWN
from barpc.rasters.raster import DRIVERS, MOSAICS
from barpc.rpcio.formats import CARRIERS, FORMATS
from barpc.rpcio.sources import _RPC_READERS, _sidecar_names

PAGE = Path(__file__).with_name("formats.md")
BEGIN = "<!-- Written by docs/generate_formats.py -->"
END = "<!-- End -->"

IMAGE = "IMG_01-X_R1C1"
"""An image beside which every kind of file may stand."""
PRODUCTS = {
    "dimap": "DIMAP's `RPC_*.XML` beside `IMG_*_R1C1`",
    "alos": "ALOS' `RPC-*.txt`",
    "strip": "the strip's of a tile",
}
"""Kind of a file that is called by a product, not by its image -> in words."""
GROUPS = {
    "the point": ("id", "enable"),
    "its place": ("lon", "lat", "alt", "east", "north", "crs"),
    "the image": ("image",),
    "where it is seen": ("col", "row"),
    "sigmas [m]": ("sigma", "sigma_xy", "sigma_x", "sigma_y", "sigma_z"),
    "sigmas [px]": ("sigma_px", "sigma_col", "sigma_row"),
}
"""What the columns of a table of ground points say."""


def sources() -> list[str]:
    """Return where an image's camera comes from, in order."""
    found: dict[str, bool] = {}
    for kind, name, before in _sidecar_names(f"{IMAGE}.tif"):
        found.setdefault(PRODUCTS.get(kind, f"`{name.replace(IMAGE, 'X')}`"), before)
    last = sorted({*DRIVERS.values(), "ENVI"} - _RPC_READERS.keys() - {*MOSAICS})
    own = f"**the image's own** ({', '.join(_RPC_READERS)})"
    order = [*(name for name in found if found[name]), own, *(name for name in found if not found[name])]
    return [*order, f"what GDAL shows of {', '.join(last)}"]


def names(of: Iterable[str]) -> str:
    """Return words in backticks."""
    return ", ".join(f"`{name}`" for name in of)


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, the first row its head."""
    head, *rest = (f"|{'|'.join(row)}|" for row in rows)
    return [head, "|---" * len(rows[0]) + "|", *rest]


def formats() -> list[str]:
    """Return the rows of files with an RPC."""
    rows = [("format", "ends", "read", "written")]
    for name, row in {**FORMATS, **CARRIERS}.items():
        written = row.writes or ("yes" if row.write else "")
        rows.append((f"`{name}`", names(row.suffixes), row.reads, written))
    return table(rows)


def control() -> list[str]:
    """Return the rows of files with ground points, and of the names of their columns."""
    known = {**COLUMNS, **KNOWN}
    if sorted(known) != sorted(key for keys in GROUPS.values() for key in keys):
        raise ValueError("GROUPS does not name the columns of COLUMNS and KNOWN")
    files = [(name, row.holds, f"({row.more:g}, {row.more:g})") for name, row in GCP_FORMATS.items()]
    columns = [(what, "; ".join(names(known[key]) for key in keys)) for what, keys in GROUPS.items()]
    return [*table([("file", "holds", "first pixel's centre"), *files]), "", *table([("column", "names"), *columns])]


def tables() -> list[str]:
    """Return what stands between each pair of marks."""
    order = ", ".join(f"{n}. {name}" for n, name in enumerate(sources(), 1))
    return [f"{order}.", "\n".join(formats()), "\n".join(control())]


def page(text: str) -> str:
    """Return the page with the tables in their places; ValueError where it has not as many."""
    first, *parts = text.split(BEGIN)
    made = tables()
    if len(parts) != len(made) or not all(END in part for part in parts):
        raise ValueError(f"{PAGE}: no place for {len(made)} tables")
    return first + "".join(
        f"{BEGIN}\n\n{table}\n\n{END}{part.partition(END)[2]}" for table, part in zip(made, parts, strict=True)
    )


def main() -> None:
    """Write or print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--print", action="store_true", dest="show", help="print instead of writing")
    if parser.parse_args().show:
        print("\n\n".join(tables()))
    else:
        PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
