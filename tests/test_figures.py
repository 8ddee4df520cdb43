"""Figures: which there are, what they show, that they are whole and always the same."""

import dataclasses
import re
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.loop.results import rms_error
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.reporting.figures import draw_comparison, draw_run
from stewart_drake.reporting.run import run_document
from stewart_drake.reporting.style import (
    TORQUES,
    controller_lines,
    figure_style,
    plain_log_ticks,
    unit_for,
    write_figures,
)
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.compare import CONTROLLERS, LABELS


@pytest.fixture(scope="module")
def run():
    settings = ("plant.kind=exact", "duration=1.0", "plant.payload_mass=0.2")
    return simulate(load_scenario("paper", settings=settings), judge_stability=False)


@pytest.fixture(scope="module")
def comparison(run):
    """All controllers; one goes far off and leaves the workspace at 0.42 s."""
    early = run.signals.isel(time=slice(0, 22))
    early["pose"] = early.pose + np.geomspace(1e-3, 100.0, 22)[:, None]
    early["error"] = early.pose - early.reference
    failed = dataclasses.replace(
        run,
        status="left_workspace",
        stopped=Failure(0.43, 2, 0.0, "leg 2 reached the end of its reach"),
        signals=early,
    )
    return {name: failed if name == "lqr" else run for name in CONTROLLERS}


def limits(ax):
    return np.array(ax.get_ylim())


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """Return the folder of one run's figures."""
    before = dict(plt.rcParams)
    folder = tmp_path_factory.mktemp("figures")
    paths = write_figures(draw_run(run), folder)
    assert dict(plt.rcParams) == before, "the user's settings were changed"
    assert not plt.get_fignums(), "a window could open"
    return folder, paths


def test_files_of_a_run(written):
    folder, paths = written
    names = ("states", "errors", "torques", "parameters")
    expected = [f"{name}.{suffix}" for name in names for suffix in ("png", "svg")]
    assert [path.name for path in paths] == expected
    assert sorted(path.name for path in folder.iterdir()) == sorted(expected)
    for path in paths:
        if path.suffix == ".png":
            height, width, _ = imread(path).shape
            assert width == 1500 and height > 900
        else:
            assert ElementTree.parse(path).getroot().tag.endswith("svg")


def test_axes_name_their_units(run):
    drawn = draw_run(run)
    for name, units in {
        "states": ["deg"] * 3 + ["mm"] * 3,
        "errors": ["deg"] * 3 + ["mm"] * 3 + ["%"],
        "torques": ["N m"] * 7,
        "parameters": ["µN m"] * 6 + ["kg", "mN m s/rad"],
    }.items():
        labels = sorted(ax.get_ylabel() for ax in drawn[name].axes)
        assert sorted(label.partition("[")[2].rstrip("]") for label in labels) == sorted(units)
        assert {ax.get_xlabel() for ax in drawn[name].axes} == {"", "time  [s]"}
        assert {ax.get_xlim() for ax in drawn[name].axes} == {(0.0, 1.0)}


def test_names_of_vertical_axes_are_in_the_figure_and_aligned_in_each_column(comparison):
    for figure in draw_comparison(comparison).values():
        columns = {}
        figure.draw_without_rendering()
        for ax in figure.axes:
            name = ax.yaxis.label.get_window_extent()
            assert 0 <= name.x0 < name.x1 < ax.bbox.x0, ax.get_ylabel()
            columns.setdefault(round(ax.bbox.x0), []).append(name.x1)
        assert all(max(one) - min(one) < 1 for one in columns.values())


def test_the_torques_of_position_servos_are_those_that_act(run):
    """Those at the samples are from before the setpoint changes."""
    scenario = load_scenario("reachy_mini", settings=("duration=1.0",))
    axis = draw_run(dataclasses.replace(run, scenario=scenario))["torques"].axes[0]
    assert [line.get_label() for line in axis.lines] == ["applied"]


