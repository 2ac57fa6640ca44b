"""Which file of a Sentinel-1 product is taken, what its numbers become, and what is refused on the way."""

from __future__ import annotations

import zipfile
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from barpc.base.errors import BarpcWarning, InputError, RpcError, RpcFormatError
from barpc.base.geodesy import SPEED_OF_LIGHT
from barpc.cameras import open_camera
from barpc.cli import cli
from barpc.rpcio import read_rpc
from barpc.sensor.sentinel1 import (
    Annotation,
    RangeDoppler,
    SlantFrame,
    burst_rows,
    mosaic,
    mosaic_offsets,
    open_product,
    read_annotation,
)
from barpc.sensor.sentinel1.annotation import read_orbit_file
from tests.sensor.s1_product import GRD, INTERVAL, IW, LATE, SAMPLING, START, STRIPMAP, Product

XML = {name: product.xml() for name, product in IW.items()}
SHORT = {
    name: replace(product, num_bursts=2, lines_per_burst=60, burst_cycle=50, first_burst=product.first_burst / 10)
    for name, product in IW.items()
}
"""The same with few lines: it is the names of their files that matter."""


def called(swath: str, pol: str, scene: int = 4, kind: str = "slc") -> str:
    return f"s1a-{swath}-{kind}-{pol}-20210216t151207-20210216t151232-036617-044d40-00{scene}.xml"


def product_of(folder: Path, *names: str) -> Path:
    """A SAFE folder with annotations of these names; each is that of the swath it is named after."""
    (folder / "annotation").mkdir(parents=True)
    for name in names:
        swath, pol = name.split("-")[1].upper(), name.split("-")[3].upper()
        (folder / "annotation" / name).write_bytes(SHORT[swath].xml().replace(b">VV<", f">{pol}<".encode()))
    (folder / "manifest.safe").write_bytes(b"<x/>")
    return folder


def zipped(folder: Path) -> Path:
    path = folder.with_suffix(".zip")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in folder.rglob("*.xml"):
            archive.write(file, f"x.SAFE/{file.relative_to(folder)}")
    return path


@pytest.fixture(scope="module")
def first() -> Annotation:
    return read_annotation(XML["IW1"], name="iw1.xml")


# --- which file ----------------------------------------------------------------------------------------------


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("there", "taken", "given"),
    [
        (("vh", "vv"), "vv", "folder"), (("hh", "hv"), "hh", "zip"), (("hh", "vh"), "hh", "folder"),
        (("hv",), "hv", "zip"), (("vh", "hv"), "vh", "manifest"),
    ],
)  # fmt: skip
def test_of_several_polarisations_the_one_sent_and_received_alike_is_taken(tmp_path, there, taken, given):
    """Each lies in another swath here, so that one sees which it was; what is asked for goes first."""
    names = [called(f"iw{k}", pol) for k, pol in enumerate(there, 1)]
    path = product_of(tmp_path / "x.SAFE", *names)
    path = {"folder": path, "zip": zipped(path), "manifest": path / "manifest.safe"}[given]
    sizes = {pol: IW[f"IW{k}"].samples for k, pol in enumerate(there, 1)}
    assert open_product(path).size[0] == sizes[taken]
    for pol in there:
        assert open_product(path, polarisation=pol.upper()).size[0] == sizes[pol]
    with pytest.raises(
        InputError,
        match=f"no polarisation xx; choose one of {', '.join(sorted(there, key=['vv', 'hh', 'vh', 'hv'].index))}",
    ):
        open_product(path, polarisation="xx")


def test_a_swath_of_another_polarisation_is_not_there(tmp_path):
    path = product_of(tmp_path / "x.SAFE", called("iw1", "vv"), called("iw2", "vv"), called("iw3", "vh"))
    with pytest.raises(InputError, match="no swath iw3; choose one of iw1, iw2, mosaic"):
        open_product(path, swath="iw3")
    with pytest.raises(InputError, match="the product has several swaths; choose one of iw1, iw2, mosaic"):
        open_product(path)
    assert open_product(path, swath="IW3", polarisation="vh").size[0] == IW["IW3"].samples
    assert open_product(path, swath="MOSAIC").size[0] == 47000  # of two swaths
    with pytest.raises(InputError, match=r"no swath iw1; choose one of iw3$"):
        open_product(path, swath="iw1", polarisation="vh")


