"""XML from elsewhere, opened safely: one place, standard library only.

A size cap and no document type: an entity cannot be declared without one, so neither "billion laughs" nor
a reference to another file can be written.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from barpc.errors import RpcFormatError

MAX_BYTES = 32 << 20
"""Largest XML read by default [bytes]; the largest in use, a day of precise orbits, has 5 MB."""

_CHUNK = 1 << 16


class _Builder(ElementTree.TreeBuilder):
    """Refuses a document type also where the encoding hides it from a search of the bytes."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ElementTree.ParseError("it declares a DOCTYPE")


def parse_xml(
    source: bytes | Path,
    *,
    name: str | None = None,
    max_bytes: int = MAX_BYTES,
    strip_namespaces: bool = False,
) -> ElementTree.Element:
    """The root element of an XML document.

    Parameters
    ----------
    source : bytes or Path
        The document, or the file that holds it.
    name : str, optional
        What to call it in messages; the path otherwise.
    max_bytes : int
        Larger documents are refused [bytes].
    strip_namespaces : bool
        Drop the ``{namespace}`` of every tag.

    Returns
    -------
    root : Element

    Raises
    ------
    RpcFormatError
        Not a readable file, too large, a DOCTYPE, or not well-formed XML. The message names the file.
    """
    name = name or (str(source) if isinstance(source, Path) else "XML document")
    data = _read(source, name, max_bytes) if isinstance(source, Path) else source
    if len(data) > max_bytes:
        raise RpcFormatError(f"{name}: {len(data)} bytes of XML, at most {max_bytes} are read")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise RpcFormatError(f"{name}: refused, it declares a DOCTYPE; remove the declaration")
    parser = ElementTree.XMLParser(target=_Builder())  # noqa: S314 - no DOCTYPE, so no entities
    try:
        for start in range(0, len(data), _CHUNK):
            parser.feed(data[start : start + _CHUNK])
        root: ElementTree.Element = parser.close()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise RpcFormatError(f"{name}: not an XML document that can be read ({error})") from error
    if strip_namespaces:
        for element in root.iter():
            element.tag = element.tag.rpartition("}")[2]
    return root


def _read(path: Path, name: str, max_bytes: int) -> bytes:
    """The bytes of a regular file, one more than `max_bytes` at most."""
    try:
        if not path.is_file():
            raise RpcFormatError(f"{name}: no such file")
        with path.open("rb") as file:
            return file.read(max_bytes + 1)
    except OSError as error:
        raise RpcFormatError(f"{name}: cannot be read ({error.strerror})") from error