def test_a_diverging_run_does_not_squash_the_others_and_ends_with_a_cross(comparison):
    drawn = draw_comparison(comparison)
    assert list(drawn) == ["states", "errors", *(f"torques_{name}" for name in CONTROLLERS)]
    run = comparison["lqi"].signals
    shown = drawn["states"].axes[0]
    motion = np.rad2deg(np.ptp(run.reference.values[:, 0]))
    assert np.ptp(limits(shown)) < 2 * motion
    crosses = [line for line in shown.lines if line.get_marker() in ("v", "^")]
    assert [line.get_xdata()[0] for line in crosses] == [0.43]
    assert limits(shown)[0] <= crosses[0].get_ydata()[0] <= limits(shown)[1]
    title = drawn["states"].legends[0].get_title().get_text()
    assert title.endswith(f": 1 of {len(comparison)} runs ended early")
    legend = [text.get_text() for text in drawn["states"].legends[0].get_texts()]
    assert legend == ["reference", *(LABELS[name] for name in CONTROLLERS), legend[-1]]
    assert legend[-1] == "run ended (triangle: beyond the axis)"


def test_the_title_of_torques_has_the_largest_and_its_motor(comparison):
    figure = draw_comparison(comparison)["torques_predictor_lqi"]
    found = re.search(
        r"at most (\S+) (m?)N m acted, by motor (\d)", figure.legends[0].get_title().get_text()
    )
    assert found
    peaks = np.abs(comparison["predictor_lqi"].signals.torque_applied.values).max(axis=0)
    factor = 1e-3 if found[2] else 1.0
    assert factor * float(found[1]) == pytest.approx(peaks.max(), rel=0.05)
    assert int(found[3]) == 1 + np.argmax(peaks)


def test_a_run_stopped_before_its_first_sample_can_be_drawn(run):
    nothing = dataclasses.replace(
        run,
        status="interrupted",
        stopped=Failure(0.0, None, np.nan, "interrupted"),
        signals=run.signals.isel(time=slice(0, 0)),
    )
    drawn = draw_run(nothing)
    drawn["states"].draw_without_rendering()
    assert list(drawn) == ["states", "errors", "torques"]
    assert draw_comparison({}) == {}
    assert "peak error" in run_document(nothing).plain()


