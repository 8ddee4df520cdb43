"""Packets that are lost in bursts: stated probabilities against counting and enumeration."""

import itertools

import numpy as np
import pytest

from stewart_drake.core.library import core
from stewart_drake.law.channel import Packets, packets_of
from stewart_drake.scenario.link_config import PacketsConfig
from stewart_drake.scenario.packets import (
    BurstChain,
    default_bound,
    losses,
    packet_times,
    torque_missing,
)

PERIOD = 0.1
COUNTED = 400_000


def network(burst, loss=0.1):
    return PacketsConfig(low=0.3, high=0.6, loss=loss, burst=burst)


def share_and_error(events):
    """Share of correlated events and its standard error, from the means of 200 batches."""
    batches = events[: len(events) // 200 * 200].reshape(200, -1).mean(axis=1)
    return float(batches.mean()), float(batches.std(ddof=1) / np.sqrt(200))


@pytest.mark.parametrize("bound", [0.4, 0.5, 0.6])
@pytest.mark.parametrize("repeats", [0, 1, 6])
@pytest.mark.parametrize("burst", [1, 4, 12])
def test_the_share_of_missing_torques_is_what_counting_gives(burst, repeats, bound):
    config = network(burst)
    times = packet_times(config, COUNTED + repeats, seed=11)
    missing = np.all(
        [
            times[i : i + COUNTED] > bound + (repeats - i) * PERIOD + 1e-9
            for i in range(repeats + 1)
        ],
        axis=0,
    )
    counted, error = share_and_error(missing)
    stated = torque_missing(config, bound, repeats, PERIOD)
    error = max(error, np.sqrt(stated / COUNTED))  # where nothing was counted
    assert abs(counted - stated) <= max(0.05 * stated, 3 * error)


def test_single_losses_are_independent():
    """A burst of one: the product of the packets' own probabilities."""
    for loss, repeats, bound in itertools.product((0.0, 0.05, 0.5), (0, 1, 6), (0.3, 0.45, 0.7)):
        due = bound + PERIOD * np.arange(repeats + 1)
        product = np.prod(1 - (1 - loss) * np.clip((due + 1e-9 - 0.3) / 0.3, 0, 1))
        stated = torque_missing(network(1, loss), bound, repeats, PERIOD)
        assert stated == pytest.approx(product, rel=1e-9, abs=1e-18)


def test_the_usual_bound_knows_bursts():
    """Both packets of a torque are often lost together, which no bound mends."""
    assert default_bound(network(1), 1, PERIOD) == pytest.approx(0.6)
    assert default_bound(network(12), 1, PERIOD) == pytest.approx(0.5)


def test_no_burst_is_under_way_at_the_first_packet():
    """Packet k is lost unless no burst began at it and the k before: 1 - (1 - p)^min(k + 1, b)."""
    runs = [losses(30, 0.2, 20, np.random.default_rng(seed)) for seed in range(4000)]
    length = np.minimum(np.arange(30) + 1, 20)
    expected = 1 - (1 - BurstChain(0.2, 20).begins) ** length
    error = np.abs(np.mean(runs, axis=0) - expected)
    assert np.all(error < 4.5 * np.sqrt(expected * (1 - expected) / 4000))


def chances(channel, arrived, since, last):
    """(last, n + 1) probabilities of the sources of the last torques, see core/packets.h."""
    c, packets, known = core(), packets_of(channel).pointer, len(arrived)
    flags, rows = arrived.astype(np.float64), np.empty((last, known + 1))
    for d in range(last):
        n = c.lib.stewart_packet_chances(
            *(packets, known, c.at(flags), since, last, d, c.at(rows[d])),
            c.scratch(c.lib.stewart_packets_scratch(packets)),
        )
    return rows[:, : n + 1]


@pytest.mark.parametrize("burst", [1, 2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_packets_are_weighed_by_every_course_of_the_losses(burst, seed):
    """Against the sum over all courses of bursts and times that agree with a report."""
    rng = np.random.default_rng(seed)
    rows, repeats, n, since, last = 4, 1, 7, int(rng.integers(0, 3)), 4
    loss = float(rng.uniform(0.1, 0.6))
    in_time = np.sort(rng.uniform(0.2, 0.95, rows))
    arrived_by = np.append(0.0, np.sort(rng.uniform(0.0, 0.9, 11)))
    arrived = np.zeros(n, dtype=bool)
    arrived[-1 - since - rng.integers(1, 4)] = rng.random() < 0.7
    channel = Packets(
        rows - repeats, repeats, tuple(in_time), tuple(arrived_by), BurstChain(loss, burst)
    )
    found = chances(channel, arrived, since, last)
    begins = 1 - (1 - loss) ** (1 / burst)
    # By packet, the oldest first: the probability that it had arrived by the report.
    told = [arrived_by[max(n - k - since, 0)] for k in range(n)]
    expected = np.zeros((last, n + 1))
    for course in itertools.product((0, 1), repeat=n + burst - 1):
        weight = np.prod([begins if one else 1 - begins for one in course])
        lost = [any(course[k : k + burst]) for k in range(n)]
        for k in range(n):
            weight *= (1 - lost[k]) if arrived[k] else 1.0 if lost[k] else 1 - told[k]
        for d in range(last):
            none_newer = weight
            for i in range(n):
                k, row, here = n - 1 - i, i - d + repeats, 0.0
                if 0 <= row < rows and not lost[k]:
                    late = max(0.0, in_time[row] - told[k]) / (1 - told[k])
                    here = 1.0 if arrived[k] else late
                expected[d, i] += none_newer * here
                none_newer *= 1 - here
            expected[d, n] += none_newer
    expected /= expected.sum(axis=1, keepdims=True)
    shown = found.shape[1] - 1  # older ones cannot bring any of these torques
    assert np.all(expected[:, shown:n] == 0)
    assert found[:, :shown] == pytest.approx(expected[:, :shown], abs=1e-7)
    assert found[:, -1] == pytest.approx(expected[:, -1], abs=1e-7)


def test_a_lost_neighbour_makes_a_packet_unlikely():
    """Packet 1 came late for no reason but loss: with bursts the next one is probably lost too."""
    told = (0.0, 0.0, 1.0, 1.0, 1.0, 1.0)
    by_burst = {
        burst: chances(
            Packets(1, 0, (1.0,), told, BurstChain(0.3, burst)),
            np.zeros(5, dtype=bool),
            since=0,
            last=1,
        )[0]
        for burst in (1, 6)
    }
    assert by_burst[1][0] == pytest.approx(0.7, abs=1e-6)
    assert by_burst[6][0] < 0.35