def test_two_images_of_one_swath_and_polarisation_are_told_apart_by_their_file(tmp_path):
    names = called("iw1", "vv", 4), called("iw1", "vv", 5), called("iw1", "vh", 6)
    path = product_of(tmp_path / "x.SAFE", *names)
    for swath in (None, "iw1", "mosaic"):
        with pytest.raises(InputError, match="several images of one swath; give the annotation XML of one"):
            open_product(path, swath=swath)
    assert open_product(path, polarisation="vh").size == open_product(path / "annotation" / names[1]).size
    (path / "annotation" / names[1]).unlink()
    assert open_product(path).size == SHORT["IW1"].model().size


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("s1d-iw1-slc-vv-1-2.xml", True),
        ("S1B-IW1-SLC-VV-1.XML", True),
        ("s1e-iw1-slc-vv-1.xml", False),
        ("s1a-iw1-raw-vv-1.xml", False),
        ("s1a-iw1-slc-rr-1.xml", False),
        ("x-s1a-iw1-slc-vv-1.xml", False),
        ("s1a-iw1-slc-vv-1.xml.bak", False),
    ],
)
def test_annotations_are_known_by_their_names(tmp_path, name, known):
    folder = tmp_path / "x.SAFE" / "annotation"
    folder.mkdir(parents=True)
    (folder / name).write_bytes(SHORT["IW1"].xml())
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr(f"x.SAFE/annotation/{name}", SHORT["IW1"].xml())
        archive.writestr(f"x.SAFE/other/{called('iw2', 'vv')}", SHORT["IW2"].xml())  # in no folder of annotations
    places = [tmp_path / "x.zip"] if name.endswith("XML") else [tmp_path / "x.zip", tmp_path / "x.SAFE"]
    for path in places:
        with nullcontext() if known else pytest.raises(RpcFormatError, match="no Sentinel-1 annotation"):
            assert open_product(path).size == SHORT["IW1"].model().size


def test_an_empty_zip_is_one_without_annotations(tmp_path):
    with zipfile.ZipFile(tmp_path / "x.zip", "w"):
        pass
    with pytest.raises(RpcFormatError, match="no Sentinel-1 annotation"):
        open_product(tmp_path / "x.zip")


def test_what_is_no_product_is_refused_by_name(tmp_path):
    with pytest.raises(RpcFormatError, match="no Sentinel-1 annotation"):
        open_product(tmp_path)
    with pytest.raises(RpcFormatError, match="no such file"):
        open_product(tmp_path / "missing.SAFE")
    (tmp_path / "broken.zip").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(RpcFormatError, match=r"broken\.zip"):
        open_product(tmp_path / "broken.zip")
    path = zipped(product_of(tmp_path / "product.SAFE", called("iw1", "vv")))
    data = bytearray(path.read_bytes())
    data[2000:2100] = bytes(100)
    path.write_bytes(data)
    with pytest.raises(RpcFormatError, match=r"product\.zip: s1a-iw1-.* cannot be read"):
        open_product(path)


def test_choices_that_a_product_has_not_are_refused(tmp_path):
    path = product_of(tmp_path / "x.SAFE", called("iw1", "vv"), called("iw2", "vv"))
    with pytest.raises(InputError, match="no burst 2, it has 2"):
        open_product(path, swath="iw1", burst=2)
    with pytest.raises(InputError, match="burst 1 of the mosaic"):
        open_product(path, swath="mosaic", burst=1)
    with pytest.raises(InputError, match="jumps between swaths"):
        open_product(path, swath="mosaic", bistatic="full")
    (tmp_path / "odd.xml").write_bytes(SHORT["IW1"].xml().replace(b"<polarisation>VV<", b"<polarisation>VV VV<"))
    with pytest.raises(RpcFormatError, match=r"odd\.xml: polarisation vv vv is none of vv, hh, vh, hv"):
        open_product(tmp_path / "odd.xml")


