"""Kinds of a scenario's sections: a row of factories per class of configuration.

Bulk runs and live machines have tables of the values that they cover
(`scenario.dependencies.Accepted`).
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, Final, NamedTuple

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
from stewart_drake.scenario.config import EncoderSensorConfig, StateSensorConfig
from stewart_drake.scenario.link import forward_times, number_sent, torque_delays
from stewart_drake.scenario.link_config import NetworkConfig, WireConfig
from stewart_drake.scenario.packets import BurstChain, in_time
from stewart_drake.scenario.signals import PACKETS, POSE, Carried
from stewart_drake.types import Array

REPORTS: Final = 10
"""Number of consecutive lost reports without a loss of information."""


class SensorKind(NamedTuple):
    # the sensor, a Drake system with the ports `state` and `measurement`
    system: Callable[[Any, Experiment], System]
    sensing: Callable[[Any, Experiment], Sensing]  # part of the law that models the measurement


class LinkKind(NamedTuple):
    """A kind of link between controller and motors."""

    # the link, a Drake system with the ports `commanded` and `torque`, for a channel of the law
    system: Callable[[Any, Experiment, Channel], System]
    # part of the law that models the link, for the longest wait for a measurement in periods
    channel: Callable[[Any, Experiment, Timeline, int], Channel]


def _sensor(config: StateSensorConfig, experiment: Experiment) -> Sensor:
    period, motion = experiment.scenario.controller.period, experiment.motion_scale
    return Sensor(np.array(config.noise_std), config.seed, period, config.faults, motion)


def _state_sensing(config: StateSensorConfig, experiment: Experiment) -> Sensing:
    anywhere = experiment.scenario.plant.kind == "paper"
    return StateSensing(np.array(config.noise_std), experiment.motion_scale, anywhere)


def _encoders(c: EncoderSensorConfig, experiment: Experiment) -> Encoders:
    truth, period = experiment.truth, experiment.scenario.controller.period
    cranks = np.abs(truth.jacobian(experiment.start[POSE])) @ experiment.motion_scale
    return Encoders(truth, c.bits, c.samples, c.offset, c.seed, period, c.faults, cranks)


def _encoder_sensing(config: EncoderSensorConfig, experiment: Experiment) -> Sensing:
    rates, motion = experiment.scenario.controller.prior.rates, experiment.motion_scale
    calibration, estimated = experiment.calibration, OFFSETS[0] in experiment.nominal.free
    known = None if calibration is None or estimated else calibration
    return EncoderSensing(
        mechanism=experiment.mechanism,
        samples=config.samples,
        quantum=0.0 if config.bits is None else 2 * np.pi / 2**config.bits,
        initial_state=experiment.start,
        rates_std=motion if rates is None else np.array(rates),
        motion=motion,
        offset=np.array([(known and known.value(name)) or 0.0 for name in OFFSETS]),
    )


SENSORS: Final[Mapping[type, SensorKind]] = {
    StateSensorConfig: SensorKind(_sensor, _state_sensing),
    EncoderSensorConfig: SensorKind(_encoders, _encoder_sensing),
}


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


def _torque_wire(link: WireConfig, experiment: Experiment, _: Channel) -> System:
    return wire(experiment, experiment.torques_in_flight(experiment.scenario.true_delay), "torque")


def _playout(link: NetworkConfig, experiment: Experiment, channel: Channel) -> System:
    sc, delay = experiment.scenario, experiment.scenario.true_delay
    period = sc.controller.period
    repeats, history = 0, 1
    if isinstance(channel, Packets):
        repeats, history = channel.repeats, channel.report_periods
    return PlayoutBuffer(
        period,
        forward_times(sc, number_sent(sc.duration, period)),
        delay,
        experiment.torques_in_flight(delay),
        rows=repeats + channel.torques,
        repeats=repeats,
        dry=link.dry,
        history=history,
    )


def _packets(_: NetworkConfig, experiment: Experiment, timeline: Timeline, waits: int) -> Channel:
    c, link = experiment.scenario.controller, experiment.scenario.assumed_link
    assert link.kind == "network"
    if c.delay_steps == 0:
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


LINKS: Final[Mapping[type, LinkKind]] = {
    WireConfig: LinkKind(_torque_wire, lambda *_: Wire()),
    NetworkConfig: LinkKind(_playout, _packets),
}


def _multibody(experiment: Experiment, wrench: bool, meshcat: Meshcat | None) -> MultibodyStewart:
    fields, start = asdict(experiment.scenario.plant), experiment.start[POSE]
    for added in ("mechanism", "torque_bias", "push"):  # by the diagram
        del fields[added]
    return MultibodyStewart(experiment.truth, meshcat=meshcat, start=start, wrench=wrench, **fields)


def _exact(experiment: Experiment, wrench: bool, meshcat: Meshcat | None) -> ExactPlant:
    truth = experiment.true_dynamics(biased=False)
    return ExactPlant(truth, experiment.start, wrench, experiment.limits)


MakePlant = Callable[[Experiment, bool, Meshcat | None], ExactPlant | MultibodyStewart]
"""Makes a plant: (experiment, whether it has an input for a wrench, Meshcat or None)."""
PLANTS: Final[Mapping[str, MakePlant]] = {
    "multibody": _multibody,
    "exact": _exact,
    "paper": _exact,
}
