"""VRTs: the closed grammar, and pixels that are those of GDAL's own reading."""

from __future__ import annotations

import os
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from barpc.base.errors import ImageError
from barpc.rasters.raster import open_raster
from barpc.rasters.vrt import GDAL_TYPES
from barpc.rpcio import read_rpc_source, write_crop, write_rpc_copy, write_rpc_vrt
from tests.rpcio.conftest import make_rpc, rpc_domain

SIZE = (40, 30)
RNG = np.random.default_rng(3)


@pytest.fixture(autouse=True)
def _no_georeference():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


def raster(path: Path, dtype: str = "uint16", bands: int = 1, mask: bool = False, **profile: object) -> Path:
    """Numbers over the whole range of a type."""
    if dtype.startswith("complex"):
        data = RNG.normal(0, 900, (bands, SIZE[1], SIZE[0])) + 1j * RNG.normal(0, 900, (bands, SIZE[1], SIZE[0]))
        data = np.rint(data) if dtype == "complex_int16" else data
    elif dtype.startswith("float"):
        data = RNG.normal(0, 40000, (bands, SIZE[1], SIZE[0]))
        data.flat[::7], data.flat[3], data.flat[4], data.flat[5] = 12.5, np.nan, np.inf, -np.inf
    else:
        limits = np.iinfo(dtype)
        data = RNG.integers(limits.min, limits.max, (bands, SIZE[1], SIZE[0]), dtype=dtype, endpoint=True)
        data.flat[::7] = 12
    shape = {"width": SIZE[0], "height": SIZE[1], "count": bands, "dtype": dtype}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", driver="GTiff", **shape, **profile) as out,
    ):
        out.write(data.astype("complex64" if dtype == "complex_int16" else dtype))
        if mask:
            out.write_mask(RNG.uniform(size=SIZE[::-1]) > 0.4)
    return path


def source(file: object, *more: str, band: object = 1, kind: str = "SimpleSource", relative: int = 1) -> str:
    return (
        f'<{kind}><SourceFilename relativeToVRT="{relative}" shared="1">{file}</SourceFilename>'
        f"<SourceBand>{band}</SourceBand>{''.join(more)}</{kind}>"
    )


def rects(src: tuple, dst: tuple) -> str:
    return "".join(
        '<{} xOff="{}" yOff="{}" xSize="{}" ySize="{}"/>'.format(tag, *r)
        for tag, r in (("SrcRect", src), ("DstRect", dst))
    )


def scaling(offset: float, ratio: float) -> str:
    return f"<ScaleOffset>{offset}</ScaleOffset><ScaleRatio>{ratio}</ScaleRatio>"


def band(*body: str, dtype: str = "uint16", number: int = 1) -> str:
    attributes = f'dataType="{GDAL_TYPES[dtype]}" band="{number}" blockXSize="16"'
    return f"<VRTRasterBand {attributes}>{''.join(body)}</VRTRasterBand>"