def test_an_error_names_the_product_or_the_orbit_file_that_is_guilty(tmp_path):
    path = product_of(tmp_path / "x.SAFE", called("iw1", "vv"))
    few = SHORT["IW1"].xml().replace(b"<orbitList>", b"<orbitList><!--").replace(b"</orbitList>", b"--></orbitList>")
    (path / "annotation" / called("iw1", "vv")).write_bytes(few)
    with pytest.raises(RpcError, match=rf"^{path}: orbit: 0 state vectors"):
        open_product(path)
    (tmp_path / "a.EOF").write_bytes(Product().eof(start=15.0))
    with pytest.raises(RpcError, match=rf"^{tmp_path / 'a.EOF'}: orbit: the image lasts"):
        open_product(path, orbit=tmp_path / "a.EOF")
    (tmp_path / "a.EOF").write_bytes(Product().eof(mission="Sentinel-1C"))
    with pytest.raises(RpcFormatError, match=rf"^{tmp_path / 'a.EOF'}: the orbit of Sentinel-1C, the image is of S1A"):
        open_product(path, orbit=str(tmp_path / "a.EOF"))


@pytest.mark.slow
def test_a_camera_takes_the_choices_of_a_product(tmp_path):
    path = product_of(tmp_path / "x.SAFE", called("iw1", "vv"), called("iw2", "vv"), called("iw3", "vh"))
    for spec, size in (
        ("swath=iw2", (25000, 110)),
        ("pol=vh", (24300, 110)),
        ("swath=iw1,burst=1", (21576, 60)),
        ("swath=mosaic,pol=vv", (47000, 149)),
    ):
        camera = open_camera(f"{path},{spec}")
        assert camera.format == "sentinel-1"
        assert camera.size == camera.model.size == size
        assert camera.alt_range == camera.model.alt_range
    plain = open_camera(f"{path},swath=iw1").model
    for spec, delays in (
        ("atmosphere=yes", (True, None)),
        ("atmosphere=no", (False, None)),
        ("bistatic=annotated", (False, LATE)),
    ):
        found = open_camera(f"{path},swath=iw1,{spec}").model
        assert found.delays.atmosphere == delays[0]
        assert found.delays.bistatic == (None if delays[1] is None else pytest.approx(delays[1], abs=1e-6))
        assert found.orbit == plain.orbit
    with pytest.raises(InputError, match="atmosphere=maybe cannot be read"):
        open_camera(f"{path},swath=iw1,atmosphere=maybe")


@pytest.mark.slow
def test_the_command_line_fits_swaths_bursts_and_mosaics(tmp_path):
    path = product_of(tmp_path / "x.SAFE", called("iw1", "vh"), called("iw2", "vh"), called("iw3", "vv"))
    eof, out = tmp_path / "S1A.EOF", tmp_path / "iw1_RPC.TXT"
    eof.write_bytes(IW["IW1"].eof())
    delays = f"orbit={eof},atmosphere=yes,bistatic=full"
    for choices in ("swath=mosaic,pol=vh", "swath=iw3,burst=1", f"swath=iw1,pol=vh,{delays}"):
        command = ["fit", f"{path},{choices}", "-o", str(out), "--overwrite"]
        result = CliRunner().invoke(cli, command, standalone_mode=False)
        assert result.exception is None
        assert "within tolerance" in result.stdout
    delayed = open_product(path, swath="iw1", polarisation="vh", orbit=eof, atmosphere=True, bistatic="full")
    image = np.random.default_rng(5).uniform(0, 1, (100, 2)) * (np.array(delayed.size) - 1)
    ground = delayed.localize(image, np.linspace(0.0, 500.0, 100))
    assert np.abs(read_rpc(out).project(ground) - image).max() <= 1e-3


# --- what becomes of its numbers -----------------------------------------------------------------------------


