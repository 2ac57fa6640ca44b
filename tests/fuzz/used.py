"""Files whose damage shows where they are used: options and an earlier block go through an adjustment, answers of a web
server through what reads files on other hosts, HDF5 through h5py."""

from __future__ import annotations

import io
import socket
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args, get_origin
from unittest import mock

import numpy as np

from barpc.ba import Adjustment, BlockPrior, adjust_tracks, block_prior
from barpc.base.declarations import Rule, declared
from barpc.base.errors import BarpcError
from barpc.base.options import AdjustOptions, FitOptions, read_options
from barpc.base.remote import Remote, hosts
from barpc.base.safe_io import IMAGE, RPC_FILE, read_bytes, read_head, versioned
from barpc.fit import fit_rpc
from barpc.rasters.raster import open_raster
from barpc.simulate import SimulatedBlock, simulate_block
from tests.pointio.stages import read_matches
from tests.pointio.test_foreign import hloc
from tests.rpcio.conftest import make_rpc, write_image

from .ends import ENDS, bent, mutate_npz_ends
from .kinds import Sample, bytes_of
from .mutate import Rng, mutate_npz, mutate_text, pick

# --- a small block ----------------------------------------------------------------------------------------


@cache
def small_block() -> SimulatedBlock:
    """Three views, 60 tracks, four control points: adjusted in 30 ms."""
    return simulate_block(3, 60, seed=1, num_checks=5, num_gcps=4)


def sound(found: Adjustment) -> Adjustment:
    """The adjustment, whose cameras are numbers; AssertionError where it says that it is done and they are none."""
    numbers = {"params": found.params, "noise": found.noise, "shift": found.gauge.shift}
    numbers["residuals"] = found.residuals[found.inlier]
    for name, value in numbers.items():
        if not np.isfinite(value).all():
            raise AssertionError(f"adjusted, and {name} is {value}")
    ground = np.array([[5.4, 43.3, 100.0]])
    for name, sensor in zip(found.names, found.sensors, strict=True):
        if not np.isfinite(sensor.project(ground)).all():
            raise AssertionError(f"adjusted, and {name} shows nothing")
    return found


def in_one_line(error: BarpcError) -> None:
    """What an adjustment says names no file; it is one line all the same."""
    text = str(error)
    if not text.isprintable() or len(text) > 2000:
        raise AssertionError(f"says {text!r}")


# --- options ----------------------------------------------------------------------------------------------

_NAMES = ("view_0000", "view_0001", "view_0002")


def ends_of(rule: Rule, whole: bool) -> list[str]:
    """Numbers at the ends of what a field may hold, within and beyond."""
    edges = [b for b in (rule.least, rule.above, rule.most, rule.below) if b is not None]
    if whole:
        near = [int(b) + step for b in edges for step in (-1, 0, 1)]
        return list(map(str, [*near, 2**53 - 1, 2**53, 2**63, 1, 2, 100]))
    near_edges = [n for b in edges for n in (b, np.nextafter(b, -np.inf), np.nextafter(b, np.inf))]
    usual = [1e-30, 1e30, 1e-29, 1e29, 1e-15, 1e15, 1e-8, 1e8, 1e-3, 1.0, 1e3]
    return [repr(float(n)) for n in [*near_edges, *usual]] + [e for e in ENDS if e[0] != "0"]


def _spelt(kind: Any, rule: Rule, rng: Rng) -> str:
    parts = get_args(kind)
    if get_origin(kind) is Mapping:
        names = [name for name in _NAMES if rng.integers(2)]
        return "{" + ", ".join(f"{name} = {_spelt(parts[1], rule, rng)}" for name in names) + "}"
    if get_origin(kind) is tuple:
        count = len(parts) if parts[-1] is not ... else int(rng.integers(4))
        return "[" + ", ".join(_spelt(parts[0], rule, rng) for _ in range(count)) + "]"
    if get_origin(kind) is Literal or rule.rows:
        return f'"{pick(rng, rule.choices(kind))}"'
    if kind is bool:
        return str(pick(rng, ("true", "false")))
    if kind is str:  # the jitter, or the name of a view
        words = _NAMES if rule.unit == "name" else ("auto", "off", "1e-30", "1e30", "100", "5e-324", "0.5")
        return f'"{pick(rng, words)}"'
    return str(pick(rng, ends_of(rule, kind is int)))


def _spelt_table(table: str, record: type, most: int, again: float, rng: Rng) -> bytes:
    known = declared(record)
    names = rng.choice(list(known), int(rng.integers(1, most + 1)), replace=again > 0 and rng.random() < again)
    lines = [f"{name} = {_spelt(known[name].kind, known[name].rule, rng)}" for name in names]
    return "\n".join([f"[{table}]", *lines, ""]).encode()


def mutate_options(_: bytes, rng: Rng) -> bytes:
    """One to four options, each at an end of its range; a key may be there twice."""
    return _spelt_table("adjust", AdjustOptions, 4, 0.1, rng)


def mutate_fit_options(_: bytes, rng: Rng) -> bytes:
    """One to three of the fit's options."""
    return _spelt_table("fit", FitOptions, 3, 0.0, rng)


