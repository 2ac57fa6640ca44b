"""Google's and Azure's stores: against their emulators on this machine, and stores that misbehave against a stub."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from barpc.base.errors import ImageError
from barpc.base.remote import REQUEST_BYTES, RemoteFile, located
from barpc.base.safe_io import IMAGE, read_bytes, versioned
from barpc.cameras import open_camera
from barpc.pipeline import load_views

pytestmark = pytest.mark.usefixtures("forgotten")
SAMPLES = Path(__file__).resolve().parents[2] / "data_samples"
DATA = (SAMPLES / "view_00.tif").read_bytes()
ACCOUNT = "DefaultEndpointsProtocol=http;AccountName=devstoreaccount1;AccountKey="
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="  # everyone's


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def answering(port: int) -> None:
    for _ in range(300):
        with socket.socket() as tried:
            if tried.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    pytest.fail("the emulator did not start")


@pytest.fixture(scope="module")
def google() -> Iterator[dict[str, str]]:
    with pytest.MonkeyPatch.context() as patch:  # looked at when it is imported
        patch.setenv("GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT", "false")
        pytest.importorskip("gcsfs")
    emulator = pytest.importorskip("gcp_storage_emulator.server")
    port = free_port()
    found = emulator.create_server("127.0.0.1", port, in_memory=True)
    found.start()
    yield {"STORAGE_EMULATOR_HOST": f"http://127.0.0.1:{port}", "FSSPEC_GS_TOKEN": "anon"}
    found.stop()


@pytest.fixture(scope="module")
def azure(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    pytest.importorskip("adlfs")
    program = shutil.which("azurite-blob")
    if program is None:
        pytest.skip("azurite-blob is not on the PATH (npm install azurite)")
    port, place = free_port(), str(tmp_path_factory.mktemp("azurite"))
    words = [program, "--blobPort", str(port), "--location", place, "--silent", "--skipApiVersionCheck"]
    with subprocess.Popen([*words, "--disableTelemetry"], stdout=subprocess.DEVNULL) as process:
        answering(port)
        at = f"BlobEndpoint=http://127.0.0.1:{port}/devstoreaccount1;"
        yield {"AZURE_STORAGE_CONNECTION_STRING": f"{ACCOUNT}{KEY};{at}"}
        process.terminate()


@pytest.fixture(params=["gs", "az"])
def scheme(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    for name, value in request.getfixturevalue({"gs": "google", "az": "azure"}[request.param]).items():
        monkeypatch.setenv(name, value)
    import fsspec

    fsspec.config.set_conf_env(fsspec.config.conf)
    store = fsspec.filesystem(request.param)
    if not store.exists("scenes"):
        store.mkdir("scenes")
    for name in ("view_00.tif", "view_01.tif"):
        store.pipe_file(f"scenes/a/{name}", (SAMPLES / name).read_bytes())
    return str(request.param)


@pytest.mark.slow  # before a commit: test_stores
@pytest.mark.filterwarnings("ignore")
def test_an_emulated_store_is_read(scheme: str) -> None:
    hosts, root = [f"{scheme}://scenes"], f"{scheme}://scenes"
    assert read_bytes(located(f"{root}/a/view_00.tif", hosts), IMAGE) == DATA
    loaded = load_views([f"{root}/a/view_00.tif"], min_views=1, hosts=hosts)
    assert loaded.views[0].sensor == open_camera(SAMPLES / "view_00.tif").rpc
    with pytest.raises(ImageError, match=r"no such file \(its store has no such object or bucket\)"):
        versioned(located(f"{root}/a/missing.tif", hosts), IMAGE)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_an_emulated_object_that_is_replaced_is_noticed_by_who_reads_it(scheme: str) -> None:
    import fsspec

    at = versioned(located(f"{scheme}://scenes/a/view_01.tif", [f"{scheme}://scenes"]), IMAGE)
    with RemoteFile(at) as file:
        file.read(REQUEST_BYTES)
        file.seek(3 * REQUEST_BYTES)
        file.read(REQUEST_BYTES)
        fsspec.filesystem(scheme).pipe_file("scenes/a/view_01.tif", bytes(at.size or 0))
        file.seek(9 * REQUEST_BYTES)
        with pytest.raises(OSError, match="changed in its store"):
            file.read(REQUEST_BYTES)


@pytest.mark.filterwarnings("ignore")
def test_an_account_that_is_not_given_costs_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("adlfs")
    monkeypatch.delenv("AZURE_STORAGE_CONNECTION_STRING", raising=False)
    with pytest.raises(ImageError, match="ValueError: unable to connect to account") as caught:
        versioned(located("az://scenes/a.tif", ["az://scenes"]), IMAGE)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore")
def test_a_wrong_key_is_said(azure: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = azure["AZURE_STORAGE_CONNECTION_STRING"].replace("Eby8", "Aby8")
    monkeypatch.setenv("AZURE_STORAGE_CONNECTION_STRING", wrong)
    with pytest.raises(ImageError, match="failed to authenticate") as caught:
        versioned(located("az://scenes/a/view_00.tif", ["az://scenes"]), IMAGE)
    assert "\n" not in str(caught.value)
    assert "Aby8" not in str(caught.value)


# --- a store of no kind ------------------------------------------------------------------------------------


def test_a_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec")

    def missing(*_: object, **__: object) -> None:
        raise ImportError("Please install gcsfs to access Google Storage")

    monkeypatch.setattr("fsspec.filesystem", missing)
    with pytest.raises(ImageError, match=r"pip install 'barpc\[remote\]' \(gcsfs is missing\)"):
        versioned(located("gs://scenes/a.tif", ["gs://scenes"]), IMAGE)
