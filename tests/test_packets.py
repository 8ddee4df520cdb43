"""Packets, the buffer that plays them, late measurements, and the law that sends plans."""

import dataclasses
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.core.library import core
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.channel import Packets, Report, Sent, Wire, packets_of, report_of
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.cautions import cautions_before
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.link import LateMeasurements, PlayoutBuffer
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import make_simulator
from stewart_drake.reporting.link import document
from stewart_drake.reporting.page import Provenance, html
from stewart_drake.scenario.link_config import NetworkConfig, PacketsConfig
from stewart_drake.scenario.packets import (
    default_bound,
    in_time,
    losses,
    packet_times,
    torque_missing,
)
from stewart_drake.scenario.timing import Delay, look_time
from stewart_drake.studies import link as link_study
from stewart_drake.studies.link import Cell, study_link
from stewart_drake.studies.runs import Outcome
from stewart_drake.studies.study_options import LinkOptions

PERIOD = 0.1
LONG = ("plant.kind=exact", "start=on_reference", "queue=reference")
NETWORK = ("link.kind=network", "link.low=0.5", "link.high=0.9")
IDEAL = (*NETWORK, "link.loss=0", "controller.packet_repeats=0")


class Plans(LeafSystem):
    """Packet k, whose row c is 100 k + c in all six."""

    def __init__(self, rows):
        super().__init__()
        self._rows = rows
        self.DeclareVectorOutputPort("plan", 6 * rows, self._output, {self.time_ticket()})

    def _output(self, context, output):
        k = round(context.get_time() / PERIOD)
        output.SetFromVector(np.repeat(100.0 * k + np.arange(self._rows), 6))


