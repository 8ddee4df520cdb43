"""The baselines with gravity compensation: PD, its gains, and LQR."""

import math
from dataclasses import replace

import numpy as np
import pytest

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.cost import pd_gains
from stewart_drake.law.coverage import uncovered_part
from stewart_drake.law.delay_model import chain, delayed_model, linear_model
from stewart_drake.law.stability import closed_loop, fastest_pole, spectral_radius
from stewart_drake.loop.law_design import compose_law, pd_gain
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.studies.compare import CONTROLLERS, GRAVITY, shown

HELD = ("reference.kind=hold", "plant.kind=exact", "queue=equilibrium", "duration=1")


@pytest.mark.parametrize("pole", [0.0, 1.0, 4.0, 11.0])
def test_the_gains_make_a_triple_pole(pole):
    """f, f' and f'' vanish there: f(s + d) = O(d^3), by samples on a circle (Cauchy)."""
    h = 0.1
    kp, kd = pd_gains(h, pole)
    s = (-2 + math.sqrt(2 + (pole * h) ** 2)) / h
    d = 0.5 * np.exp(2j * np.pi * np.arange(64) / 64)
    at = s + d
    f = (at**2 - pole**2) * np.exp(at * h) + kp + kd * at
    coefficients = np.fft.fft(f) / 64  # of d^0, d^1, ...
    assert abs(coefficients[:3]).max() < 1e-9 * abs(f).max()
    assert abs(coefficients[3]) > 0.1 * abs(f).max()


@pytest.mark.parametrize("turns", [0.0, 0.3, 0.9, 1.3, 1.6])
def test_no_other_gains_let_an_error_decay_faster(turns):
    """Against the poles of a finely sampled delay; stable up to p h = sqrt(2)."""
    h, steps = 0.1, 200
    pole = turns / h
    model = linear_model(np.array([[0, 1], [pole**2, 0]]), np.array([[0.0], [1.0]]))
    sampled = replace(delayed_model(model, h / steps, steps, integral=False), C=np.eye(2))

    def slowest(kp, kd):
        K = np.hstack([[[kp, kd]], np.zeros((1, sampled.queue_length))])
        return math.log(spectral_radius(closed_loop(sampled, K))) * steps / h

    assert chain(sampled).A.shape[0] == 2 + steps
    gains = np.array(pd_gains(h, pole))
    best = slowest(*gains)
    assert best == pytest.approx((-2 + math.sqrt(2 + turns**2)) / h, abs=0.2 / h)
    assert (best < 0) == (turns < math.sqrt(2))
    for direction in np.eye(2) if best < 0 else ():
        for share in (0.97, 1.03):
            assert slowest(*(gains * np.where(direction, share, 1.0))) > best


@pytest.mark.parametrize("fraction", [0.0, 0.4])
def test_each_coordinate_is_a_loop_of_its_own(fraction):
    settings = ("controller.kind=pd", "controller.kp=30", "controller.kd=8", "plant.gravity=true")
    law = compose_law(prepare(load_scenario("paper", None, settings)))
    timeline = replace(law.timeline, delay=replace(law.timeline.delay, fraction=fraction))
    A, B = law.plant.dynamics.linearize(law.plant.mechanism.home)
    still = linear_model(np.vstack([np.eye(12)[6:], np.zeros((6, 12))]), B)  # e'' = B T
    K = law.cost.gain(law.cost.sampled(still, timeline), np.ones(2))
    one = np.eye(6)
    assert B[RATES] @ K[:, :12] == pytest.approx(np.hstack([30 * one, 8 * one]), abs=1e-9)
    assert K.shape[1] == (18 if fraction else 12) and not K[:, 12:].any()
    exact = law.cost.gain(law.cost.sampled(linear_model(A, B), timeline), np.ones(2))
    assert exact == pytest.approx(K, rel=0.2, abs=0.05 * abs(K).max())  # gravity within a period


def gains_of(*settings, name="gravity"):
    experiment = prepare(load_scenario(name, "pd_gravity", settings))
    return experiment, pd_gain(experiment)


def test_null_gains_follow_the_uncompensated_delay_and_gravity():
    experiment, blind = gains_of()
    pole = fastest_pole(experiment.nominal.linearize(experiment.start[POSE])[0])
    assert pole > 1
    assert (blind.kp, blind.kd) == pd_gains(0.16 + 0.005, pole)
    _, aware = gains_of("controller.delay_steps=null")
    assert (aware.kp, aware.kd) == pd_gains(0.005, pole)
    _, light = gains_of("plant.gravity=false")
    assert (light.kp, light.kd) == pytest.approx(pd_gains(0.165, 0.0))


def test_one_gain_sets_the_other_for_critical_damping():
    assert gains_of("controller.kp=9")[1].kd == 6.0
    assert gains_of("controller.kd=6")[1].kp == 9.0
    both = gains_of("controller.kd=6", "controller.kp=2")[1]
    assert (both.kp, both.kd) == (2.0, 6.0)


@pytest.mark.parametrize("name", GRAVITY)
def test_a_baseline_holds_a_plate_that_falls_without_gravity_compensation(name):
    steps = "delay.steps=1" if name == "pd_gravity" else "delay.steps=0"
    settings = (*HELD, steps, f"sensor.noise_std={[1e-5] * 12}")
    held = simulate(load_scenario("gravity", name, settings), judge_stability=False)
    assert held.status == "completed" and np.abs(held.signals.error.values).max() < 1e-3
    blind = ("controller.feedforward=none",)
    dropped = simulate(load_scenario("gravity", name, settings + blind), judge_stability=False)
    assert np.abs(dropped.signals.error.values).max() > 5e-3


def test_pd_follows_across_the_delay_with_the_predictor():
    start = ("start=on_reference", "queue=reference", "plant.kind=exact", "duration=3")
    run = simulate(load_scenario("paper", None, (*start, "controller.kind=pd")))
    assert run.status == "completed" and run.accumulated_error < 0.1
    margin = run.summary["controller_margin"]
    assert margin["stable"] and margin["delay_margin_s"][0] > 0.005


def test_the_core_names_what_it_has_not():
    law = compose_law(prepare(load_scenario("paper", None, ("controller.kind=pd",))))
    assert uncovered_part(law) == "controller.kind"
    assert uncovered_part(compose_law(prepare(load_scenario("gravity", "lqr_gravity")))) is None


def test_compare_shows_the_baselines_where_gravity_acts():
    assert tuple(shown("gravity")) == (*CONTROLLERS, *GRAVITY)
    assert tuple(shown("paper")) == CONTROLLERS
    assert tuple(shown("paper", ("plant.gravity=true",))) == (*CONTROLLERS, *GRAVITY)
    rows = shown("gravity", ("compare={pd_gravity: {kp: 40.0}}",))
    assert rows["pd_gravity"].controller.kp == 40.0
    tuned = shown("gravity", ("tuner.kind=rule",))
    assert tuned["pd_gravity"].controller.kind == "pd"


def test_gains_without_pd_are_refused():
    for setting, other in (
        ("controller.kp=3", None),
        ("controller.w_R=3", "pd_gravity"),
        ("controller.integral_weight=3", "pd_gravity"),
        ("controller.kd=-1", "pd_gravity"),
    ):
        with pytest.raises(ConfigError, match=r"^settings: controller\.\w+: got"):
            load_scenario("gravity", other, (setting,))
