"""Constants that are numbers, each doubled and halved: which figure moves, and by how much.

A figure is what `adjust_tracks` leaves in a world of `benchmarks/worlds.py`: RMS over the worst stretch of a view [px],
observations that were cut, the stated sigma of the scene's place. For each constant and factor one row:
  px      largest change of what is left, in units of the noise of the tie points (0.1 px), with the world's name
  cut     largest change of the number of cut observations, as part of them
  sigma   largest change of the scene's sigma, as a logarithm
  CPU     seconds beside those of the constant as it is
`same` where no figure of any world changes by a bit; `fails` where a run ends in an error (a size that others must
match). A constant that is an argument's default is not reached.

    python -m benchmarks.ablation barpc.ba.select               # all numbers of a room
    python -m benchmarks.ablation barpc.ba --only _SURE SURE --worlds local:0 swing:0 --factors 0.5 2
    python -m benchmarks.ablation --mechanisms                  # each way of explaining residuals switched off
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import multiprocessing
import os
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import numpy as np  # noqa: E402  (the thread counts come first)

from benchmarks.worlds import judge, solver  # noqa: E402
from benchmarks.worlds_families import World, make  # noqa: E402

WORLDS = (
    "clean:0", "priors:1", "local:0", "local:1", "swing:0", "swing:1", "cloud:1", "foreign:1", "two:1", "agile:0",
    "angles:0", "control:0", "dem:1", "wrong_dem:0",
)  # fmt: skip
"""One of a kind that takes seconds."""
NOISE = 0.1  # px, of the tie points of every world


MOVED = (
    "local:0", "local:2", "local:4", "local:6", "local:7", "swing:1", "swing:3", "wander:2", "foreign:0",
    "foreign:2", "two:1", "agile:0", "priors:1", "biased:1", "control:1", "glacier:0", "glacier:2", "fault:1",
    "fault:2", "glacier:22", "lost:0", "lost:2", "lost:3", "lost:5", "slide:1", "cloud:1", "dem:0", "plane:0",
)  # fmt: skip
"""Worlds of every family, for whole mechanisms."""
MECHANISMS: dict[str, Any] = {
    "restart from a consensus": ("solution._is_suspect", lambda *_: False),
    "drift of a higher degree": ("solution._with_more_drift", lambda first, *_: first),
    "control that distorts": ("solution._without_distorting_control", lambda found, *_: found),
    "foreign camera": ("select.models.find_foreign_camera", lambda *_: (None, None)),
    "search of terms": ("select.models.search_terms", lambda *_, **__: importlib.import_module(_BEAM).Selection()),
    "veto of check tracks": ("select.image_terms.is_admitted", lambda *_: True),
    "terms in the images": ("select.models.with_terms", lambda found, *_: found),
    "splines and detectors": ("select.models.with_splines select.image_terms.with_splines", lambda found, *_: found),
    "terms beside splines": ("select.models.with_terms_beside_splines", lambda smooth, *_: smooth),
    "line of detectors": ("terms.detector_line.change_points", lambda *_: []),
    "affine in the image": ("select.models._with_image_affine", lambda *_: None),
    "correlated noise": ("select.beam.correlated_log_ratio select.anomalies.correlated_log_ratio", lambda *_: 0.0),
    "rivals side by side": ("select.beam._rivals", lambda _: []),
    "parts that hold a moving group": ("select.beam.TermSearch._parts_at_motion", lambda *_: []),
    "simpler terms": ("terms.decay.Decay.simpler", lambda *_: None),
    "alternatives of a low frequency": ("terms.low_frequency.LowFrequency.alternatives", lambda *_: []),
    "steps": ("terms.step.Step.propose", lambda *_: []),
    "decays": ("terms.decay.Decay.propose", lambda *_: []),
    "transients": ("terms.transient.Transient.propose", lambda *_: []),
    "low frequencies": ("terms.low_frequency.LowFrequency.propose", lambda *_: []),
    "sinusoids": ("select.beam.find_periods select.anomalies.find_periods", lambda *_: []),
    "moving objects": ("terms.moving_objects.MovingObjects.of", lambda *_: []),
}
"""A mechanism -> the functions of `barpc.ba` that it stands in, and what they are replaced by."""
_BEAM = "barpc.ba.select.beam"


@dataclass(frozen=True)
class Mechanism:
    """One of `MECHANISMS`."""

    name: str

    def set(self, _factor: float) -> None:
        """Switch it off, in this process."""
        for target, name in self.places():
            setattr(target, name, MECHANISMS[self.name][1])

    def places(self) -> Iterator[tuple[Any, str]]:
        """Yield modules or classes, and the name of its function there."""
        for place in MECHANISMS[self.name][0].split():
            *modules, last = f"barpc.ba.{place}".split(".")
            owner = modules[-1] if modules[-1][0].isupper() else None
            target = importlib.import_module(".".join(modules[:-1] if owner else modules))
            target = getattr(target, owner) if owner else target
            assert hasattr(target, last), place
            yield target, last


@dataclass(frozen=True)
class Constant:
    """A name at the top of a module whose value is a number, or a tuple of numbers."""

    module: str
    name: str

    def value(self) -> Any:
        """As it is."""
        return getattr(importlib.import_module(self.module), self.name)

    def set(self, factor: float) -> None:
        """Multiply it where it stands and where it was imported to."""
        old = self.value()
        new = _times(old, factor)
        for name, module in list(sys.modules.items()):
            if name == self.module or (name.startswith("barpc") and self._imported(module)):
                setattr(module, self.name, new)

    def _imported(self, module: Any) -> bool:
        path = getattr(module, "__file__", None)
        if path is None or self.name not in vars(module):
            return False
        body = ast.parse(Path(path).read_text(encoding="utf-8")).body
        places = [node for node in body if isinstance(node, ast.ImportFrom) and node.module == self.module]
        return any(alias.name == self.name for node in places for alias in node.names)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(_times(part, factor) for part in value)
    return max(round(value * factor), 1) if isinstance(value, int) else value * factor


def constants(package: str) -> Iterator[Constant]:
    """Those of all modules below a package."""
    place = ROOT / Path(*package.split("."))
    for path in [place.with_suffix(".py")] if place.with_suffix(".py").exists() else sorted(place.rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = (
                node.targets
                if isinstance(node, ast.Assign)
                else [node.target]
                if isinstance(node, ast.AnnAssign)
                else []
            )
            for name in names:
                if isinstance(name, ast.Name) and _is_number(Constant(module, name.id).value()):
                    yield Constant(module, name.id)


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(_is_number(part) for part in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def figures(task: tuple[Constant | Mechanism | None, float, tuple[str, ...]]) -> list[dict[str, Any]] | str:
    """What every world is left with, in a process of its own; an error's name."""
    constant, factor, worlds = task
    if constant is not None:
        constant.set(factor)
    try:
        return [_figures(made(world)) for world in worlds]
    except Exception as error:  # noqa: BLE001  (whatever a number that makes no sense does)
        return type(error).__name__


