"""Table of claims: the figures under noise, bias, loss, jitter or a wrong delay in the documents.

`python benchmarks/claims.py [ROW or SECTION ...]` runs rows and writes two files in
benchmarks/results: claims.json with the value of every seed, and claims.md. Without names it runs
all rows. `--missing` leaves out rows that the file has with the same settings. `--command ROW`
prints the command of the row's first run.
"""

import argparse
import json
import math
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _bench import size, table, write
from joblib import Parallel, delayed
from true_machine import calibrated

import stewart_drake as sd
from stewart_drake.files.fileio import replacing
from stewart_drake.files.jsonio import jsonable
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_compatible
from stewart_drake.studies.robustness import study_robustness
from stewart_drake.studies.statistics import SIGNIFICANT
from stewart_drake.studies.study_options import RobustnessOptions

SEEDS = range(7300, 7320)
"""Seeds of no other benchmark, test or setting of the law."""
STUDY_RUNS = 150
DATA = Path(__file__).parent / "results" / "claims.json"
AMPLITUDE = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
"""Of the reference, rad and m."""
BIAS = 3e-4
"""Torque bias of each motor, N m; its sign is drawn."""
OFFSET = float(np.deg2rad(0.1))
"""Of each encoder, rad; its sign is drawn."""

ON = ("start=on_reference", "queue=reference")
NONE = "controller.estimate=[]"
COULOMB = "controller.estimate=[torque_bias,payload,damping,coulomb]"
POSITION = "controller.estimate=[torque_bias,payload,payload_position,damping]"
WRENCH = "controller.estimate=[torque_bias,payload,damping,wrench]"
PAYLOAD = "plant.payload_mass=0.4"
THREE = (PAYLOAD, "plant.joint_damping=1e-3")
HALF = f"reference.amplitude={(0.5 * AMPLITUDE).tolist()}"
NETWORK = (*ON, "link.kind=network", "link.low=0.5", "link.high=0.9", "link.playout=0.9")
ENCODERS = "sensor.kind=encoders"
OFTEN = "sensor.samples=100"
NARROW = "controller.prior={torque_bias: 0.003, payload: 0.5, damping: 0.003}"
IDENTIFIED = "controller.prior={torque_bias: 0.00006, payload: 0.01, damping: 0.00006}"


class Row(NamedTuple):
    """One claim."""

    name: str
    words: str
    """Condition."""
    settings: tuple[str, ...]
    drawn: str = ""
    """What the seed draws, separated by spaces; see `of_seed`. Nothing: one run."""
    controller: str = "predictor_lqi"
    scenario: str = "paper"
    known: bool = False
    """Whether the controller reads the plant's true numbers from a file."""


def noise(share: float) -> str:
    """Return the setting of noise: a share of the amplitudes, per second for the rates."""
    return f"sensor.noise_std={[float(f'{share * a:.10g}') for a in np.tile(AMPLITUDE, 2)]}"


def pushed(force: float, turn: float = 0.0, begin: float = 4.0, end: str = "null") -> str:
    """Return the setting of a horizontal force in N, turned from x by an angle in rad."""
    x, y = (float(f"{force * part:.10g}") for part in (np.cos(turn), np.sin(turn)))
    return f"plant.push={{wrench: [0, 0, 0, {x}, {y}, 0], from: {begin:g}, to: {end}}}"


def of_seed(drawn: str, seed: int) -> list[str]:
    """Return the settings that a seed draws."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 6)
    settings = {
        "bias": (f"plant.torque_bias={(BIAS * signs).tolist()}",),
        "noise": (noise(1e-3), f"sensor.seed={seed}"),
        "half_noise": (noise(5e-4), f"sensor.seed={seed}"),
        "codes": (f"sensor.seed={seed}",),
        "offsets": (f"sensor.offset={(OFFSET * signs).tolist()}",),
        "losses": (f"sensor.seed={seed}",),
        "packets": (f"link.seed={seed}",),
        "jitter": (f"delay.seed={seed}",),
        "direction": (pushed(0.01, 2 * np.pi * np.random.default_rng(seed).uniform()),),
    }
    return [setting for name in drawn.split() for setting in settings[name]]


def scenario_of(row: Row, seed: int, folder: str) -> Scenario:
    """Return the scenario of one run."""
    plant = (*row.settings, *of_seed(row.drawn, seed))
    known = calibrated(plant, folder) if row.known else ()
    settings = ("plant.kind=exact", *plant, *known)
    return load_compatible(row.scenario, row.controller, settings)


def run(row: Row, seed: int) -> tuple[float | None, float | None]:
    """Return E_ac in % s, or None and the instant at which the plate was lost, s."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = scenario_of(row, seed, folder)
        ending = run_in_bulk(scenario)
    stopped = ending.stopped
    return (None, stopped.time) if stopped else (ending.figures.accumulated_error, None)


