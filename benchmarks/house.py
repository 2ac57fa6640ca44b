"""The size of the house: lines, modules, numbers that decide, long functions, names that stand twice, flags, options.

Numbers are counted by their meanings, so that a constant that is shared counts wherever it means something else: module
constants, modules beyond the first that use a number of `barpc.base.statistics`, floats inside functions other than 0,
0.5, 1, 2 and powers of ten, and numeric defaults of parameters. Names are those of classes, functions and constants of
modules, a leading _ left out. A test pins internals where it names something private of barpc or sets a part of it.

python benchmarks/house.py            # a table of the package and its folders
python benchmarks/house.py --numbers  # every module constant that is a number, with where it stands
python benchmarks/house.py --names    # every name that stands in two modules or more, with where
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "barpc"
USUAL = PACKAGE / "base/statistics.py"
LONG, MANY = 55, 6
"""Lines of a function, and its parameters: more are counted."""


def modules() -> dict[Path, ast.Module]:
    """Every module of the package, parsed."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def is_number(node: ast.expr | None) -> bool:
    """A number, or arithmetic, a tuple or a call of numbers alone: 5, -2.0, 10 * MB, (1, 2), np.log(2)."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) or is_number(right)
        case ast.Tuple(elts=elements) | ast.List(elts=elements):
            return bool(elements) and all(map(is_number, elements))
        case ast.Call(args=arguments, keywords=[]):
            return bool(arguments) and all(map(is_number, arguments))
    return False


def numbers(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and name of each constant of a module whose value is a number."""
    for node in tree.body:
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                pairs = list(zip(names, values, strict=True)) if len(names) == len(values) else []
            case ast.Assign(targets=[target], value=value) | ast.AnnAssign(target=target, value=value):
                pairs = [(target, value)]
            case _:
                continue
        yield from ((node.lineno, name.id) for name, value in pairs if isinstance(name, ast.Name) and is_number(value))


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def parameters(function: ast.FunctionDef) -> int:
    args = function.args
    return sum(arg.arg not in ("self", "cls") for arg in (*args.posonlyargs, *args.args, *args.kwonlyargs))


def is_counted(value: float) -> bool:
    """Whether a float in a function is a choice: not 0, 0.5, 1, 2 or a power of ten, as of units."""
    size = abs(value)
    return size not in (0.0, 0.5, 1.0, 2.0) and abs(np.log10(size) - round(np.log10(size))) > 1e-12


def floats(tree: ast.Module) -> int:
    """Floats inside functions that are choices."""
    inside = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.Lambda)
        for part in (node.body if isinstance(node.body, list) else [node.body])
        for inner in ast.walk(part)
        if isinstance(inner, ast.Constant) and isinstance(inner.value, float)
    }
    return sum(is_counted(node.value) for node in inside)


def defaults(tree: ast.Module) -> int:
    """Parameters whose default is a number."""
    return sum(
        is_number(default) for node in functions(tree) for default in (*node.args.defaults, *node.args.kw_defaults)
    )


def shared(trees: dict[Path, ast.Module]) -> Counter[str]:
    """Modules that use each number of `barpc.base.statistics`."""
    known = {name for _, name in numbers(ast.parse(USUAL.read_text(encoding="utf-8")))}
    found: Counter[str] = Counter()
    for tree in trees.values():
        imported = {
            alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module == "barpc.base.statistics"
            for alias in node.names
        }
        found.update(imported & known)
    return found


def meanings(trees: dict[Path, ast.Module]) -> int:
    """Numbers that decide, by their meanings: see the module's text."""
    uses = shared(trees)
    return sum(sum(1 for _ in numbers(tree)) + floats(tree) + defaults(tree) for tree in trees.values()) + (
        sum(uses.values()) - len(uses)
    )


def twice(trees: dict[Path, ast.Module]) -> dict[str, list[Path]]:
    """Names of classes, functions and constants that stand in two modules or more, a leading _ left out; and where."""
    found: dict[str, list[Path]] = {}
    for path, tree in trees.items():
        names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        for node in tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            names |= {inner.id for one in targets if one for inner in ast.walk(one) if isinstance(inner, ast.Name)}
        for name in {name.lstrip("_") for name in names if not name.endswith("__")}:
            found.setdefault(name, []).append(path)
    return {name: paths for name, paths in sorted(found.items()) if len(paths) > 1}


def measured(trees: dict[Path, ast.Module]) -> tuple[int, ...]:
    lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in trees)
    found = [function for tree in trees.values() for function in functions(tree)]
    return (
        lines,
        len(trees),
        meanings(trees),
        sum(f.end_lineno - f.lineno + 1 > LONG for f in found if f.end_lineno),
        sum(parameters(f) > MANY for f in found),
        len(twice(trees)),
    )