def _use_options(path: Path) -> object:
    options, block = read_options(path), small_block()
    try:
        return sound(adjust_tracks(block.views, block.tracks, options.adjust, block.gcps))
    except BarpcError as error:
        return in_one_line(error)


def _use_fit_options(path: Path) -> object:
    options = read_options(path)
    try:
        fitted = fit_rpc(make_rpc(), (2000, 1900), (50.0, 290.0), options=options.fit, strict=False)
    except BarpcError as error:
        return in_one_line(error)
    return fitted.rpc


# --- an earlier block -------------------------------------------------------------------------------------


def _block_file(folder: Path, sparse: bool) -> Path:
    block, options = small_block(), AdjustOptions(drift=0, model="rotation", solver="sparse" if sparse else "auto")
    prior = block_prior(adjust_tracks(block.views, block.tracks, options))
    if sparse:
        from barpc.ba.solving.linear import Blocks

        whole = np.asarray(prior.dense())
        prior = BlockPrior(
            prior.names, prior.model, prior.drift, prior.params, Blocks.of(whole, prior.params.shape[1]), prior.center,
            1e-3 * np.ones((1, prior.params.size)),
        )  # fmt: skip
    prior.save(folder / "block.npz")
    return folder / "block.npz"


def _use_block(path: Path) -> object:
    prior, block = BlockPrior.load(path), small_block()
    try:
        options = AdjustOptions(drift=0, model="rotation")
        return sound(adjust_tracks(block.views, block.tracks, options, prior=prior))
    except BarpcError as error:
        return in_one_line(error)


# --- HDF5 -------------------------------------------------------------------------------------------------


def _hdf5(folder: Path, kind: str) -> Path:
    """The matches, and of hloc's the keypoints in the same file."""
    import h5py

    path = hloc(folder, kind)
    if kind == "hloc":
        with h5py.File(path, "a") as file, h5py.File(path.with_name("feats.h5"), "r") as points:
            for name in points:
                points.copy(name, file)
    return path


def _beside_plain(folder: Path) -> None:
    (folder / "made").mkdir()
    hloc(folder / "made", "plain")
    (folder / "made" / "keypoints.h5").rename(folder / "keypoints.h5")


def mutate_hdf5(data: bytes, rng: Rng) -> bytes:
    """Arrays of other shapes, types and ends; members missing, doubled, linked, nested; sizes that are claimed."""
    import h5py

    memory = io.BytesIO(data)
    with h5py.File(memory, "r+") as file:
        for _ in range(rng.integers(1, 4)):
            names: list[str] = []
            file.visit(names.append)
            if not names:
                break
            with suppress(OSError, RuntimeError, ValueError, KeyError, TypeError):  # of what an edit before has left
                _edit(file, str(pick(rng, names)), rng, h5py)
    return memory.getvalue()


