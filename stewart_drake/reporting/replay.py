"""Animation of a finished run and its reference in Meshcat, with the SDFormat model."""

import html
import logging
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr
from pydrake.geometry import Meshcat, MeshcatParams, Rgba

from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.preparation import simulated_machine
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.scene import TORQUE_COLORS, Scene, crank_paths, full_color, torque_shares
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import rotation, turns_between
from stewart_drake.reporting.document import number
from stewart_drake.reporting.page import environment
from stewart_drake.reporting.run import late_error, torqueless
from stewart_drake.scenario.run_log import EXPECTED, read_log, scenario_of
from stewart_drake.scenario.signals import ANGLES, LEGS, POSITION

_PATH_COLORS: Final = {"reference": Rgba(0.0, 0.62, 0.45), "plate": Rgba(0.0, 0.45, 0.70)}
_VIEWPORT: Final = '<meta name="viewport" content="width=device-width, initial-scale=1">'
_MAX_FRAMES: Final = 1500
"""Largest number of frames; Meshcat interpolates between them."""


def replay(signals: xr.Dataset, mechanism: Mechanism, meshcat: Meshcat | None = None) -> Meshcat:
    """Put the animation of a run into Meshcat, by default a new one on a free local port.

    `StaticHtml()` of the returned Meshcat plays without a server.
    """
    meshcat = meshcat or quiet_meshcat()
    scene, shown = Scene(mechanism, meshcat), _thinned(signals)
    for name, signal in (("reference", "reference"), ("plate", "pose")):
        center = scene.disc.translation()  # of the drawn plate
        poses = shown[signal].values
        path = np.array([p[POSITION] + rotation(p[ANGLES]) @ center for p in poses]).T
        if len(poses) > 1:
            meshcat.SetLine(f"/paths/{name}", path, 1.5, _PATH_COLORS[name])
    # The shortest time between two frames: samples may lie between grid steps.
    period = float(np.min(np.diff(shown.time.values), initial=1.0))
    meshcat.StartRecording(1 / period, set_visualizations_while_recording=False)
    frames = zip(shown.time.values, shown.pose.values, shown.reference.values, strict=True)
    for t, pose, wanted in frames:
        # Slightly late, because Meshcat rounds down to a frame.
        if not scene.show(pose, wanted, t + 1e-3 * period):
            break
    meshcat.StopRecording()
    meshcat.PublishRecording()
    scene.close()
    return meshcat


def replay_html(result: SimulationResult, mechanism: Mechanism, title: str) -> str:
    """Return a run as one HTML page that plays without a server or a network."""
    outcome = result.status.replace("_", " ")
    if result.stopped is not None:
        outcome += f" at {result.stopped.time:.2f} s"
    elif torqueless(result):
        outcome += ", without a finite torque of the controller"
    else:
        late = late_error(result) if result.scenario.actuator.kind == "position_servo" else ""
        error = late and f"rms error {late}"  # E_ac is that of the soft start
        outcome += f", {error or f'E_ac {number(result.accumulated_error)} % s'}"
    return _html(result.signals, mechanism, title, outcome)


def log_html(path: Path) -> str:
    """Return a log as a page like that of `replay_html`; it needs the scenario of the run.

    A row without a pose is left out. Without a reference, as in a log of `machine`, the pose counts
    as it.
    """
    signals = read_log(path)
    scenario = scenario_of(signals, path)
    for name in ("pose", "torque_applied"):
        if name not in signals:
            raise ConfigError(f"{path}: has no {name}; expected {EXPECTED}")
    if "reference" not in signals or signals.reference.isnull().all():
        signals["reference"] = signals.pose
    poses = np.hstack([signals.pose.values, signals.reference.values])
    signals = signals.isel(time=np.isfinite(poses).all(axis=1))
    if signals.sizes["time"] == 0:
        raise ConfigError(f"{path}: has no pose in any row; expected {EXPECTED}")
    signals["error"] = signals.pose - signals.reference
    outcome = f"log of {signals.time.values[-1] - signals.time.values[0]:.1f} s"
    return _html(signals.fillna(0.0), simulated_machine(scenario), path.stem, outcome)


def _html(signals: xr.Dataset, mechanism: Mechanism, title: str, outcome: str) -> str:
    meshcat = replay(signals, mechanism)
    shown = _thinned(signals)
    known = bool(np.isfinite(shown.torque_applied.values).any())  # not that of servos
    torque = np.nan_to_num(shown.torque_applied.values)
    largest = np.abs(torque).max(axis=1, initial=0.0)
    full = full_color(largest)
    off = np.linalg.norm(shown.error.values[:, POSITION], axis=1)
    turns = turns_between(shown.pose.values[:, ANGLES], shown.reference.values[:, ANGLES])
    data = {
        "time": np.round(shown.time.values, 4).tolist(),
        "position": np.round(1e3 * off, 4).tolist(),
        "angle": np.round(np.rad2deg(turns), 4).tolist(),
        "share": np.round(torque_shares(torque, full), 3).tolist(),
        "cranks": crank_paths(mechanism.name),
    }
    template = environment().get_template("replay.html.j2")
    overlay = template.render(
        title=title,
        outcome=outcome,
        known=known,
        full=number(full, 2),
        peak=number(float(largest.max(initial=0.0)), 2),
        data=data,
        legs=LEGS,
        colors=TORQUE_COLORS,
    )
    return scene_page(meshcat, overlay, html.escape(title))


def scene_page(meshcat: Meshcat, overlay: str, title: str) -> str:
    """Return Meshcat's page without a server, with more HTML at its end."""
    page = meshcat.StaticHtml()
    before, end, after = page.rpartition("</body>")
    assert end, "Meshcat's page has no body"
    whole = f"{before}{overlay}{end}{after}".replace("Drake MeshCat", title, 1)
    return whole.replace("<head>", f"<head>{_VIEWPORT}", 1)


def quiet_meshcat() -> Meshcat:
    """Return a Meshcat without printing its address."""
    log = logging.getLogger("drake")
    level = log.level
    log.setLevel(logging.WARNING)
    try:
        return Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    finally:
        log.setLevel(level)


def _thinned(signals: xr.Dataset) -> xr.Dataset:
    signals = signals.isel(time=np.isfinite(signals.pose.values).all(axis=1))
    return signals.isel(time=slice(None, None, -(-signals.sizes["time"] // _MAX_FRAMES) or 1))