def test_an_annotation_is_read_field_by_field(first):
    product = IW["IW1"]
    assert (first.mission, first.product_type, first.mode, first.swath, first.polarisation) == (
        "S1A", "SLC", "IW", "IW1", "VV",
    )  # fmt: skip
    assert first.kind == "a IW SLC of IW1"
    assert (first.samples, first.lines, first.lines_per_burst) == (product.samples, 13500, 1500)
    assert (first.azimuth_time_interval, first.range_sampling_rate) == (INTERVAL, SAMPLING)
    assert (first.slant_range_time, first.range_pixel_spacing) == (product.first_range_time, 2.329562)
    assert (first.rank, first.pulse_interval, first.bistatic_applied) == (9, 5.823e-4, True)
    assert first.first_line_time == START
    assert len(first.bursts) == 9
    assert first.ground_range is None
    assert first.states.source == "Auxiliary"
    for k in (0, 7, 16):
        position, velocity = product.state(-65.0 + 10.0 * k)
        np.testing.assert_allclose(first.states.position[k], position, atol=1e-6)
        np.testing.assert_allclose(first.states.velocity[k], velocity, atol=1e-6)
        assert (first.states.time[k] - START) / np.timedelta64(1, "us") == -65e6 + 1e7 * k
    grid = first.grid
    azimuth, both_ways = product.azimuth_range(grid.ground)
    np.testing.assert_allclose(grid.range_time, both_ways, rtol=1e-12)
    np.testing.assert_allclose((grid.time - START) / np.timedelta64(1, "ns") * 1e-9, azimuth, atol=1e-6)
    assert grid.image.min() == 0.0
    assert grid.image.max(axis=0).tolist() == [product.samples - 1, 13499]
    first_valid = first.bursts[4].first_valid
    assert (first_valid >= 0).sum() == 1460
    assert set(first_valid[20:-20]) == {100}
    assert set(first.bursts[4].last_valid[20:-20]) == {product.samples - 100}


def test_a_processor_s_bistatic_correction_is_one_where_it_says_true():
    for told, applied in ((b"true", True), (b"false", False), (b" true ", True), (b"True", False)):
        text = XML["IW1"].replace(b"Applied>true<", b"Applied>" + told + b"<")
        assert read_annotation(text).bistatic_applied == applied


def test_the_model_of_a_swath_has_the_numbers_of_its_annotation(first):
    model = IW["IW1"].model()
    assert model.frame == SlantFrame(IW["IW1"].first_range_time, SAMPLING, INTERVAL)
    assert model.epoch == START
    assert model.size == (21576, 8 * 1342 + 1500)
    low, high = first.grid.ground[:, 2].min(), first.grid.ground[:, 2].max()
    assert model.alt_range == (np.floor(low) - 200.0, np.ceil(high) + 500.0)
    assert model.look == "right"
    assert not model.delays
    assert model.accuracy == pytest.approx((np.hypot(0.4, 3.5), np.hypot(0.4, 4.0)))
    assert model.all_ground == (-500.0, 9000.0)
    assert model.advice == ""
    assert GRD.model().all_ground is None
    assert "take the SLC of the scene" in GRD.model().advice
    for words in ("21576 x 12236 px from 2021-02-16T15:12:07, looks right, for", "-100 to 900 m"):
        assert words in repr(replace(model, alt_range=(-100.0, 900.0)))


def test_bistatic_corrections_are_half_the_range_time_less_than_their_constants(first):
    """As the grid tells the first, to whole microseconds; the other from rank times pulse interval."""
    plain = RangeDoppler.from_annotation(first)
    ground = plain.localize(np.array([[100.0, 300.0], [20000.0, 9000.0]]), np.array([0.0, 800.0]))
    _, both_ways = plain.azimuth_range(ground)
    for form, constant in (("annotated", LATE), ("full", 9 * 5.823e-4 - LATE)):
        model = RangeDoppler.from_annotation(first, bistatic=form)
        assert model.delays.bistatic == pytest.approx(constant, abs=1e-6)
        late = (model.project(ground) - plain.project(ground)) * [1.0, INTERVAL]
        expected = np.column_stack([np.zeros(2), model.delays.bistatic - both_ways / 2])
        np.testing.assert_allclose(late, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("scatter", "ok"), [(9e-6, True), (12e-6, False)])
def test_a_grid_whose_times_scatter_by_more_than_ten_microseconds_tells_no_correction(first, scatter, ok):
    signs = np.where(np.arange(len(first.grid.time)) % 2, 1, -1)
    moved = first.grid.time + (signs * round(scatter * 1e9)).astype("timedelta64[ns]")
    annotation = replace(first, grid=replace(first.grid, time=moved))
    with nullcontext() if ok else pytest.raises(InputError, match="does not tell the bistatic correction"):
        model = RangeDoppler.from_annotation(annotation, bistatic="annotated")
        assert model.delays.bistatic == pytest.approx(LATE, abs=1.2 * scatter)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("samples", "lines", "warned"),
    [(4.8, 0.0, False), (5.2, 0.0, True), (0.0, 4.8, False), (0.0, -5.2, True)],
)
def test_a_grid_five_pixels_off_does_not_belong_to_the_orbit(first, samples, lines, warned):
    grid = replace(
        first.grid,
        range_time=first.grid.range_time + samples / SAMPLING,
        time=first.grid.time + np.timedelta64(round(lines * INTERVAL * 1e9), "ns"),
    )
    annotation = replace(first, grid=grid)
    if warned:
        with pytest.warns(BarpcWarning, match="does not belong to the orbit"):
            model = RangeDoppler.from_annotation(annotation)
    else:
        model = RangeDoppler.from_annotation(annotation)
    assert model == IW["IW1"].model()


