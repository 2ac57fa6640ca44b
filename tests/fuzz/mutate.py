"""Damage: to the bytes of a file, and to its structure, which leaves the syntax whole and the sense broken."""

from __future__ import annotations

import io
import json
import re
import zipfile
from collections.abc import Callable
from copy import deepcopy
from xml.etree import ElementTree

import numpy as np

Rng = np.random.Generator
Mutate = Callable[[bytes, Rng], bytes]

NUMBERS = (
    "nan", "inf", "-inf", "-0", "0", "-1", "1", "2", "1.0", "1.5", "1e-300", "5e-324", "1e99", "-1e99", "1e308",
    "1e999", "9" * 19, "9" * 400, "-" + "9" * 5000, "2147483648", "-9223372036854775809", "1_0", "0x10",
    "1e", "--1", "90.0", "360",
)  # fmt: skip
WORDS = (
    "", " ", "\t", "null", "true", "a", "left", "../x", "/etc/passwd", "é\u0301", "\u202e", "\u0663",
    "\x1b[31m", "x" * 3000,
    "=1+1", "#", '"', "'", "\\", "%s", "{}", "a__b", "2021-02-30T00:00:00", "NaT", "\x00", "1 2 3", "a.b", "-",
)  # fmt: skip
MARKS = (b"\x00", *(mark.encode() for mark in '<>&"()[]{},\n'), b": ", b"=", b"\xff", b"\xef\xbb\xbf")
VALUES = (
    None, True, False, 0, -1, 1, 2, 1.0, 1.5, -0.0, 1e-300, 1e15, 1e99, -1e99, 10**17, 10**18, 10**400, -(2**63) - 1,
    float("nan"), float("inf"), "", "a", "x" * 3000, "\x00\n\x1b", "\ud800", "../../x", "nan", "1e5", [], {}, [[]],
    [None], [1], [1, 2], [1, 2, 3], {"": 0}, {"a": {"a": {"a": {"a": 1}}}}, [[[[[1]]]]],
)  # fmt: skip
DEPTH = 10_000


def pick(rng: Rng, options: object) -> object:
    return options[int(rng.integers(len(options)))]


