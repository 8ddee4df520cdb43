"""The loop on motor encoders: the sensor as a system, its faults, figures, both plants, record."""

from functools import cache

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.sensor import Encoders
from stewart_drake.loop.simulation import make_simulator, simulate
from stewart_drake.mechanism.trajectories import make_reference
from stewart_drake.reporting.csv_file import read_signals, signals_csv
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import LEGS
from stewart_drake.scenario.timing import look_time
from tests.mechanisms import PAPER

ENCODERS = ("plant.kind=exact", "sensor.kind=encoders")
ON_REFERENCE = (*ENCODERS, "start=on_reference", "queue=reference")
FINE = ("sensor.samples=100",)


@cache
def run(*settings, scenario="paper", controller=None):
    return simulate(load_scenario(scenario, controller, settings), judge_stability=False)


def bad(result):
    """Return the counts of incomplete measurements: missing, frozen, rejected."""
    counts = result.summary["counts"]
    names = ("missing", "frozen", "rejected")
    missing, frozen, rejected = (counts[f"measurements_{name}"] for name in names)
    return missing, frozen, rejected


# The sensor.


class Moving(LeafSystem):
    """A plate that follows the paper's motion."""

    def __init__(self):
        super().__init__()
        self.reference = make_reference(Scenario().reference, 10.0)
        self.DeclareVectorOutputPort("state", 12, self.calc)

    def calc(self, context, output):
        pose = self.reference.value(context.get_time())[:, 0]
        output.SetFromVector(np.concatenate([pose, np.zeros(6)]))


def seen(times, *arguments, moves=True, **more):
    """Return the codes at times in s, of a plate on the paper's motion or at its start."""
    builder = DiagramBuilder()
    start = np.concatenate([Moving().reference.value(0.0)[:, 0], np.zeros(6)])
    plate = builder.AddSystem(Moving() if moves else ConstantVectorSource(start))
    encoders = builder.AddSystem(Encoders(PAPER, *arguments, **more))
    builder.Connect(plate.get_output_port(), encoders.get_input_port())
    builder.ExportOutput(encoders.get_output_port(), "measurement")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    found = []
    for time in times:
        if time > 0:
            simulator.AdvanceTo(look_time(time))
        values = diagram.GetOutputPort("measurement").Eval(simulator.get_context())
        found.append(values.reshape(-1, 6))
    return found


def angles_at(times):
    reference = Moving().reference
    return np.array([PAPER.crank_angles(reference.value(t)[:, 0]) for t in times])


@pytest.mark.parametrize("samples", [1, 4, 100])
def test_exact_encoders_say_where_the_cranks_were(samples):
    first, later = seen([0.0, 0.7], None, samples, np.full(6, 0.01), 0, 0.1)
    assert first == pytest.approx(np.tile(angles_at(np.zeros(1)) + 0.01, (samples, 1)), abs=1e-12)
    times = 0.6 + 0.1 * np.arange(1, samples + 1) / samples
    assert later == pytest.approx(angles_at(times) + 0.01, abs=1e-9)


def test_codes_are_of_their_width_and_begin_anywhere():
    times = [0.1 * k for k in range(1, 60)]
    q, exact = 2 * np.pi / 2**10, angles_at(np.array(times))
    errors = {}
    for seed in (0, 1):
        found = np.array(seen(times, 10, 1, np.zeros(6), seed, 0.1))[:, 0]
        errors[seed] = found - exact
        assert np.abs(errors[seed]).max() <= q / 2 + 1e-9
        assert np.std(errors[seed]) == pytest.approx(q / np.sqrt(12), rel=0.1)
        # One lattice per leg.
        turns = (found - found[0]) / q
        assert np.abs(turns - np.round(turns)).max() < 1e-6
    assert not np.allclose(errors[0], errors[1], atol=q / 10)
    again = np.array(seen(times[:3], 10, 1, np.zeros(6), 1, 0.1))[:, 0]
    assert np.array_equal(again - exact[:3], errors[1][:3])


def fault(kind, start=0.0, end=9.0, **more):
    return {"kind": kind, "from": start, "to": end, **more}


