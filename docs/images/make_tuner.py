"""Draws the loop and the network of the documents: `python make_tuner.py [WEIGHTS]`."""

import sys
from pathlib import Path

from loop_figure import loop_figure
from network_figure import network_figure

from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.tuner.network import DEFAULT, load_network

weights = sys.argv[1] if len(sys.argv) > 1 else DEFAULT
loop = build_closed_loop(
    load_scenario("paper", settings=["tuner.kind=ann", f"tuner.weights={weights}"])
)
here = Path(__file__).parent
loop_figure(loop).savefig(here / "loop.png", dpi=120)
network_figure(load_network(weights)).savefig(here / "network.png", dpi=120)
