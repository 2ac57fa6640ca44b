"""SHA256SUMS of a run folder that a test made or changed, as if a run had written it so."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path

from barpc.base.manifest import SUMS, Layer, read, render
from barpc.workspace import own_files


def files(run: Path) -> list[str]:
    """Every file of a run but its state."""
    names = (path.relative_to(run).as_posix() for path in sorted(run.rglob("*")) if path.is_file())
    return [name for name in names if not name.startswith(".barpc/")]


def seal(run: Path) -> Path:
    """Write what an adversary does who knows all: hashes of every file as it is now, also in the state; the folder."""
    head = read(run)[1][0].head if (run / SUMS).exists() else "barpc 0, code 0"
    layer = Layer(head, {name: sha256((run / name).read_bytes()).hexdigest() for name in files(run) if name != SUMS})
    (run / SUMS).write_text(render([layer]))
    if (path := run / ".barpc/state.json").exists():
        state = json.loads(path.read_text())
        state["outputs"] = {**layer.files, SUMS: sha256((run / SUMS).read_bytes()).hexdigest()}
        path.write_text(json.dumps(state))
        (run / ".barpc/outputs.jsonl").unlink(missing_ok=True)
        assert SUMS in own_files(run)
    return run