def test_faults_are_of_their_legs_and_times():
    faults = [
        fault("missing", 0.25, 0.35, leg=2),
        fault("frozen", 0.28, 0.55, leg=5),
        fault("spike", 0.45, 0.5, leg=6, size=2.0),
    ]
    three, four, five = seen([0.3, 0.4, 0.5], None, 10, np.zeros(6), 0, 0.1, faults)
    found = np.vstack([three, four, five])
    times = np.round(np.arange(0.21, 0.505, 0.01), 9)
    exact = angles_at(times)
    assert np.array_equal(np.isnan(found[:, 1]), (times >= 0.25) & (times < 0.35))
    frozen = times >= 0.28
    assert found[frozen, 4] == pytest.approx(np.full(frozen.sum(), exact[times == 0.27, 4][0]))
    spiked = (times >= 0.45) & (times < 0.5)
    assert np.all(np.abs(found - exact)[spiked, 5] > 1e-3)
    right = np.ones(found.shape, dtype=bool)
    right[(times >= 0.25) & (times < 0.35), 1] = False
    right[frozen, 4], right[spiked, 5] = False, False
    assert found[right] == pytest.approx(exact[right], abs=1e-9)


def test_a_share_strikes_that_share_from_the_first_sample_on():
    times = [0.1 * k for k in range(20)]
    struck = [fault("missing", share=0.05), fault("spike", share=0.01)]
    found = np.array(seen(times, None, 100, np.zeros(6), 3, 0.1, struck, moves=False))
    missing = np.isnan(found)
    number = found.size
    assert missing.sum() == pytest.approx(0.05 * number, abs=4 * np.sqrt(0.05 * number))
    assert missing[0].any()
    off = np.abs(found[~missing].reshape(-1) - np.broadcast_to(found[1, -1], found.shape)[~missing])
    spikes = np.sum(off > 1e-9)
    assert spikes == pytest.approx(0.01 * 0.95 * number, abs=4 * np.sqrt(0.01 * number))


# The loop.


@pytest.mark.parametrize(
    ("settings", "bound"),
    [
        (("sensor.bits=null",), 0.03),
        (("sensor.bits=20",), 0.06),
        (("sensor.bits=17",), 0.3),
        (("sensor.bits=14", *FINE), 1.5),
        (("sensor.bits=14", "sensor.samples=50", "plant.kind=multibody"), 1.8),
        pytest.param((*FINE, "sensor.delay=0.1", "sensor.loss=0.1"), 2.0, marks=pytest.mark.slow),
        # From rest the error is 21.08 with the state as measurement.
        pytest.param(
            ("sensor.bits=14", *FINE, "start=rest", "queue=zero"), 21.5, marks=pytest.mark.slow
        ),
    ],
)
def test_the_error_is_small(settings, bound):
    """Means over seeds: `python benchmarks/encoders.py`; on the reference 0.026 with the state."""
    assert run(*ON_REFERENCE, *settings).accumulated_error < bound


@pytest.mark.slow
def test_what_is_not_known_is_found():
    bias = "plant.torque_bias=[3e-4,-3e-4,3e-4,-3e-4,3e-4,-3e-4]"
    more = ("plant.payload_mass=0.4", "plant.joint_damping=1e-3")
    result = run(*ON_REFERENCE, "sensor.bits=14", *FINE, bias, *more)
    assert result.accumulated_error < 4.0
    true = np.array([3e-4, -3e-4] * 3 + [0.4, 1e-3])
    left = np.abs(result.signals.parameters.values[-1] - true)
    assert np.all(left < 4 * result.signals.parameter_std.values[-1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "counted"),
    [
        ("[{kind: missing, leg: 2, from: 4, to: 5}]", (11, 0, 0)),
        ("[{kind: missing, from: 4, to: 4.5}]", (6, 0, 0)),
        ("[{kind: spike, share: 0.01, from: 0, to: 100}]", (0, 0, 60)),
        ("[{kind: missing, share: 0.05, from: 0, to: 100}]", (61, 0, 0)),
    ],
)
def test_faults_do_little_and_are_counted(faults, counted):
    """One window of 0.1 s more than the fault lasts contains a part of it."""
    usual = (*ON_REFERENCE, *FINE, "duration=6")
    clean, result = run(*usual), run(*usual, f"sensor.faults={faults}")
    assert result.accumulated_error < 1.2 * clean.accumulated_error
    assert bad(clean) == (0, 0, 0)
    assert np.abs(np.subtract(bad(result), counted)).max() <= 1


