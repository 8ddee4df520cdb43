"""References: exact derivatives, smooth joints, defined for all time, honest about bad files."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.polynomial import Polynomial
from pydrake.trajectories import PiecewisePolynomial

from stewart_drake.mechanism.trajectories import (
    PlateTrajectory,
    catch_up,
    evaluate,
    make_reference,
    peak_to_peak,
    spread_instants,
)
from stewart_drake.scenario.reference_config import (
    CsvConfig,
    HoldConfig,
    SineConfig,
    WaypointsConfig,
)
from stewart_drake.scenario.signals import ACCELERATIONS, POSE, RATES
from tests.faults import one_line, written

HOME = [0.0, 0.0, 0.0, 0.0, 0.0, 0.38]
HEADER = "time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]"
WAYPOINTS = WaypointsConfig(
    times=[0.5, 1.0, 2.5, 3.0],
    poses=[HOME, [0.1, 0.2, -0.1, 0.01, 0, 0.4], [0, 0.1, 0, 0, 0.02, 0.38], HOME],
)


def sample_csv(path, times, motion):
    rows = [",".join(repr(float(v)) for v in [t, *motion(t)]) for t in times]
    path.write_text("\n".join([HEADER, *rows, ""]))
    return CsvConfig(file=str(path))


def assert_derivatives_agree(trajectory, t):
    """Central differences of the pose give the rates, those of the rates the accelerations."""
    h = 1e-5
    before, at, after = (evaluate(trajectory, s) for s in (t - h, t, t + h))
    for low, high in ((POSE, RATES), (RATES, ACCELERATIONS)):
        scale = 1 + np.abs(at).max()
        np.testing.assert_allclose(
            (after[low] - before[low]) / (2 * h), at[high], atol=1e-4 * scale
        )


def assert_smooth(trajectory, knots, atol=1e-4):
    """Pose, rates and accelerations have no jump at the knots."""
    for t in knots:
        np.testing.assert_allclose(
            evaluate(trajectory, t + 1e-9), evaluate(trajectory, t - 1e-9), atol=atol
        )


# Sine and hold


def test_the_sine_is_the_papers_equation_46():
    trajectory = make_reference(SineConfig(), 10.0)
    amplitude = np.array([0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08])
    for t in (0.0, 0.7, math.pi / 2, 123.4):
        expected = [
            amplitude * math.sin(t) + HOME,
            amplitude * math.cos(t),
            -amplitude * math.sin(t),
        ]
        np.testing.assert_allclose(evaluate(trajectory, t), np.concatenate(expected), atol=1e-15)


@given(
    frequency=st.floats(0.01, 5) | st.lists(st.floats(0.01, 5), min_size=6, max_size=6),
    unit=st.sampled_from(["rad/s", "Hz"]),
    amplitude=st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6),
    t=st.floats(0.1, 20),
)
@settings(deadline=None)
def test_the_derivatives_of_a_sine_are_exact(frequency, unit, amplitude, t):
    config = SineConfig(amplitude=amplitude, frequency=frequency, frequency_unit=unit)
    trajectory = make_reference(config, 10.0)
    assert_derivatives_agree(trajectory, t)
    omega = np.array(config.angular_frequency)
    factor = 2 * math.pi if unit == "Hz" else 1
    assert omega == pytest.approx(np.broadcast_to(frequency, 6) * factor)
    waves = [a * math.sin(w * t) for a, w in zip(amplitude, omega, strict=True)]
    assert np.array_equal(trajectory.value(t)[:, 0], np.add(config.offset, waves))
    third = trajectory.MakeDerivative(3).value(t)[:, 0]
    np.testing.assert_allclose(
        third, -(omega**2) * evaluate(trajectory, t)[RATES], atol=1e-9 * (1 + omega.max() ** 3)
    )


# Motions in C


@given(
    ends=st.lists(st.floats(0.05, 2), min_size=1, max_size=5),
    degree=st.integers(1, 6),
    seed=st.integers(0, 1000),
)
@settings(deadline=None)
def test_pieces_then_another_motion_are_drakes_polynomials_then_waves(ends, degree, seed):
    """A joint belongs to the later piece; before t = 0 the motion is that at 0."""
    rng, times = np.random.default_rng(seed), np.append(0.0, np.cumsum(ends))
    powers = rng.normal(size=(degree + 1, len(ends), 6))
    pieces = [[[Polynomial(powers[::-1, k, i])] for i in range(6)] for k in range(len(ends))]
    drakes = PiecewisePolynomial(np.array(pieces), times.tolist())
    sine = SineConfig(frequency=rng.uniform(0.1, 3, 6).tolist())
    motion = PlateTrajectory(times, powers, make_reference(sine, 1.0))
    size = 1e-13 * 2.0**degree * math.factorial(degree)
    for t in (*times[:-1], *rng.uniform(0, times[-1], 20)):
        for order in range(4):
            expected = drakes.EvalDerivative(t, order)
            np.testing.assert_allclose(motion.EvalDerivative(t, order), expected, atol=size)
    omega = np.array(sine.angular_frequency)
    for t in (times[-1], *(times[-1] + rng.uniform(0, 100, 20))):
        waves = [omega**k * np.sin(omega * t + k * np.pi / 2) for k in range(3)]
        expected = np.concatenate([np.array(sine.amplitude) * wave for wave in waves])
        expected[:6] += sine.offset
        np.testing.assert_allclose(evaluate(motion, t), expected, atol=1e-12)
    for early in (-1.0, -1e-300, math.nan):
        assert np.array_equal(motion.along([early]), motion.along([0.0]))
    assert np.isfinite(motion.along([math.inf, 1e308])).all()


@pytest.mark.parametrize(
    ("times", "shape", "message"),
    [
        ([0.0, 1.0], (2, 2, 6), "coefficients: got shape"),
        ([0.0, 1.0, 2.0], (6, 6), "coefficients: got shape"),
        ([0.0, 1.0, 1.0], (2, 2, 6), "expected ascending numbers"),
        ([0.0, math.nan], (2, 1, 6), "expected ascending numbers"),
    ],
)
def test_pieces_that_do_not_fit_their_times_are_refused(times, shape, message):
    with pytest.raises(ValueError, match=message):
        PlateTrajectory(times, np.zeros(shape))


# Waypoints


def test_waypoints_are_met_and_held_before_and_after():
    assert WAYPOINTS.times is not None and WAYPOINTS.poses is not None
    trajectory = make_reference(WAYPOINTS, 10.0)
    for t, pose in zip(WAYPOINTS.times, WAYPOINTS.poses, strict=True):
        np.testing.assert_allclose(evaluate(trajectory, t)[POSE], pose, atol=1e-14)
    for t in (0.0, 0.3, 3.1, 100.0):
        np.testing.assert_array_equal(evaluate(trajectory, t), HOME + [0.0] * 12)


@given(
    gaps=st.lists(st.floats(0.2, 3), min_size=1, max_size=6),
    values=st.lists(st.floats(-0.5, 0.5), min_size=7, max_size=7),
    start=st.floats(0, 1),
)
@settings(deadline=None)
def test_waypoints_are_joined_with_continuous_acceleration(gaps, values, start):
    times = [float(t) for t in start + np.cumsum([0.0, *gaps])]
    poses = [[v, -v, v, v / 10, 0.0, 0.38] for v in values[: len(times)]]
    config = WaypointsConfig(times=times, poses=poses)
    trajectory = make_reference(config, 10.0)
    assert_smooth(trajectory, [t for t in times if t > 0])
    for middle in (np.array(times[1:]) + times[:-1]) / 2:
        assert_derivatives_agree(trajectory, middle)


def test_two_waypoints_of_a_file_are_the_minimum_jerk_motion(tmp_path):
    path = tmp_path / "poses.yaml"
    path.write_text(f"times: [0, 2]\nposes: {[[0.0] * 6, [0.4] * 6]}\n")
    trajectory = make_reference(WaypointsConfig(file=str(path)), 2.0)
    for s in np.linspace(0, 1, 11):
        expected = 0.4 * (10 * s**3 - 15 * s**4 + 6 * s**5)
        np.testing.assert_allclose(evaluate(trajectory, 2 * s)[POSE], expected, atol=1e-15)


@pytest.mark.parametrize(
    ("times", "poses", "parts"),
    [
        ([0, 1, 1], [HOME] * 3, ["times[2]: got 1.0 after 1.0", "increasing"]),
        ([0, 1], [HOME] * 3, ["poses: got 3 poses", "expected 2"]),
        ([0, 1], [HOME, [0, 1.6, 0, 0, 0, 0]], ["poses[1][1]: got 1.6 rad", "90 degrees"]),
        ([0, 1], [HOME, [0, 0, 3.5, 0, 0, 0]], ["poses[1][2]: got 3.5 rad", "unwrap"]),
        ([0, 1], [HOME, [7, 0, 0, 0, 0, 0]], ["poses[1][0]: got 7 rad", "(are these degrees?)"]),
        ([0, 1], [HOME, [0, 0, 0, 2e3, 0, 0]], ["poses[1][3]: got 2000 m", "1000"]),
    ],
)
def test_bad_waypoints_are_refused(times, poses, parts, tmp_path):
    path = tmp_path / "poses.yaml"
    path.write_text(f"times: {times}\nposes: {poses}\n")
    for config, where in [
        (WaypointsConfig(times=times, poses=poses), "reference."),
        (WaypointsConfig(file=str(path)), f"{path}: "),
    ]:
        one_line(lambda config=config: make_reference(config, 10.0), *parts, start=where)


# CSV


def sine_pose(t):
    return evaluate(make_reference(SineConfig(), 10.0), t)[POSE]


def test_a_sampled_sine_is_the_sine(tmp_path):
    """Also at t = 0, where it moves already."""
    config = sample_csv(tmp_path / "a.csv", np.linspace(0, 10, 1001), sine_pose)
    sampled = make_reference(config, 10.0)
    exact = make_reference(SineConfig(), 10.0)
    for t in np.linspace(0, 9.999, 301):
        error = np.abs(evaluate(sampled, t) - evaluate(exact, t))
        assert error[POSE].max() < 1e-9
        assert error[RATES].max() < 1e-6
        assert error[ACCELERATIONS].max() < 1e-4


def test_a_csv_motion_is_smooth_at_its_samples_and_held_after(tmp_path):
    def bump(t):  # comes to rest at t = 2
        return np.array(HOME) + 0.05 * (1 - math.cos(math.pi * t))

    times = np.concatenate([np.linspace(0, 1, 21), np.linspace(1.1, 2, 10)])
    trajectory = make_reference(sample_csv(tmp_path / "a.csv", times, bump), 10.0)
    assert_smooth(trajectory, [float(t) for t in times[1:-1]])
    for t in (0.33, 1.07, 1.52):
        assert_derivatives_agree(trajectory, t)
    for t in (2.0, 2.5, 100.0):
        np.testing.assert_allclose(evaluate(trajectory, t), [*bump(2.0)] + [0.0] * 12, atol=1e-12)


def test_units_and_the_order_of_columns_are_read_from_the_header(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{380 + t},{t},0,10,20,30,{t}" for t in range(4)]  # the least number of samples
    header = "\ufeff Z [mm], Time[s],roll[deg],pitch[deg],yaw[deg],x[mm],y[m]"
    path.write_text("\n".join([header, *rows, "", " , ", ""]), encoding="utf-8")
    trajectory = make_reference(CsvConfig(file=str(path)), 3.0)
    expected = [0, math.radians(10), math.radians(20), 0.03, 2, 0.382]
    np.testing.assert_allclose(evaluate(trajectory, 2.0)[POSE], expected, atol=1e-12)


GOOD_ROWS = [f"{t / 10},0,0,0,0,0,0.38" for t in range(6)]


MOVING = "\n".join([HEADER, *(f"{t / 10},0,0,0,{t / 100},0,0.38" for t in range(6))])


def changed(row, text):
    rows = list(GOOD_ROWS)
    rows[row] = text
    return "\n".join([HEADER, *rows])


BAD_CSV = {
    "empty": ("", ["is empty", "time[s]"]),
    "no header": ("\n".join(GOOD_ROWS), ["row 1", "'0.0'", "a header time[s]"]),
    "three rows": ("\n".join([HEADER, *GOOD_ROWS[:3]]), ["got 3 samples", "at least 4"]),
    "semicolons": (HEADER.replace(",", ";"), ["row 1", "separated by ';'", "expected commas"]),
    "decimal commas": (
        changed(1, "0,1,0,0,0,0,0,0,38"),
        ["7 fields in line 3, saw 9", "points for the decimals"],
    ),
    "no units": ("time,roll,pitch,yaw,x,y,z", ["row 1", "unknown column 'time'"]),
    "odd unit": (HEADER.replace("x[m]", "x[ft]"), ["row 1", "'x[ft]'", "x in m or mm"]),
    "missing column": (HEADER.replace(",z[m]", ""), ["row 1", "column z is missing"]),
    "column twice": (HEADER.replace("y[m]", "x[mm]"), ["row 1", "a second column 'x[mm]'"]),
    "text": (
        changed(2, "0.2,0,abc,0,0,0,0.38"),
        ["row 4", "pitch[rad]", "'abc'", "a finite number"],
    ),
    "nan": (changed(3, "0.3,0,0,nan,0,0,0.38"), ["row 5", "yaw[rad]", "nan", "finite"]),
    "late start": (changed(0, "0.05,0,0,0,0,0,0.38"), ["row 2", "time[s]", "0.05", "subtract"]),
    "time twice": (changed(2, "0.1,0,0,0,0,0,0.38"), ["row 4", "time[s]", "0.1 after 0.1"]),
    "gap": (changed(5, "9,0,0,0,0,0,0.38"), ["row 7", "time[s]", "8.6 s", "resampling"]),
    "pitch in degrees": (
        changed(1, "0.1,0,5,0,0,0,0.38"),
        ["row 3", "pitch[rad]", "(are these degrees?)"],
    ),
    "roll in degrees": (
        changed(1, "0.1,15,0,0,0,0,0.38"),
        ["row 3, column roll[rad]: got 15 rad; expected an angle within", "(are these degrees?)"],
    ),
    "yaw jumps in degrees": (
        changed(1, "0.1,0,0,355,0,0,0.38").replace("yaw[rad]", "yaw[deg]"),
        ["row 3", "yaw[deg]: got 355 deg after 0; expected no jump by a turn"],
    ),
    "far in millimetres": (
        changed(1, "0.1,0,0,0,0,0,-2e6").replace("z[m]", "z[mm]"),
        ["row 3", "z[mm]: got -2000000 mm; expected a finite number below 1e+06 mm"],
    ),
    "open quote": (changed(1, '"0.1,0,0,0,0,0,0.38'), ["is not CSV", "inside string"]),
    "moving end": (MOVING, ["last row", " x at 0.5 s", "duration"]),
    "glitch": (
        f"{MOVING}\n0.6,0,0,0,0.06,0,0.40\n0.7,0,0,0,0.07,0,0.38\n0.8,0,0,0,0.08,0,0.38",
        ["row 8", "z[m]", "0.02 m off", "resample"],
    ),
    "too few samples": (
        "\n".join([HEADER, *(f"{t},0,0,0,{math.sin(1.5 * t)},0,0" for t in range(20))]),
        ["x[m]", "ten samples per swing"],
    ),
}


@pytest.mark.parametrize("case", BAD_CSV)
def test_a_bad_csv_file_is_refused_in_one_line(case, tmp_path):
    text, parts = BAD_CSV[case]
    config = CsvConfig(file=str(written(tmp_path / "a.csv", text)))
    one_line(lambda: make_reference(config, 10.0), *parts, start=f"{config.file}: ")


@given(noise=st.floats(0, 2.5e-4), seed=st.integers(0, 2**32 - 1), jitter=st.floats(0, 0.3))
@settings(deadline=None, max_examples=50)
def test_a_measured_motion_with_noise_and_uneven_steps_is_accepted(
    noise, seed, jitter, tmp_path_factory
):
    """Ten samples per period; angles and two positions are still but for the noise.

    On an even grid noise shows by at most 1 + 4/3 + 1/3 times itself, two thirds of the bound.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(60) / 10 + jitter * rng.uniform(-0.05, 0.05, 60)
    times[0] = 0.0

    def motion(t):
        pose = np.array(HOME) + rng.uniform(-noise, noise, 6)
        return pose + [0, 0, 0, 0, 0, 0.08 * math.sin(2 * math.pi * t)]

    path = tmp_path_factory.getbasetemp() / "measured.csv"
    trajectory = make_reference(sample_csv(path, times, motion), 5.0)
    assert abs(evaluate(trajectory, 2.25)[5] - 0.46) < 0.01


