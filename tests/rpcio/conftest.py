"""An RPC with every coefficient at work, an image to carry it, and the files of every dialect."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rasterio.shutil import copy as raster_copy

from barpc.cli import main
from barpc.rasters.raster import open_raster
from barpc.rpcio.formats import FORMATS
from barpc.rpcio.text import COEFFICIENTS, OFFSETS, SCALES, SINGLE, fields_from_rpc
from barpc.rpcio.xml import rpc_items
from barpc.sensor.rpc import RPC
from tests import geotiffs


def rpc_domain(rpc: RPC) -> str:
    """The element of GDAL's metadata domain."""
    rows = "".join(f'<MDI key="{key}">{value}</MDI>\n' for key, value in rpc_items(rpc).items())
    return f'<Metadata domain="RPC">\n{rows}</Metadata>'


def make_rpc(lon: float = 5.4, lat: float = 43.2, **changes: float | None) -> RPC:
    """25 degrees off nadir, GSD near 0.5 m; every number but the offsets and scales with all its digits."""
    rng = np.random.default_rng(3)
    coeffs = rng.normal(0, 2e-6, (4, 20))
    coeffs[0, :4] += [1e-3, 1.0, 0.02, -0.11]
    coeffs[2, :4] += [-2e-3, 0.03, -1.0, 0.07]
    coeffs[1::2, 0] = 1.0
    errors = {"err_bias": 3.1, "err_rand": 0.7} | changes
    return RPC(coeffs, [lon, lat, 166.6667], [0.0062, 0.0045, 142.8571], [999.1, 950.7], [1010.3, 980.9], **errors)


WRITABLE = [row for row in FORMATS.values() if row.write is not None]
each_written = pytest.mark.parametrize("row", WRITABLE, ids=lambda row: row.name)


@pytest.fixture
def rpc() -> RPC:
    return make_rpc()


def write_image(path: Path, shape: tuple[int, int, int] = (1, 40, 60), **profile: object) -> Path:
    """A raster of known pixels; keywords go to rasterio."""
    data = np.random.default_rng(5).integers(0, 60000, shape).astype(profile.pop("dtype", "uint16"))
    return geotiffs.write_image(path, data, **profile)


def ended(*words: object) -> int:
    """The code with which a command line ends."""
    with pytest.raises(SystemExit) as stop:
        main([*map(str, words)])
    return int(stop.value.code or 0)


def pixels(path: Path) -> np.ndarray:
    with open_raster(path) as dataset:
        return np.asarray(dataset.read())


def nitf_record(rpc: RPC) -> str:
    """The record of RPC00B (STDI-0002) of numbers that it holds; an unknown accuracy is zero."""
    fields = fields_from_rpc(rpc)
    axes = "+08.4f", "+09.4f", "+05.0f"  # lat, lon, height
    layouts = "07.2f", "07.2f", "06.0f", "05.0f", *axes, "06.0f", "05.0f", *axes
    cells = [format(fields.get(key, [0.0])[0], layout) for key, layout in zip(SINGLE, layouts, strict=True)]
    halves = [f"{value:+.6E}".split("E") for key in COEFFICIENTS for value in fields[key]]
    return "1" + "".join(cells) + "".join(f"{mantissa}E{int(power):+d}" for mantissa, power in halves)


def write_nitf(rpc: RPC, image: Path, path: Path) -> None:
    """A NITF with an RPC and the pixels of an image, by GDAL."""
    with open_raster(image) as dataset:
        raster_copy(dataset, str(path), driver="NITF", TRE=f"RPC00B={nitf_record(rpc)}")
    path.with_name(f"{path.name}.aux.xml").unlink(missing_ok=True)


