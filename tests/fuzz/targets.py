"""What a fuzzer throws at the readers: any bytes are an RPC or one `RpcFormatError` in one line.

`run_atheris.py` drives them with atheris, `test_readers.py` with mutated samples.
"""

from __future__ import annotations

import io

from barpc.errors import RpcFormatError
from barpc.rpcio import FORMATS
from barpc.rpcio.fields import ReadOptions
from barpc.rpcio.formats import parse
from barpc.rpcio.text import decode
from barpc.rpcio.tiff import read_directory, read_values


def check_text(data: bytes) -> bool:
    """Whether the bytes are an RPC file, recognised by their content."""
    try:
        rpc, _ = parse(data, "fuzz")
    except RpcFormatError as error:
        _check_message(error)
        return False
    assert rpc.coeffs.shape == (4, 20)
    return True


def check_format(data: bytes, name: str) -> bool:
    """Whether a format's reader takes the bytes, past its own sniffing."""
    try:
        FORMATS[name].read(decode(data), "fuzz", ReadOptions())
    except RpcFormatError as error:
        _check_message(error)
        return False
    return True


def check_tiff(data: bytes) -> bool:
    """Whether the bytes have a TIFF directory whose values can be fetched."""
    file = io.BytesIO(data)
    try:
        directory = read_directory(file, "fuzz")
        for entry in directory.entries:
            read_values(file, directory, entry, "fuzz")
    except RpcFormatError as error:
        _check_message(error)
        return False
    return True


def _check_message(error: RpcFormatError) -> None:
    message = str(error)
    assert message.startswith("fuzz")
    assert len(message) < 2000


def check_all(data: bytes) -> None:
    """One input for everything: its first byte chooses the reader."""
    if not data:
        return
    names = list(FORMATS)
    choice = data[0] % (len(names) + 2)
    if choice < len(names):
        check_format(data[1:], names[choice])
    elif choice == len(names):
        check_tiff(data[1:])
    else:
        check_text(data[1:])