def test_a_burst_counts_from_its_own_first_line_and_there_is_none_before_the_first(first):
    for k in (0, 8):
        model = RangeDoppler.from_annotation(first, burst=k)
        assert model.epoch == first.bursts[k].time
        assert model.size == (21576, 1500)
    for k in (-1, 9):
        with pytest.raises(InputError, match=f"no burst {k}, it has 9"):
            RangeDoppler.from_annotation(first, burst=k)


def test_a_burst_between_two_rows_stands_at_the_nearest_and_says_how_far_off(first):
    shift = np.timedelta64(round(0.3 * INTERVAL * 1e9), "ns")
    bursts = list(first.bursts)
    bursts[2] = replace(bursts[2], time=bursts[2].time + shift)
    bursts[5] = replace(bursts[5], time=bursts[5].time - shift)
    rows = burst_rows(replace(first, bursts=tuple(bursts)))
    assert [row.first_row for row in rows] == [1342 * k for k in range(9)]
    np.testing.assert_allclose([row.offset for row in rows], [0, 0, 0.3, 0, 0, -0.3, 0, 0, 0], atol=1e-3)


def test_bursts_follow_each_other_and_each_has_a_valid_line(first):
    bursts = list(first.bursts)
    assert len(burst_rows(first)) == len(bursts)
    blank = replace(bursts[3], first_valid=np.full_like(bursts[3].first_valid, -1))
    alone = bursts[3].first_valid.copy()
    alone[:700], alone[701:] = -1, -1
    swapped = [*bursts[:4], bursts[5], bursts[4], *bursts[6:]]
    twice = [*bursts[:5], bursts[4], *bursts[5:]]
    for wrong in ([*bursts[:3], blank, *bursts[4:]], [blank], swapped, twice):
        with pytest.raises(RpcFormatError, match="bursts out of order, or one without valid lines"):
            burst_rows(replace(first, bursts=tuple(wrong)))
    single = burst_rows(replace(first, bursts=(replace(bursts[3], first_valid=alone),)))
    assert (single[0].stop - single[0].start) == 1
    assert single[0].start - single[0].first_row == 700


def test_lines_beyond_the_bursts_go_on_by_the_nearest_one(first):
    lines, step, bursts = first.lines_per_burst, first.azimuth_time_interval, first.bursts
    count = len(bursts)

    def later(burst, lines):
        return bursts[burst].time + np.timedelta64(round(lines * step * 1e9), "ns")

    found = first.line_time(np.array([-2.0, 0.0, lines - 1.0, lines, lines * (count - 1) + 3.0, lines * count + 5.0]))
    expected = [later(0, -2), later(0, 0), later(0, lines - 1), later(1, 0), later(-1, 3), later(-1, lines + 5)]
    assert (np.abs(found - np.array(expected)) <= np.timedelta64(1, "ns")).all()
    plain = replace(first, bursts=())
    assert plain.line_time(np.array(10.0)) - plain.first_line_time == np.timedelta64(round(10 * step * 1e9), "ns")


def test_of_an_orbit_file_the_vectors_around_the_image_are_taken(first, tmp_path):
    """Those of seventy seconds before its first line to seventy after its last, 25 s later."""
    path = tmp_path / "S1A.EOF"
    kind = b"<Mission>Sentinel-1A</Mission><File_Type>AUX_RESORB</File_Type>"
    path.write_bytes(IW["IW1"].eof().replace(b"<Mission>Sentinel-1A</Mission>", kind))
    states = read_orbit_file(path, first)
    assert states.source == "AUX_RESORB"
    since = (states.time - START) / np.timedelta64(1, "us") * 1e-6
    np.testing.assert_array_equal(since, np.arange(-70.0, 91.0, 10.0))
    for k in (0, 16):
        position, velocity = IW["IW1"].state(since[k])
        np.testing.assert_allclose(states.position[k], position, atol=1e-6)
        np.testing.assert_allclose(states.velocity[k], velocity, atol=1e-6)
    path.write_bytes(IW["IW1"].eof().replace(b"EARTH_FIXED", b" EARTH_FIXED "))
    assert len(read_orbit_file(path, first).time) == 17
    for mission, owner, ok in (("S1A", "", False), ("S1X", "S1X", True), ("S1C", "Sentinel-1C", True)):
        path.write_bytes(IW["IW1"].eof(mission=owner))
        if ok:
            assert len(read_orbit_file(path, replace(first, mission=mission)).time) == 17
        else:
            with pytest.raises(RpcFormatError, match="the orbit of no known mission, the image is of S1A"):
                read_orbit_file(path, replace(first, mission=mission))


