"""What stands for images on the command line: files, folders, patterns, named cameras, the lists of other tools."""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import date
from pathlib import Path, PurePath
from typing import Any

from barpc.errors import BarpcError, InputError
from barpc.remote import is_url
from barpc.sidefile import IMAGE, OPTIONS, parse_json, read_head, read_text

_ENDS = (".tif", ".tiff", ".ntf", ".nitf", ".nsf", ".jp2", ".j2k", ".vrt")
_DEEP = 40  # levels of a configuration


def expanded(specs: Sequence[str]) -> list[str]:
    """Return files instead of folders (their rasters; a radar product is one) and of patterns that no shell took.

    InputError for an empty name, a folder that holds no raster, a pattern that finds nothing.
    """
    found: list[str] = []
    for spec in specs:
        if not spec:  # what an unset variable of a shell leaves, and the current folder to all who open it
            raise InputError("an empty name among the images; give '.' for the current folder")
        name, choices = spec, ""
        if not os.path.lexists(spec) and not is_url(spec):
            name = os.fspath(name_of(spec))
            choices = spec[len(name) :]
        found += [one + choices for one in _files(name)]
    return found


def name_of(spec: str) -> str:
    """Return the file's part of a name with choices behind it, as it was typed."""
    from barpc.cameras import split_spec

    with suppress(BarpcError):
        _, choices = split_spec(spec)
        for key, text in choices.items():
            spec = spec.removesuffix(f",{key}={text}")
        return spec.partition(",")[0] if choices and not os.path.lexists(spec) else spec
    return spec


def _files(name: str) -> list[str]:
    path = Path(name)
    if is_url(name) or not (path.is_dir() or any(char in name for char in "*?[")):
        return [name]
    if path.is_dir():
        if (path / "manifest.safe").exists() or path.suffix.upper() == ".SAFE":
            return [name]
        inside = sorted(entry.name for entry in os.scandir(path) if entry.is_file())
        rasters = [str(path / one) for one in inside if one.lower().endswith(_ENDS) and _is_raster(path / one)]
        if not rasters:
            from barpc.sensor.terrasar import find_annotation

            if find_annotation(path):
                return [name]
            raise InputError(f"{name}: a folder without images ({', '.join(_ENDS)})")
        return rasters
    if os.path.lexists(name):
        return [name]
    matching = sorted(glob.glob(name))  # noqa: PTH207  (a Path would take the ./ away)
    if not matching:
        raise InputError(f"{name}: no file has such a name")
    return matching


def _is_raster(path: Path) -> bool:
    from barpc.raster import driver_of

    with suppress(BarpcError):
        return driver_of(read_head(path, IMAGE, 64)) is not None
    return False


def with_cameras(images: Sequence[str], named: Sequence[str]) -> list[str]:
    """Return images with the cameras that IMAGE=FILE names for them; IMAGE: a path as given, a file's name, its stem.

    InputError for a text that names none of the images, several of them, or one for the second time.
    """
    out, taken = list(images), set[int]()
    bare = [name_of(image) for image in images]
    for text in named:
        fits = [
            (len(key), number)
            for number, image in enumerate(bare)
            for key in {image, PurePath(image).name, PurePath(image).stem}
            if key and text.startswith(f"{key}=")
        ]
        longest = max(fits, default=(0, -1))[0]
        places = {number for size, number in fits if size == longest}
        if len(places) != 1:
            what = "several images" if places else "none of the images"
            raise InputError(f"--rpc {text}: names {what}; give IMAGE=FILE with a path as among the images")
        (number,) = places
        if number in taken:
            raise InputError(f"--rpc {text}: a second camera of {bare[number]}")
        taken.add(number)
        out[number] = _with_camera(out[number], bare[number], text[longest + 1 :])
    return out


def _with_camera(spec: str, image: str, file: str) -> str:
    """Return the image with this file as its camera, if that is not the one that is found anyway."""
    from barpc.rpcio import read_rpc_source

    if not is_url(image) and not is_url(file):
        with suppress(BarpcError):
            if Path(read_rpc_source(image).path).resolve() == Path(file).resolve():
                return spec
    return f"{spec},camera={file}"


# --- configurations of other tools ------------------------------------------------------------------------


@dataclass(frozen=True)
class Item:
    """An image of a configuration: its path, its camera (file, rpcm's dictionary, None), the mapping that says so."""

    image: str
    camera: str | dict[str, Any] | None
    holder: dict[str, Any]


@dataclass(frozen=True)
class Config:
    """A configuration file of another tool, and the images that it lists."""

    tool: str
    path: Path
    data: dict[str, Any]
    items: tuple[Item, ...]

    def images(self, hosts: Sequence[str] = ()) -> list[Any]:
        """Return the images, as `barpc.adjust` takes them."""
        return [_as_image(item, hosts, self.path) for item in self.items]


def read_config(tool: str, file: str) -> Config:
    """Return the images and cameras that a configuration of s2p, CARS or sat-bundleadjust lists; paths relative to it.

    InputError where it does not parse, or lists no images.
    """
    path = Path(file)
    data = _parsed(path)
    try:
        if not isinstance(data, dict):
            raise TypeError("no mapping")
        items = tuple(CONFIGS[tool](data, path.absolute().parent))
        if not items:
            raise ValueError("it lists no images")
    except (KeyError, TypeError, ValueError, AttributeError, StopIteration) as error:
        if isinstance(error, BarpcError):
            raise
        raise InputError(f"{path}: not a configuration of {tool} ({error!r})") from error
    return Config(tool, path, data, items)