@cache
def made(name: str) -> World:
    """The world of a family and a seed; of those that the parent made, workers have copies."""
    family, seed = name.split(":")
    return make(family, int(seed))


def _figures(world: World) -> dict[str, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        said = solver(world)
    judged = judge(world, said.adjusted)
    return {
        "left": judged.left,
        "shape": judged.shape,
        "cut": said.rejected / len(world.tracks),
        "sigma": said.sigma,
        "seconds": said.seconds,
    }


def row(found: list[dict[str, Any]] | str, base: list[dict[str, Any]], worlds: tuple[str, ...]) -> dict[str, Any]:
    """A line of the table: largest changes over the worlds."""
    if isinstance(found, str):
        return {"fails": found}
    px = np.array([a["left"] - b["left"] for a, b in zip(found, base, strict=True)]) / NOISE
    cut = np.array([a["cut"] - b["cut"] for a, b in zip(found, base, strict=True)])
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.array([np.log(np.divide(a["sigma"], b["sigma"])) for a, b in zip(found, base, strict=True)])
    cpu = sum(a["seconds"] for a in found) / sum(b["seconds"] for b in base)
    px, sigma = np.nan_to_num(px, nan=np.inf), np.nan_to_num(sigma)
    if not (px.any() or cut.any() or sigma.any()):
        return {"same": True, "cpu": cpu}
    worst = int(np.argmax(np.abs(px)))
    return {
        "px": float(px[worst]), "world": worlds[worst], "cut": float(cut[np.argmax(np.abs(cut))]),
        "sigma": float(np.abs(sigma).max()), "cpu": cpu,
    }  # fmt: skip


def line(constant: Constant, factor: float, got: dict[str, Any]) -> str:
    """For the table."""
    head = f"| {constant.module.removeprefix('barpc.')}.{constant.name} | {constant.value()} | x {factor:g} |"
    if "fails" in got:
        return f"{head} fails: {got['fails']} | | | |"
    if "same" in got:
        return f"{head} same | | | {got['cpu']:.2f} |"
    return f"{head} {got['px']:+.2f} ({got['world']}) | {got['cut']:+.4f} | {got['sigma']:.3f} | {got['cpu']:.2f} |"


def ablate_mechanisms(names: list[str], worlds: tuple[str, ...], workers: int) -> None:
    """Print a row a mechanism: CPU beside all of them, and the worlds that end otherwise, px and m of shape."""
    for world in worlds:
        made(world)
    tasks = [(None, 1.0, worlds), *((Mechanism(name), 1.0, worlds) for name in names)]
    print("| without | CPU | worse | better |\n|---|---|---|---|", flush=True)
    with multiprocessing.get_context("fork").Pool(workers, maxtasksperchild=1) as pool:
        base: Any = None
        for n, got in enumerate(pool.imap(figures, tasks)):
            if n == 0:
                base = got
                continue
            if isinstance(got, str) or isinstance(base, str):
                print(f"| {names[n - 1]} | | fails: {got if isinstance(got, str) else base} | |", flush=True)
                continue
            cells: list[list[str]] = [[], []]
            for world, a, b in zip(worlds, got, base, strict=True):
                for key, unit, floor in (("left", "px", 0.01), ("shape", "m", 0.1)):
                    more, less = max(a[key], b[key]), min(a[key], b[key])
                    if more > 1.2 * less + floor:
                        cells[int(a[key] < b[key])].append(f"{world} {b[key]:.3g} -> {a[key]:.3g} {unit}")
            cpu = sum(a["seconds"] for a in got) / sum(b["seconds"] for b in base)
            print(f"| {names[n - 1]} | {cpu:.2f} | {'; '.join(cells[0])} | {'; '.join(cells[1])} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", nargs="?", default="barpc.ba", help="such as barpc.ba.select")
    parser.add_argument("--only", nargs="+", help="names of constants")
    parser.add_argument("--worlds", nargs="+", default=(), help="FAMILY:SEED")
    parser.add_argument("--mechanisms", action="store_true", help="switch off each way of explaining residuals")
    parser.add_argument("--factors", nargs="+", type=float, default=(0.5, 2.0))
    parser.add_argument("-j", type=int, default=1, help="worker processes")
    parser.add_argument("--json", type=Path, help="rows so far, written after each; gone on from")
    args = parser.parse_args()
    worlds = tuple(args.worlds or (MOVED if args.mechanisms else WORLDS))
    if args.mechanisms:
        ablate_mechanisms([name for name in MECHANISMS if not args.only or name in args.only], worlds, args.j)
        return
    wanted = [c for c in constants(args.package) if not args.only or c.name in args.only]
    tasks = [(c, f, worlds) for c in wanted for f in args.factors]
    known = json.loads(args.json.read_text()) if args.json and args.json.exists() else {}
    print(
        "| constant | value | times | left [noise] | cut | sigma | CPU |\n|---|---|---|---|---|---|---|",
        flush=True,
    )
    for world in worlds:
        made(world)
    with multiprocessing.get_context("fork").Pool(args.j, maxtasksperchild=1) as pool:
        base = pool.apply(figures, ((None, 1.0, worlds),))
        if isinstance(base, str):
            sys.exit(f"the worlds as they are: {base}")
        new = [t for t in tasks if _key(t) not in known]
        for task, found in zip(new, pool.imap(figures, new), strict=True):
            known[_key(task)] = row(found, base, worlds)
            if args.json:
                args.json.write_text(json.dumps(known, indent=1))
            print(line(task[0], task[1], known[_key(task)]), flush=True)


def _key(task: tuple[Constant, float, tuple[str, ...]]) -> str:
    return f"{task[0].module}.{task[0].name} {task[1]:g}"


if __name__ == "__main__":
    main()