def test_the_rms_error_is_an_angle_and_a_distance_after_the_first_half(run):
    """The plate is turned by 2 degrees about a slanted axis, and 3 mm away."""
    turned = run.signals.copy(deep=True)
    n = len(turned.time)
    turned["reference"][:, :3], turned["reference"][:, 3:] = [0.3, -0.4, 1.2], [0, 0, 0.3]
    axis, R = np.array([2.0, 1.0, -2.0]) / 3, rotation(np.array([0.3, -0.4, 1.2]))
    K = np.cross(np.eye(3), -axis)  # K v = axis x v
    angle = np.radians(2)
    R = R @ (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)
    roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    turned["pose"][: n // 2] = 1.0
    turned["pose"][n // 2 :, :3] = [roll, np.arcsin(-R[2, 0]), yaw]
    turned["pose"][n // 2 :, 3:] = [3e-3, 0, 0.3]

    def shown(signals, status="completed"):
        found = rms_error(signals.pose.values, signals.reference.values)
        summary = run.summary | {"rms_error": found}
        one = dataclasses.replace(run, signals=signals, summary=summary, status=status)
        return " ".join(run_document(one).plain().split())

    assert "rms error 2.0 deg, 3.0 mm in the second half" in shown(turned)
    turned["pose"][-1] = np.nan
    assert "2.0 deg, 3.0 mm" in shown(turned)
    rests = turned.copy(deep=True)
    rests["reference"][: n // 4] = 0.5
    followed = slice(n // 8, n // 4 + 1)
    rests["pose"][followed] = rests["reference"][followed]
    assert "in the second half of the motion" in shown(rests)
    assert rms_error(rests.pose.values, rests.reference.values)["angle_deg"] < 1
    assert "rms error" not in shown(turned, "left_workspace")


def test_a_run_counts_the_true_values_within_two_deviations(run):
    """As many as the title of the figure says; a live run knows none."""
    title = draw_run(run)["parameters"].legends[0].get_title().get_text()
    count = re.search(r"(\d of 8) true values", title)[1]
    told = " ".join(run_document(run).plain().split())
    assert f"two estimated standard deviations; {count} true values are within)" in told
    far = run.summary["estimates"] | {"payload_mass": {"value": 0.3, "std": 0.01}}
    off = dataclasses.replace(run, summary=run.summary | {"estimates": far})
    near = far | {"payload_mass": {"value": 0.3, "std": 0.06}}
    on = dataclasses.replace(run, summary=run.summary | {"estimates": near})
    counts = [int(re.search(r"(\d) of 8", run_document(one).plain())[1]) for one in (off, on)]
    assert counts[1] == counts[0] + 1
    live = dataclasses.replace(run, summary=run.summary | {"live": {}})
    assert "true values" not in run_document(live).plain()


def test_an_estimated_delay_is_comparable_with_its_deviation(run):
    delay = {"true_s": 0.8, "estimated_s": 0.8001234, "std_s": 8.5e-5}
    found = run_document(dataclasses.replace(run, summary={**run.summary, "delay": delay})).plain()
    said = " ".join(found.split())
    assert "800.12 ± 0.17 ms at the end (± two estimated standard deviations); true 800 ms" in said


@pytest.mark.parametrize(
    ("settings", "named"),
    [([], True), (["queue=reference"], False), (["start=on_reference"], False)],
)
def test_the_delay_floor_is_named_for_a_plate_that_rests(settings, named, run):
    scenario = load_scenario("paper", settings=settings)
    shown = dataclasses.replace(run, scenario=scenario)
    assert ("delay floor" in run_document(shown).plain()) == named


def test_rounding_is_no_motion(run):
    """A coordinate that stays where it should gets no axis of 1e-14 deg."""
    still = run.signals.copy()
    still["reference"] = still.reference * np.array([0, 0, 0, 0, 0, 1])
    still["error"] = 0 * still.reference + 1e-13 * np.sin(still.time)
    still["pose"] = still.reference + still.error
    drawn = draw_run(dataclasses.replace(run, signals=still))
    for name in ("states", "errors"):
        assert all(np.ptp(limits(ax)) > 1e-6 for ax in drawn[name].axes[:6])


def test_a_reference_that_holds_still_has_its_errors_in_the_states(run):
    held = run.signals.copy()
    held["reference"] = 0 * held.reference + np.array([0, 0, 0, 0, 0, 0.38])
    held["error"] = 1e-13 * np.sin(held.time) + 0 * held.reference
    held["pose"] = held.reference + held.error
    for drawn in (
        draw_run(dataclasses.replace(run, signals=held)),
        draw_comparison({"lqr": dataclasses.replace(run, signals=held)}),
    ):
        assert "errors" not in drawn
        assert all(np.ptp(limits(ax)) > 1e-3 for ax in drawn["states"].axes)
        title = drawn["states"].legends[0].get_title().get_text()
        assert "holds still: the error is at most" in title
        assert all(
            ax.yaxis.get_major_formatter().get_offset() == "" for ax in drawn["states"].axes[-1:]
        )


def test_axes_of_parameters_fit_what_is_left_after_the_start(run):
    """An estimate that is wrong by a thousand at first leaves the final interval visible."""
    estimated = run.signals.copy()
    early = (run.signals.time < 0.4).values[:, None]
    estimated["parameters"] = estimated.parameters + 1e3 * early
    drawn = draw_run(dataclasses.replace(run, signals=estimated))["parameters"]
    for ax, same in zip(drawn.axes, draw_run(run)["parameters"].axes, strict=True):
        assert ax.get_ylim() == same.get_ylim()
    assert "the start is cut off" in drawn.legends[0].get_title().get_text()


@pytest.mark.parametrize("number", [3, 12])
def test_any_number_of_controllers_has_distinct_lines_named_on_the_figure(run, number):
    names = [*CONTROLLERS, *(f"a controller of my own {k}" for k in range(7))][:number]
    lines = controller_lines(names)
    grey = {(line.linestyle, line.marker) for line in lines.values()}
    assert len(grey) == len(set(lines.values())) == number
    drawn = draw_comparison(dict.fromkeys(names, run))
    box = drawn["states"].legends[0].get_window_extent()
    assert 0 <= box.x0 < box.x1 <= drawn["states"].bbox.x1


RANGES = [(19.5, 37), (0.4, 300), (8, 12), (20, 55), (1e-3, 2e-3), (0.59, 1.95)]


@pytest.mark.parametrize(("low", "high"), RANGES)
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


@pytest.mark.parametrize(("largest", "unit"), [(2.0, "N m"), (0.02, "mN m"), (2e-9, "µN m")])
def test_a_unit_fits_the_values(largest, unit):
    found, factor = unit_for([0.0, -largest, np.nan], TORQUES)
    assert found == unit and factor == TORQUES[unit]
    assert unit_for([], TORQUES)[0] == "µN m"