def vrt(path: Path, *body: str, size: tuple[int, int] = SIZE) -> Path:
    path.write_text(f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">{"".join(body)}</VRTDataset>')
    return path


def assert_as_gdal(path: Path) -> None:
    """Pixels, masks and what goes with them, of the whole and of a window."""
    with rasterio.open(path) as by_gdal, open_raster(path) as ours:
        for name in ("shape", "count", "dtypes", "crs", "transform", "bounds", "colorinterp"):
            assert getattr(ours, name) == getattr(by_gdal, name), name
        np.testing.assert_array_equal(np.array(ours.nodatavals, float), np.array(by_gdal.nodatavals, float))
        assert ours.tags() == by_gdal.tags()
        for window in (None, Window(3, 2, 8, 6), Window(0, 0, 1, 1)):
            expected = by_gdal.read(window=window)
            found = ours.read(window=window)
            assert found.dtype == expected.dtype
            np.testing.assert_array_equal(found, expected)
            for i in by_gdal.indexes:
                np.testing.assert_array_equal(ours.read(i, window=window), by_gdal.read(i, window=window))
                np.testing.assert_array_equal(ours.read_masks(i, window=window), by_gdal.read_masks(i, window=window))
            masked = ours.read(1, window=window, masked=True), by_gdal.read(1, window=window, masked=True)
            np.testing.assert_array_equal(*(m.filled(0) for m in masked))
            np.testing.assert_array_equal(*(np.ma.getmaskarray(m) for m in masked))


@pytest.mark.few(5)
@pytest.mark.parametrize("dtype", GDAL_TYPES)
def test_a_vrt_by_gdal_reads_as_gdal_reads_it(tmp_path: Path, dtype: str) -> None:
    nodata = {} if dtype.startswith("complex") else {"nodata": 12}
    raster(tmp_path / "a.tif", dtype, 2, transform=rasterio.Affine(2, 0, 7, 0, -2, 9), crs=32631, **nodata)
    with (
        rasterio.open(tmp_path / "a.tif") as image,
        rasterio.open(tmp_path / "tagged.tif", "w", **image.profile, rpcs=None) as out,
    ):
        out.update_tags(NAME="x & <y>")
        out.write(image.read())
    for name in ("a", "tagged"):
        rasterio.shutil.copy(tmp_path / f"{name}.tif", tmp_path / f"{name}.vrt", driver="VRT")
        assert_as_gdal(tmp_path / f"{name}.vrt")


PARTS = rects((0, 0, 25, 30), (0, 0, 25, 30)), rects((5, 0, 20, 25), (20, 5, 20, 25))
BODIES = {
    "a window": lambda: vrt_size((12, 9), band(source("a.tif", rects((20, 15, 12, 9), (0, 0, 12, 9))))),
    "two that overlap": lambda: band(source("a.tif", PARTS[0]), source("b.tif", PARTS[1])),
    "nothing in part": lambda: band(
        "<NoDataValue>77</NoDataValue>", source("a.tif", rects((0, 0, 9, 9), (30, 25, 9, 9)))
    ),
    "beyond the source": lambda: band(source("a.tif", rects((35, 25, 10, 10), (2, 3, 10, 10)))),
    "a rounded offset": lambda: band(source("a.tif", rects((0, 0, 20, 20), (4.0000000001, 6, 20, 20)))),
    "hidden nodata": lambda: band("<NoDataValue>12</NoDataValue><HideNoDataValue>1</HideNoDataValue>", source("a.tif")),
    "nodata of the source": lambda: band(
        "<NoDataValue>9</NoDataValue>",
        source("b.tif"), source("a.tif", "<NODATA>12</NODATA>", kind="ComplexSource"),
    ),
    "scaled": lambda: band(
        source("a.tif", scaling(0.25, 0.00390625), kind="ComplexSource"), dtype="uint8"
    ),
    "scaled to float": lambda: band(
        source("a.tif", scaling(-3.7, 0.1), kind="ComplexSource"), dtype="float32"
    ),
    "doubled": lambda: band(source("a.tif", scaling(0.0, 2.0), kind="ComplexSource")),
    "scaled beyond the range": lambda: band(
        source("f.tif", "<ScaleRatio>2.5</ScaleRatio><NODATA>12.5</NODATA>", kind="ComplexSource"), dtype="int16"
    ),
    "scaled in 32 bits": lambda: band(
        source("f.tif", "<ScaleOffset>2000000000</ScaleOffset>", kind="ComplexSource"), dtype="int32"
    ),
    "another type": lambda: band(source("f.tif"), dtype="uint8") + band(source("a.tif"), dtype="uint8", number=2),
    "wide to narrow": lambda: band(source("i.tif"), dtype="int16"),
    "whole to float": lambda: band(source("i.tif"), dtype="float32"),
    "a mask": lambda: band(source("m.tif")) + f"<MaskBand>{mask_of('m.tif')}</MaskBand>",
    "a mask in part": lambda: band(source("m.tif")) + f"<MaskBand>{mask_of('m.tif', *PARTS[:1])}</MaskBand>",
    "a mask as values": lambda: band(source("m.tif", band="mask,1"), dtype="uint8"),
    "alpha": lambda: band("<ColorInterp>Gray</ColorInterp>", source("a.tif"), dtype="uint8")
    + band("<ColorInterp>Alpha</ColorInterp>", source("b.tif"), dtype="uint8", number=2),
    "NaN as nodata": lambda: band("<NoDataValue>nan</NoDataValue>", source("f.tif", PARTS[1]), dtype="float32"),
    "a large whole number as nodata": lambda: band(
        "<NoDataValue>100000000000000000</NoDataValue>", source("a.tif", PARTS[1]), dtype="int64"
    ),
    "all that is passed over": lambda: (
        '<SRS dataAxisToSRSAxisMapping="2,1">EPSG:4326</SRS><GeoTransform> 5, 1e-3, 0.0, 44, 0, -1E-3</GeoTransform>'
        '<Metadata><MDI key="a">b</MDI></Metadata><Metadata domain="xml:X"><MDI key="y"/></Metadata>'
        '<OverviewList resampling="nearest">2 4</OverviewList>'
        + band(
            "<Description>d</Description><UnitType>m</UnitType><Offset>1</Offset><Scale>2</Scale>"
            '<ColorTable><Entry c1="1" c2="2" c3="3" c4="255"/></ColorTable>'
            "<CategoryNames><Category>x</Category></CategoryNames><Histograms><HistItem><HistMin>-0.5</HistMin>"
            "<HistMax>1</HistMax><BucketCount>2</BucketCount><IncludeOutOfRange>0</IncludeOutOfRange>"
            "<Approximate>0</Approximate><HistCounts>1|2</HistCounts></HistItem></Histograms>",
            source("a.tif", '<SourceProperties RasterXSize="40" RasterYSize="30" DataType="UInt16" BlockXSize="40" '
            'BlockYSize="30"/>')
            .replace("<SimpleSource", '<SimpleSource resampling="bilinear"'),
            dtype="uint8",
        )
    ),
}  # fmt: skip


def mask_of(file: str, *more: str) -> str:
    return band(source(file, *more, band="mask,1"), dtype="uint8").replace(' band="1"', "")


def vrt_size(size: tuple[int, int], body: str) -> tuple[tuple[int, int], str]:
    return size, body


@pytest.mark.few(8)
@pytest.mark.parametrize("name", BODIES)
def test_a_vrt_reads_as_gdal_reads_it(tmp_path: Path, name: str) -> None:
    raster(tmp_path / "a.tif")
    raster(tmp_path / "b.tif")
    raster(tmp_path / "m.tif", mask=True)
    raster(tmp_path / "f.tif", "float32")
    raster(tmp_path / "i.tif", "int32")
    body = BODIES[name]()
    size, body = body if isinstance(body, tuple) else (SIZE, body)
    path, again = vrt(tmp_path / "x.vrt", body, size=size), tmp_path / "far" / "again.vrt"
    assert_as_gdal(path)
    write_rpc_vrt(make_rpc(), path, again)
    with open_raster(path) as first, open_raster(again) as second, rasterio.open(again) as by_gdal:
        np.testing.assert_array_equal(second.read(), first.read())
        np.testing.assert_array_equal(by_gdal.read(), first.read())
        np.testing.assert_array_equal(by_gdal.read_masks(), [first.read_masks(i) for i in first.indexes])
        assert (second.nodatavals, second.colorinterp) == (
            pytest.approx(first.nodatavals, nan_ok=True),
            first.colorinterp,
        )
        assert (by_gdal.crs, by_gdal.transform) == (first.crs, first.transform)
        assert by_gdal.rpcs is not None


def test_a_linked_vrt_finds_its_sources_where_gdal_does(tmp_path: Path) -> None:
    raster(tmp_path / "a.tif")
    (tmp_path / "far").mkdir()
    raster(tmp_path / "far" / "a.tif")
    vrt(tmp_path / "x.vrt", band(source("a.tif")))
    (tmp_path / "far" / "x.vrt").symlink_to(tmp_path / "x.vrt")
    assert_as_gdal(tmp_path / "far" / "x.vrt")
    write_rpc_vrt(make_rpc(), tmp_path / "far" / "x.vrt", tmp_path / "far" / "again.vrt")
    assert 'relativeToVRT="1">../a.tif<' in (tmp_path / "far" / "again.vrt").read_text()


@pytest.mark.parametrize("name", ["a?if=VRT.tif", "a?b&c.tif", "%61.tif", "'a'.tif", "<a>.tif", "à.tif"])
def test_a_source_has_any_name_that_a_file_has(tmp_path: Path, name: str) -> None:
    raster(tmp_path / "a.tif")
    raster(tmp_path / name)
    text = name.replace("&", "&amp;").replace("<", "&lt;")
    assert_as_gdal(vrt(tmp_path / "x.vrt", band(source(text))))


def test_vrts_of_raw_pixels_are_read_in_turn(tmp_path: Path) -> None:
    """GDAL finds the header of one where it may look beside all files: not beside those of the other."""
    raster(tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as image:
        pixels = image.read(1)
    pixels.tofile(tmp_path / "raw.img")
    lines = f"samples = {SIZE[0]}\nlines = {SIZE[1]}\nbands = 1\nheader offset = 0\ndata type = 12\nbyte order = 0"
    (tmp_path / "raw.hdr").write_text(f"ENVI\n{lines}\ninterleave = bsq\n")
    with rasterio.open(
        tmp_path / "a.tif.msk", "w", driver="GTiff", **dict.fromkeys(("width", "height"), 9), count=1, dtype="uint8"
    ) as beside:
        beside.update_tags(INTERNAL_MASK_FLAGS_1="2")
    masked = f"<MaskBand>{mask_of('a.tif')}</MaskBand>"
    paths = [vrt(tmp_path / f"{n}.vrt", band(source(n)), masked) for n in ("raw.img", "a.tif")]
    with open_raster(paths[0]) as first, open_raster(paths[1]) as second, open_raster(paths[0]) as third:
        for dataset in (first, second, third):
            np.testing.assert_array_equal(dataset.read(1), pixels)
            assert (dataset.read_masks(1) == 255).all()


def descriptors() -> int:
    folder = Path("/proc/self/fd")
    return len(list(folder.iterdir())) if folder.is_dir() else 0


def test_a_mosaic_of_many_files_does_not_keep_them_open(tmp_path: Path) -> None:
    for n in range(150):
        os.link(raster(tmp_path / "0.tif") if n == 0 else tmp_path / "0.tif", tmp_path / f"{n + 1}.tif")
    parts = [source(f"{n + 1}.tif", rects((0, 0, 1, 1), (n % 40, n // 40, 1, 1))) for n in range(150)]
    with open_raster(vrt(tmp_path / "x.vrt", band(*parts))) as mosaic:
        before = descriptors()
        pixels = mosaic.read(1)
        assert descriptors() - before <= 64
    assert (pixels.ravel()[:120] == pixels[0, 0]).all()


SIMPLE = band(source("a.tif"))
REFUSED = {
    "a source as attribute": (
        band('<SimpleSource SourceFilename="http://127.0.0.1:9/x.tif"/>'),
        "SimpleSource SourceFilename=",
    ),
    "a band that names a file": (SIMPLE.replace(' band="1"', ' SourceFilename="x"'), "VRTRasterBand SourceFilename="),
    "a mask that names a file": (SIMPLE + '<MaskBand SourceFilename="x"/>', "MaskBand SourceFilename="),
    "metadata that name a file": ('<Metadata SourceFilename="x"/>' + SIMPLE, "Metadata SourceFilename="),
    "a tag in other case": (SIMPLE.replace("SourceFilename", "sourcefilename"), "sourcefilename"),
    "an attribute in other case": (SIMPLE.replace("relativeToVRT", "relativetovrt"), "relativetovrt"),
    "a namespace": (SIMPLE.replace("<VRTRasterBand", '<VRTRasterBand xmlns="x"'), "x}VRTRasterBand"),
    "a derived band": (band("<PixelFunctionType>sum</PixelFunctionType>"), "PixelFunctionType"),
    "a class of its own": (SIMPLE.replace(" band=", ' subClass="VRTDerivedRasterBand" band='), "subClass"),
    "open options": (band(source("a.tif", '<OpenOptions><OOI key="x">y</OOI></OpenOptions>')), "OpenOptions"),
    "two sources in one": (band(source("a.tif", "<SourceFilename>b.tif</SourceFilename>")), "two <SourceFilename>"),
    "text between tags": (SIMPLE.replace("<SourceBand>", "http://x<SourceBand>"), "'http://x' in <SimpleSource>"),
    "a service as SRS": ("<SRS>http://127.0.0.1:9/x</SRS>" + SIMPLE, "'http://127.0.0.1:9/x' in <SRS>"),
    "an SRS that is none": ("<SRS>GEOGCS[nonsense]</SRS>" + SIMPLE, "reference system"),
    "overviews elsewhere": (
        band(source("a.tif"), "<Overview><SourceFilename>b.tif</SourceFilename></Overview>"),
        "Overview",
    ),
    "resampling": (band(source("a.tif", rects((0, 0, 20, 15), (0, 0, 40, 30)))), "resamples"),
    "resampling of rows": (band(source("a.tif", rects((0, 0, 20, 15), (0, 0, 20, 30)))), "resamples"),
    "resampling of columns": (band(source("a.tif", rects((0, 0, 20, 15), (0, 0, 10, 15)))), "resamples"),
    "half a pixel": (band(source("a.tif", rects((0, 0, 20, 15), (0.5, 0, 20, 15)))), "resamples"),
    "no bands": ("", "without bands"),
    "bands out of order": (band(source("a.tif"), number=2), "band 1 says that it is band 2"),
    "a type that is none": (SIMPLE.replace("UInt16", "UInt17"), "dataType='UInt17'"),
    "a band that is not there": (band(source("a.tif", band=4)), "no band 4 in"),
    "itself": (band(source("x.vrt")), "a VRT of a VRT"),
    "a pipe": (band(source("pipe")), "pipe"),
    "a service": (band(source("wms.xml")), "not a raster"),
    "a grid of text": (band(source("grid.asc")), "not a raster"),
    "a name of nothing": (band(source("")), "no plain local file"),
    "an address": (band(source("http://127.0.0.1:9/x.tif", relative=0)), "no plain local file"),
    "an address by GDAL's name": (band(source("/vsicurl/http://127.0.0.1:9/x.tif", relative=0)), "no plain local file"),
    "a path from where it runs": (band(source("a.tif", relative=0)), "no plain local file"),
    "a file that is not there": (band(source("nowhere.tif")), "no such file"),
    "options beside bands": ("<OpenOptions/>" + SIMPLE, "OpenOptions"),
    "an open tag": (SIMPLE.replace("</VRTRasterBand>", ""), "not an XML document"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_outside_the_grammar_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    raster(tmp_path / "a.tif")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "wms.xml").write_text("<GDAL_WMS/>")
    (tmp_path / "grid.asc").write_text("ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n")
    body, message = REFUSED[name]
    path = vrt(tmp_path / "x.vrt", body)
    with pytest.raises(ImageError) as caught, open_raster(path) as dataset:
        dataset.read()
    assert message in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("side", ["rasterXSize", "rasterYSize"])
def test_a_vrt_says_both_of_its_sides(tmp_path: Path, side: str) -> None:
    path = vrt(tmp_path / "x.vrt", SIMPLE)
    path.write_text(re.sub(f'{side}="[0-9]+"', "", path.read_text()))
    with pytest.raises(ImageError, match="a VRT without rasterXSize and rasterYSize"), open_raster(path):
        pass


def test_a_source_in_two_formats_is_opened_as_its_first_bytes_say(tmp_path: Path) -> None:
    """GDAL's VRT driver takes a file that says <VRTDataset anywhere in its first kilobyte."""
    inner = f'<VRTDataset rasterXSize="40" rasterYSize="30">{band(source("a.tif"))}</VRTDataset>'
    raster(tmp_path / "a.tif")
    (tmp_path / "two.ntf").write_text("NITF02.10 " + inner)
    path = vrt(tmp_path / "x.vrt", band(source("two.ntf")))
    with pytest.raises(ImageError, match="cannot be read as VRT"), open_raster(path) as dataset:
        dataset.read()


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("</VRTDataset>", "<!-- LINE_NUM_COEFF_1: 1 <LINENUMCOEF --></VRTDataset>"),
        lambda text: text.replace('domain="RPC"', "domain='RPC'"),
        lambda text: text.replace('domain="RPC"', 'domain="&#82;PC"'),
    ],
)
def test_the_rpc_of_a_vrt_is_what_its_opening_finds(tmp_path: Path, change) -> None:
    rpc = make_rpc()
    raster(tmp_path / "a.tif")
    path = vrt(tmp_path / "x.vrt", rpc_domain(rpc), SIMPLE)
    path.write_text(change(path.read_text()))
    with open_raster(path):
        found = read_rpc_source(path)
    assert (found.rpc, found.format, found.path) == (rpc, "gdal", path)
    with rasterio.open(path) as by_gdal:
        assert by_gdal.rpcs.line_num_coeff == rpc.coeffs[2].tolist()


def test_a_vrt_is_copied_cropped_and_pointed_at_with_its_pixels_and_mask(tmp_path: Path) -> None:
    rpc = make_rpc()
    raster(tmp_path / "m.tif", mask=True)
    path = vrt(tmp_path / "x.vrt", band(source("m.tif")), f"<MaskBand>{mask_of('m.tif')}</MaskBand>")
    write_rpc_copy(rpc, path, tmp_path / "copy.tif")
    write_rpc_vrt(rpc, path, tmp_path / "again.vrt")
    write_crop(rpc, path, tmp_path / "crop.tif", (3, 4, 20, 18))
    with open_raster(path) as dataset:
        pixels, mask = dataset.read(), dataset.read_masks(1)
    for name in ("copy.tif", "again.vrt"):
        with open_raster(tmp_path / name) as dataset:
            np.testing.assert_array_equal(dataset.read(), pixels)
            np.testing.assert_array_equal(dataset.read_masks(1), mask)
    with open_raster(tmp_path / "crop.tif") as dataset:
        np.testing.assert_array_equal(dataset.read(), pixels[:, 4:22, 3:23])
        np.testing.assert_array_equal(dataset.read_masks(1), mask[4:22, 3:23])
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "again.vrt", "copy.tif", "crop.tif", "m.tif", "x.vrt",
    ]  # fmt: skip
