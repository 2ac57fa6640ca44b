"""For stereo pipelines: the configuration of s2p and of CARS, cameras and lists for ASP."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from barpc.export.neural import Files, as_json, rpc_of
from barpc.export.shots import Scene, Shot, pairs_of, relative_link
from barpc.rpcio import WRITABLE


def _image(shot: Shot, out: Path) -> str:
    """Return the image as a configuration in `out` names it: the run's VRT or copy where there is one."""
    return relative_link(shot.carrier or shot.file, out)


def _text(shot: Shot, name: str) -> bytes:
    write = WRITABLE[name].write
    assert write is not None
    return write(shot.rpc).encode()


def s2p(scene: Scene, out: Path) -> Files:
    """Write ``config.json``: the images, the first as reference, each with its corrected RPC."""
    images = [{"img": _image(shot, out), "rpc": rpc_of(shot)} for shot in scene.shots]
    return {"config.json": as_json({"out_dir": "s2p_out", "images": images, "full_img": True})}


def cars(scene: Scene, out: Path) -> Files:
    """Write ``inputs.yaml``, with the pairs whose angle shows heights, and a ``.geom`` an image."""
    sensors = {}
    for shot in scene.shots:
        camera = {"path": f"{shot.name}.geom", "model_type": "RPC"}
        sensors[shot.name] = {"image": _image(shot, out), "geomodel": camera}
    pairing = [list(pair) for pair in pairs_of(scene)]
    found = {"input": {"sensors": sensors, "pairing": pairing}, "output": {"directory": "cars_out"}}
    files = {f"{shot.name}.geom": _text(shot, "geom") for shot in scene.shots}
    return {**files, "inputs.yaml": ("\n".join(yaml(found)) + "\n").encode()}


def asp(scene: Scene, out: Path) -> Files:
    """Write ``<image>.xml`` each (in Maxar's form), and lists of images and cameras for its tools, run in `out`."""
    files = {f"{shot.name}.xml": _text(shot, "xml") for shot in scene.shots}
    lists = {"images.txt": [_image(shot, out) for shot in scene.shots], "cameras.txt": list(files)}
    return files | {name: ("\n".join(lines) + "\n").encode() for name, lines in lists.items()}


def yaml(value: Any, indent: str = "") -> list[str]:
    r"""Return YAML text: mappings with plain keys in blocks, all else as JSON.

    Examples
    --------
    >>> print(*yaml({"a": {"b c": "x: y"}, "d": [["one", "two"]]}), sep="\n")
    "a":
      "b c": "x: y"
    "d":
      - ["one", "two"]
    """
    lines = []
    for key, item in value.items():
        head = f"{indent}{json.dumps(key, ensure_ascii=False)}:"
        if isinstance(item, Mapping) and item:
            lines += [head, *yaml(item, indent + "  ")]
        elif isinstance(item, list) and item:
            lines += [head, *(f"{indent}  - {json.dumps(one, ensure_ascii=False)}" for one in item)]
        else:
            lines.append(f"{head} {json.dumps(item, ensure_ascii=False)}")
    return lines


STEREO: Mapping[str, Any] = {"s2p": s2p, "cars": cars, "asp": asp}