# ------------------------------------------------------------------ the rows


def both(row: Row) -> list[Row]:
    """Return a row and the same without the parameter estimator."""
    without = row._replace(name=f"{row.name}-none", words=f"{row.words}; no estimator")
    return [row, without._replace(settings=(*row.settings, NONE))]


def late(ms: float) -> tuple[str, ...]:
    """Return a true delay that differs by some ms from the 0.8 s that the controller believes."""
    steps, fraction = divmod(round(8 + ms / 100, 9), 1)
    return (
        *(f"delay.steps={int(steps)}", f"delay.fraction={fraction:.9g}"),
        *("controller.delay_steps=8", "controller.delay_fraction=0"),
    )


def believed(eta: float) -> tuple[str, ...]:
    """Return the belief in a delay, s, of the paper's scenario."""
    return (f"controller.delay_steps={round(eta / 0.1)}",)


def paper() -> list[Row]:
    """Runs without anything unknown."""
    rest, on = Row("rest", "from rest", ()), Row("on", "on the reference", ON)
    limit = Row("rest-limit", "from rest, torque limit 1.8 N m", ("actuator.torque_limit=1.8",))
    engine = ("plant.kind=multibody",)
    return [
        *both(rest),
        *both(on),
        *both(limit),
        Row("rest-slow", "from rest, catch-up 1.0 s", ("controller.catch_up=1.0",)),
        *both(Row("gravity", "full gravity, 0.16 s", (), scenario="gravity")),
        Row("rest-multibody", "from rest, multibody plant", engine),
        Row("on-multibody", "on the reference, multibody plant", (*ON, *engine)),
    ]


def unknown() -> list[Row]:
    """Started on the reference, with and without the estimator."""
    bias = f"bias {BIAS:g} N m"
    small, large = ("plant.joint_damping=3e-4",), ("plant.joint_damping=1e-3",)
    rows = [
        Row("noise", "noise 0.1 %", ON, "noise"),
        Row("bias", bias, ON, "bias"),
        Row("bias-noise", f"{bias}, noise 0.1 %", ON, "noise bias"),
        Row("payload", "payload 0.4 kg", (*ON, PAYLOAD)),
        Row("damping", "damping 1e-3 N m s/rad", (*ON, *large)),
        Row("all", "bias, payload, damping 3e-4", (*ON, PAYLOAD, *small), "bias"),
        Row("all-noise", "the same, noise", (*ON, PAYLOAD, *small), "noise bias"),
        Row("three", "bias, payload, damping 1e-3", (*ON, PAYLOAD, *large), "bias"),
        Row("three-noise", "the same, noise", (*ON, PAYLOAD, *large), "noise bias"),
        Row("dirty", "noise, bias, payload", (*ON, PAYLOAD), "noise bias"),
        Row("dirty-overlay", "overlay `dirty` (alternating bias)", (*ON, "overlay=dirty"), "codes"),
    ]
    integral = Row("bias-no-integral", f"{bias}; no estimator, no integral", ON, "bias")
    integral = integral._replace(settings=(*ON, NONE, "controller.integral=false"))
    shares = [
        Row(f"noise-{100 * share:g}", f"noise {100 * share:g} %", (*ON, noise(share)), "codes")
        for share in (1e-4, 3e-4, 3e-3, 1e-2)
    ]
    return [one for row in (*rows, *shares) for one in both(row)] + [integral]


