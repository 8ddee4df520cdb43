"""Figures on light and dark pages, and round numbers on logarithmic axes."""

import re

import pytest
from matplotlib.figure import Figure

from stewart_drake.reporting.style import figure_style, plain_log_ticks


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
