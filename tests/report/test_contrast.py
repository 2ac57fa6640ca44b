"""Text and lines of the page against what they stand on: WCAG 2.2 AA, computed from its colours (1.4.3 and 1.4.11)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from barpc.report import page

CSS = re.search(r"<style>(.*?)</style>", Path(page.__file__).with_name("template.html.j2").read_text(), re.DOTALL)[1]
TEXT = ("fg", "muted", "after", "good", "look", "bad")
DRAWN = ("before", "after", "good", "look", "bad", "third", "muted", "fg")
PALE = ("line", "bg", "soft")  # what says nothing by itself: rules, grounds, outlines of letters
CHOSEN = 0.18  # of the colour `after` over a chosen row


def palettes() -> dict[str, dict[str, str]]:
    """Colours by name; by day, by night and on paper."""
    found = [dict(re.findall(r"--(\w+): (#\w+)", part)) for part in re.findall(r":root \{( --bg[^}]*)\}", CSS)]
    return dict(zip(("day", "night", "paper"), found, strict=True))


def rgb(color: str) -> np.ndarray:
    digits = color[1:] if len(color) == 7 else "".join(2 * c for c in color[1:])
    return np.array([int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)])


def luminance(color: np.ndarray) -> float:
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_the_ratio_is_that_of_the_standard() -> None:
    assert contrast(rgb("#000"), rgb("#ffffff")) == pytest.approx(21.0)
    assert contrast(rgb("#777777"), rgb("#fff")) == pytest.approx(4.48, abs=0.005)
    assert contrast(rgb("#ff0000"), rgb("#ffffff")) == pytest.approx(4.0, abs=0.005)


@pytest.mark.parametrize("light", ["day", "night", "paper"])
def test_text_can_be_read_and_lines_be_seen(light: str) -> None:
    colors = {name: rgb(color) for name, color in palettes()[light].items()}
    assert set(colors) == {*TEXT, *DRAWN, *PALE}
    chosen = (1 - CHOSEN) * colors["soft"] + CHOSEN * colors["after"]
    for name in TEXT:
        for ground in (colors["bg"], colors["soft"]):
            assert contrast(colors[name], ground) >= 4.5, name
    assert "tr.on td { color: var(--fg);" in CSS  # the colours of a verdict do not reach it
    assert contrast(colors["fg"], chosen) >= 4.5
    for name in DRAWN:
        assert contrast(colors[name], colors["bg"]) >= 3.0, name


def test_every_colour_in_use_is_one_that_is_judged() -> None:
    text = set(re.findall(r"[{ ;]color: var\(--(\w+)\)", CSS))
    labels = set(re.findall(r"\.(?:tick|axis|degrees|nodename, \.stack|matrix \.value) \{ fill: var\(--(\w+)\)", CSS))
    assert text | labels <= set(TEXT)
    assert len(text) > 4
    drawn = set(re.findall(r"(?:stroke|fill|background): var\(--(\w+)\)", CSS))
    assert drawn <= {*DRAWN, *PALE}
    assert f"var(--after) {100 * CHOSEN:.0f}%, transparent" in CSS
    rest = re.sub(r":root \{[^}]*\}", "", CSS)
    assert not re.findall(r"#[0-9a-f]{3,8}\b", rest)  # no colour but those by name