def friction() -> list[Row]:
    """Coulomb friction and a payload off the centre, also estimated (`-found`)."""
    rows = []
    plants: dict[str, tuple[str, tuple[str, ...]]] = {
        "smooth": ("no friction", ()),
        "coulomb-1e-4": ("Coulomb friction 1e-4 N m", ("plant.coulomb_friction=1e-4",)),
        "coulomb-3e-4": ("Coulomb friction 3e-4 N m", ("plant.coulomb_friction=3e-4",)),
        "coulomb-1e-3": ("Coulomb friction 1e-3 N m", ("plant.coulomb_friction=1e-3",)),
        "aside": (
            "payload 0.4 kg at 30, -20, 50 mm",
            (PAYLOAD, "plant.payload_position=[0.03,-0.02,0.05]"),
        ),
    }
    for name, (words, plant) in plants.items():
        for drawn in ("", "noise"):
            row = Row(f"{name}-{drawn}".strip("-"), words, (*ON, *plant), drawn)
            row = row._replace(words=f"{words}, noise" if drawn else words)
            look = (*row.settings, POSITION if name == "aside" else COULOMB)
            rows += [
                row,
                row._replace(name=f"{row.name}-found", settings=look),
                row._replace(name=f"{row.name}-known", words=f"{row.words}; known", known=True),
            ]
    dirty = Row("dirty-position", "noise, bias, payload at the centre; position estimated", ON)
    dirty = dirty._replace(settings=(*ON, PAYLOAD, POSITION), drawn="noise bias")
    bare = dirty._replace(name="smooth-noise-position", words="noise; position estimated")
    rows += [bare._replace(settings=(*ON, POSITION), drawn="noise"), dirty]
    aside = (PAYLOAD, "plant.payload_position=[0.03,-0.02,0.05]", POSITION)
    words = "payload 0.4 kg at 30, -20, 50 mm, noise, bias"
    more = {
        "adaptive": ("delay estimated", ON, "adaptive_lqi"),
        "codes": ("14 bit encoders, 1 kHz", (*ON, ENCODERS, "sensor.bits=14", OFTEN), None),
        "rest": ("from rest", (), None),
        "rest-slow": ("from rest, catch-up 1.0 s", ("controller.catch_up=1.0",), None),
    }
    for name, (also, settings, controller) in more.items():
        row = Row(f"aside-{name}-found", f"{words}; {also}", (*settings, *aside), "noise bias")
        row = row._replace(drawn="codes bias") if name == "codes" else row
        rows.append(row._replace(controller=controller) if controller else row)
    return rows


def rest() -> list[Row]:
    """Started from rest."""
    slow, early = "controller.catch_up=1.0", "controller.open_loop_start=false"
    what = "from rest, noise, bias, payload"
    dirty = Row("rest-dirty", what, (PAYLOAD,), "noise bias")
    alike = Row("rest-overlay", "from rest, overlay `dirty`", ("overlay=dirty",), "codes")
    return [
        Row("rest-noise", "from rest, noise 0.1 %", (), "noise"),
        Row("rest-bias", f"from rest, bias {BIAS:g} N m", (), "bias"),
        Row("rest-payload", "from rest, payload 0.4 kg", (PAYLOAD,)),
        Row("rest-payload-slow", "the same, catch-up 1.0 s", (PAYLOAD, slow)),
        Row("rest-three", "from rest, bias, payload, damping 1e-3", (PAYLOAD,), "bias")._replace(
            settings=(PAYLOAD, "plant.joint_damping=1e-3")
        ),
        dirty,
        dirty._replace(name="rest-dirty-0.6", settings=(PAYLOAD, "controller.catch_up=0.6")),
        dirty._replace(name="rest-dirty-0.8", settings=(PAYLOAD, "controller.catch_up=0.8")),
        dirty._replace(name="rest-dirty-slow", settings=(PAYLOAD, slow)),
        dirty._replace(name="rest-dirty-early", settings=(PAYLOAD, slow, early)),
        dirty._replace(name="rest-dirty-adaptive", controller="adaptive_lqi"),
        dirty._replace(
            name="rest-dirty-adaptive-slow",
            words=f"{what}; delay believed 0.6 s",
            settings=(PAYLOAD, slow, *believed(0.6)),
            controller="adaptive_lqi",
        ),
        alike,
        alike._replace(name="rest-overlay-slow", settings=("overlay=dirty", slow)),
        alike._replace(name="rest-overlay-early", settings=("overlay=dirty", slow, early)),
        alike._replace(name="rest-overlay-adaptive", controller="adaptive_lqi"),
        alike._replace(
            name="rest-overlay-adaptive-slow",
            words=f"{alike.words}; delay believed 0.6 s",
            settings=("overlay=dirty", slow, *believed(0.6)),
            controller="adaptive_lqi",
        ),
    ]


def wrong_delay() -> list[Row]:
    """A delay that is taken for known, and is another."""
    rows = []
    for ms in (1, -1, 2, -2, 3, -3, 5, -5, 10, -10):
        words = f"{abs(ms)} ms {'longer' if ms > 0 else 'shorter'} than believed"
        wrong = Row(f"late{ms:+d}", words, (*ON, *late(ms)))
        rows += both(wrong)
        if abs(ms) <= 3:
            minute = (*wrong.settings, "duration=60")
            rows.append(wrong._replace(name=f"{wrong.name}-minute", settings=minute))
            rows.append(wrong._replace(name=f"{wrong.name}-noise", drawn="noise"))
    for ms in (20, -20):
        slow = (*ON, *late(ms), NONE, "controller.w_R=1000")
        words = f"{ms:+d} ms, no estimator, w_R 1000"
        rows.append(Row(f"late{ms:+d}-slow", words, slow))
    for eta in (0.6, 0.7, 0.9, 1.0):
        rows.append(Row(f"told-{eta}", f"believed {eta} s", (*ON, *believed(eta))))
    return rows