def _parsed(path: Path) -> Any:
    text = read_text(path, OPTIONS)
    if path.suffix.lower() in (".yaml", ".yml"):
        return _parsed_yaml(path, text)
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError(f"{path}: not JSON that can be read ({error})") from error


def _parsed_yaml(path: Path, text: str) -> Any:
    try:
        import yaml
    except ImportError:
        raise InputError(f"{path}: YAML is read where PyYAML is installed; give the same as JSON") from None

    class Loader(yaml.SafeLoader):  # type: ignore[misc]  # (no types)
        """Takes no aliases, of which a small file can make endless ones."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("an alias (*name) is not read")
            return super().compose_node(parent, index)

    try:
        return yaml.load(text, Loader)  # noqa: S506  (a safe loader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise InputError(f"{path}: not YAML that can be read ({' '.join(str(error).split())})") from error


def _placed(folder: Path, name: Any) -> str:
    if not isinstance(name, str) or not name:
        raise TypeError(f"{name!r} is no name of a file")
    return name if is_url(name) else str(folder / name)


def _of_s2p(data: dict[str, Any], folder: Path) -> Iterator[Item]:
    for image in data["images"]:
        rpc = image.get("rpc") or None
        camera = rpc if rpc is None or isinstance(rpc, dict) else _placed(folder, rpc)
        yield Item(_placed(folder, image["img"]), camera, image)


def _of_cars(data: dict[str, Any], folder: Path) -> Iterator[Item]:
    given = data.get("input") or data["inputs"]
    for name, sensor in given["sensors"].items():
        holder = sensor if isinstance(sensor, dict) else {"image": sensor}
        given["sensors"][name] = holder
        image, model = holder["image"], holder.get("geomodel")
        if isinstance(image, dict):
            image = image.get("main_file") or next(iter(image["bands"].values()))["path"]
        if isinstance(model, dict):
            model = model["path"]
        yield Item(_placed(folder, image), None if model is None else _placed(folder, model), holder)


def _of_sat_bundleadjust(data: dict[str, Any], folder: Path) -> Iterator[Item]:
    if "input_dir" in data:
        base = Path(_placed(folder, data["input_dir"]))
        images, rpcs = base / "images", base / "rpcs"
    else:
        images = Path(_placed(folder, data["geotiff_dir"]))
        inside = data.get("rpc_src", "geotiff") == "geotiff"
        rpcs = images if inside else Path(_placed(folder, data["rpc_dir"]))
    from barpc.rpcio import find_rpc

    for name in _files(str(images)):
        camera = None if rpcs == images else str(find_rpc(rpcs, Path(name)))
        yield Item(name, camera, {})


CONFIGS: dict[str, Callable[[dict[str, Any], Path], Iterator[Item]]] = {
    "s2p": _of_s2p,
    "cars": _of_cars,
    "sat-bundleadjust": _of_sat_bundleadjust,
}
"""Tool -> the images that its configuration lists."""


def _as_image(item: Item, hosts: Sequence[str], path: Path) -> Any:
    if item.camera is None:
        return item.image
    if isinstance(item.camera, str):
        return _with_camera(item.image, item.image, item.camera)
    from barpc.raster import open_raster
    from barpc.remote import located
    from barpc.rpcio.formats import parse
    from barpc.scene import View
    from barpc.sensor.geometry import altitude_range

    rpc, _ = parse(json.dumps({"rpc": item.camera}).encode(), f"{path}, rpc of {item.image}")
    image = located(item.image, hosts)
    with open_raster(image) as dataset:
        size = (int(dataset.width), int(dataset.height))
    return View(PurePath(item.image).stem, os.fspath(image), size, rpc, altitude_range(rpc))


def corrected(config: Config, folder: Path, views: Sequence[Any]) -> str:
    """Return the configuration as a text for the folder of a run, with the corrected cameras of its images in order.

    What names files relative to where it lay names them from there.
    """
    from barpc.export.neural import as_json
    from barpc.export.shots import relative_link
    from barpc.export.stereo import yaml
    from barpc.rpcio import WRITABLE

    write = WRITABLE["json"].write
    assert write is not None
    data = _moved(config.data, config.path.absolute().parent, folder)
    holders = [item.holder for item in CONFIGS[config.tool](data, folder)]
    for item, holder, view in zip(config.items, holders, views, strict=True):
        if config.tool == "s2p":
            holder |= {"img": relative_link(item.image, folder), "rpc": json.loads(write(view.sensor))["rpc"]}
        else:
            holder["geomodel"] = {"path": f"{view.name}.geom", "model_type": "RPC"}
            written = [view.name + end for end in (".vrt", ".tif") if (folder / (view.name + end)).is_file()]
            holder["image"] = written[0] if written and isinstance(holder["image"], str) else holder["image"]
    if config.path.suffix.lower() in (".yaml", ".yml"):
        return "\n".join(yaml(data)) + "\n"
    return as_json(data).decode()


def _moved(value: Any, before: Path, now: Path, depth: int = 0) -> Any:
    """Return a part of a configuration in which relative names of files that exist are relative to another folder."""
    if depth > _DEEP:
        raise InputError(f"a configuration nested more than {_DEEP} deep")
    if isinstance(value, dict):
        return {str(key): _moved(item, before, now, depth + 1) for key, item in value.items()}
    if isinstance(value, list):
        return [_moved(item, before, now, depth + 1) for item in value]
    if isinstance(value, date):
        return value.isoformat()
    if isinstance(value, str) and value.strip(".") and "\0" not in value and not Path(value).is_absolute():
        from barpc.export.shots import relative_link

        with suppress(OSError):
            return relative_link(before / value, now) if os.path.lexists(before / value) else value
    return value
