"""SICD: every way of forming an image, against another implementation and against first principles."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import polynomial

from barpc.base.errors import InputError, RpcError, RpcFormatError
from barpc.base.geodesy import ecef_from_ground, ground_from_ecef
from barpc.cameras import open_camera
from barpc.fit import fit_rpc
from barpc.sensor.geometry import view_angles
from barpc.sensor.sicd import find_sicd, is_sicd, open_sicd
from tests.sensor.radar_documents import KINDS, SIZE, document, nitf

CASES = [(kind, side) for kind in KINDS for side in "RL"]


def points(seed: int = 1, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(0, SIZE, (count, 2)), rng.uniform(-500.0, 1500.0, count)


@pytest.fixture
def model_of(tmp_path):
    def make(kind: str, **said: object):
        path = tmp_path / "image.xml"
        path.write_text(document(kind, **said))
        return open_sicd(path)

    return make


@pytest.mark.few(2)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # sarkit's own
@pytest.mark.parametrize(("kind", "side"), CASES)
def test_pixels_lie_where_another_implementation_says(kind, side, tmp_path):
    projection = pytest.importorskip("sarkit.sicd.projection", reason="sarkit is another SICD implementation")
    etree = pytest.importorskip("lxml.etree")
    path = tmp_path / "image.xml"
    path.write_text(document(kind, side=side))
    model, (image, alt) = open_sicd(path), points(count=8)
    said = projection.MetadataParams.from_xml(etree.parse(path))
    plane = (image[:, ::-1] - model.origin) * model.spacing
    ground = model.localize(image, alt)
    for k in range(len(image)):
        sets = projection.compute_projection_sets(said, plane[k : k + 1])
        there, *_ = projection.r_rdot_to_constant_hae_surface(
            said.LOOK, said.SCP, sets, alt[k], delta_hae_max=1e-9, nlim=50
        )
        assert np.abs(np.ravel(there) - ecef_from_ground(ground[k])).max() < 1e-7  # m
    seen, *_ = projection.scene_to_image(said, ecef_from_ground(ground), delta_gp_s2i=1e-9, maxiter=50)
    np.testing.assert_allclose(seen / model.spacing, plane / model.spacing, rtol=0, atol=1e-7)  # px


@pytest.mark.few(4)
@pytest.mark.parametrize(("kind", "side"), CASES)
def test_range_and_rate_of_a_localised_point_are_those_that_the_document_states(kind, side, model_of):
    """From the definitions: the distance to ARPPoly at the time of the pixel, and how fast that distance changes."""
    model, (image, alt) = model_of(kind, side=side), points(seed=2)
    ground = model.localize(image, alt)
    np.testing.assert_allclose(ground[:, 2], alt, atol=1e-6)
    plane = ((image[:, ::-1] - model.origin) * model.spacing).T
    stated = model.formation.at(*plane, model.orbit)
    time, step, point = polynomial.polyval2d(*plane, model.formation.time), 1e-3, ecef_from_ground(ground)
    before, now, after = (np.linalg.norm(model.orbit(time + d)[0].T - point, axis=1) for d in (-step, 0.0, step))
    np.testing.assert_allclose(now, stated.distance, rtol=0, atol=1e-6)
    np.testing.assert_allclose((after - before) / (2 * step), stated.rate, rtol=0, atol=1e-5)
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=1e-7)


def test_points_of_the_image_plane_are_seen_at_their_pixels(model_of):
    model = model_of("PLANE")
    image, _ = points(seed=3)
    x, y = ((image[:, ::-1] - model.origin) * model.spacing).T[:, :, None]
    formation = model.formation
    ground = ground_from_ecef(formation.scp + x * formation.along_x + y * formation.along_y)
    np.testing.assert_allclose(model.project(ground), image, rtol=0, atol=1e-6)


@pytest.mark.parametrize("side", "RL")
def test_only_the_side_that_is_looked_at_is_seen(side, model_of):
    model = model_of("INCA", side=side)
    image, alt = points(seed=4)
    ground = model.localize(image, alt)
    other = replace(model, look="left" if side == "R" else "right")
    assert np.isnan(other.project(ground)).all()
    mirrored = other.localize(image, alt)
    assert np.linalg.norm(ecef_from_ground(mirrored) - ecef_from_ground(ground), axis=1).min() > 5e5
    incidence, azimuth = view_angles(model, ground)
    assert np.abs(incidence - 35.0).max() < 1.0
    flight = 90.0 - np.degrees(np.arctan2(1.0, 0.2))  # east of north
    toward = (azimuth - flight + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(toward, -90.0 if side == "R" else 90.0, atol=4.0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_part_of_an_image_and_a_nitf_are_read_as_they_are(kind, tmp_path, model_of):
    whole, part = model_of(kind), model_of(kind, first=(700, 300))
    assert part == whole  # pixels count from the part's own first one
    camera = open_camera(nitf(document(kind), tmp_path / "image.ntf"))
    assert camera.format == "sicd"
    assert camera.model == whole
    assert camera.extent == SIZE
    assert camera.alt_range == pytest.approx((-880.0, 1120.0), abs=1e-3)


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", KINDS)
def test_a_namespace_with_a_prefix_changes_nothing(kind, tmp_path, model_of):
    text = re.sub(r"<(/?)(?=[A-Za-z])", r"<\1sicd:", document(kind)).replace("xmlns=", "xmlns:sicd=")
    assert "<SICD" not in text
    path = tmp_path / "prefixed.xml"
    for written in (path, nitf(text, tmp_path / "prefixed.ntf")):
        if written == path:
            path.write_text(text)
        camera = open_camera(written)
        assert (camera.format, camera.model) == ("sicd", model_of(kind))
    assert not any(map(is_sicd, (b"<SICDX>", b"<a:SICDS/>", b"SICD>")))


@pytest.mark.parametrize(("images", "graphics", "texts"), [(0, 0, 0), (3, 0, 0), (1, 2, 0), (1, 0, 2), (2, 12, 11)])
def test_a_document_stands_behind_all_that_a_nitf_holds(images, graphics, texts, tmp_path):
    path = nitf(document("PFA"), tmp_path / "image.ntf", images, graphics, texts)
    assert find_sicd(path) == document("PFA").encode()
    assert find_sicd(nitf("<other/>", path, images, graphics, texts)) is None
    with pytest.raises(RpcFormatError, match="no SICD metadata in it"):
        open_sicd(path)


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", KINDS)
def test_an_rpc_holds_the_image(kind, model_of):
    model = model_of(kind)
    fit = fit_rpc(model, model.size, model.alt_range)
    image, alt = points(seed=6)
    alt = np.clip(alt, *model.alt_range)
    miss = np.abs(fit.rpc.project(model.localize(image, alt)) - image).max(axis=0)
    assert (miss < 1e-4).all()
    assert (miss <= 1.1 * fit.max_ckp + 1e-8).all()
    assert (miss >= 0.1 * fit.rmse_ckp).all()


@pytest.mark.parametrize(
    ("was", "now", "words"),
    [
        ("<CollectType>MONOSTATIC", "<CollectType>BISTATIC", "bistatic"),
        ("<Type>RGAZIM</Type>", "<Type>OTHER</Type>", "OTHER, which the SICD standard does not project"),
        ("<ImageFormAlgo>PFA", "<ImageFormAlgo>OTHER", "RGAZIM by OTHER"),
        ("<SideOfTrack>R", "<SideOfTrack>up", "'up', expected R or L"),
        ("<SideOfTrack>R", "<SideOfTrack>L", "not projected to its stated pixel"),
        ("<SS>0.8", "<SS>-0.8", "Grid/Row/SS is -0.8"),
        ("<NumRows>700", "<NumRows>nan", "not finite"),
        ("<Row>340", "<Row>341.5x", "not a list of numbers"),
        ('exponent1="1"', 'exponent1="-1"', "of no power from 0 to 30"),
        ("ARPPoly", "APPoly", "no Position/ARPPoly/X"),
        ("<CollectDuration>6.0", "<CollectDuration>0", "CollectDuration is 0"),
    ],
)
def test_what_is_wrong_in_a_document_is_one_line(was, now, words, tmp_path):
    text = document("PFA")
    assert was in text
    path = tmp_path / "image.xml"
    path.write_text(text.replace(was, now))
    with pytest.raises((RpcFormatError, InputError), match=words) as caught:
        open_sicd(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("cut", [10, 350, 362, 380, 400, 900])
def test_a_nitf_that_ends_early_is_one_line(cut, tmp_path):
    path = nitf(document("PFA"), tmp_path / "image.ntf")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(RpcError, match=r"image\.ntf"):
        open_sicd(path)
