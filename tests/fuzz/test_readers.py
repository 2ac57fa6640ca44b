"""Mutated files of every format: an RPC, or one error in one line."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fuzz.samples import SAMPLES, seed
from tests.fuzz.targets import check_all, check_format, check_text, check_tiff

TOKENS = (
    b"nan",
    b"inf",
    b"-",
    b"1e999",
    b"0",
    b"\x00",
    b"<",
    b">",
    b"&",
    b'"',
    b"(",
    b")",
    b"[",
    b"]",
    b"\n",
    b": ",
)


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four edits: a flipped bit, a part cut out, doubled or moved, a token put in."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not out:
            break
        at, length = int(rng.integers(0, len(out))), int(rng.geometric(0.1))
        match rng.integers(0, 5):
            case 0:
                out[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                del out[at : at + length]
            case 2:
                out[at:at] = out[at : at + length]
            case 3:
                out[at : at + length] = TOKENS[int(rng.integers(0, len(TOKENS)))]
            case _:
                other = int(rng.integers(0, len(out)))
                out[at : at + length] = out[other : other + length]
    return bytes(out)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_sample_is_accepted_as_it_is(name):
    kind = name.split(" ", maxsplit=1)[0]
    if kind == "tiff":
        assert check_tiff(SAMPLES[name])
    else:
        assert check_format(SAMPLES[name], kind)
        assert check_text(SAMPLES[name])


@pytest.mark.parametrize("name", SAMPLES)
def test_mutations_are_an_rpc_or_one_error(name):
    rng = np.random.default_rng(11)
    data = seed(name)
    for _ in range(300):
        check_all(data[:1] + mutate(data[1:], rng))


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_many_mutations_are_an_rpc_or_one_error(name):
    rng = np.random.default_rng(12)
    data = seed(name)
    for _ in range(8000):
        mutant = mutate(data[1:], rng)
        check_all(data[:1] + mutant)
