"""SHA256SUMS: layers of what commands wrote, read back as they were written, and roots that name the layers before."""

from __future__ import annotations

import hashlib

import pytest

from barpc.base.errors import InputError
from barpc.base.manifest import SUMS, Layer, head, parse, read, render, root_of

ONE, TWO, THREE = ("1" * 64, "2" * 64, "a" * 64)


def test_layers_are_lines_of_which_the_last_of_a_file_counts(tmp_path):
    assert head("0.4", "abc") == "barpc 0.4, code abc"
    first = Layer(head("0.4", "abc"), {"tables/b.csv": TWO, "a.tif": ONE})
    second = Layer(head("0.5", "def", root_of([first])), {"a.tif": THREE})
    assert (first.after, second.after) == ("", root_of([first]))
    text = (
        f"# barpc 0.4, code abc\n# {ONE}  a.tif\n{TWO}  tables/b.csv\n"
        f"# barpc 0.5, code def, after {root_of([first])}\n{THREE}  a.tif\n"
    )
    assert render([first, second]) == text
    assert parse(text) == [first, second]
    assert (
        root_of([first])
        == hashlib.sha256(f"# barpc 0.4, code abc\n{ONE}  a.tif\n{TWO}  tables/b.csv\n".encode()).hexdigest()
    )
    (tmp_path / SUMS).write_text(text)
    assert read(tmp_path) == (hashlib.sha256(text.encode()).hexdigest(), [first, second])


@pytest.mark.parametrize(
    "text",
    ["", f"{ONE}  a.tif\n", f"# head\n{ONE}  ../a.tif\n", f"# head\n{ONE}  /a.tif\n", f"# head\n{ONE}  a.tif",
     f"# head\r\n{ONE}  a.tif\r\n", f"# head\n{TWO}  b\n{ONE}  a\n", f"# head\n# {ONE}  a\n", f"# head\n{ONE} a\n",
     f"# head\n{ONE[1:]}  a\n", "# head\n\xff"],
)  # fmt: skip
def test_what_is_not_as_it_is_written_is_refused_by_name(text, tmp_path):
    (tmp_path / SUMS).write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=f"{SUMS}: changed, "):
        read(tmp_path)