def _edit(file: Any, name: str, rng: Rng, h5py: Any) -> None:
    found = file[name]
    small = isinstance(found, h5py.Dataset) and found.shape is not None and found.size < 1000  # others claim it
    value = np.asarray(found[()] if small else np.eye(2))
    if value.dtype.kind not in "fiu":
        value = np.eye(2)
    edit = int(rng.integers(9))
    if edit == 0:
        file[f"{name}_again/{rng.integers(5)}"] = h5py.SoftLink(f"/{name}") if rng.integers(2) else value
        return
    if edit == 1:
        file["/".join(["deep"] * int(rng.integers(2, 60))) + f"/{rng.integers(1 << 30)}"] = value
        return
    del file[name]
    if edit == 2:
        file[name] = value[: len(value) // 2] if value.ndim else value
    elif edit == 3:
        kinds = ("f2", "f4", "f8", ">f8", "i1", "u8", "<i8", "c16", "S3", "?")
        with np.errstate(all="ignore"):
            file[name] = np.zeros(value.shape, str(pick(rng, kinds)))
    elif edit == 4:
        shape = pick(rng, ((10**9, 2), (0, 2), (), (2, 10**12), (5,), (3, 3, 3), (1 << 20, 2)))
        file.create_dataset(name, shape, "f4", chunks=True if shape and 0 not in shape else None)
    elif edit == 5:
        file[name] = h5py.Empty("f4") if rng.integers(2) else h5py.ExternalLink("/etc/passwd", "a")
    else:
        file[name] = bent(value, rng)


# --- a web server -----------------------------------------------------------------------------------------


class _Server:
    """Answers every request with the same bytes, and closes."""

    def __init__(self) -> None:
        self.data = b""
        self._socket = socket.create_server(("127.0.0.1", 0), backlog=64)
        self.host = f"http://127.0.0.1:{self._socket.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            connection = self._socket.accept()[0]
            try:
                connection.settimeout(5.0)
                asked = b""
                while b"\r\n\r\n" not in asked:
                    if not (more := connection.recv(4096)):
                        break
                    asked += more
                connection.sendall(self.data)
                connection.shutdown(socket.SHUT_WR)
                while connection.recv(4096):
                    pass
            except OSError:
                pass
            finally:
                connection.close()


@cache
def _server(_process: int) -> _Server:
    return _Server()


_image = bytes_of(lambda folder: write_image(folder / "a.tif", shape=(1, 2, 2)))


def _answer() -> bytes:
    body = _image()
    head = (
        f'HTTP/1.1 206 Partial Content\r\nServer: s\r\nContent-Length: {len(body)}\r\nETag: "one"\r\n'
        f"Content-Range: bytes 0-{len(body) - 1}/{len(body)}\r\nLocation: /answer.http\r\n\r\n"
    )
    return head.encode() + body


_HEADERS = (
    b"Content-Encoding: gzip", b"Transfer-Encoding: chunked", b"Content-Length: 99999999999999999999",
    b"Content-Length: -1", b"Content-Range: bytes 0-9/*", b"Content-Range: bytes */0", b"Connection: close",
    b"Content-Range: bytes 0-65535/999999999999999999", b"Location: http://[", b"Location: //other.org/x",
    b"Location: \xff", b"ETag: \x1b[31m", b"ETag: " + b"x" * 70000, b"X: y\r\n" * 200, b" folded", b":", b"\x00",
    b"Content-Length: 5\r\nContent-Length: 6",
)  # fmt: skip
_STATUS = (100, 101, 199, 200, 204, 206, 301, 302, 304, 307, 308, 404, 410, 416, 425, 429, 500, 503, 999, 0, -1)


def mutate_answer(data: bytes, rng: Rng) -> bytes:
    """Another status, headers missing, doubled, of other values and orders, a body cut short or too long."""
    head, _, body = data.partition(b"\r\n\r\n")
    lines = head.split(b"\r\n")
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(1, len(lines))) if len(lines) > 1 else 0
        match rng.integers(0, 8):
            case 0:
                lines[0] = b"HTTP/1.1 %d X" % int(pick(rng, _STATUS))  # type: ignore[call-overload]
            case 1 if at:
                del lines[at]
            case 2:
                lines.insert(at + 1, bytes(pick(rng, _HEADERS)))  # type: ignore[call-overload]
            case 3 if at:
                lines[at] = lines[at].partition(b":")[0] + b": " + str(pick(rng, ENDS)).encode()
            case 4:
                lines.insert(at + 1, lines[at])
            case 5:
                body = body[: int(rng.integers(len(body) + 1))]
            case 6:
                body = b"%x\r\n" % int(rng.integers(1 << 40)) + body
            case _:
                lines[at] = lines[at][: int(rng.integers(len(lines[at]) + 1))]
    return b"\r\n".join(lines) + b"\r\n\r\n" + body


def _use_answer(path: Path) -> object:
    import os

    from barpc.base import remote

    server = _server(os.getpid())
    server.data = path.read_bytes()
    at = Remote(f"{server.host}/{path.name}")
    with (
        mock.patch.object(hosts, "WAITS", (0.0,)),
        mock.patch.object(hosts, "TIMEOUT", 2.0),
        mock.patch.object(remote, "_blocks", remote._BlockCache()),
    ):
        pinned = versioned(at, IMAGE)
        read_head(pinned, IMAGE, 100)
        read_bytes(at, RPC_FILE)
        with open_raster(pinned) as image:
            image.read(1)
    return None


# --- values -----------------------------------------------------------------------------------------------


def not_finite(value: object) -> str | None:
    """Where a record that a reader hands out holds a number that is none; of other values nothing is asked."""
    if not is_dataclass(value) or type(value).__name__ not in ("RPC", "Tracks"):  # others say more, later
        return None
    for field in fields(value):
        found = getattr(value, field.name)
        if isinstance(found, (np.ndarray, float)) and not np.isfinite(found).all():
            return f"{type(value).__name__}.{field.name} not finite"
    return None


USED: dict[str, Sample] = {
    "options used": Sample(
        "run.toml",
        _use_options,
        lambda: b'[adjust]\nmodel = "rotation"\nsigma_attitude = 3.0\nfixed = ["view_0000"]\nnoise_floor = 0.02\n',
        (mutate_options, mutate_options, mutate_options, mutate_text),
        share=0.5,
    ),
    "fit options used": Sample(
        "run.toml",
        _use_fit_options,
        lambda: b'[fit]\nmethod = "ridge"\ngrid = [6, 6, 5]\n',
        (mutate_fit_options,),
        share=0.1,
    ),
    **{
        kind: Sample(
            "block.npz",
            _use_block,
            bytes_of(partial(_block_file, sparse=sparse)),
            (mutate_npz, mutate_npz_ends, mutate_npz_ends),
            share=0.3,
        )
        for kind, sparse in {"block used": False, "sparse block used": True}.items()
    },
    "answer": Sample("answer.http", _use_answer, _answer, (mutate_answer,), share=0.3),
}
"""Kind -> sample."""
if find_spec("h5py"):
    USED |= {
        f"matches {kind}": Sample(
            "t.h5",
            lambda path: read_matches(path, ["a", "b"]),
            bytes_of(partial(_hdf5, kind=kind)),
            (mutate_hdf5,),
            beside,
            share=0.3,
        )
        for kind, beside in {"hloc": lambda folder: None, "plain": _beside_plain}.items()
    }