class Ramp(LeafSystem):
    """Its time, twice."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("y", 2, self._output, {self.time_ticket()})

    def _output(self, context, output):
        output.SetFromVector([context.get_time()] * 2)


def scenario(*more, controller=None):
    return sd.load_scenario("paper", controller, settings=(*LONG, *more))


def run(*more):
    return sd.simulate(scenario(*more), judge_stability=False)


# The buffer, against every packet looked at for every period.


@settings(max_examples=80, deadline=None)
@given(seed=st.integers(0, 2**31), dry=st.sampled_from(["hold", "zero"]))
def test_the_buffer_plays_the_newest_packet_that_is_there(seed, dry):
    rng = np.random.default_rng(seed)
    n, rows = 30, int(rng.integers(1, 6))
    repeats = int(rng.integers(0, rows))
    delay = Delay(int(rng.integers(0, 6)), float(rng.choice([0.0, 0.4])))
    eta = delay.eta(PERIOD)
    times = rng.choice([rng.uniform(0, 2 * eta + 0.1, n), PERIOD * rng.integers(0, 8, n)])
    times = np.where(rng.random(n) < 0.3, np.inf, times)
    queue = -1.0 - np.repeat(np.arange(delay.queue_length)[:, None], 6, axis=1)
    builder = DiagramBuilder()
    plans = builder.AddSystem(Plans(rows))
    buffer = builder.AddSystem(
        PlayoutBuffer(PERIOD, times, delay, queue, rows=rows, repeats=repeats, dry=dry, history=3)
    )
    builder.Connect(plans.get_output_port(), buffer.GetInputPort("commanded"))
    simulator = Simulator(builder.Build())
    context = buffer.GetMyContextFromRoot(simulator.get_context())
    simulator.Initialize()
    last = queue[0, 0] if len(queue) else 0.0
    played = missed = 0
    history = [last] * 3
    for s in range(n - 1):  # the period from s dt + eta0 on
        begins = (s + delay.fraction) * PERIOD
        due = {
            k: 100.0 * k + c
            for k in range(min(s + 1, n))
            for c in range(rows)
            if abs(k * PERIOD + eta + (c - repeats) * PERIOD - begins) < 1e-6
            and k * PERIOD + times[k] <= begins + 1e-8
        }
        if due:
            last, played = due[max(due)], played + 1
        elif s < delay.steps:
            last = queue[s - delay.steps + len(queue), 0]
        else:
            last, missed = (last if dry == "hold" else 0.0), missed + 1
        history = [last, *history[:2]]
        simulator.AdvanceTo(begins + 0.3 * PERIOD)
        now = begins + 0.3 * PERIOD
        assert np.array_equal(buffer.GetOutputPort("torque").Eval(context), np.full(6, last))
        sent = int(now / PERIOD + 1e-9) + 1
        late = [
            k
            for k in range(min(sent, n))
            if np.isfinite(times[k])
            and k * PERIOD + eta - repeats * PERIOD <= begins + 1e-8
            and times[k] > eta - repeats * PERIOD + 1e-8
        ]
        counts = [sent, np.isinf(times[:sent]).sum(), len(late), played, missed]
        assert buffer.GetOutputPort("packets").Eval(context).tolist() == counts
        report = buffer.GetOutputPort("report").Eval(context)
        there = [0 <= k < n and k * PERIOD + times[k] <= now for k in range(sent - 1, sent - 4, -1)]
        assert report[:3].tolist() == there
        assert report[3::6].tolist() == history


@pytest.mark.parametrize("burst", [1, 3])
def test_so_many_are_lost_and_in_bursts(burst):
    n, loss = 200_000, 0.2
    lost = losses(n, loss, burst, np.random.default_rng(1))
    # A burst makes neighbours alike: as if there were so many fewer packets.
    assert abs(lost.mean() - loss) < 4 * np.sqrt(loss * burst / n)
    changes = np.flatnonzero(np.diff(lost.astype(int)))
    lengths = np.diff(changes)[0 if lost[changes[0] + 1] else 1 :: 2]
    assert lengths.min() == burst
    begins = 1 - (1 - loss) ** (1 / burst)
    # A run goes on as long as another burst begins in each of its last packets.
    assert lengths.mean() == pytest.approx(loss / ((1 - loss) * begins), rel=0.03)


def test_times_are_those_of_the_distribution():
    uniform = packet_times(PacketsConfig(low=0.5, high=0.9, loss=0.0), 20_000, 3)
    assert 0.5 <= uniform.min() < 0.501 and 0.899 < uniform.max() <= 0.9
    assert abs(uniform.mean() - 0.7) < 4 * 0.4 / np.sqrt(12 * 20_000)
    log = PacketsConfig(distribution="lognormal", median=0.65, sigma=0.15, loss=0.0)
    assert np.median(packet_times(log, 20_000, 3)) == pytest.approx(0.65, rel=0.01)
    assert np.log(packet_times(log, 20_000, 3)).std() == pytest.approx(0.15, rel=0.03)
    lossy = packet_times(dataclasses.replace(log, loss=0.3), 20_000, 3)
    there = np.isfinite(lossy)
    assert np.array_equal(lossy[there], packet_times(log, 20_000, 3)[there])
    assert in_time(dataclasses.replace(log, loss=0.3), 0.65) == pytest.approx(0.5, abs=1e-6)


def test_the_usual_bound_is_the_least_that_makes_late_rarer_than_lost():
    config = PacketsConfig(low=0.5, high=0.9, loss=0.05)
    rng = np.random.default_rng(0)
    for repeats in (0, 1, 2):
        bound = default_bound(config, repeats, PERIOD)
        enough = max(1.5 * 0.05 ** (repeats + 1), 1e-3)
        assert torque_missing(config, bound, repeats, PERIOD) <= enough
        assert torque_missing(config, bound - PERIOD, repeats, PERIOD) > enough
        times = np.where(rng.random((100_000, repeats + 1)) < 0.05, np.inf, 0)
        times = times + rng.uniform(0.5, 0.9, times.shape)
        missing = np.all(times > 0.7 + PERIOD * np.arange(repeats + 1), axis=1).mean()
        exact = torque_missing(config, 0.7, repeats, PERIOD)
        assert missing == pytest.approx(exact, abs=4 * np.sqrt(exact / 100_000))


# Measurements that come late.


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_the_newest_measurement_is_handed_on_once(seed):
    rng = np.random.default_rng(seed)
    n = 25
    times = rng.choice([PERIOD * rng.integers(0, 5, n), rng.uniform(0, 0.5, n), np.zeros(n)])
    times = np.where(rng.random(n) < 0.3, np.inf, times)
    builder = DiagramBuilder()
    ramp, way = builder.AddSystem(Ramp()), builder.AddSystem(LateMeasurements(PERIOD, times, 2))
    builder.Connect(ramp.get_output_port(), way.get_input_port())
    simulator = Simulator(builder.Build())
    context = way.GetMyContextFromRoot(simulator.get_context())
    given = -1
    for k in range(n):
        if k:
            simulator.AdvanceTo(k * PERIOD * (1 - 2e-14))  # before the events of the sample
        there = [j for j in range(k + 1) if j * PERIOD + times[j] <= k * PERIOD + 1e-9]
        newest = max(there, default=-1)
        y = way.GetOutputPort("measurement").Eval(context)
        age = way.GetOutputPort("age").Eval(context)[0]
        if newest > given:
            assert y == pytest.approx(newest * PERIOD, abs=1e-12)
            assert age == pytest.approx((k - newest) * PERIOD, abs=1e-12)
            given = newest
        else:
            assert np.isnan(y).all() and age == 0


def test_a_sensor_that_is_late_is_borne_like_a_longer_delay():
    """Delays of 0.6 and 0.2 s leave no more error than 0.8 and 0 s: 0.03 % s."""
    late = run("delay.steps=6", "sensor.delay=0.2")
    assert late.status == "completed" and late.accumulated_error < 0.03
    assert late.summary["counts"]["measurements_missing"] == 2
    signals = late.signals
    samples = [int(np.argmin(np.abs(signals.time.values - 0.1 * k))) for k in range(100)]
    state = np.hstack([signals.pose.values, signals.rates.values])[samples]
    measured, estimate = signals.measurement.values[samples], signals.state_estimate.values[samples]
    assert np.abs(measured[2:] - state[:-2]).max() < 1e-12
    late_by = np.abs(measured - state)[5:].max()
    assert np.abs(estimate - state)[5:].max() < 1e-3 * late_by


def test_a_delay_of_the_sensor_that_is_no_whole_period_waits_for_the_sample():
    first = run("delay.steps=6", "sensor.delay=0.2", "duration=1").signals
    second = run("delay.steps=6", "sensor.delay=0.11", "duration=1").signals
    assert np.array_equal(first.pose.values, second.pose.values)


# The law.


@pytest.mark.parametrize(
    ("time", "delay"), [(0.8, ()), (0.25, ("delay.steps=2", "delay.fraction=0.5"))]
)
@pytest.mark.parametrize("torques", [1, 4])
@pytest.mark.parametrize("controller", ["predictor_lqi", "delay_lqi"])
def test_a_network_without_losses_is_a_wire(time, delay, torques, controller):
    """Every packet takes as long as the bound: nothing differs from a wire of that delay."""
    network = (
        *IDEAL,
        f"link.low={time}",
        f"link.high={time}",
        f"link.playout={time}",
        f"controller.packet_torques={torques}",
    )
    found, expected = (
        sd.simulate(
            scenario("duration=1", *more, controller=controller), judge_stability=False
        ).signals
        for more in (network, delay)
    )
    for name in ("pose", "torque_applied", "torque_commanded", "state_estimate"):
        assert np.abs(found[name].values - expected[name].values).max() <= 1e-9
    assert found.packets.values[-1].tolist()[:3] == [11, 0, 0]


def test_plans_say_what_the_law_will_say():
    """If everything arrives, successive plans agree up to what was learnt."""
    loop = build_closed_loop(scenario(*IDEAL, "link.playout=0.9", "duration=4"))
    simulator, controller = make_simulator(loop), loop.GetSubsystemByName("controller")
    plans = []
    for k in range(40):
        simulator.AdvanceTo(look_time(0.1 * k)) if k else simulator.Initialize()
        context = controller.GetMyContextFromRoot(simulator.get_context())
        plans.append(controller.memory(context).plan)
    for before, after in pairwise(plans[25:]):
        assert np.abs(before[1:] - after[:-1]).max() < 1e-3 * np.abs(after).max()


def test_the_law_knows_what_has_acted():
    """Over a bad network, with reports: what the filter takes to have acted has acted."""
    bad = (*NETWORK, "link.loss=0.1", "link.playout=0.8", "duration=4")
    loop = build_closed_loop(scenario(*bad, "controller.packet_torques=3"))
    simulator, controller = make_simulator(loop), loop.GetSubsystemByName("controller")
    law, applied, decided = controller._law, [], []
    steps = law.timeline.steps
    for k in range(40):
        if k:
            simulator.AdvanceTo(look_time(0.1 * k) - 0.05)
            applied.append(loop.GetOutputPort("torque_applied").Eval(simulator.get_context()))
            simulator.AdvanceTo(look_time(0.1 * k))
        else:
            simulator.Initialize()
        memory = controller.memory(controller.GetMyContextFromRoot(simulator.get_context()))
        acted = memory.in_flight[: -1 - steps]  # before T_k and the mu that are under way
        known = min(k, len(acted))
        assert np.array_equal(
            acted[len(acted) - known :], np.reshape(applied[k - known :], (-1, 6))
        )
        decided.append(memory.in_flight[-1])
    _, lost, late, _, _ = loop.GetOutputPort("packets").Eval(simulator.get_context())
    assert lost >= 2 and late >= 2
    # And not all of it had been decided so: plans stood in.
    assert not np.array_equal(applied[steps:], decided[: len(applied) - steps])


class Buffer:
    """Packets that were sent, as core/packets.h remembers them."""

    def __init__(self, channel, memory=None):
        self._it = packets_of(channel).pointer
        self._rows, self._memory = len(channel.in_time), memory
        if memory is None:
            self._memory = np.empty(core().lib.stewart_packets_memory(self._it))
            core().lib.stewart_packets_start(self._it, core().at(self._memory))

    @property
    def packets(self):
        return Sent(self._memory, self._rows).packets

    def of(self, channel):
        """Return the same packets over another channel."""
        return Buffer(channel, self._memory)

    def believed(self, flying, timeline, report):
        c, memory, flying = core(), self._memory.copy(), flying.copy()
        given = c.at(memory), report_of(report).pointer, timeline.steps, len(flying), c.at(flying)
        scratch = c.scratch(c.lib.stewart_packets_scratch(self._it))
        c.lib.stewart_packets_update(self._it, *given, scratch)
        return flying

    def send(self, plan, flying):
        c = core()
        given = c.at(self._memory), c.at(plan), len(flying), c.at(flying)
        c.lib.stewart_packets_send(self._it, *given)


def test_the_most_probable_content_is_believed():
    """One packet a period, r = 1, by hand: packet k has T_{k-1}, T_k and a plan for k + 1."""
    # mu = 3: the rows are due 0.2, 0.3 and 0.4 s after they are sent.
    channel = Packets(2, 1, in_time=(0.3, 0.6, 0.9), arrived_by=(0.0, 0.1, 0.3, 0.6, 0.9, 0.9))
    timeline = Timeline(PERIOD, Delay(3))
    sent, flying = Buffer(channel), np.zeros((6, 6))
    for k in range(5):
        flying = sent.believed(flying, timeline, None)
        plan = np.array([np.full(6, 10.0 + k), np.full(6, 20.0 + k)])  # T_k, and for T_{k+1}
        sent.send(plan, flying)
        flying = np.vstack([flying[1:], plan[:1]])
    assert sent.packets[-1, :, 0].tolist() == [13, 14, 24]
    # Without any report T_k comes with packet k or its repetition: 0.3 + 0.7 * 0.6 > 1/2.
    believed = sent.believed(flying, timeline, None)
    assert believed[-5:, 0].tolist() == [10, 11, 12, 13, 14]
    # Nothing has come. T_4: packet 4 is there in time with (0.6 - 0.1) / (1 - 0.1) > 1/2. T_3:
    # packet 4 with (0.3 - 0.1) / 0.9 = 0.22, else packet 3 with (0.6 - 0.3) / 0.7 = 0.43, which
    # make 0.56. T_2: no packet will be there; the buffer holds what acted last.
    nothing = Report(np.zeros(6, dtype=bool), np.full((3, 6), 7.0), 0)
    believed = sent.believed(flying, timeline, nothing)
    assert believed[-5:, 0].tolist() == [7, 7, 7, 13, 14]
    # A reported torque that is not finite is none: the assumed one stays.
    for odd in (np.nan, np.inf):
        acted = np.array([[7.0] * 6, [odd] + [7.0] * 5, [7.0] * 6])
        report = replace(nothing, acted=acted)
        believed = sent.believed(flying, timeline, report)
        assert believed[-5:, 0].tolist() == [10, 7, 7, 13, 14]
    # A slower network. T_3: packets 4 and 3 with 0.06 + 0.94 * 0.12 = 0.17, packet 2, which had a
    # plan for it, with 0.83 (0.9 - 0.25) / 0.75 = 0.72, more than twice as much. T_4: packet 4 with
    # 0.17, the plan of packet 3 with 0.83 (0.9 - 0.15) / 0.85 = 0.74.
    chances = (0.0, 0.1, 0.15, 0.25, 0.9, 0.9)
    slow = dataclasses.replace(channel, in_time=(0.15, 0.25, 0.9), arrived_by=chances)
    believed = sent.of(slow).believed(flying, timeline, nothing)
    assert believed[-5:, 0].tolist() == [7, 7, 7, 22, 23]
    # 0.33 and 0.56 are not enough to change one's mind.
    chances = (0.0, 0.1, 0.15, 0.4, 0.9, 0.9)
    slow = dataclasses.replace(channel, in_time=(0.15, 0.4, 0.9), arrived_by=chances)
    believed = sent.of(slow).believed(flying, timeline, nothing)
    assert believed[-5:, 0].tolist() == [7, 7, 7, 13, 14]
    # What a packet that has come says is certain.
    came = Report(np.array([False, True, False, False, False]), np.full((3, 6), 7.0), 0)
    believed = sent.believed(flying, timeline, came)
    assert believed[-5:, 0].tolist() == [7, 7, 12, 13, 14]


def test_packets_that_come_later_than_reports_tell_of_are_borne():
    """The state of a packet that was missing in the last report is unknown."""
    channel = Packets(1, 0, (0.5,), (0.0, 0.2, 0.4, 1.0, 1.0, 1.0), report_periods=2)
    sent = Buffer(channel)
    for k in range(6):
        sent.send(np.full((1, 6), 10.0 + k), np.zeros((6, 6)))
    none = np.zeros(6, dtype=bool)
    late = dataclasses.replace(channel, in_time=(1.0,))
    nothing, timeline = Report(none, np.empty((0, 6))), Timeline(PERIOD, Delay(4))
    # (1 - 0.4) / (1 - 0.4): it takes four periods, and is there by then.
    believed = sent.of(late).believed(np.zeros((6, 6)), timeline, nothing)
    assert believed[-4, 0] == 12
    # All were told of after four periods, by when every packet is there: this one is lost.
    longer = dataclasses.replace(late, report_periods=4)
    believed = sent.of(longer).believed(np.zeros((6, 6)), timeline, nothing)
    assert believed[-4, 0] == 0
    law = compose_law(prepare(scenario(*NETWORK)))
    assert isinstance(law.channel, Packets)
    assert law.channel.report_periods == law.extra_torques + 1
    slow = run(*NETWORK, "link.loss=0", "link.high=2.5", "link.playout=2.3", *LONG)
    assert slow.status == "completed"


def test_a_channel_refuses_chances_of_other_rows():
    with pytest.raises(ValueError, match="in_time: got 1 values; expected 3"):
        Packets(2, 1, in_time=(1.0,), arrived_by=(0.0,))
    assert isinstance(
        build_closed_loop(scenario()).GetSubsystemByName("controller")._law.channel, Wire
    )


def test_measurements_that_come_back_over_a_network_are_borne():
    back = "link.return={low: 0.0, high: 0.3, loss: 0.1}"
    result = run("link.kind=network", "link.loss=0.05", back, "link.low=0.3", "link.high=0.5")
    assert result.status == "completed"
    assert result.summary["counts"]["measurements_missing"] > 10
    assert result.accumulated_error < 5


def test_the_multibody_plant_is_held_over_a_network():
    settings = ("plant.kind=multibody", *NETWORK, "link.loss=0.05", "duration=3")
    result = sd.simulate(scenario(*settings), judge_stability=False)
    assert result.status == "completed" and result.accumulated_error < 1


def test_the_bound_is_a_whole_number_of_a_multibody_plants_steps():
    multibody = (*NETWORK, "plant.kind=multibody")
    assert scenario(*multibody, "link.playout=0.653").true_delay.fraction == pytest.approx(0.53)
    message = r"link\.playout: got 0\.6535; expected a whole number of plant\.time_step"
    with pytest.raises(ConfigError, match=message):
        scenario(*multibody, "link.playout=0.6535")
    with pytest.raises(ConfigError, match=r"link\.median: got null"):
        scenario("link.kind=network", "plant.kind=multibody", "link.distribution=lognormal")


def test_a_network_on_which_nothing_ever_comes_is_refused_at_once():
    for times in ("link.low=700", "link.high=900"), ("link.playout=101",):
        field, got = times[-1].split("=")
        with pytest.raises(ConfigError, match=f"{field}: got {got}, a delay of more than 1000 per"):
            scenario("link.kind=network", *times)
    slow = "link.return={distribution: lognormal, median: 1.0e6, sigma: 10}"
    with pytest.raises(ConfigError, match=r"link\.return: got measurements"):
        compose_law(prepare(scenario(*NETWORK, slow)))


def test_without_reports_the_law_goes_on_what_is_probable():
    """The same packets: it still tracks, and takes for acted what was not."""
    network = (*NETWORK, "link.loss=0.2", "link.seed=2", "duration=3")
    deaf = run(*network, "link.playout=0.9", "link.acknowledged=false")
    told = run(*network, "link.playout=0.9")
    assert deaf.status == "completed"
    assert np.array_equal(deaf.signals.packets.values, told.signals.packets.values)
    assert not np.array_equal(deaf.signals.pose.values, told.signals.pose.values)


def test_a_network_has_the_delay_of_bound_and_repetitions():
    sc = scenario(*NETWORK, "link.playout=0.65", "controller.packet_repeats=2")
    assert sc.true_delay.eta(0.1) == pytest.approx(0.85, abs=1e-12)
    assert sc.true_delay.steps == 8 and sc.true_delay.fraction == pytest.approx(0.5)
    usual = scenario(*NETWORK)
    assert isinstance(usual.link, NetworkConfig)
    assert usual.eta == pytest.approx(default_bound(usual.link, 1, 0.1) + 0.1)


# The study of the bound.


@pytest.fixture
def known_outcomes(monkeypatch):
    """Return runs whose outcome is known: best at 0.43 s, and nothing completes above 20 % lost.

    The list is of the runs that were asked for.
    """
    asked = []

    def outcome(run):
        asked.append(run)
        assert isinstance(run.link, NetworkConfig) and run.link.playout is not None
        if run.link.loss > 0.2:
            return Outcome("left_workspace", "left", time=1.0)
        return Outcome("completed", error=1 + abs(run.link.playout - 0.43) + 0.01 * run.link.seed)

    def runs(wanted, progress, **_):
        if progress is not None:
            progress(len(wanted), len(wanted))
        return {key: outcome(run) for key, run in wanted.items()}, False

    monkeypatch.setattr(link_study, "run_scenarios", runs)
    return asked


QUICK = ("link.kind=network", "link.low=0.2", "link.high=0.45")


def test_the_study_finds_the_best_bound_and_the_loss_that_is_borne(known_outcomes):
    """Half periods next to the best whole one are tried: 0.45 s is better than 0.4 s."""
    told = []
    study = study_link(scenario(*QUICK), LinkOptions(runs=3), lambda *counts: told.append(counts))
    bounds = [0.3, 0.35, 0.4, 0.45, 0.5, 0.6]
    assert [cell.bound for cell in study.bounds] == pytest.approx(bounds)
    late = [0.6, 0.4, 0.2, 0, 0, 0]
    assert [cell.late for cell in study.bounds] == pytest.approx(late, abs=1e-6)
    assert study.best is not None and study.best.bound == pytest.approx(0.45)
    assert study.best.expected == pytest.approx(1.03)
    assert study.survivable == 0.2 and study.left_out == ()
    assert [cell.runs for cell in study.losses] == [3] * len(link_study.LOSSES)
    assert told == [(12, 39), (18, 39), (39, 39)]
    page = html(document(study), Provenance("stewart-drake analyze link", {}))
    assert page.count("<svg") + page.count("image/svg") >= 1


def test_bounds_are_alike_where_the_seeds_do_not_tell_them_apart(known_outcomes):
    """The t-tests of SciPy are the project's own choice; what counts are the four outcomes."""
    study = study_link(scenario(*QUICK), LinkOptions(runs=1))
    common = np.array([1.0, 1.3, 0.8, 1.1])
    rows = {
        0.1: common,  # the best
        0.2: common + [0.05, 0.06, 0.05, 0.04],  # a little, but always worse
        0.3: common + [0.2, -0.1, 0.15, -0.1],  # worse in the mean, not always
        0.4: common + 0.001,  # always worse, by a thousandth
        0.5: common[:3] / 2,  # better, but a run was lost
    }
    cells = [Cell(b, 0.0, 0.0, 0.0, 4, tuple(errors)) for b, errors in rows.items()]
    study = replace(study, runs=4, bounds=cells)
    assert study.best is not None and study.best.bound == 0.1 and list(study.alike) == [0.3, 0.4]
    assert study.summary["alike_bounds"] == [0.3, 0.4]
    # Differences of 0.0375 +- 0.1601, t of three degrees of freedom, over a mean of 1.05.
    assert study.alike[0.3] == pytest.approx((0.0375 + 2.3534 * 0.1601 / 2) / 1.05, rel=1e-3)

    assert document(study).tone == "fair"
    assert document(replace(study, bounds=cells[:2])).tone == "good"
    new = cells[0]._replace(loss=study.scenario.link.loss, errors=(1.0, 1.3, 0.8, 5.0))
    rare = document(replace(study, bounds=cells[:2], losses=[new]))
    assert rare.tone == "fair" and "is worse" not in rare.verdict
    assert "the worst run 5.00 % s: too few runs for such rare errors; repeat" in rare.verdict
    many = [cells[0]._replace(runs=8, errors=(*common, *common)), cells[4]._replace(runs=8)]
    assert replace(study, bounds=many).unconfirmed_losses == []  # 3 of 8 against 8 of 8

    begun = [
        cells[0],
        cells[1]._replace(runs=2, errors=(1.2, 1.3)),
        cells[2]._replace(runs=0, errors=()),
    ]
    partial = replace(study, bounds=begun, losses=[], interrupted=True)
    assert partial.unconfirmed_losses == []  # nothing was lost, only not run
    assert document(partial).verdict.startswith(
        "Interrupted: not all simulations were run; with --out the same command goes on."
    )
    assert "is worse" not in document(partial).verdict


