"""RPCs from and to rasterio and rpcm: the same camera on both sides."""

from __future__ import annotations

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio.transform import RPCTransformer

import barpc
from barpc.base.errors import RpcError
from tests.rpcio.conftest import grid, make_rpc, write_image


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("changes", [{}, {"err_bias": None, "err_rand": None}])
def test_what_rasterio_reads_of_a_file_is_the_camera_that_it_was_given(changes, tmp_path):
    rpc = make_rpc(**changes)
    path = write_image(tmp_path / "a.tif")
    with rasterio.open(path, "r+") as dataset:
        dataset.rpcs = rpc.to_rasterio()
    for found in (barpc.read_rpc(path), barpc.RPC.from_rasterio(rasterio.open(path).rpcs)):
        np.testing.assert_allclose(found.project(grid(rpc)), rpc.project(grid(rpc)), rtol=0, atol=1e-9)
        assert (found.err_bias, found.err_rand) == (rpc.err_bias, rpc.err_rand)
    assert barpc.RPC.from_rasterio(rpc.to_rasterio()) == rpc


def test_gdal_projects_with_it_from_the_corner_of_the_pixel(tmp_path):
    """The oracle counts from the corner: half a pixel more than barpc, of columns and rows alike."""
    rpc = make_rpc()
    lon, lat, _ = grid(rpc)[::7].T
    alt = np.full(len(lon), rpc.ground_offset[2])
    with RPCTransformer(rpc.to_rasterio()) as transformer:
        row, col = transformer.rowcol(lon, lat, zs=alt, op=lambda value: value)
    expected = rpc.project(np.column_stack([lon, lat, alt])) + 0.5
    np.testing.assert_allclose(np.column_stack([col, row]), expected, rtol=0, atol=1e-6)


def test_rpcm_projects_with_the_dictionary_and_gives_it_back():
    rpcm = pytest.importorskip("rpcm")
    rpc = make_rpc()
    model = rpcm.RPCModel(rpc.to_rpcm_dict(), dict_format="rpcm")
    found = np.column_stack(model.projection(*grid(rpc).T))
    np.testing.assert_allclose(found, rpc.project(grid(rpc)), rtol=0, atol=1e-9)
    assert barpc.RPC.from_rpcm(model) == rpc
    back = rpcm.RPCModel({k: str(v) for k, v in model.to_geotiff_dict().items()})
    assert barpc.RPC.from_rpcm(back) == replace(rpc, err_bias=None, err_rand=None)


def test_the_accuracies_that_gdal_gives_for_unknown_are_none():
    rpcs = make_rpc().to_rasterio()
    for unknown in (-1.0, 0.0, None):
        rpcs.err_bias = rpcs.err_rand = unknown
        found = barpc.RPC.from_rasterio(rpcs)
        assert (found.err_bias, found.err_rand) == (None, None)


def test_what_is_no_rpc_is_refused_by_name(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        nothing = rasterio.open(write_image(tmp_path / "a.tif")).rpcs
    with pytest.raises(RpcError, match="None instead of an RPC: the image has none"):
        barpc.RPC.from_rasterio(nothing)
    given = make_rpc().to_rpcm_dict()
    with pytest.raises(RpcError, match="SimpleNamespace: lat_scale is missing"):
        barpc.RPC.from_rpcm(SimpleNamespace(**{k: v for k, v in given.items() if k != "lat_scale"}))
    with pytest.raises(RpcError, match="row_den has 19 numbers, expected 20"):
        barpc.RPC.from_rpcm(SimpleNamespace(**(given | {"row_den": given["row_den"][:19]})))
