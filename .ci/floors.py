"""Print constraints that pin every dependency of pyproject.toml to the lowest version that it allows.

python .ci/floors.py > floors.txt && pip install -c floors.txt '.[test,cluster]'
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

EXTRAS = ("report", "cluster", "test")


def floor(line: str) -> str:
    """`name==lowest` of a requirement that must state one."""
    requirement = Requirement(line)
    lowest = [clause.version for clause in requirement.specifier if clause.operator == ">="]
    if len(lowest) != 1:
        raise SystemExit(f"{line}: states no lowest version; say one with >=")
    return f"{requirement.name}=={lowest[0]}"


def main() -> None:
    """Print them, one a line."""
    path = Path(__file__).resolve().parents[1] / "pyproject.toml"
    project = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    lines = list(project["dependencies"])
    for extra in EXTRAS:
        lines += project["optional-dependencies"][extra]
    lines = [line for line in lines if Requirement(line).name != project["name"]]
    print("\n".join(sorted(map(floor, lines))))


if __name__ == "__main__":
    main()