# Peak to peak


def test_the_peak_to_peak_of_a_sine_is_twice_its_amplitude_however_short_the_run():
    config = SineConfig(amplitude=[0.1, -0.2, 0.0, 0.01, 0.0, 0.02], frequency=1e-3)
    span = peak_to_peak(config, make_reference(config, 0.1), 0.1)
    np.testing.assert_allclose(span, [0.2, 0.4, 0, 0.02, 0, 0.04])


def test_the_peak_to_peak_of_a_constant_is_zero():
    for config in (HoldConfig(), WaypointsConfig(times=[0, 1, 3], poses=[[0.3] * 6] * 3)):
        assert not peak_to_peak(config, make_reference(config, 5.0), 5.0).any()


def test_the_peak_to_peak_of_samples_is_their_range_within_the_run(tmp_path):
    config = sample_csv(tmp_path / "a.csv", np.linspace(0, 10, 501), sine_pose)
    whole = peak_to_peak(config, make_reference(config, 10.0), 10.0)
    np.testing.assert_allclose(
        whole, 2 * np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08]), rtol=1e-6
    )
    first_quarter = peak_to_peak(config, make_reference(config, 1.5), 1.5)
    np.testing.assert_allclose(first_quarter, whole / 2 * math.sin(1.5), rtol=1e-6)