def weights() -> list[Row]:
    """Against the tolerance of Bryson's rule; 0.03 is the default."""
    rows = []
    for tolerance in (1.0, 0.1, 0.03, 0.01):
        on = (*ON, f"controller.w_R={(tolerance / 0.03) ** 2:.6g}")
        cases: dict[str, tuple[str, tuple[str, ...], str]] = {
            "clean": ("", (), ""),
            "bias": (", bias", (), "bias"),
            "noise": (", noise 0.1 %", (), "noise"),
            "late+5": (", 5 ms longer than believed", late(5), ""),
            "late-5": (", 5 ms shorter", late(-5), ""),
            "late+10": (", 10 ms longer", late(10), ""),
            "late-10": (", 10 ms shorter", late(-10), ""),
        }
        for name, (words, settings, drawn) in cases.items():
            at = Row(f"weights-{name}", f"tolerance {tolerance:g}{words}", (*on, *settings), drawn)
            rows += [one._replace(name=f"{one.name}-{tolerance:g}") for one in both(at)]
    return rows


def delay() -> list[Row]:
    """Delays that are found."""
    rows, drifting = [], "controller.delay_estimator=drifting"
    for eta in (0.8, 0.5, 1.1):
        found = Row(f"found-{eta}", f"believed {eta} s", (*ON, *believed(eta)))
        rows += [found, found._replace(name=f"found-{eta}-dirty", drawn="noise bias")]
        rows[-1] = rows[-1]._replace(
            words=f"{found.words}, dirty", settings=(*found.settings, PAYLOAD)
        )
    for eta in (0.8, 0.6, 1.0):
        rows.append(Row(f"rest-found-{eta}", f"from rest, believed {eta} s", believed(eta)))
    changing: dict[str, tuple[str, tuple[str, ...]]] = {
        "drift": ("0.8 to 0.9 s in 10 s", (drifting, "delay.drift=0.01")),
        "swing": ("swing of 20 ms at 1 rad/s", (drifting, "delay.swing=0.02")),
        **{
            f"jump{jump:+g}": (
                f"jump of {jump:+g} s at 4 s",
                (f"delay.jump={jump}", "delay.jump_time=4"),
            )
            for jump in (0.1, -0.1, 0.05, 0.3)
        },
    }
    for name, (words, settings) in changing.items():
        row = Row(name, words, (*ON, *settings))
        rows.append(row)
        if name in ("drift", "jump+0.1", "jump-0.1"):
            dirty = row._replace(name=f"{name}-dirty", words=f"{words}, dirty", drawn="noise bias")
            rows.append(dirty._replace(settings=(*row.settings, PAYLOAD)))
    rows = [row._replace(controller="adaptive_lqi") for row in rows]
    for ms in (1, 3, 10):
        words, settings = f"jitter {ms} ms", (*ON, f"delay.jitter_std={ms / 1e3}")
        jitter = Row(f"jitter-{ms}", f"{words}; mean delay known", settings, "jitter")
        rows += both(jitter)
        estimated = jitter._replace(name=f"jitter-{ms}-found", words=f"{words}; delay estimated")
        rows.append(estimated._replace(controller="adaptive_lqi"))
    part = ("delay.fraction=0.37", "controller.delay_steps=8", "controller.delay_fraction=0.37")
    rows.append(Row("found-0.837", "0.837 s, believed so", (*ON, *part), "", "adaptive_lqi"))
    return rows


def measurements() -> list[Row]:
    """Measurements that are lost."""
    half = (*ON, "sensor.loss=0.5")
    dirty = Row("half-dirty", "half of the measurements lost, dirty", (*half, PAYLOAD))
    return [
        Row("half", "half of the measurements lost", half, "losses"),
        dirty._replace(drawn="noise bias"),
    ]


def timed(row: Row) -> Row:
    """Return a row whose law is told that torques act at exact times."""
    settings = (*row.settings, "controller.timing_std=1e-6")
    return row._replace(
        name=f"{row.name}-timed", words=f"{row.words}, exact timing told", settings=settings
    )


