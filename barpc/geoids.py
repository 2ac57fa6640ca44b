"""Geoids by name: EGM96 comes with barpc, EGM2008 is looked for where PROJ keeps its grids."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path

from barpc.errors import InputError

_OWN = {"egm96": Path(__file__).with_name("egm96_15.tif")}
"""15 arc minutes, rounded to 1/128 m: of the US National Geospatial-Intelligence Agency, in the public domain."""
_IN_PROJ = {"egm2008": ("us_nga_egm08_25.tif", "egm08_25.gtx")}
GEOIDS = (*_OWN, *_IN_PROJ)


def geoid_file(given: str | os.PathLike[str]) -> str:
    """The file of a geoid grid, given by its path or as one of `GEOIDS`.

    Raises
    ------
    InputError
        It is a name, and none of PROJ's folders holds its grid: the message says where to get it.
    """
    text = os.fspath(given)
    name = text.lower()
    if name not in GEOIDS or Path(text).exists():
        return text
    if name in _OWN:
        return str(_OWN[name])
    folders = proj_folders()
    for folder in folders:
        for file in _IN_PROJ[name]:
            if (folder / file).is_file():
                return str(folder / file)
    first = _IN_PROJ[name][0]
    raise InputError(
        f"geoid {name}: no {' or '.join(_IN_PROJ[name])} in PROJ's folders ({', '.join(map(str, folders)) or 'none'}); "
        f"get it by 'projsync --file {first}' or from https://cdn.proj.org/{first} and give its path, or take egm96"
    )


def proj_folders() -> list[Path]:
    """The folders in which PROJ looks for grids: of its variables, the user, Python packages, the system."""
    said = [part for name in ("PROJ_DATA", "PROJ_LIB") for part in os.environ.get(name, "").split(os.pathsep)]
    folders = [Path(part) for part in said if part] + [_of_user()]
    for package, place in (("rasterio", "proj_data"), ("pyproj", "proj_dir/share/proj")):
        spec = find_spec(package)
        folders += [Path(spec.origin).parent / place] if spec is not None and spec.origin else []
    folders += [Path(root) / "share/proj" for root in (sys.prefix, "/usr/local", "/usr")]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def _of_user() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "proj"
    if sys.platform == "darwin":
        return Path.home() / "Library/Application Support/proj"
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share") / "proj"
