"""Out of memory is called so, wherever it strikes, and nothing else is."""

from __future__ import annotations

import errno
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from barpc import __version__
from barpc.base import errors
from barpc.base.errors import BarpcError, ImageError, InputError, out_of_memory
from barpc.pipeline import verify_outputs
from barpc.pipeline.executor import run_batch
from tests.cli.conftest import verb  # noqa: F401
from tests.cli.test_main import run
from tests.reliability.trials import SAMPLES, crop

resource = pytest.importorskip("resource")
ROOT = Path(__file__).resolve().parents[2]
SAID = "barpc: out of memory; what was finished is kept: run the same command again, with a smaller -j or [tie] tile\n"


OPENBLAS = "OpenBLAS error: Memory allocation still failed after 10 retries, giving up.\n"
"""It ends the process by itself, with exit 1."""


def from_cv2(text: str) -> Exception:
    return type("error", (Exception,), {"__module__": "cv2"})(text)


def caused(error: Exception, cause: BaseException, handled: bool = False) -> Exception:
    if handled:
        error.__context__ = cause
    else:
        error.__cause__ = cause
    return error


MAPPED = ImportError("cv2.abi3.so: failed to map segment from shared object")
CERTAIN = [
    MemoryError(),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
    from_cv2("OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 1000000 bytes"),
    caused(ImportError("numpy could not be imported"), MemoryError()),
    caused(RuntimeError("x"), caused(ValueError("y"), MemoryError()), handled=True),
]
LIKELY = [
    MAPPED,
    ImportError("x.so: cannot map zero-fill pages: Cannot allocate memory"),
    caused(ImportError("numpy could not be imported"), MAPPED),
    RuntimeError("can't start new thread"),
    RuntimeError("GDAL: Out of memory allocating 5 bytes"),
    OSError("Unable to synchronously open file (unable to allocate memory)"),
]
OTHER = [
    ImportError("No module named 'numpy'"),
    ImportError("libcudart.so.11: cannot open shared object file: No such file or directory"),
    ImportError("libgomp.so: cannot allocate memory in static TLS block"),
    ImportError("x.so: failed to map segment from shared object: Operation not permitted"),
    ImportError("cannot import name 'memory' from 'x'"),
    OSError(errno.ENOSPC, "No space left on device"),
    from_cv2("OpenCV(5.0.0) error: (-215:Assertion failed) size"),
    ValueError("memory"),
    ImageError("Out of memory.tif: no such file"),  # a name of a file
    caused(KeyError("k"), ImageError("failed to map segment")),
]


@pytest.fixture(params=[True, False], ids=["room", "no room"])
def room(request, monkeypatch) -> bool:
    monkeypatch.setattr(errors, "has_room", lambda: request.param)
    return request.param


@pytest.fixture
def told(verb, capsys) -> Callable[[BaseException], str]:  # noqa: F811
    """What the command says of a verb that ends in an error."""

    def ends_in(error: BaseException) -> str:
        verb(error)
        assert run("info") == 1
        return capsys.readouterr().err.removeprefix("barpc: ")

    return ends_in


@pytest.mark.parametrize("error", CERTAIN, ids=repr)
def test_what_says_that_memory_is_out_is_taken_at_its_word(error, room) -> None:
    assert out_of_memory(error)


@pytest.mark.parametrize("error", LIKELY, ids=repr)
def test_what_may_say_so_is_believed_where_there_is_none(error, room, told) -> None:
    assert out_of_memory(error) is not room
    assert told(error).startswith("out of memory;") is not room


@pytest.mark.parametrize("error", OTHER, ids=repr)
def test_nothing_else_is_called_so(error, room, told) -> None:
    assert not out_of_memory(error)
    assert "out of memory;" not in told(error)


def test_a_chain_that_bites_its_tail_ends() -> None:
    first, second = ValueError("a"), ValueError("b")
    first.__cause__, second.__cause__ = second, first
    assert not out_of_memory(first)


def test_no_file_is_blamed_for_want_of_memory(room) -> None:
    """Wherever a reader makes its own sentence of whatever was raised."""
    expected = InputError if room else MemoryError  # with room it is the file that asked for too much
    with pytest.raises(expected):
        try:
            raise MemoryError
        except MemoryError as error:
            raise InputError("a.npz: not an archive of arrays") from error
    with pytest.raises(InputError):
        try:
            raise ValueError("x")
        except ValueError as error:
            raise InputError("a.npz: not an archive of arrays") from error
    with pytest.raises(BarpcError):
        raise InputError("alone")
    assert str(pickle.loads(pickle.dumps(InputError("from a worker")))) == "from a worker"


def test_no_reader_of_a_file_that_was_written_is_blamed(tmp_path, monkeypatch) -> None:
    def fail(_path: Path) -> None:
        raise MemoryError

    one = verify_outputs.Consumer("barpc", fail)  # type: ignore[arg-type]
    monkeypatch.setattr(verify_outputs, "_consumers", lambda _: {"barpc": one})
    with pytest.raises(MemoryError):
        verify_outputs._consumer_readings(tmp_path / "x_RPC.TXT", lambda _, read: (0.0, 0.0))


def test_a_worker_says_what_its_own_memory_is(room) -> None:
    def fail() -> None:
        raise MAPPED

    (outcome,), _ = run_batch(fail, [()], __version__)
    assert outcome[2] is MAPPED if room else isinstance(outcome[2], MemoryError)


@pytest.mark.slow
@pytest.mark.landing(2)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems bound no address space")
@pytest.mark.parametrize("megabytes", [250, 550, 350, 450, 500, 600, 625, 650, 700, 800, 1000])
@pytest.mark.parametrize("word", ["adjust", "verify"])
def test_a_bound_on_memory_is_one_line_that_says_so(tmp_path, word, megabytes) -> None:
    """OpenBLAS waited for ever, deaf to signals; a loader's word was a bug, a file not reopened a full disk."""
    images = [crop(path, tmp_path / path.name) for path in SAMPLES[:2]]
    command = [sys.executable, "-m", "barpc", "-q", "adjust", *map(str, images), "-o", str(tmp_path / "out")]
    if word == "verify":
        assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode in (0, 3)
        command = [sys.executable, "-m", "barpc", "-q", "verify", str(tmp_path / "out")]
    limit = megabytes << 20
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )  # fmt: skip
    if megabytes < 550:
        assert done.returncode == 1
    assert done.returncode in (0, 1, 3)
    assert done.returncode != 1 or done.stderr in (SAID, OPENBLAS if megabytes > 550 else SAID)