@pytest.fixture
def image(tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    return write_image(tmp_path / "in" / "scene.tif")


def grid(rpc: RPC) -> np.ndarray:
    """Ground points over an RPC's box (N, 3)."""
    t = np.linspace(-1, 1, 7)
    return np.stack(np.meshgrid(t, t, t), axis=-1).reshape(-1, 3) * rpc.ground_scale + rpc.ground_offset


A_ORDER = "1 L P H LP LH PH LPH LL PP HH LLL LLP LLH LPP PPP PPH LHH PHH HHH"
"""STDI-0002, table 8-1 (RPC00A)."""
B_ORDER = "1 L P H LP LH PH LL PP HH PLH LLL LPP LHH LLP PPP PHH LLH PPH HHH"


def polynomials(rpc: RPC, ground: np.ndarray, order: str = B_ORDER) -> np.ndarray:
    """The four polynomials (4, N) at ground points (N, 3), an RPC's numbers summed in an order that is written out."""
    L, P, H = ((ground - rpc.ground_offset) / rpc.ground_scale).T
    value = {"1": np.ones(len(ground)), "L": L, "P": P, "H": H}
    return rpc.coeffs @ np.array([np.prod([value[letter] for letter in word], axis=0) for word in order.split()])


def in_order(rpc: RPC, ground: np.ndarray, order: str = B_ORDER) -> np.ndarray:
    """Image points (N, 2) by these polynomials."""
    col, col_den, row, row_den = polynomials(rpc, ground, order)
    return np.column_stack([col / col_den, row / row_den]) * rpc.image_scale + rpc.image_offset


def _numbered(name: str, values: list[float]) -> str:
    return "".join(f"<{name}_{i}>{value!r}</{name}_{i}>" for i, value in enumerate(values, 1))


def dimap_v2(rpc: RPC) -> str:
    """Pleiades' XML: 1-based offsets, and a direct model that is somebody else's."""
    fields = fields_from_rpc(rpc)
    model = "".join(_numbered(key, fields[key]) for key in COEFFICIENTS)
    shift = {"LINE_OFF": 1, "SAMP_OFF": 1}
    validity = "".join(f"<{k}>{fields[k][0] + shift.get(k, 0)!r}</{k}>" for k in OFFSETS + SCALES)
    direct = "".join(_numbered(key, [7.5] * 20) for key in COEFFICIENTS)
    return (
        '<?xml version="1.0" encoding="UTF-8"?><Dimap_Document><Rational_Function_Model><Global_RFM>'
        f"<Direct_Model>{direct}</Direct_Model><Inverse_Model>{model}<ERR_BIAS_ROW>0.001</ERR_BIAS_ROW>"
        f"</Inverse_Model><RFM_Validity>{validity}</RFM_Validity></Global_RFM>"
        "</Rational_Function_Model></Dimap_Document>"
    )


def dimap_v3(rpc: RPC) -> str:
    """Pleiades Neo's XML: 0-based offsets, other names."""
    fields = fields_from_rpc(rpc)
    model = "".join(_numbered(key, fields[key]) for key in COEFFICIENTS)
    validity = "".join(f"<{k}>{fields[k][0]!r}</{k}>" for k in OFFSETS + SCALES)
    return (
        "<Dimap_Document><Rational_Function_Model><Global_RFM>"
        f"<GroundtoImage_Values>{model}</GroundtoImage_Values><RFM_Validity>"
        "<ImagetoGround_Validity_Domain><FIRST_COL>4901</FIRST_COL></ImagetoGround_Validity_Domain>"
        f"{validity}</RFM_Validity></Global_RFM></Rational_Function_Model></Dimap_Document>"
    )


def dimap_v1(rpc: RPC) -> str:
    """The first DIMAP: forty numbers an element, A and B by axis."""
    fields = fields_from_rpc(rpc)
    lists = {
        axis: " ".join(repr(v) for part in ("NUM", "DEN") for v in fields[f"{name}_{part}_COEFF"])
        for axis, name in (("ROW", "LINE"), ("COL", "SAMP"))
    }
    axes = {"Lon": "LONG", "Lat": "LAT", "Alt": "HEIGHT", "Col": "SAMP", "Row": "LINE"}
    validity = "".join(
        f"<{axis}><A>{fields[f'{name}_SCALE'][0]!r}</A>"
        f"<B>{fields[f'{name}_OFF'][0] + (axis in ('Col', 'Row'))!r}</B></{axis}>"
        for axis, name in axes.items()
    )
    return (
        f"<Dimap><Global_RFM><F_COL>{lists['COL']}</F_COL><F_ROW>{lists['ROW']}</F_ROW>"
        f"<RFM_Validity>{validity}</RFM_Validity></Global_RFM></Dimap>"
    )


def enmap(rpc: RPC) -> str:
    """EnMAP's metadata: one RPC a band, here the second; the first is shifted by a hundred rows."""
    bands = ""
    for band, offset in ((1, 100.0), (2, 0.0)):
        fields = fields_from_rpc(rpc)
        fields["LINE_OFF"] = [fields["LINE_OFF"][0] + offset]
        rename = {"LINE": "ROW", "SAMP": "COL"}
        items = ""
        for key in OFFSETS + SCALES:
            axis, _, kind = key.partition("_")
            items += f"<{rename.get(axis, axis)}_{kind}>{fields[key][0]!r}</{rename.get(axis, axis)}_{kind}>"
        for key in COEFFICIENTS:
            axis, part, _ = key.split("_")
            items += _numbered(f"{rename[axis]}_{part}", fields[key])
        bands += f'<bandID number="{band}">{items}</bandID>'
    return f"<level_X><product><navigation><RPC>{bands}</RPC></navigation></product></level_X>"


def alos() -> str:
    """Columns of an ALOS scene: offsets that fill them, scales, four times twenty coefficients."""
    offsets = ["006500", "03550", "-35.6812", "-139.7671", "00500"]
    scales = ["006501", "03551", "0.3000", "0.3500", "0510"]
    head = (f"{cell:>{width}}" for cell, width in zip(offsets + scales, 2 * (6, 5, 8, 9, 5), strict=True))
    numbers = (f"{value:+.5f}E-{i}" for value in (1.25, 2.25, 3.25, 4.25) for i in [*range(10)] * 2)
    return "".join([*head, *(f"{number:>12}" for number in numbers)])


def yaml(rpc: RPC) -> str:
    """What orthority writes."""
    fields = {key.lower(): values for key, values in fields_from_rpc(rpc).items()}
    lines = ["scene.tif:", "    im_size: [60, 40]", "    rpc:"]
    for key, values in fields.items():
        if len(values) == 1:
            lines.append(f"        {key}: {values[0]!r}")
        else:
            first, rest = ", ".join(map(repr, values[:9])), ", ".join(map(repr, values[9:]))
            lines.append(f"        {key}: [{first},\n            {rest}]")
    return "\n".join(lines) + "\n"


def envi(rpc: RPC) -> str:
    """A header as GDAL and ENVI write it."""
    fields = fields_from_rpc(rpc)
    values = [v for key in (*OFFSETS, *SCALES, *COEFFICIENTS) for v in fields[key]] + [0, 0, 1]
    lines = [", ".join(map(repr, values[i : i + 4])) for i in range(0, 93, 4)]
    return "ENVI\nsamples = 60\nlines = 40\nrpc info = {\n  " + ",\n  ".join(lines) + "}\nbyte order = 0\n"


DIALECTS = {
    "dimap v1": dimap_v1,
    "dimap v2": dimap_v2,
    "dimap v3": dimap_v3,
    "enmap": enmap,
    "yaml": yaml,
    "envi": envi,
}
"""Format, and which of its dialects, of those that are only read -> who writes it."""