def test_a_bound_at_which_most_packets_are_late_is_not_recommended(known_outcomes):
    """Old plans, which a simulation computes without an error, replace the torques there."""
    study = study_link(scenario(*QUICK), LinkOptions(runs=2))
    late = [cell._replace(late=0.8, errors=(0.1, 0.1)) for cell in study.bounds[:1]]
    lost = [cell._replace(errors=()) for cell in study.bounds[1:]]
    for bounds, best, words in (
        ([*late, *study.bounds[1:]], 0.45, "at which at least half of the packets are in time"),
        ([*late, study.bounds[1]._replace(errors=(1.0,)), *lost[1:]], 0.35, "lost 1 of 2. A bound"),
        (
            [*late, *lost],
            None,
            "No bound works for this link. Up to 0.3 s most packets are late. From 0.35 s on "
            "torques act 0.45 s or more after their measurement, and no run completed.",
        ),
    ):
        other = replace(study, bounds=bounds)
        assert other.summary["best_bound"] == (best and pytest.approx(best))
        assert words in document(other).verdict
    assert document(other).tone == "bad"
    other = replace(study, bounds=[*late, *study.bounds[1:]])
    assert "Shorter bounds do not count: there the model" in document(other).verdict


def test_the_worst_run_has_an_interval_from_runs_that_chose_nothing(known_outcomes):
    study = study_link(scenario(*QUICK), LinkOptions(runs=3))
    chose, checked = (
        {run.link.seed for run in runs} for runs in (known_outcomes[:18], known_outcomes[18:])
    )
    assert (chose, checked) == ({0, 1, 2}, {3, 4, 5})
    assert {run.sensor.seed for run in known_outcomes[18:]} == {3, 4, 5}
    assert study.checked is not None and study.checked.errors == pytest.approx((1.05, 1.06, 1.07))
    # All of three completed: 0.05^(1/3).
    assert study.checked.no_worse == pytest.approx(0.05 ** (1 / 3))
    lost = study.losses[-1]
    assert lost.errors == () and lost.no_worse == 0
    assert study.summary["losses"][0]["no_worse"] == pytest.approx(0.05 ** (1 / 3))