@pytest.mark.parametrize("samples", [1, 100])
def test_a_frozen_leg_is_called_so(samples):
    frozen = "sensor.faults=[{kind: frozen, leg: 3, from: 4, to: 4.4}]"
    missing, stuck, rejected = bad(
        run(*ON_REFERENCE, f"sensor.samples={samples}", frozen, "duration=5")
    )
    assert (missing, stuck + rejected) == (0, 4)
    assert stuck >= 3


@pytest.mark.slow
def test_a_delay_that_is_not_known_either():
    wrong = ("controller.delay_estimator=constant", "controller.delay_steps=7")
    for where in (ON_REFERENCE, ENCODERS):
        result = run(*where, *wrong, "sensor.bits=14", *FINE)
        assert result.status == "completed"
        assert result.summary["delay"]["estimated_s"] == pytest.approx(0.8, abs=2e-3)


@pytest.mark.slow
def test_offsets_are_found():
    """A tenth of a degree each; 0.1 mrad are left after 10 s."""
    offsets = np.deg2rad(0.1) * np.array([1, -1, 1, 1, -1, -1])
    known = "controller.prior={torque_bias: 0.003, payload: 0.5, damping: 0.003}"
    mounted = f"sensor.offset={offsets.tolist()}"
    settings = (
        *ON_REFERENCE,
        *FINE,
        known,
        mounted,
        "controller.estimate=[torque_bias,payload,damping,offsets]",
    )
    loop = build_closed_loop(load_scenario("paper", settings=settings))
    simulator = make_simulator(loop)
    simulator.AdvanceTo(10.0)
    controller = loop.GetSubsystemByName("controller")
    belief = controller.memory(controller.GetMyContextFromRoot(simulator.get_context())).belief
    assert np.abs(belief.parameters[8:] - offsets).max() < 1.5e-4
    std = np.sqrt(np.diag(belief.estimate.covariance)[20:])
    assert np.all(np.abs(belief.parameters[8:] - offsets) < 3 * std)


def test_without_an_estimator_rates_are_differences():
    """These controllers need a loop without delay."""
    settings = ("controller.estimate=[]", "delay.steps=0", "controller.period=0.02")
    result = run(*ON_REFERENCE, "sensor.bits=17", *settings)
    assert result.status == "completed"
    judged = simulate(load_scenario("paper", settings=(*ENCODERS, *settings, "duration=0.1")))
    assert "differences" in judged.summary["warnings"][0]


# What is told of it.


def test_the_record_has_angles_with_labels(tmp_path):
    result = run(*ON_REFERENCE, "sensor.samples=3", "duration=0.5")
    measured = result.signals.measurement
    assert measured.dims == ("time", "encoder") and measured.attrs["units"] == "rad"
    assert list(measured.encoder.values[:7]) == [*(f"A{leg}[0]" for leg in LEGS), "A1[1]"]
    last = measured.sel(encoder=[f"A{leg}[2]" for leg in LEGS], time=0.4).values
    pose = result.signals.pose.sel(time=0.4).values
    assert np.abs(last - PAPER.crank_angles(pose)).max() < 2 * np.pi / 2**14
    result.save(tmp_path)
    back = read_signals(tmp_path / "signals.nc")
    header = signals_csv(back).partition("\n")[0]
    assert "measurement_A1[0][rad],measurement_A2[0][rad]" in header


@pytest.mark.parametrize("role", ["controller", "sensor"])
def test_own_systems_that_measure_the_state_are_refused(role):
    class Own(LeafSystem):
        def __init__(self):
            super().__init__()
            names = {
                "controller": ("measurement", "torque", 6),
                "sensor": ("state", "measurement", 12),
            }
            took, gives, size = names[role]
            self.DeclareVectorInputPort(took, 12)
            self.DeclareVectorOutputPort(gives, size, lambda context, output: None)

    scenario = load_scenario("paper", settings=ENCODERS)
    with pytest.raises(ConfigError, match=f"got 'encoders' with a {role} of your own"):
        simulate(scenario, judge_stability=False, **{role: Own})