# Where to look at a motion


@given(
    duration=st.floats(0.1, 1e4),
    number=st.integers(8, 300),
    periods=st.sampled_from([0.25, 0.5, 1.0, 1.5, 2.0, 7.0, 100.0]),
)
def test_spread_instants_see_all_phases_of_a_motion_in_step_with_the_parts(
    duration, number, periods
):
    times = spread_instants(duration, number)
    part = duration / number
    assert times[0] == 0 and times[-1] < duration
    np.testing.assert_array_equal(np.floor(times / part * (1 + 1e-12)), np.arange(number))
    phases = np.sort(times / part * periods % 1)  # so many periods in each part
    gaps = np.diff([*phases, phases[0] + 1])
    assert gaps.max() < 0.45  # evenly spaced instants: 0.5 at the best with half a period, else 1


# Catch-up


@given(
    t_start=st.just(0.0) | st.floats(1e-3, 2),
    duration=st.floats(0.1, 2),
    start=st.lists(st.floats(-0.3, 0.3), min_size=12, max_size=12),
)
@settings(deadline=None)
def test_a_catch_up_leaves_the_start_and_joins_the_reference_smoothly(t_start, duration, start):
    pose, rates = np.array(start[:6]), np.array(start[6:])
    reference = make_reference(SineConfig(), 10.0)
    blend = catch_up(pose, rates, reference, t_start, duration)
    t_end = t_start + duration
    for t in (0.0, t_start / 2, t_start):
        expected = np.concatenate([pose + rates * t, rates, np.zeros(6)])
        np.testing.assert_allclose(evaluate(blend, t), expected, atol=1e-9)
    for t in (t_end, t_end + 0.1, t_end + 50):
        np.testing.assert_allclose(evaluate(blend, t), evaluate(reference, t), atol=1e-12)
    assert_smooth(blend, [t for t in (t_start, t_end) if t > 1e-6])
    assert_derivatives_agree(blend, t_start + duration / 2)


def test_a_catch_up_onto_itself_is_the_reference():
    """A start on a straight line that the reference follows anyway needs no blend."""
    line = PiecewisePolynomial.FirstOrderHold([0.0, 10.0], np.array([[0.0, 1.0]] * 6))
    for t_start in (1.0, 1e-300):  # the second counts as 0
        blend = catch_up([0.0] * 6, [0.1] * 6, line, t_start, 0.5)
        for t in (0.0, 0.9, 1.2, 1.5, 5.0):
            np.testing.assert_allclose(evaluate(blend, t)[POSE], t / 10, atol=1e-15)


@pytest.mark.parametrize(
    ("length", "t_start", "duration"),
    [(5, 0.0, 1.0), (6, -0.1, 1.0), (6, 0.0, 0.0), (6, 1.0, 1e-17), (6, math.inf, 1.0)],
)
def test_a_catch_up_refuses_what_has_no_blend(length, t_start, duration):
    with pytest.raises(ValueError, match="expected"):
        catch_up([0.0] * length, [0.0] * 6, make_reference(SineConfig(), 1.0), t_start, duration)