def test_half_periods_that_a_plant_cannot_have_are_left_out(known_outcomes):
    coarse = ("plant.kind=multibody", "plant.time_step=0.02")
    study = study_link(scenario(*QUICK, *coarse), LinkOptions(runs=1))
    assert [cell.bound for cell in study.bounds] == pytest.approx([0.3, 0.4, 0.5, 0.6])
    assert study.left_out == pytest.approx((0.35, 0.45))
    assert "Not tried: 0.35 s and 0.45 s" in document(study).plain()


@pytest.mark.parametrize("completes", [1.0, 0.97, 0.8])
def test_statements_on_the_worst_run_are_wrong_in_five_percent_at_most(completes):
    """20,000 studies: errors are uniform, runs beyond `completes` are lost."""
    rng, studies = np.random.default_rng(4), 20_000
    for n in (5, 29):
        stated = np.array(
            [link_study.Cell(0.5, 0.1, 0.0, 0.0, n, (1.0,) * k).no_worse for k in range(n + 1)]
        )
        errors = rng.random((studies, n))
        completed = (errors < completes).sum(axis=1)
        truth = np.where(completed == n, errors.max(axis=1), completes)
        wrong = int((truth < stated[completed]).sum())
        assert wrong / studies < 0.05 + 3 * np.sqrt(0.05 * 0.95 / studies)
        if completes == 1.0:  # then it is exact
            assert wrong / studies > 0.045