def gravity() -> list[Row]:
    """Full gravity across the delay, 6 s, noise 0.1 %."""
    rows, short = [], "duration=6"
    for eta in (0.10, 0.12, 0.14, 0.16, 0.20):
        settings = (short, f"delay.steps={round(100 * eta)}")
        words = f"full amplitude, {eta:.2f} s, noise"
        row = Row(f"gravity-{eta:.2f}-noise", words, settings, "noise", scenario="gravity")
        rows += [row, timed(row)]
    for eta in (0.30, 0.60):
        settings = (short, f"delay.steps={round(100 * eta)}", HALF)
        words = f"half the amplitude, {eta:.2f} s, noise"
        row = Row(f"gravity-half-{eta:.2f}-noise", words, settings, "half_noise")
        row = row._replace(scenario="gravity")
        rows += [row, timed(row)]
    return rows


def push() -> list[Row]:
    """Unknown forces on the plate, without and with `wrench` among the estimated parameters."""
    adaptive, rows = {"controller": "adaptive_lqi"}, []
    for force in (0.01, 0.05, 0.1, 1.0):
        words, name = f"{force:g} N along x from 4 s on", f"push-{force:g}"
        on = Row(name, words, (*ON, pushed(force)))
        found = on._replace(name=f"{name}-wrench", settings=(*on.settings, WRENCH))
        rows += [on, on._replace(name=f"{name}-adaptive", **adaptive)]
        rows += [found, found._replace(name=f"{name}-wrench-adaptive", **adaptive)]
        noisy = [one._replace(name=f"{one.name}-noise", drawn="noise") for one in rows[-2:]]
        rows += [one._replace(words=f"{words}, noise") for one in noisy]
    none = Row("push-none-wrench", "no force", (*ON, WRENCH))
    noisy = none._replace(name="push-none-wrench-noise", words="no force, noise", drawn="noise")
    turned = Row("push-turned", "0.01 N in a drawn horizontal direction, noise", ON)
    half = "half the motion, 0.05 N along x from 4 s on"
    many = [
        Row("push-half", half, (*ON, HALF, pushed(0.05))),
        Row("push-kick", "5 N along x for 0.1 s at 3 s", (*ON, pushed(5.0, 0.0, 3.0, "3.1"))),
        turned._replace(drawn="noise direction"),
        Row("push-start", "0.05 N along x from the start on", (*ON, pushed(0.05, begin=0.0))),
    ]
    same = [
        one._replace(name=f"{one.name}-wrench", settings=(*one.settings, WRENCH)) for one in many
    ]
    told = (*same[-1].settings, "controller.prior={wrench: [0.005, 0.05]}")
    return [
        *(*rows, none, noisy, noisy._replace(name="push-none-wrench-adaptive-noise", **adaptive)),
        *(*many, *same, same[-1]._replace(name="push-start-prior", settings=told)),
    ]


def encoders() -> list[Row]:
    """Motor encoders in the place of the measured state."""
    rows, fourteen = [], "sensor.bits=14"

    def add(name: str, words: str, *settings: str, drawn: str = "codes", **other: Any) -> None:
        rows.append(Row(name, words, (*settings, ENCODERS), drawn, **other))

    for end, often, samples in (("", "one sample", ()), ("-1k", "1 kHz", (OFTEN,))):
        exact = f"exact, {often}"
        add(f"codes-exact{end}", exact, *ON, "sensor.bits=null", *samples, drawn="")
        for bits in (20, 17, 14, 12):
            code = (f"sensor.bits={bits}", *samples)
            add(f"codes-{bits}{end}", f"{bits} bit, {often}", *ON, *code)
            if bits < 17:
                add(f"rest-codes-{bits}{end}", f"from rest, {bits} bit, {often}", *code)
    for name, prior in (("narrow", NARROW), ("identified", IDENTIFIED)):
        for bits, samples in ((17, ()), (14, ()), (14, (OFTEN,)), (12, (OFTEN,))):
            end, often = ("-1k", "1 kHz") if samples else ("", "one sample")
            words = f"priors {name}, {bits} bit, {often}"
            code = f"sensor.bits={bits}"
            add(f"{name}-{bits}{end}", words, *ON, *samples, code, prior)
    for name, words, prior in (("three", "", ()), ("three-narrow", ", narrow priors", (NARROW,))):
        for bits in (14, 12):
            settings = (*ON, OFTEN, f"sensor.bits={bits}", *THREE, *prior)
            what = f"bias, payload, damping 1e-3, {bits} bit, 1 kHz{words}"
            add(f"{name}-codes-{bits}-1k", what, *settings, drawn="codes bias")
    for bits in (20, 17, 14):
        for end, often, samples in (("", "one sample", 1), ("-1k", "1 kHz", 10)):
            code = (f"sensor.bits={bits}", f"sensor.samples={samples}")
            words = f"`gravity`, 10 s, {bits} bit, {often}"
            add(f"gravity-codes-{bits}{end}", words, *code, scenario="gravity")
    estimate = "controller.estimate=[torque_bias,payload,damping"
    for name, words, also in (("off", "not looked for", ""), ("found", "estimated", ",offsets")):
        add(
            f"offsets-{name}",
            f"offsets of 0.1 degree, {words}, narrow priors, 14 bit, 1 kHz",
            *(*ON, OFTEN, fourteen, NARROW, f"{estimate}{also}]"),
            drawn="codes offsets",
        )
    faults = {
        "nan": ("5 % NaN", "{kind: missing, share: 0.05, from: 0, to: 100}"),
        "silent-leg": ("a leg silent for 1 s", "{kind: missing, leg: 2, from: 4, to: 5}"),
        "frozen-leg": ("a leg frozen for 0.4 s", "{kind: frozen, leg: 3, from: 4, to: 4.4}"),
        "silent": ("all silent for 0.5 s", "{kind: missing, from: 4, to: 4.5}"),
        "spikes": ("1 % spikes", "{kind: spike, share: 0.01, from: 0, to: 100}"),
    }
    for name, (words, fault) in faults.items():
        for end, often, samples in (("", "one sample", ()), ("-1k", "1 kHz", (OFTEN,))):
            if samples or name == "nan":
                settings = (*ON, fourteen, *samples, f"sensor.faults=[{fault}]")
                add(f"faults-{name}{end}", f"{words}, 14 bit, {often}", *settings)
    wrong = ("controller.delay_estimator=constant", *believed(0.7), OFTEN, fourteen)
    add("codes-found", "delay believed 0.7 s and found, 14 bit, 1 kHz", *ON, *wrong)
    add("rest-codes-found", "from rest, believed 0.7 s and found, 14 bit, 1 kHz", *wrong)
    return rows


