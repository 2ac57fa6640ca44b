"""An image without an RPC: the line names the flags that give it one, or leave it out."""

from __future__ import annotations

import pytest

from barpc.base.errors import ImageError, MissingRpcError
from barpc.pipeline import load_views
from barpc.rpcio import write_rpc_copy
from tests.rpcio.conftest import make_rpc, write_image


def test_an_image_without_an_rpc_is_told_how_to_get_one_or_be_left_out(tmp_path):
    plain = write_image(tmp_path / "plain.tif", shape=(1, 60, 80))
    for k in range(2):
        raw = write_image(tmp_path / f"raw_{k}.tif", shape=(1, 60 + k, 80))
        write_rpc_copy(make_rpc().crop(900, 900 + 20 * k), raw, tmp_path / f"in/view_{k}.tif")
    good = [tmp_path / f"in/view_{k}.tif" for k in range(2)]
    with pytest.raises(MissingRpcError) as told:
        load_views([*good, plain])
    assert str(told.value).startswith(f"{plain}: no RPC in the image and none beside it")
    assert "plain.tif,camera=FILE" in str(told.value)
    assert "--keep-going" in str(told.value)
    assert isinstance(told.value, ImageError)
    found = load_views([*good, plain], keep_going=True)
    assert [view.name for view in found.views] == ["view_0", "view_1"]
    ((path, reason),) = found.left_out
    assert path == str(plain)
    assert "--keep-going" not in reason  # it was given