def arrows(trees: dict[Path, ast.Module]) -> int:
    """Pairs of rooms (folders of the package, and modules beside them) of which one imports from the other."""

    def room(dotted: str) -> str:
        return dotted.split(".")[1] if "." in dotted else ""

    found = set()
    for path, tree in trees.items():
        own = room(".".join(path.relative_to(ROOT).with_suffix("").parts))
        for node in ast.walk(tree):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module == "barpc":
                names = [f"barpc.{alias.name}" for alias in node.names]
            found |= {(own, room(name)) for name in names if name.startswith("barpc.") and room(name) != own}
    return len(found)


def is_private(name: str) -> bool:
    """A name with one leading _, but for those that namedtuples have in public."""
    return name.startswith("_") and not name.startswith("__") and name not in ("_", "_replace", "_asdict")


def owner(node: ast.AST) -> str:
    """The name that attributes, items and calls begin with: a for a.b[c](d).e."""
    while isinstance(node, ast.Attribute | ast.Subscript | ast.Call):
        node = node.func if isinstance(node, ast.Call) else node.value
    return node.id if isinstance(node, ast.Name) else ""


def pins(test: ast.FunctionDef, imported: set[str]) -> bool:
    """Whether a test names something private or sets an attribute of what is imported from barpc."""
    own = set(imported)
    for node in ast.walk(test):
        match node:
            case ast.ImportFrom(module=str(module), names=names) if module.startswith("barpc"):
                own |= {alias.asname or alias.name for alias in names}
    for node in ast.walk(test):
        match node:
            case ast.Name(id=name) if is_private(name) and name in own:
                return True
            case ast.Attribute(attr=name) if is_private(name) and owner(node) not in ("self", "cls"):
                return True
            case ast.Call(
                func=ast.Attribute(attr="setattr" | "delattr" | "setitem" | "patch" | "object"), args=[at, *_]
            ):
                text = at.value if isinstance(at, ast.Constant) else None
                if owner(at) in own or str(text).startswith("barpc"):
                    return True
    return False


def tests() -> tuple[int, int, int]:
    """Lines of the tests; tests; tests that pin internals."""
    lines = count = pinned = 0
    for path in (ROOT / "tests").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        tree, lines = ast.parse(text), lines + len(text.splitlines())
        of_barpc = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom | ast.Import)]
        own = {
            (alias.asname or alias.name).split(".")[0]
            for node in of_barpc
            for alias in node.names
            if (getattr(node, "module", None) or alias.name).startswith("barpc")
        }
        found = [function for function in functions(tree) if function.name.startswith("test")]
        count, pinned = count + len(found), pinned + sum(pins(function, own) for function in found)
    return lines, count, pinned


def surface() -> tuple[int, int]:
    """Flags over all verbs, and fields of options."""
    import click

    from barpc.base.declarations import declared
    from barpc.base.options import AdjustOptions, FitOptions, RunOptions, TieOptions
    from barpc.cli import COMMANDS, Verbs

    verbs = Verbs()
    context = click.Context(verbs)
    commands = {verb: verbs.get_command(context, verb) for verb in COMMANDS}
    flags = {
        (verb, flag)
        for verb, command in commands.items()
        for parameter in (command.params if command else ())
        for flag in parameter.opts
        if flag.startswith("--") and not flag.startswith("--help")
    }
    tables = RunOptions, TieOptions, AdjustOptions, FitOptions
    fields = [name for table in tables for name, one in declared(table).items() if one.kind not in tables]
    return len(flags), len(fields)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--numbers", action="store_true")
    parser.add_argument("--names", action="store_true")
    args = parser.parse_args()
    trees = modules()
    if args.names:
        for name, paths in twice(trees).items():
            print(name, *(path.relative_to(PACKAGE) for path in paths))
        return
    if args.numbers:
        for path, tree in trees.items():
            for line, name in numbers(tree):
                print(f"{path.relative_to(ROOT)}:{line} {name}")
        return
    heads = "", "lines", "modules", "numbers", f"> {LONG} lines", f"> {MANY} parameters", "names twice"
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    places = {"barpc": PACKAGE, **{path.name: path for path in sorted(PACKAGE.iterdir()) if path.is_dir()}}
    for name, place in places.items():
        if inside := {path: tree for path, tree in trees.items() if place in path.parents}:
            print(f"| {name} |", " | ".join(map(str, measured(inside))), "|")
    print(f"\n{arrows(trees)} arrows between rooms")
    print("{} lines of tests; of {} tests {} pin internals".format(*tests()))
    print("{} flags over all verbs, {} fields of options".format(*surface()))


if __name__ == "__main__":
    main()