def servos() -> list[Row]:
    """Position servos, bias, payload and damping 3e-4 unknown."""
    rows = []
    for fall, load in (("", ()), ("gravity-", ("plant.gravity=true",))):
        settings = (*ON, PAYLOAD, "plant.joint_damping=3e-4", "actuator.kind=servo", *load)
        for controller, hz, known in (
            *(("servo_preview", hz, False) for hz in ((10,) if load else (10, 2, 5, 20))),
            ("servo_feedforward", 10, False),
            ("servo_feedforward", 10, True),
        ):
            name = controller.replace("_", "-") + (f"-{hz}" if hz != 10 else "")
            words = f"servos of {hz} Hz{', full gravity' if load else ''}"
            bandwidth = (f"actuator.bandwidth={hz}",) if hz != 10 else ()
            row = Row(f"{fall}{name}", words, (*settings, *bandwidth), "bias", controller)
            rows.append(both(row)[1] if known else row)
        for law in ("predictor_lqi", "adaptive_lqi"):
            motors = tuple(one for one in settings if "servo" not in one)
            name = f"{fall}{law.replace('_lqi', '')}-all"
            words = f"law across the delay{', full gravity' if load else ''}"
            if load or law != "predictor_lqi":  # without gravity, the row `all`
                rows.append(Row(name, words, motors, "bias", law))
    return rows


def network() -> list[Row]:
    """Packets under way for 0.5 to 0.9 s, played out after 0.9 s, one repeat, the delay known."""
    rows = []

    def add(name: str, words: str, *settings: str, dirty: bool = False) -> None:
        more = (PAYLOAD,) if dirty else ()
        drawn = "packets noise bias" if dirty else "packets"
        rows.append(Row(name, words, (*NETWORK, *settings, *more), drawn))

    for share in (5, 20):
        lost = f"link.loss={share / 100}"
        add(f"lost-{share}", f"{share} % lost", lost)
        add(f"lost-{share}-dirty", f"{share} % lost, dirty", lost, dirty=True)
        single = ("controller.packet_torques=1", "controller.packet_repeats=0")
        for dry in ("hold", "zero"):
            words = f"{share} % lost, no plans, no repeats, `link.dry: {dry}`"
            add(f"lost-{share}-single-{dry}", words, lost, *single, f"link.dry={dry}")
    add("lost-5-no-plans", "5 % lost, no plans", "link.loss=0.05", "controller.packet_torques=1")
    add("lost-5-bound-0", "5 % lost, play-out bound 0", "link.loss=0.05", "link.playout=0")
    bursts = ("link.loss=0.08", "link.burst=12")
    for torques in (8, 16):
        words = f"8 % lost in bursts of 12, plans of {torques} torques"
        add(f"bursts-{torques}", words, *bursts, f"controller.packet_torques={torques}")
    rest = Row("lost-5-rest-dirty", "from rest, 5 % lost, dirty, catch-up 1.0 s", NETWORK[2:])
    rest = rest._replace(
        settings=(*rest.settings, "link.loss=0.05", "controller.catch_up=1.0", PAYLOAD)
    )
    scattered = (*ON, "delay.steps=7", f"delay.jitter_std={0.4 / 12**0.5:.6f}")
    return [
        *rows,
        rest._replace(drawn="packets noise bias"),
        Row("no-buffer", "none lost, no buffer", scattered, "jitter"),
    ]


