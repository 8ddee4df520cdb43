"""Sensor, link and plant of a scenario by their `kind`, and the parts of the law that model them.

Bulk runs and live machines have tables of the values that they cover
(`scenario.dependencies.Accepted`).
"""

from dataclasses import asdict
from typing import Final

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import System

from stewart_drake.law.channel import Channel, Packets, Wire
from stewart_drake.law.sensing import EncoderSensing, Sensing, StateSensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.link import DelayChain, PlayoutBuffer, VaryingDelay
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.sampling import declare_constant
from stewart_drake.loop.sensor import Encoders, Sensor
from stewart_drake.scenario.calibration import OFFSETS
from stewart_drake.scenario.link import forward_times, number_sent, torque_delays
from stewart_drake.scenario.packets import BurstChain, in_time
from stewart_drake.scenario.signals import PACKETS, POSE, Carried
from stewart_drake.types import Array

REPORTS: Final = 10
"""Number of consecutive lost reports without a loss of information."""


def make_sensor(experiment: Experiment) -> System:
    """Make the sensor, with the ports `state` and `measurement`."""
    c, period = experiment.scenario.sensor, experiment.scenario.controller.period
    motion = experiment.motion_scale
    if c.kind == "state":
        return Sensor(np.array(c.noise_std), c.seed, period, c.faults, motion)
    truth = experiment.truth
    cranks = np.abs(truth.jacobian(experiment.start[POSE])) @ motion
    return Encoders(truth, c.bits, c.samples, c.offset, c.seed, period, c.faults, cranks)


def make_sensing(experiment: Experiment) -> Sensing:
    """Make the part of the law that models the measurement."""
    sc, c, motion = experiment.scenario, experiment.scenario.sensor, experiment.motion_scale
    if c.kind == "state":
        return StateSensing(np.array(c.noise_std), motion, anywhere=sc.plant.kind == "paper")
    rates = sc.controller.prior.rates
    calibration, estimated = experiment.calibration, OFFSETS[0] in experiment.nominal.free
    known = None if calibration is None or estimated else calibration
    return EncoderSensing(
        mechanism=experiment.mechanism,
        samples=c.samples,
        quantum=0.0 if c.bits is None else 2 * np.pi / 2**c.bits,
        initial_state=experiment.start,
        rates_std=motion if rates is None else np.array(rates),
        motion=motion,
        offset=np.array([(known and known.value(name)) or 0.0 for name in OFFSETS]),
    )


def wire(experiment: Experiment, queue: Array, carries: Carried) -> System:
    """Make the link of a wire with the commands (L, n) in flight at t = 0."""
    sc, delay = experiment.scenario, experiment.scenario.true_delay
    period = sc.controller.period
    if not sc.delay.constant:
        return VaryingDelay(period, torque_delays(sc), delay, queue, carries)
    chain = DelayChain(period, delay.steps, delay.fraction, queue, carries)
    declare_constant(chain, "delay", np.array([sc.eta]))  # for the record
    declare_constant(chain, "packets", np.full(len(PACKETS), np.nan))
    return chain


def make_link(experiment: Experiment, channel: Channel) -> System:
    """Make the link, with the ports `commanded` and `torque`, for a channel of the law."""
    sc, link, delay = experiment.scenario, experiment.scenario.link, experiment.scenario.true_delay
    period, queue = sc.controller.period, experiment.torques_in_flight(delay)
    if link.kind == "wire":
        return wire(experiment, queue, "torque")
    repeats, history = 0, 1
    if isinstance(channel, Packets):
        repeats, history = channel.repeats, channel.report_periods
    return PlayoutBuffer(
        period,
        forward_times(sc, number_sent(sc.duration, period)),
        delay,
        queue,
        rows=repeats + channel.torques,
        repeats=repeats,
        dry=link.dry,
        history=history,
    )


def make_channel(experiment: Experiment, timeline: Timeline, waits: int) -> Wire | Packets:
    """Make the part of the law that models the link.

    Measurements arrive after at most `waits` periods.
    """
    c, link = experiment.scenario.controller, experiment.scenario.assumed_link
    if link.kind == "wire" or c.delay_steps == 0:
        return Wire()
    rows = c.packet_repeats + c.packet_torques
    due = timeline.eta + (np.arange(rows) - c.packet_repeats) * c.period
    kept = rows + timeline.steps + waits + REPORTS + 1
    return Packets(
        torques=c.packet_torques,
        repeats=c.packet_repeats,
        in_time=tuple(in_time(link, due).tolist()),
        arrived_by=tuple(in_time(link, c.period * np.arange(kept)).tolist()),
        losses=BurstChain(link.loss, link.burst),
        holds=link.dry == "hold",
        report_periods=waits + REPORTS + 1,
    )


def make_plant(
    experiment: Experiment, meshcat: Meshcat | None = None
) -> ExactPlant | MultibodyStewart:
    """Make the plant, with an input `wrench` if something pushes it."""
    plant, truth, start = experiment.scenario.plant, experiment.truth, experiment.start
    wrench = any(plant.push.wrench) or experiment.own.pushes
    if plant.kind != "multibody":
        dynamics = experiment.true_dynamics(biased=False)
        return ExactPlant(dynamics, start, wrench, experiment.limits)
    fields = asdict(plant)
    for added in ("mechanism", "torque_bias", "push"):  # by the diagram
        del fields[added]
    return MultibodyStewart(truth, meshcat=meshcat, start=start[POSE], wrench=wrench, **fields)