def test_ground_range_polynomials_have_one_length_and_rising_times():
    xml = GRD.xml()
    found = read_annotation(xml).ground_range
    assert found.ground_from_slant.shape == (36, 4)
    assert found.slant_from_ground.shape == (36, 3)
    assert found.slant_origin[:3].tolist() == [800394.0, 800397.0, 800400.0]
    assert found.ground_from_slant[0].tolist() == [0.0, 1.98 - 2e-4, -4.1e-6, 2.1e-11]
    for tag in (b"srgr", b"grsr"):
        longer = xml.replace(b"<%sCoefficients>" % tag, b"<%sCoefficients>1.0 " % tag, 1)
        with pytest.raises(RpcFormatError, match="ground range polynomials of different lengths"):
            read_annotation(longer)
    stamps = [b"<azimuthTime>%s</azimuthTime><sr0>" % part.split(b"<")[0] for part in xml.split(b"<azimuthTime>")[1:]]
    one, other = [stamp for stamp in stamps if stamp in xml][:2]
    for twice in (
        xml.replace(other, one),
        xml.replace(one, b"@").replace(other, one).replace(b"@", other),
    ):
        with pytest.raises(RpcFormatError, match="times of the ground range polynomials do not rise"):
            read_annotation(twice)


# --- swaths side by side ---------------------------------------------------------------------------------------


def test_a_mosaic_begins_with_its_nearest_swath_and_its_earliest_line():
    swaths = [read_annotation(XML[name]) for name in ("IW3", "IW1", "IW2")]
    late = [round(x.first_burst / INTERVAL, 3) for x in (IW["IW3"], IW["IW1"], IW["IW2"])]
    offsets = mosaic_offsets(swaths)
    np.testing.assert_allclose(offsets[:, 0], [45000, 0, 22000], atol=1e-6)
    np.testing.assert_allclose(offsets[:, 1], late, atol=1e-3)
    model = mosaic(swaths)
    assert model.epoch == START
    assert model.frame.first_range_time == IW["IW1"].first_range_time
    assert model.size == (69300, round(1.7 / INTERVAL) + 8 * 1342 + 1500)
    early = [
        replace(s, first_line_time=s.first_line_time - np.timedelta64(1, "s")) if k == 2 else s
        for k, s in enumerate(swaths)
    ]
    assert mosaic_offsets(early)[2, 1] == 0.0
    assert mosaic_offsets(early)[1, 1] == pytest.approx(0.2 / INTERVAL, abs=1e-3)


def test_the_altitudes_of_a_mosaic_are_those_of_all_its_swaths():
    swaths = [read_annotation(XML[name]) for name in ("IW1", "IW2")]
    ground = swaths[1].grid.ground.copy()
    ground[3, 2] = 2345.6
    other = replace(swaths[1], grid=replace(swaths[1].grid, ground=ground))
    with pytest.warns(BarpcWarning, match="does not belong to the orbit"):
        model = mosaic([swaths[0], other])
    assert model.alt_range[1] == 2346 + 500


@pytest.mark.parametrize("field", ["azimuth_time_interval", "range_sampling_rate"])
@pytest.mark.parametrize(("off", "ok"), [(5e-10, True), (-5e-10, True), (2e-9, False), (-2e-9, False)])
def test_swaths_of_one_product_have_one_interval_and_one_rate(first, field, off, ok):
    other = replace(read_annotation(XML["IW2"]), **{field: getattr(first, field) * (1 + off)})
    with nullcontext() if ok else pytest.raises(InputError, match=r"not of the same product as iw1\.xml"):
        assert mosaic_offsets([first, other]).shape == (2, 2)