SECTIONS = {
    "paper": paper,
    "unknown": unknown,
    "rest": rest,
    "wrong_delay": wrong_delay,
    "weights": weights,
    "friction": friction,
    "gravity": gravity,
    "delay": delay,
    "measurements": measurements,
    "push": push,
    "servos": servos,
    "encoders": encoders,
    "network": network,
}
STUDIES = {
    "robust-on": ("on the reference", ON),
    "robust-rest": ("from rest", ()),
    "robust-rest-slow": ("from rest, catch-up 1.0 s", ("controller.catch_up=1.0",)),
}
"""Studies as `analyze robustness` makes them, with its default ranges."""


# ------------------------------------------------------------------ running and writing


def study(name: str, workers: int) -> dict[str, Any]:
    """Return the outcome of one of STUDIES."""
    scenario = sd.load_scenario("paper", settings=("plant.kind=exact", *STUDIES[name][1]))
    with tempfile.TemporaryDirectory() as folder:
        found = study_robustness(
            scenario, folder, RobustnessOptions(runs=STUDY_RUNS, seed=SEEDS[0], workers=workers)
        )
    separations = found.explanation.singles
    return jsonable(
        {
            "completed": found.success._asdict(),
            "median": found.quantile(0.5)._asdict(),
            "auc": {one.factor: {**one.auc._asdict(), "p": one.p} for one in separations},
            "E_ac": found.errors,
        }
    )


def described(row: Row) -> str:
    """Return what makes a row, for its reader and to see whether it has changed."""
    words = row.drawn.replace(" ", ", ").replace("half_noise", "half the noise")
    parts = [f"{words} drawn"] if row.drawn else []
    if row.controller != "predictor_lqi":
        parts.append(f"`--controller {row.controller}`")
    if row.scenario != "paper":
        parts.append(f"`{row.scenario}`")
    settings = [f"`{one}`" for one in row.settings if one not in ON]
    on = ["on the reference"] if ON[0] in row.settings else []
    known = ["true numbers in `controller.calibration`"] if row.known else []
    return ", ".join([*on, *parts, *settings, *known])


def numbers(found: dict[str, Any]) -> list[str]:
    """Return runs, median, mean, standard deviation, worst and lost."""
    errors = [math.inf if e is None else e for e in found["E_ac"]]
    done, median = [e for e in errors if math.isfinite(e)], float(np.median(errors))
    lost = len(errors) - len(done)
    figures = [
        f"{median:.3g}" if math.isfinite(median) else "lost",
        f"{np.mean(done):.3g}" if done else "-",
        f"{np.std(done, ddof=1):.2g}" if len(done) > 1 else "-",
        f"{max(done):.3g}" if done else "-",
    ]
    first = f", from {min(found['lost_at']):.2f} s on" if lost else ""
    return [str(len(errors)), *figures, f"{lost}{first}"]


def interval(found: dict[str, float | None], scale: float = 1.0) -> str:
    """Return an estimate and its 95 % interval; null in the file is an infinite E_ac."""
    ends = [found[end] for end in ("value", "low", "high")]
    value, low, high = ("lost" if x is None else f"{scale * x:.3g}" for x in ends)
    return f"{value} ({low} to {high})"


HOW_TO_READ = (
    f"E_ac in % s. A row with something drawn has {len(SEEDS)} runs, seeds {SEEDS[0]} to "
    f"{SEEDS[-1]}, on which nothing was tuned; a row without has one run. Noise is 0.1 % of the "
    f"amplitudes (per second for the rates). A bias is {BIAS:g} N m at each motor, with a drawn "
    "sign. A lost run counts as infinite in the median; mean, standard deviation and worst are "
    "those of the completed runs. Controller `predictor_lqi`, scenario `paper` and the exact plant "
    "unless the settings say otherwise. `python benchmarks/claims.py --command ROW` prints the "
    "command of a row's first run; the file *claims.json* has every run's E_ac.\n"
)


