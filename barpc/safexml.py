"""XML from elsewhere, opened safely: one place, standard library only.

A size cap and no document type: an entity cannot be declared without one, so neither "billion laughs" nor
a reference to another file can be written.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from barpc.errors import RpcFormatError
from barpc.sidefile import Kind, read_bytes

MAX_BYTES = 32 << 20
"""Largest XML read [bytes]; the largest in use, a day of precise orbits, has 5 MB."""


_MAX_DEPTH = 100
_MAX_ELEMENTS = 2_000_000


class _Builder(ElementTree.TreeBuilder):
    """Refuses trees that are too large, and a document type that the encoding hides from a search of the bytes."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = self._count = 0

    def start(self, tag: str, attrs: dict[str, str]) -> ElementTree.Element:
        self._depth, self._count = self._depth + 1, self._count + 1
        if self._depth > _MAX_DEPTH or self._count > _MAX_ELEMENTS:
            raise ElementTree.ParseError(f"{self._count} elements, {self._depth} deep: too many")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)

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
    data = (
        read_bytes(source, Kind("an XML file", max_bytes, RpcFormatError))
        if isinstance(source, Path)
        else source
    )
    if len(data) > max_bytes:
        raise RpcFormatError(f"{name}: {len(data)} bytes of XML, at most {max_bytes} are read")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise RpcFormatError(f"{name}: refused, it declares a DOCTYPE; remove the declaration")
    parser = ElementTree.XMLParser(target=_Builder())  # noqa: S314 - no DOCTYPE, so no entities
    try:
        parser.feed(data)  # at once: expat before 2.6 looks at an unfinished token again with every part
        root: ElementTree.Element = parser.close()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise RpcFormatError(f"{name}: not an XML document that can be read ({error})") from error
    if strip_namespaces:
        for element in root.iter():
            element.tag = element.tag.rpartition("}")[2]
    return root
