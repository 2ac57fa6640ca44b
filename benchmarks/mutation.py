"""Small errors put into barpc on purpose: how many do the fast tests catch?

    python benchmarks/mutation.py --sample 150 --seed 1 --json score.json
    python benchmarks/mutation.py --chosen
    python benchmarks/mutation.py --part ba --sample 10 --bar 0.9

Every mutant changes one place of one module in a copy of the tree; the fast tests of the module's part (its folder;
`top`: the modules beside the folders) are run there and stop at the first failure. Before that they must pass without a
mutant. What survives has `--slow` seconds of the slow tests of its part, which the landing check runs. Texts, messages,
annotations, logging and sizes of chunks are left alone. Mutants that no test can tell from
the original are named in mutation.toml, with the reason.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOML = Path(__file__).with_suffix(".toml")
TOP = "top"
LONGEST = 1200.0  # seconds of a part's tests without a mutant
LOADED = [
    "cv2",
    "pyproj",
    "pytest",
    "rasterio",
    "scipy.ndimage",
    "scipy.stats",
    "shapely",
]  # once: every run would take seconds
SKIPPED = (".git", "__pycache__", ".venv", "site", "dist", ".*_cache")  # of a tree that is copied

COMPARISONS = {
    ast.Lt: ("<", "<=", ">"), ast.LtE: ("<=", "<", ">="), ast.Gt: (">", ">=", "<"), ast.GtE: (">=", ">", "<="),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
}  # fmt: skip
ARITHMETIC = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.FloorDiv: ("//", "/"),
    ast.Mod: ("%", "*"), ast.Pow: ("**", "*"), ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
}  # fmt: skip
CHECKED = "strict"  # of a zip: what it checks holds, and so does without
NO_CODE = {"annotation", "returns", "decorator_list", "type_params", "msg"}
SILENT = (
    b"_LOG.",
    b"warnings.",
    b"np.errstate",
    b"field(",
    b"TypeVar",
    b"_LISTED",
    b"CHUNK",
    b"logging.",
    b"logger.",
)

Change = tuple[int, int, str]


@dataclass(frozen=True)
class Mutant:
    """One change: bytes start to stop of a file become `new`."""

    file: str
    start: int
    stop: int
    new: str

    @property
    def part(self) -> str:
        """Which tests are to catch it."""
        return part_of(Path(self.file))

    def source(self) -> tuple[str, str]:
        """The file before and after."""
        raw = (ROOT / self.file).read_bytes()
        return raw.decode(), (raw[: self.start] + self.new.encode() + raw[self.stop :]).decode()

    def lines(self) -> tuple[int, list[str], list[str]]:
        """Where the lines begin that it changes (from 1), and what stands there before and after."""
        raw = (ROOT / self.file).read_bytes()
        first = raw.rfind(b"\n", 0, self.start) + 1
        last = len(raw) if (end := raw.find(b"\n", self.stop)) < 0 else end
        after = raw[first : self.start] + self.new.encode() + raw[self.stop : last]
        return (
            raw.count(b"\n", 0, first) + 1,
            raw[first:last].decode().splitlines(),
            after.decode().splitlines(),
        )

    def diff(self) -> str:
        """The changed lines."""
        number, before, after = self.lines()
        rows = list(difflib.unified_diff(before, after, lineterm="", n=0))
        return "\n".join([f"{self.file}:{number}", *(row for row in rows[2:] if not row.startswith("@@"))])


class Places:
    """Walks a module and yields (start, stop, new text) of every small error that could be made in it."""

    def __init__(self, raw: bytes) -> None:
        self.raw = raw
        self.lines = [0, *accumulate(map(len, raw.splitlines(keepends=True)))]
        self.open: set[ast.AST] = set()  # the 1 of a length -1 that a reshape works out: any negative one says so

    def _span(self, node: Any) -> tuple[int, int]:
        start = self.lines[node.lineno - 1] + node.col_offset
        return start, self.lines[node.end_lineno - 1] + node.end_col_offset

    def _text(self, node: ast.AST) -> str:
        return self.raw[slice(*self._span(node))].decode()

    def walk(self, node: ast.AST) -> Iterator[Change]:
        """All changes below a node, outside of texts, annotations, messages and logging."""
        if isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Assert):
            return
        if isinstance(node, ast.stmt | ast.Call) and self.raw.startswith(SILENT, self._span(node)[0]):
            return
        if isinstance(node, ast.keyword) and node.arg == CHECKED:
            return
        yield from getattr(self, f"_{type(node).__name__.lower()}", lambda _: ())(node)
        for name, value in ast.iter_fields(node):
            if name in NO_CODE or isinstance(node, ast.Raise):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from self.walk(child)

    def _between(self, left: ast.AST, right: ast.AST, old: str, new: str) -> Change:
        start = self.raw.index(old.encode(), self._span(left)[1], self._span(right)[0])
        return start, start + len(old), new

    def _compare(self, node: ast.Compare) -> Iterator[Change]:
        if len(node.ops) == 1:
            old, *new = COMPARISONS[type(node.ops[0])]
            yield from (self._between(node.left, node.comparators[0], old, other) for other in new)

    def _binop(self, node: ast.BinOp) -> Iterator[Change]:
        text = isinstance(node.left, ast.JoinedStr) or isinstance(getattr(node.left, "value", None), str)
        if type(node.op) in ARITHMETIC and not text:
            yield self._between(node.left, node.right, *ARITHMETIC[type(node.op)])

    def _augassign(self, node: ast.AugAssign) -> Iterator[Change]:
        if type(node.op) in ARITHMETIC:
            old, new = ARITHMETIC[type(node.op)]
            yield self._between(node.target, node.value, old + "=", new + "=")

    def _boolop(self, node: ast.BoolOp) -> Iterator[Change]:
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        yield self._between(node.values[0], node.values[1], old, new)

    def _unaryop(self, node: ast.UnaryOp) -> Iterator[Change]:
        yield (*self._span(node), f"({self._text(node.operand)})")

    def _constant(self, node: ast.Constant) -> Iterator[Change]:
        number = node.value
        if isinstance(number, bool | int | float) and node not in self.open:
            other = not number if isinstance(number, bool) else number + 1
            if isinstance(number, float):
                other = 2 * number or 1.0
            yield (*self._span(node), repr(other))

    def _ifexp(self, node: ast.IfExp) -> Iterator[Change]:
        test, one, two = map(self._text, (node.test, node.body, node.orelse))
        yield (*self._span(node), f"{two} if {test} else {one}")

    def _if(self, node: ast.If) -> Iterator[Change]:
        if isinstance(node.body[-1], ast.Raise | ast.Return | ast.Continue):
            yield (*self._span(node.test), "False")

    def _expr(self, node: ast.Expr) -> Iterator[Change]:
        if isinstance(node.value, ast.Call):
            yield (*self._span(node), "pass")

    def _call(self, node: ast.Call) -> Iterator[Change]:
        if getattr(node.func, "attr", "") == "reshape":
            self.open.update(arg.operand for arg in node.args if isinstance(arg, ast.UnaryOp))
        symmetric = isinstance(node.func, ast.Attribute) or self._text(node.func) in ("min", "max")
        if len(node.args) > 1 and not symmetric:
            one, two = node.args[:2]
            if not {type(one), type(two)} & {ast.Starred} and self._text(one) != self._text(two):
                yield self._span(one)[0], self._span(two)[1], f"{self._text(two)}, {self._text(one)}"


def part_of(path: Path) -> str:
    """The part of a file: the innermost of its folders that has tests; of a module beside the folders its own name."""
    names = path.parts[-2:0:-1] or (path.stem,)
    return next((name for name in names if (ROOT / "tests" / name).is_dir()), TOP)


def parts() -> dict[str, list[str]]:
    """Every part of barpc -> its tests, those of a folder or those that stand beside the folders."""
    names = dict.fromkeys(part_of(path.relative_to(ROOT)) for path in sorted((ROOT / "barpc").rglob("*.py")))
    tests = {name: sorted((ROOT / "tests" / name).glob("test_*.py")) for name in names}
    if {"verbs", "cli"} <= set(tests):
        tests["verbs"] += tests["cli"]  # which call them
    tests[TOP] = sorted((ROOT / "tests").glob("test_*.py"))
    own = Path("tests/test_mutation.py")
    return {name: [str(p) for path in tests[name] if (p := path.relative_to(ROOT)) != own] for name in names}


def mutants(chosen_parts: Iterable[str]) -> list[Mutant]:
    """All mutants of the modules of some parts, in the order of their places."""
    found = []
    for path in sorted((ROOT / "barpc").rglob("*.py")):
        name = path.relative_to(ROOT)
        if part_of(name) in chosen_parts:
            raw = path.read_bytes()
            for start, stop, new in Places(raw).walk(ast.parse(raw)):
                found.append(Mutant(str(name), start, stop, new))
    return found


def chosen() -> list[Mutant]:
    """The mutants that mutation.toml lists by hand."""
    return [_listed(row) for row in tomllib.loads(TOML.read_text())["chosen"]]


def _listed(row: dict[str, str]) -> Mutant:
    raw = (ROOT / row["file"]).read_bytes()
    if raw.count(row["old"].encode()) != 1:
        raise SystemExit(f"{TOML.name}: {row['old']!r} stands {raw.count(row['old'].encode())} times in {row['file']}")
    start = raw.index(row["old"].encode())
    return Mutant(row["file"], start, start + len(row["old"].encode()), row["new"])


def equivalents() -> dict[tuple[str, str], str]:
    """(file, changed line) -> why no test can tell it from the original."""
    rows = tomllib.loads(TOML.read_text()).get("equivalent", [])
    return {(row["file"], row["line"]): row["why"] for row in rows}


def changed(mutant: Mutant) -> str:
    """The lines that a mutant puts in, as one."""
    return " ".join(row[1:].strip() for row in mutant.diff().splitlines()[1:] if row.startswith("+"))


class Tree:
    """A copy of the working tree, in which tests are run."""

    def __init__(self, folder: Path) -> None:
        self.root, self.versions = folder, 0
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*SKIPPED), dirs_exist_ok=True)

    def caught(self, mutant: Mutant, tests: list[str], limit: float, slow: float = 0.0) -> tuple[bool, str, float]:
        """Whether tests fail with the mutant in the tree; the test that did; seconds.

        Where the fast ones do not, the slow ones of the landing check have `slow` seconds; one of them that fails
        without the mutant, too, does not count.
        """
        target = self.root / mutant.file
        before, after = mutant.source()
        written = target.stat().st_mtime
        self.versions += 1
        target.write_text(after)
        # compiled code is kept by the time and length of its source: no two versions of a file have the same
        os.utime(target, (written, written + 10.0 * self.versions))
        named = target.stem.removeprefix("_")
        order = sorted(tests, key=lambda path: named not in Path(path).name)
        try:
            found, test, seconds = self.failing(order, limit)
            if found or not slow:
                return found, test, seconds
            found, test, more = self.failing(order, slow, "slow and not nightly")
        finally:
            target.write_text(before)
            os.utime(target, (written, written))
        place = re.match(r"(?:FAILED|ERROR) (\S+?)(?:\[| - |$)", test)
        real = found and place is not None and not self.failing([place[1]], LONGEST, "slow and not nightly")[0]
        return real, test if real else "", seconds + more

    def failing(self, tests: list[str], limit: float, marks: str = "not slow") -> tuple[bool, str, float]:
        """Run tests in a process of their own, file by file as given, up to the first that fails.

        It is forked from one that has done nothing yet: numba ends what is forked from a process with its threads.
        """
        start, log = time.monotonic(), self.root / "log.txt"
        log.write_text("")
        clean = multiprocessing.get_context("forkserver")
        clean.set_forkserver_preload(LOADED)
        child = clean.Process(target=self._run, args=(log, tests, marks))
        child.start()
        child.join(limit)
        if child.is_alive():
            os.killpg(child.pid or 0, signal.SIGKILL)
            child.join()
            return True, "too slow", limit
        named = [line for line in log.read_text().splitlines() if line.startswith(("FAILED", "ERROR"))]
        code = child.exitcode
        told = named[0][:160] if named else f"no test is named: exit code {code}" if code else ""
        return code != 0, told, time.monotonic() - start

    def _run(self, log: Path, tests: list[str], marks: str) -> None:
        """The forked process: pytest on the tree's own modules, none of which is imported yet."""
        os.setsid()
        os.chdir(self.root)
        sys.path.insert(0, str(self.root))
        for name in [name for name in sys.modules if name.split(".")[0] in ("barpc", "benchmarks", "tests")]:
            del sys.modules[name]
        sys.dont_write_bytecode = False  # compiled once, not for every mutant
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        shared = os.environ.get("BARPC_SHARED", str(ROOT.parent / "shared"))
        os.environ.update(PYTHONPATH=str(self.root), BARPC_SHARED=shared)
        clock = Clock(self.root / "seconds.json")
        arguments = ["-x", "-q", "-m", marks, "-p", "no:cacheprovider", *tests]
        with log.open("w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
            sys.stdout = sys.stderr = file
            found = int(pytest.main(arguments, plugins=[clock]))
        os._exit(found)


class Clock:
    """Pytest's plugin that writes the seconds of each file of tests."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.seconds: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count the seconds of a test."""
        name = report.nodeid.partition("::")[0]
        self.seconds[name] = self.seconds.get(name, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        """Write them."""
        self.path.write_text(json.dumps(self.seconds))


def run(picked: list[Mutant], jobs: int, slow: float = 0.0) -> Iterator[dict[str, object]]:
    """Every mutant's fate, one after the other, as rows of the score."""
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(jobs) as pool:
        trees: SimpleQueue[Tree] = SimpleQueue()
        for i in range(jobs):
            trees.put(Tree(Path(temporary) / str(i)))
        tests: dict[str, list[str]] = {}
        limit: dict[str, float] = {}

        def sound(part: str) -> None:
            """Refuse tests that fail anyway; the quick ones run first from then on."""
            tree = trees.get()
            failed, test, seconds = tree.failing(parts()[part], LONGEST)
            print(f"{part}: {seconds:.0f} s without a mutant", flush=True)
            if failed:
                raise SystemExit(f"{part}: the tests fail without a mutant: {test}")
            known = json.loads((tree.root / "seconds.json").read_text())
            trees.put(tree)
            tests[part] = sorted(parts()[part], key=lambda path: known.get(path, 0.0))
            limit[part] = 60.0 + 5.0 * seconds

        def one(mutant: Mutant) -> dict[str, object]:
            why = equivalents().get((mutant.file, changed(mutant)))
            tree, part = trees.get(), mutant.part
            found, test, seconds = (False, "", 0.0) if why else tree.caught(mutant, tests[part], limit[part], slow)
            trees.put(tree)
            fate = "equivalent" if why else "caught" if found else "SURVIVED"
            print(f"{fate} {seconds:.0f} s {test or why or ''}\n{mutant.diff()}", flush=True)
            return {"part": part, "fate": fate, "test": test, "why": why, "diff": mutant.diff()}

        list(pool.map(sound, dict.fromkeys(mutant.part for mutant in picked)))
        yield from pool.map(one, picked)


def score(rows: list[dict[str, object]]) -> dict[str, object]:
    """Counts by part, and the share of what is not equivalent that was caught."""
    shares = {}
    for part in [*dict.fromkeys(str(row["part"]) for row in rows), "all"]:
        fates = [row["fate"] for row in rows if part in ("all", row["part"])]
        counts = {fate: fates.count(fate) for fate in ("caught", "SURVIVED", "equivalent")}
        if fates:
            real = len(fates) - counts["equivalent"]
            shares[part] = {**counts, "share": round(counts["caught"] / real, 3) if real else None}
    return {
        "score": shares,
        "survivors": [row["diff"] for row in rows if row["fate"] == "SURVIVED"],
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sample", type=int, default=60, help="mutants drawn at random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", action="append", choices=[*parts()], help="part of barpc; all by default")
    parser.add_argument("--chosen", action="store_true", help="the listed mutants instead of a sample")
    parser.add_argument("--survivors", type=Path, help="only the survivors of this score, again")
    parser.add_argument("--skip", type=int, default=0, help="leave out so many of the sample's first mutants")
    parser.add_argument("--slow", type=float, default=0.0, help="seconds of slow tests for what fast ones do not catch")
    parser.add_argument("--json", type=Path, help="where the score is written")
    parser.add_argument("--bar", type=float, default=0.0, help="least share that must be caught")
    parser.add_argument("-j", type=int, default=1, dest="jobs")
    args = parser.parse_args()
    wanted = args.part or [*parts()]
    picked = chosen() if args.chosen else mutants(wanted)
    if args.survivors:
        again = set(json.loads(args.survivors.read_text())["survivors"])
        picked = [mutant for mutant in picked if mutant.diff() in again]
    elif not args.chosen:
        picked = random.Random(args.seed).sample(picked, min(args.sample, len(picked)))[args.skip :]
    rows: list[dict[str, object]] = []
    found = score(rows)
    for row in run([m for m in picked if m.part in wanted], args.jobs, args.slow):
        rows.append(row)
        found = score(rows)
        if args.json:
            args.json.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found["score"], indent=1))
    share = found["score"].get("all", {}).get("share")  # type: ignore[attr-defined]
    if share is not None and share < args.bar:
        raise SystemExit(f"{share:.0%} caught, {args.bar:.0%} wanted")


if __name__ == "__main__":
    main()