@pytest.mark.parametrize(("seconds", "ok"), [(27.7, True), (27.8, False), (-27.7, True), (-27.8, False)])
def test_swaths_of_one_product_begin_within_the_length_of_one(first, seconds, ok):
    """13,500 lines of the file, 27.75 s."""
    moved = first.first_line_time + np.timedelta64(round(seconds * 1e9), "ns")
    other = replace(read_annotation(XML["IW2"]), first_line_time=moved)
    with nullcontext() if ok else pytest.raises(InputError, match="not of the same product"):
        assert mosaic_offsets([first, other])[:, 1].max() == pytest.approx(abs(seconds) / INTERVAL, abs=1e-3)


def test_a_stripmap_and_another_satellite_are_no_part_of_a_mosaic(first):
    with pytest.raises(InputError, match="a mosaic takes TOPS SLC swaths, this is a S3 SLC of S3"):
        mosaic_offsets([first, read_annotation(STRIPMAP.xml())])
    with pytest.raises(InputError, match="not of the same product"):
        mosaic_offsets([first, replace(first, mission="S1B")])
    with pytest.raises(InputError, match="no swaths"):
        mosaic([])


# --- times and pixels ------------------------------------------------------------------------------------------


def ground_frame(count: int = 4):
    """Polynomials that change from one time to the next, listed at uneven times."""
    from barpc.sensor.sentinel1 import GroundFrame

    listed = np.array([-3.0, 1.0, 2.5, 7.0])[:count]
    origin = np.array([8.0e5, 8.001e5, 8.0003e5, 8.0002e5])[:count]
    coeffs = np.array(
        [
            [0.0, 1.9, -4e-6, 2e-11],
            [5.0, 2.0, -4.1e-6, 1e-11],
            [-3.0, 1.95, -3.9e-6, 3e-11],
            [2.0, 1.9, -4e-6, 0.0],
        ]
    )[:count]
    return GroundFrame(2e-3, 10.0, listed, origin, coeffs, 0.5)


def ranged(frame, time: float, slant: float) -> float:
    """Ground range of one point, by interpolation of every number and a polynomial."""

    def at(values: np.ndarray) -> float:
        if len(values) == 1:
            return float(values[0])
        k = int(np.clip(np.searchsorted(frame.listed, time) - 1, 0, len(values) - 2))
        t = (time - frame.listed[k]) / (frame.listed[k + 1] - frame.listed[k])
        return float(values[k] + t * (values[k + 1] - values[k]))

    u = slant - at(frame.origin)
    return sum(at(frame.coeffs[:, k]) * u**k for k in range(frame.coeffs.shape[1]))


@pytest.mark.parametrize("count", [4, 2, 1])
def test_ground_range_is_a_polynomial_of_slant_range_that_is_interpolated_in_time(count):
    """Beyond the first and the last listed time it goes on as between the nearest two."""
    frame, rng = ground_frame(count), np.random.default_rng(1)
    time, slant = rng.uniform(-5.0, 9.0, 40), rng.uniform(8.05e5, 8.9e5, 40)
    times = np.stack([time, 2 * slant / SPEED_OF_LIGHT])
    image, slope = frame.image(times)
    expected = [ranged(frame, t, s) / 10.0 for t, s in zip(time, slant, strict=True)]
    np.testing.assert_allclose(image, [expected, time / 2e-3], rtol=1e-11)
    for k, step in enumerate((1e-4, 1e-9)):
        move = np.zeros((2, 1))
        move[k] = step
        difference = (frame.image(times + move)[0] - frame.image(times - move)[0]) / (2 * step)
        away = np.abs(time[:, None] - frame.listed).min(axis=1) > 2e-4
        np.testing.assert_allclose(slope[:, k][:, away], difference[:, away], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(frame.times(image), times, rtol=1e-11)


def test_slant_range_columns_and_rows_count_time():
    frame = SlantFrame(5e-3, 6e7, 2e-3)
    image, slope = frame.image(np.array([[1.0], [5.0001e-3]]))
    np.testing.assert_allclose(image, [[6.0], [500.0]], rtol=1e-9)
    np.testing.assert_array_equal(slope[..., 0], [[0.0, 6e7], [500.0, 0.0]])
    np.testing.assert_allclose(frame.times(image), [[1.0], [5.0001e-3]], rtol=1e-14)