def mutate_bytes(data: bytes, rng: Rng) -> bytes:
    """One to four edits: a flipped bit, a part cut out, doubled or moved, a token put in."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not out:
            break
        at, length = int(rng.integers(0, len(out))), int(rng.geometric(0.1))
        match rng.integers(0, 6):
            case 0:
                out[at] ^= 1 << int(rng.integers(0, 8))
            case 1:
                del out[at : at + length]
            case 2:
                out[at:at] = out[at : at + length]
            case 3:
                out[at : at + length] = pick(rng, MARKS)
            case 4:
                del out[at:]
            case _:
                other = int(rng.integers(0, len(out)))
                out[at : at + length] = out[other : other + length]
    return bytes(out)


_TOKEN = re.compile(r"[^\s,;:=<>()\[\]{}\"]+")


def mutate_text(data: bytes, rng: Rng) -> bytes:
    """Tokens replaced by hostile numbers and words; lines left out, doubled, exchanged, emptied, run together."""
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(rng.integers(1, 4)):
        lines = text.split("\n")
        at = int(rng.integers(len(lines)))
        match rng.integers(0, 9):
            case 0:
                del lines[at]
            case 1:
                lines.insert(at, lines[at])
            case 2:
                other = int(rng.integers(len(lines)))
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at:at] = [str(pick(rng, ("", " ", "#", "[" * DEPTH, "a=" + "[" * DEPTH, "," * 50)))] * int(
                    rng.integers(1, 50)
                )
            case 4:
                lines = lines[:1] if rng.integers(2) else lines[1:]
            case _:
                found = list(_TOKEN.finditer(lines[at]))
                if found:
                    token = pick(rng, found)
                    word = str(pick(rng, NUMBERS if rng.integers(3) else WORDS))
                    lines[at] = lines[at][: token.start()] + word + lines[at][token.end() :]
        text = "\n".join(lines)
    return text.encode("utf-8", "surrogateescape")


def _somewhere(tree: list, rng: Rng, deeper: float) -> tuple:
    """A list or dictionary of a tree, and a place in it; each level is gone into with a probability."""
    holder, key = tree, 0
    while rng.random() < deeper and isinstance(holder[key], (dict, list)) and holder[key]:
        holder = holder[key]
        key = pick(rng, list(holder)) if isinstance(holder, dict) else int(rng.integers(len(holder)))
    return holder, key


def mutate_json(data: bytes, rng: Rng) -> bytes:
    """Values of other types and sizes, keys missing, doubled and unknown, lists of other lengths, deep nesting."""
    tree = [json.loads(data)]
    for _ in range(rng.integers(1, 4)):
        holder, key = _somewhere(tree, rng, 0.93)
        match rng.integers(0, 8):
            case 0 if holder is not tree:
                del holder[key]
            case 1 if isinstance(holder, list) and holder is not tree:
                holder.insert(key, deepcopy(holder[key]))
            case 2 if isinstance(holder, list) and holder is not tree:
                holder.clear()
            case 3 if isinstance(holder, dict):
                holder[str(pick(rng, WORDS))] = holder.pop(key)
            case 4:
                holder[key] = [holder[key]] if rng.integers(2) else {"a": holder[key]}
            case _:
                holder[key] = deepcopy(pick(rng, VALUES))
        if not tree:
            return b""
    text = json.dumps(tree[0])
    if rng.random() < 0.02:
        deep = "[" * DEPTH + "]" * DEPTH if rng.integers(2) else '{"a":' * DEPTH + "1" + "}" * DEPTH
        text = re.sub(r"\d+", deep, text, count=1)
    return text.encode("utf-8", "surrogatepass")


def mutate_values(data: bytes, rng: Rng) -> bytes:
    """JSON whose values have the types they should and other sizes; nothing where nothing may be; lists shorter."""
    tree = [json.loads(data)]
    for _ in range(rng.integers(1, 4)):
        holder, key = _somewhere(tree, rng, 0.97)
        value = holder[key]
        if isinstance(value, list) and value and len(value) not in (2, 3, 7):
            holder[key] = value[:: int(rng.integers(1, 4)) * (-1) ** int(rng.integers(2))][
                : int(rng.integers(len(value) + 1))
            ]
        elif rng.random() < 0.2:
            holder[key] = None
        elif isinstance(value, (int, float)):
            holder[key] = pick(rng, (0, -1, 1, 2, 1.0, 0.5, 1e-300, 5e-324, 1e15, 10**17, -1e99, 1e99, 90, -0.0, True))
        elif isinstance(value, str):
            holder[key] = pick(rng, (*WORDS, "check", "adjust", "failed", "bad", "up", "view_0001"))
    return json.dumps(tree[0]).encode("utf-8", "surrogatepass")


def mutate_xml(data: bytes, rng: Rng) -> bytes:
    """Elements left out, doubled, emptied, renamed and nested; texts and attributes replaced."""
    root = ElementTree.fromstring(data)
    for _ in range(rng.integers(1, 4)):
        holders = [element for element in root.iter() if len(element)]
        if not holders:
            break
        holder = pick(rng, holders)
        at = int(rng.integers(len(holder)))
        element = holder[at]
        match rng.integers(0, 9):
            case 0:
                del holder[at]
            case 1:
                holder.insert(at, deepcopy(element))
            case 2:
                holder[:] = []
            case 3:
                element.tag = str(pick(rng, ("a", "RPC", "MDI", "F_COL", holder.tag)))
            case 4:
                element.attrib = (
                    {str(k): "\ufffd" for k in element.attrib} if rng.integers(2) else {"number": "9" * 400}
                )
            case 5:
                words = (element.text or "").split()
                element.text = " ".join(words[: len(words) // 2] if rng.integers(2) else words * 2)
            case _:
                words = (element.text or "").split() or [""]
                words[int(rng.integers(len(words)))] = str(pick(rng, NUMBERS if rng.integers(3) else WORDS))
                element.text = "".join(c for c in " ".join(words) if c.isprintable())
    text = ElementTree.tostring(root)
    if rng.random() < 0.02:
        text = text.replace(b"</", b"<a>" * DEPTH + b"</a>" * DEPTH + b"</", 1)
    return text


def mutate_npz(data: bytes, rng: Rng) -> bytes:
    """Arrays of other lengths, shapes and types, numbers that are none, members missing or lying about their size."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    for _ in range(rng.integers(1, 4)):
        name = str(pick(rng, list(arrays) or ["a"]))
        value = arrays.get(name, np.zeros(1))
        match rng.integers(0, 9):
            case 0:
                arrays.pop(name, None)
            case 1:
                arrays[name] = value[: len(value) // 2] if value.ndim else value[None]
            case 2:
                arrays[name] = np.concatenate([value, value]) if value.ndim else value[None, None]
            case 3:
                arrays[name] = value.ravel() if rng.integers(2) else value[..., None]
            case 4:
                kind = pick(rng, ("f4", "i1", "u8", "c16", "U7", "S3", "M8[s]", "?", "V8", ">f8", "f8"))
                arrays[name] = np.zeros(value.shape, str(kind))
            case 5:
                arrays[name] = np.array(pick(rng, ([], 0, -1, 2**63 - 1, 1e308, np.nan, "", "x" * 500, [[]], True)))
            case 6:
                arrays[str(pick(rng, ("a", "sigma", "col", "")))] = value
            case _:
                if value.size and value.dtype.kind in "fi":
                    value = value.astype(np.float64) if value.dtype.kind == "f" else value.copy()
                    numbers = (
                        (np.nan, np.inf, -1.0, 0.0, 1e308, 1e99)
                        if value.dtype.kind == "f"
                        else (-1, 0, 2**40, 2**63 - 1)
                    )
                    value.flat[int(rng.integers(value.size))] = np.array(pick(rng, numbers)).astype(value.dtype)
                    arrays[name] = value
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if rng.integers(2) else zipfile.ZIP_STORED) as archive:
        for name, value in arrays.items():
            member = io.BytesIO()
            np.save(member, value)
            content = member.getvalue()
            if rng.random() < 0.2:
                shape = str(pick(rng, ("(100000000000,)", "(-1,)", "(2, 3", "(True,)", "()", "(0, 4)"))).encode()
                content = re.sub(rb"\([\d, ]*\)", shape, content, count=1)
            archive.writestr(f"{name}.npy", content)
    packed = out.getvalue()
    return mutate_bytes(packed, rng) if rng.random() < 0.2 else packed


def mutate_header(data: bytes, rng: Rng) -> bytes:
    """Binary numbers near the start replaced by hostile ones of several widths."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 3)):
        kind = str(pick(rng, (">f8", "<f8", ">i4", "<i4", "<u2", ">u2", "<u4", "<u8")))
        numbers = (
            (np.nan, np.inf, 0.0, -1.0, 1e308, 1e-320, 360.0, 1e-9)
            if "f" in kind
            else (0, 1, 2, -1, 2**31 - 1, 12, 255)
        )
        with np.errstate(all="ignore"):
            word = np.array(pick(rng, numbers)).astype(kind).tobytes()
        at = int(rng.integers(0, max(1, min(len(out), 200)))) // 2 * 2
        out[at : at + len(word)] = word
    return bytes(out)