def page(data: dict[str, Any]) -> list[str]:
    """Return the parts of claims.md."""
    head = ["row", "condition", "runs", "median", "mean", "standard deviation", "worst", "lost"]
    parts = [HOW_TO_READ]
    for section, make in SECTIONS.items():
        lines = [
            [f"`{row.name}`", row.words, *numbers(data["rows"][row.name]), described(row)]
            for row in make()
            if row.name in data["rows"]
        ]
        title = section.replace("_", " ").capitalize()
        parts.append(f"## {title}\n\n{make.__doc__}\n\n{table([*head, 'settings'], lines)}")
    shares, causes = [], []
    for name, found in data["studies"].items():
        runs, completed = str(len(found["E_ac"])), interval(found["completed"], 100)
        shares.append([f"`{name}`", STUDIES[name][0], runs, completed, interval(found["median"])])
        for factor, auc in found["auc"].items():
            if auc["p"] < SIGNIFICANT:
                bare, sized = factor.strip("|"), factor.startswith("|")
                cause = f"{name}-{bare}{'-size' if sized else ''}"
                words = f"size of {bare}" if sized else bare
                causes.append([f"`{cause}`", words, interval(auc), f"{auc['p']:.2g}"])
    head = ["row", "start", "runs", "completed, %", "median of all"]
    parts.append(
        "## Robustness\n\n`analyze robustness` with its default ranges. Intervals are of 95 % "
        f"(Wilson's for shares).\n\n{table(head, shares)}"
    )
    words = "Quantities that separate lost runs from the others (AUC 0.5: not at all)."
    parts.append(f"{words}\n\n{table(['row', 'quantity', 'AUC', 'p by Holm'], causes)}")
    return parts


def chosen_rows(names: Iterable[str]) -> dict[str, Row]:
    """Return the rows of these names and sections, by name."""
    rows = {section: make() for section, make in SECTIONS.items()}
    by_name = {row.name: row for some in rows.values() for row in some}
    names = list(names)
    if not names:
        return by_name
    wanted = [one.name for name in names for one in rows.get(name, [])]
    return {name: row for name, row in by_name.items() if name in (*wanted, *names)}


def main() -> None:
    """Run and write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="ROW or SECTION")
    parser.add_argument(
        "--seeds", type=int, default=size("SEEDS", len(SEEDS)), help="fewer: nothing is written"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--missing", action="store_true", help="only rows not measured yet")
    parser.add_argument("--command", action="store_true", help="print commands, run nothing")
    given = parser.parse_args()
    rows = chosen_rows(given.names)
    studies = [name for name in STUDIES if name in given.names or not given.names]
    unknown_names = set(given.names) - set(rows) - set(SECTIONS) - set(STUDIES)
    if unknown_names:
        parser.error(f"{', '.join(sorted(unknown_names))}: no such row or section")
    if given.command:
        for row in rows.values():
            settings = ("plant.kind=exact", *row.settings, *of_seed(row.drawn, SEEDS[0]))
            overlay = " ".join(f"--set '{one}'" for one in settings)
            print(f"stewart-drake simulate {row.scenario} --controller {row.controller} {overlay}")
        return
    empty: dict[str, Any] = {"rows": {}, "studies": {}}
    data = json.loads(DATA.read_text("utf-8")) if DATA.exists() else empty
    if given.missing:
        studies = [name for name in studies if name not in data["studies"]]
        kept = {name: one["settings"] for name, one in data["rows"].items()}
        rows = {name: row for name, row in rows.items() if kept.get(name) != described(row)}
    whole, names = given.seeds == len(SEEDS), chosen_rows([])
    data["rows"] = {name: one for name, one in data["rows"].items() if name in names}
    for name, row in rows.items():
        seeds = SEEDS[: given.seeds] if row.drawn else SEEDS[:1]
        ended = Parallel(n_jobs=given.jobs)(delayed(run)(row, seed) for seed in seeds)
        found = {
            "settings": described(row),
            "E_ac": [error for error, _ in ended],
            "lost_at": [time for _, time in ended if time is not None],
        }
        print(name, *numbers(found), sep=" | ", flush=True)
        data["rows"][name] = found
        save(data, whole)
    for name in studies:
        data["studies"][name] = study(name, given.jobs)
        print(name, interval(data["studies"][name]["completed"], 100), flush=True)
        save(data, whole)
    if whole:
        write(__file__, "Claims", page(data))


def save(data: dict[str, Any], whole: bool) -> None:
    """Write the file of all values, a line for each row, unless the runs were a trial."""
    if not whole:
        return

    def lines(some: dict[str, Any]) -> str:
        return ",\n".join(f"{json.dumps(name)}: {json.dumps(one)}" for name, one in some.items())

    parts = ",\n".join(f'"{part}": {{\n{lines(some)}\n}}' for part, some in data.items())
    with replacing(DATA) as partial_file:
        partial_file.write_text(f"{{\n{parts}\n}}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
