"""Figures on light and dark pages, and round numbers on logarithmic axes."""

import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from stewart_drake.reporting.style import DARK, figure_style, plain_log_ticks


def luminance(color: str) -> float:
    """Relative luminance of #rrggbb, as WCAG 2 defines it."""
    parts = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("color", DARK)
def test_what_is_read_on_white_is_read_on_dark_and_what_is_faint_stays_so(color):
    light, dark = contrast(color, "#ffffff"), contrast(DARK[color], DARK["#ffffff"])
    if light >= 4.5:
        assert dark >= 4.5
    elif light >= 3:
        assert dark >= 3
    elif light < 1.3:
        assert dark < 1.5


@pytest.mark.parametrize(("low", "high"), [(19.5, 37), (0.4, 300), (8, 12), (20, 55), (1e-3, 2e-3)])
def test_ticks_of_a_logarithmic_axis_are_plain_numbers(low, high):
    with figure_style():
        figure = Figure()
        ax = figure.subplots()
        ax.plot([low, high], [1, 2])
        ax.set(xscale="log", xlim=(low, high))
        plain_log_ticks(ax.xaxis)
        places = [place for place in ax.xaxis.get_majorticklocs() if low <= place <= high]
        texts = ax.xaxis.get_major_formatter().format_ticks(places)
        minor = ax.xaxis.get_minor_formatter().format_ticks(ax.xaxis.get_minorticklocs())
    assert 3 <= len(texts) <= 12 and not any(minor)
    for text, place in zip(texts, places, strict=True):
        assert re.fullmatch(r"[\d.]+(e-0\d)?", text)
        assert float(text) == pytest.approx(place), "not what stands there"
