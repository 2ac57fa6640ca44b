"""RPC00A and RPC00B order their twenty terms differently: each is read in its own."""

from __future__ import annotations

import numpy as np
import pytest

from barpc.rpcio import read_rpc
from barpc.sensor.rpc import RPC
from tests.rpcio.conftest import A_ORDER, grid, in_order, write_image, write_nitf


def rpc_of_fitting_numbers() -> RPC:
    """Every number as the record holds it, every coefficient at work."""
    coeffs = np.round(np.random.default_rng(9).uniform(-1, 1, (4, 20)) * 0.01, 6)
    coeffs[1::2] *= 0.1
    coeffs[:, 0] = [0.01, 1.0, -0.02, 1.0]
    coeffs[0, 1], coeffs[2, 2] = 0.9, -0.9
    return RPC(np.round(coeffs, 6), [5.4, 43.2, 500.0], [0.1, 0.2, 500.0], [999.0, 950.0], [1010.0, 980.0])


def test_the_terms_of_an_rpc00a_record_stand_in_their_own_order(tmp_path) -> None:
    """The record's numbers, used in the order of RPC00A (GDAL takes terms 7 to 10 otherwise: no oracle here)."""
    rpc = rpc_of_fitting_numbers()
    path = tmp_path / "a.ntf"
    write_nitf(rpc, write_image(tmp_path / "scene.tif"), path)
    data = path.read_bytes()
    assert data.count(b"RPC00B01041") == 1
    path.write_bytes(data.replace(b"RPC00B01041", b"RPC00A01041"))
    found = read_rpc(path)
    ground = grid(rpc)
    np.testing.assert_allclose(found.project(ground), in_order(rpc, ground, A_ORDER), atol=1e-8)
    assert np.abs(found.project(ground) - rpc.project(ground)).max() > 1.0


def test_a_record_says_of_itself_that_it_is_valid(tmp_path) -> None:
    path = tmp_path / "a.ntf"
    write_nitf(rpc_of_fitting_numbers(), write_image(tmp_path / "scene.tif"), path)
    path.write_bytes(path.read_bytes().replace(b"RPC00B010411", b"RPC00B010410"))
    with pytest.raises(Exception, match="SUCCESS flag"):
        read_rpc(path)
