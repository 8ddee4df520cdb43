"""Runs are shown again through the SDFormat model."""

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.diagram import build_viewer
from stewart_drake.report import replay as replay_module
from stewart_drake.signals import LEGS


@pytest.fixture(scope="module")
def run() -> sd.SimulationResult:
    settings = ("plant.kind=exact", "duration=0.4", "start=on_reference", "queue=reference")
    return sd.simulate(sd.load_scenario("paper", settings=settings))


def test_every_frame_of_an_exact_run_closes_the_loops_of_the_model(
    run: sd.SimulationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaps = []
    original = replay_module.set_pose

    def watched(plant, tree, *args):  # type: ignore[no-untyped-def]
        original(plant, tree, *args)
        for leg in LEGS:
            ends = (
                plant.GetFrameByName(f"{name}_{leg}").CalcPoseInWorld(tree).translation()
                for name in ("rod_end", "plate_joint")
            )
            gaps.append(np.abs(next(ends) - next(ends)).max())

    monkeypatch.setattr(replay_module, "set_pose", watched)
    meshcat = replay_module.replay(run.signals, sd.load_mechanism("paper"))
    assert len(gaps) == 6 * len(run.signals.time)
    assert max(gaps) < 1e-12
    html = meshcat.StaticHtml()
    assert "<html" in html.lower() and len(html) > 100_000


def test_the_viewer_knows_the_model(run: sd.SimulationResult) -> None:
    meshcat = replay_module.replay(run.signals, sd.load_mechanism("paper"))
    assert meshcat.HasPath("/drake/visualizer/paper/plate")
    _, plant, _ = build_viewer(sd.load_mechanism("paper"), meshcat)
    assert plant.num_actuators() == 6