def test_the_study_asks_for_a_network_before_it_imports_what_it_needs(monkeypatch, capsys):
    monkeypatch.setattr("stewart_drake.cli.analyze.analyze", None)
    assert main(["analyze", "link", "paper"]) == 2
    assert "got 'wire'; expected 'network', which has a play" in capsys.readouterr().err


def test_the_overlay_lays_fields_over_a_scenario():
    dirty = scenario("overlay=dirty", "sensor.seed=4")
    assert dirty.plant.payload_mass == pytest.approx(0.1 * 4.0)
    assert np.abs(dirty.plant.torque_bias).tolist() == [3e-4] * 6
    clean = scenario("sensor.seed=4")
    amplitude = np.array(clean.reference.amplitude)
    assert dirty.sensor.noise_std == pytest.approx(1e-3 * np.tile(amplitude, 2))
    for dusty, plain in ((dirty.plant, clean.plant), (dirty.sensor, clean.sensor)):
        changed = {
            name
            for name, value in dataclasses.asdict(plain).items()
            if dataclasses.asdict(dusty)[name] != value
        }
        assert changed <= {"payload_mass", "torque_bias", "noise_std"}
    with pytest.raises(ConfigError, match="overlay: got 'drity'; expected one of dirty"):
        scenario("overlay=drity")


def test_more_samples_than_a_datagram_holds_are_warned_of():
    encoders = ("sensor.kind=encoders", "link.kind=network")
    for samples, said in (
        (16, []),
        (17, ["sensor.samples is 17: live and machine take at most 16"]),
    ):
        sc = sd.load_scenario("gravity", settings=(*encoders, f"sensor.samples={samples}"))
        assert cautions_before(prepare(sc), None) == said
