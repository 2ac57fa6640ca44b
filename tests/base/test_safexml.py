"""XML from elsewhere is opened safely or refused with a message that names the file."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import tostring

import pytest

from barpc.base.errors import RpcFormatError
from barpc.base.safe_io import parse_xml

LAUGHS = b'<!DOCTYPE a [<!ENTITY x "lol"><!ENTITY y "&x;&x;&x;&x;">]><a>&y;</a>'


def test_a_document_is_read_from_bytes_and_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_bytes(b"<a><b>1</b></a>")
    assert parse_xml(path).findtext("b") == "1"
    assert parse_xml(path.read_bytes()).findtext("b") == "1"


def test_namespaces_are_dropped_when_asked() -> None:
    document = b'<l:a xmlns:l="http://x"><l:b>1</l:b></l:a>'
    assert parse_xml(document).findtext("b") is None
    assert parse_xml(document, strip_namespaces=True).findtext("b") == "1"


def test_of_wanted_elements_alone_the_root_has_all_that_is_in_them() -> None:
    document = b'<l:a xmlns:l="http://x">0<l:b>1<l:c k="2">3</l:c>4<l:b>5</l:b></l:b>6<l:d><l:b/>7<l:e/></l:d></l:a>'
    root = parse_xml(document, strip_namespaces=True, only=("b",))
    assert tostring(root) == b'<a><b>1<c k="2">3</c>4<b>5</b></b><b /></a>'
    assert tostring(parse_xml(b"<b><c>1</c></b>", only=("b",))) == b"<b><c>1</c></b>"


@pytest.mark.parametrize("only", [(), ("RPB",)], ids=["all", "a part"])
@pytest.mark.parametrize(
    ("document", "words"),
    [
        (b"<a><RPB/><b></a>", "mismatched tag: line 1, column 14"),
        (b"<a><RPB/><b>", "no element found: line 1, column 12"),
        (b"<a><RPB/>&x;</a>", "undefined entity"),
        (b"<a><RPB/>" + b"<b>" * 100, "102 elements, 101 deep: too many"),
        ("<!DOCTYPE a><a><RPB/></a>".encode("utf-16"), "it declares a DOCTYPE"),
    ],
    ids=["mismatched", "truncated", "entity", "deep", "DOCTYPE"],
)
def test_what_is_not_kept_is_still_looked_through(document: bytes, words: str, only: tuple[str, ...]) -> None:
    with pytest.raises(RpcFormatError, match=words):
        parse_xml(document, only=only)


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(LAUGHS, id="entities"),
        pytest.param(b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', id="external"),
        pytest.param(LAUGHS.decode().encode("utf-16"), id="entities in UTF-16"),
        pytest.param(b'<?xml version="1.0" encoding="cp037"?>' + LAUGHS.decode().encode("cp037"), id="EBCDIC"),
        pytest.param(b"<a><b></a>", id="not well-formed"),
        pytest.param(b"<a><b>", id="truncated"),
        pytest.param(b"", id="empty"),
        pytest.param(b"\x89PNG\r\n", id="not XML"),
        pytest.param(b'<?xml version="1.0" encoding="no-such"?><a/>', id="unknown encoding"),
        pytest.param(b"<a>" + b"x" * 200 + b"</a>", id="too large"),
    ],
)
def test_a_hostile_or_broken_document_is_refused_by_name(document: bytes) -> None:
    with pytest.raises(RpcFormatError, match=r"evil\.xml"):
        parse_xml(document, name="evil.xml", max_bytes=150)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path, words in ((tmp_path / "no.xml", "no such file"), (tmp_path, "a folder")):
        with pytest.raises(RpcFormatError, match=words):
            parse_xml(path)
