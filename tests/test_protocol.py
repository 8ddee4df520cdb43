"""Datagrams: the documented bytes, in Python and in C, and what is refused."""

import hashlib
import hmac
import math
import random
import re
import struct
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stewart_drake.core import build
from stewart_drake.core.library import core
from stewart_drake.export.controller import TEMPLATES
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.endpoint import (
    SHORTEST_KEY,
    Endpoint,
    Offers,
    Session,
    read_key,
)
from stewart_drake.live.protocol import (
    LONGEST,
    MISSING,
    MOST_HISTORY,
    MOST_ROWS,
    NEVER,
    SECOND,
    TAG,
    VERSION,
    ControllerFlags,
    ControllerMessage,
    Head,
    MachineFlags,
    MachineMessage,
    Refusal,
    RefusedError,
    decode,
    encode,
)
from stewart_drake.loop.peer import (
    DIGEST,
    MOST_BITS,
    MOST_SAMPLES,
    NAME,
    Fault,
    Identity,
    Part,
    Reason,
    identity_of,
)
from stewart_drake.scenario.loading import load_scenario
from tests import exchange

ROOT = Path(__file__).resolve().parents[1]
KEY = b"0123456789abcdef"

HEAD = Head(0x1122334455667788, 0x99AABBCCDDEEFF01, 7, 3, 2_500_000_000, 1_234_567_890, 1_000_000)
ARRIVED = 0b1011
ACTED = np.array([[0.5, -0.25, 0, 1, -1, 2]])
PLAN = ControllerMessage(
    HEAD,
    ControllerFlags.ARMED,
    2_400_000_000,
    3_200_000_000,
    1_000_000_000,
    np.vstack([ACTED, [[0.125, 0, 0, 0, 0, -8]]]),
)
CRANKS = replace(PLAN, flags=ControllerFlags(0), torques=ACTED, cranks=True)
STATE = MachineMessage(
    head=HEAD,
    flags=MachineFlags.SIMULATION | MachineFlags.RUNNING | MachineFlags.HOLDS,
    sampled=2_400_000_000,
    begin=1_000_000_000,
    period=100_000_000,
    watchdog=SECOND,
    rate=1.0,
    torque_limit=math.inf,
    arrived=ARRIVED,
    acted_from=2_400_000_000,
    acted=ACTED,
    played=23,
    dry=1,
    refused=4,
    state=np.array([0, 0.5, -0.5, 0.25, 0, 0.375, 0, 0, 0, 1, 0, np.nan]),
    reason=Reason(Fault.REACH, leg=2),
    before=Reason(Fault.STOOD, lasted=330_000_000),
)
IDENTITY = identity_of(load_scenario("paper"))
REQUEST = ControllerMessage(HEAD, identity=IDENTITY)
ENCODERS = MachineMessage(
    head=HEAD,
    flags=MachineFlags.PARKED,
    sampled=2_400_000_000,
    begin=NEVER,
    period=100_000_000,
    watchdog=SECOND,
    rate=1.0,
    torque_limit=0.5,
    arrived=ARRIVED,
    acted_from=NEVER,
    acted=np.empty((0, 6)),
    codes=np.array([[1, -1, 4096, -4096, 0, MISSING]], np.int32),
    bits=14,
    zeros=np.array([0, 0.5, 0, 0, 0, -0.5]),
)
OFFER = replace(ENCODERS, codes=None, bits=0, zeros=None, identity=IDENTITY)
VECTORS = [
    (PLAN, None),
    (PLAN, KEY),
    (STATE, None),
    (ENCODERS, None),
    (REQUEST, None),
    (OFFER, None),
    (CRANKS, None),
]


def blocks_of(section):
    """Return the datagrams of a section of docs/protocol.md."""
    text = (ROOT / "docs" / "protocol.md").read_text("utf-8").split(f"## {section}\n")[1]
    text = text.split("\n## ")[0]
    return [bytes.fromhex(block) for block in re.findall(r"```text\n(.*?)```", text, re.DOTALL)]


def in_c():
    """Those of protocol_test.c."""
    text = (TEMPLATES / "protocol_test.c").read_text("utf-8")
    found = re.findall(r"_bytes\[\] =\n(.*?);", text, re.DOTALL)
    return [bytes.fromhex("".join(re.findall('"([0-9a-f]+)"', block))) for block in found]


def cause(data, key=None):
    try:
        decode(data, key)
    except RefusedError as refused:
        return refused.cause
    return None


@pytest.mark.parametrize("number", range(len(VECTORS)))
def test_the_documented_bytes_are_written_and_read(number):
    message, key = VECTORS[number]
    documented, theirs = blocks_of("Test vectors"), in_c()
    assert len(documented) == len(theirs) == len(VECTORS)
    data = documented[number]
    assert data == theirs[number]
    assert encode(message, key) == data
    assert encode(decode(data, key)) == encode(message)


def test_the_documented_exchange_is_what_a_machine_answers():
    """`python -m tests.exchange` prints the blocks."""
    said = exchange.exchange()
    assert [encode(message) for message in said] == blocks_of("A worked exchange")
    request, offer, confirmation, measurement, torques = said
    assert isinstance(offer, MachineMessage) and offer.identity == request.identity != None  # noqa: E711
    assert offer.head.nonce == confirmation.head.nonce == torques.head.nonce != 0
    assert isinstance(measurement, MachineMessage) and measurement.begin == torques.begin
    assert len(encode(offer)) <= len(encode(request))


def test_each_field_lies_where_the_tables_say():
    """Every row of the tables of docs/protocol.md whose place is a number, read by itself."""
    text = (ROOT / "docs" / "protocol.md").read_text("utf-8").split("## A session")[0]
    head, machine, controller = re.split(r"## (?:Machine|Controller) to ", text)
    formats = {"u8": "<B", "u16": "<H", "u32": "<I", "u64": "<Q", "f64": "<d"}
    wanted = {
        "version": 3,
        "tag": 0,
        "kind": 1,
        "samples": 1,
        "bits": 0,
        "history": 1,
        "arrived": 0b1011,
        "reason": 1,
        "leg": 2,
        "before": 8,
        "lasted": 0,
        "before_lasted": 330_000_000,
        "content": 0,
        "rows": 2,
    }
    seen = 0
    for part, message in ((head, STATE), (machine, STATE), (head, PLAN), (controller, PLAN)):
        data = encode(message)
        for place, kind, name in re.findall(r"^\| (\d+) \| (\w+) \| (\w+) \|", part, re.MULTILINE):
            (value,) = struct.unpack_from(formats[kind], data, int(place))
            if name == "length":
                expected = len(data)
            else:
                expected = wanted.get(name, getattr(message, name, None))
                expected = getattr(message.head, name) if expected is None else expected
            assert value == expected, name
            seen += 1
    assert seen == 2 * 11 + 21 + 5


def test_the_numbers_are_those_of_c():
    lib = core().lib
    for names in (MachineFlags, ControllerFlags):
        assert all(one == getattr(lib, f"STEWART_{one.name}") for one in names)
    assert [getattr(lib, f"STEWART_{one.name}") for one in Refusal] == [*range(1, 8)]
    assert len(Fault) == lib.STEWART_FAULTS
    most = lib.STEWART_ROWS, lib.STEWART_HISTORY, lib.STEWART_SAMPLES, lib.STEWART_BITS
    assert most == (MOST_ROWS, MOST_HISTORY, MOST_SAMPLES, MOST_BITS)
    assert (lib.STEWART_PROTOCOL, lib.STEWART_TAG, lib.STEWART_LONGEST) == (VERSION, TAG, LONGEST)
    assert (lib.STEWART_DIGEST, lib.STEWART_NAME) == (DIGEST, NAME)


def test_the_tag_is_the_first_half_of_an_hmac():
    data = encode(PLAN, KEY)
    assert data[-TAG:] == hmac.new(KEY, data[:-TAG], hashlib.sha256).digest()[:16]


def test_crank_angles_follow_from_codes():
    values = ENCODERS.values
    assert values is not None
    turn = 2 * np.pi
    expected = [turn / 2**14, 0.5 - turn / 2**14, turn / 4, -turn / 4, 0, np.nan]
    np.testing.assert_allclose(values, expected, rtol=1e-15)
    assert STATE.values is STATE.state


# ---------------------------------------------------------------- random messages


def any_message(rng):
    """Return a message of either side, with numbers of all sizes."""
    head = Head(*(rng.randrange(1, 2**n) for n in (64, 64, 32, 32, 64, 64, 64)))
    some = np.array([rng.uniform(-1, 1) * 10.0 ** rng.randrange(-300, 300) for _ in range(6)])
    names = ("paper", "0.1 s", "encoders, 1 samples, 14 bits", "x" * 32)
    identity = Identity(*(Part(rng.randbytes(8), name) for name in names))
    if rng.random() < 0.5:
        if rng.random() < 0.3:
            return ControllerMessage(head, identity=identity)
        torques = np.outer(1 + np.arange(rng.randrange(MOST_ROWS + 1)), some)
        rows, cranks = (3, 4, rng.randrange(2**63), torques), rng.random() < 0.5
        return ControllerMessage(head, ControllerFlags.STOP, *rows, cranks=cranks)
    acted = np.outer(1 + np.arange(rng.randrange(MOST_HISTORY + 1)), some)
    times = (rng.randrange(1, 2**64) for _ in range(4))
    flags, bits = MachineFlags(rng.randrange(1024)), rng.choices([True, False], k=64)
    there = sum(bit << i for i, bit in enumerate(bits))
    fixed = (1.0, math.inf, there, 5, acted, 1, 2, 3)
    faults = {
        "reason": Reason(rng.choice(list(Fault)), rng.randrange(7), rng.randrange(2**64)),
        "before": Reason(rng.choice(list(Fault)), 0, rng.randrange(2**64)),
        "cranks": rng.random() < 0.5,
    }
    if rng.random() < 0.3:
        offered = (*fixed[:4], acted[:0], *fixed[5:])
        return MachineMessage(head, flags, *times, *offered, identity=identity, **faults)
    if rng.random() < 0.5:
        return MachineMessage(head, flags, *times, *fixed, state=np.append(some, some), **faults)
    codes = np.array([rng.randrange(-(2**31), 2**31) for _ in range(24)], np.int32).reshape(-1, 6)
    return MachineMessage(head, flags, *times, *fixed, codes=codes, bits=9, zeros=some)


@pytest.mark.parametrize("key", [None, KEY, bytes(99)])
def test_what_is_written_is_read(key):
    rng = random.Random(1)
    for _ in range(100):
        message = any_message(rng)
        data = encode(message, key)
        assert len(data) <= LONGEST
        assert encode(decode(data, key)) == encode(message)


def test_messages_that_do_not_fit_are_not_written():
    for torques in (np.zeros((MOST_ROWS + 1, 6)), np.zeros((2, 5)), np.zeros(6)):
        with pytest.raises(ValueError, match="expected up to"):
            encode(ControllerMessage(HEAD, begin=0, torques=torques))


# ---------------------------------------------------------------- what is refused


def changed(data, place, value):
    return data[:place] + value + data[place + len(value) :]


def test_every_shorter_datagram_is_malformed():
    for message, key in VECTORS:
        data = encode(message, key)
        assert all(cause(data[:n], key) == Refusal.MALFORMED for n in range(len(data)))
        assert cause(data + b"\0", key) == Refusal.MALFORMED
        assert cause(data + bytes(LONGEST), key) == Refusal.MALFORMED


def test_the_first_thing_that_is_wrong_is_the_cause():
    plan, report, nan = encode(PLAN), encode(STATE), struct.pack("<d", math.nan)
    request, offer = encode(REQUEST), encode(OFFER)
    wrong = [
        (changed(plan, 0, b"XTWC"), None, Refusal.MALFORMED),
        (changed(plan, 4, b"\1"), None, Refusal.VERSION),
        (changed(encode(PLAN, KEY), 4, b"\1"), None, Refusal.VERSION),
        (changed(plan, 5, b"\7"), None, Refusal.MALFORMED),
        (encode(PLAN, KEY), None, Refusal.KEY),
        (plan, KEY, Refusal.KEY),
        (encode(PLAN, KEY), b"x" + KEY, Refusal.KEY),
        (changed(encode(PLAN, KEY), 100, b"\1"), KEY, Refusal.KEY),
        (changed(plan, 8, bytes(8)), None, Refusal.MALFORMED),
        (changed(plan, 24, bytes(4)), None, Refusal.MALFORMED),
        (changed(plan, 56, b"\4"), None, Refusal.MALFORMED),
        (changed(plan, 60, b"\3"), None, Refusal.MALFORMED),
        (changed(plan, 60, b"\xff"), None, Refusal.MALFORMED),
        (changed(plan, 61, b"\1"), None, Refusal.MALFORMED),
        (changed(plan, 61, b"\3"), None, Refusal.MALFORMED),
        (changed(plan, 62, b"\1"), None, Refusal.MALFORMED),
        (changed(request, 60, b"\1"), None, Refusal.MALFORMED),
        (changed(request, 96, b"\n"), None, Refusal.MALFORMED),
        (changed(request, 103, b"x"), None, Refusal.MALFORMED),
        (changed(request, len(request) - 1, b"\1"), None, Refusal.MALFORMED),
        (changed(offer, 63, b"\1"), None, Refusal.MALFORMED),
        (changed(offer, 168, b"\x80"), None, Refusal.MALFORMED),
        (changed(plan, 80, b"\xff" * 8), None, Refusal.MALFORMED),
        (changed(plan, 88, nan), None, Refusal.MALFORMED),
        (changed(report, 60, b"\3"), None, Refusal.MALFORMED),
        (changed(report, 61, b"\2"), None, Refusal.MALFORMED),
        (changed(report, 63, b"\x11"), None, Refusal.MALFORMED),
        (changed(report, 80, bytes(8)), None, Refusal.MALFORMED),
        (changed(report, 96, nan), None, Refusal.MALFORMED),
        (changed(report, 104, bytes(8)), None, Refusal.MALFORMED),
        (changed(report, 140, bytes([len(Fault)])), None, Refusal.MALFORMED),
        (changed(report, 141, b"\7"), None, Refusal.MALFORMED),
        (changed(report, 142, bytes([len(Fault)])), None, Refusal.MALFORMED),
        (changed(report, 143, b"\1"), None, Refusal.MALFORMED),
        (changed(report, len(report) - 8, nan), None, Refusal.MALFORMED),
    ]
    for data, key, expected in wrong:
        assert cause(data, key) == expected
    assert cause(changed(report, 160, nan)) is None  # a value that is lost


def test_a_window_takes_each_number_once():
    """Against a set of all that were seen, over numbers that overtake one another and repeat."""
    rng = random.Random(20261122)
    here, seen, newest = ("127.0.0.1", 5), set[int](), 0
    session = Session(9, here)
    causes = set()
    for _ in range(20_000):
        number = max(1, newest + rng.choice([-100, -64, -63, -5, -1, 0, 1, 1, 1, 2, 7, 63, 64, 90]))
        found = session.refusal(Head(9, 4, number, 0, 0, 0, 0), here, 0)
        if number <= newest - 64:
            expected = Refusal.LATE
        else:
            expected = Refusal.REPLAYED if number in seen else None
        assert found == expected
        causes.add(found)
        seen.add(number)
        newest = max(newest, number)
        bits = session.window.seen
        assert [n for n in range(newest, newest - 64, -1) if bits >> (newest - n) & 1] == [
            n for n in range(newest, newest - 64, -1) if n in seen and n > 0
        ]
    assert causes == {None, Refusal.LATE, Refusal.REPLAYED}


def test_a_session_is_of_two_numbers_and_an_address():
    here, other = ("127.0.0.1", 5), ("127.0.0.1", 6)
    session = Session(9, here, nonce=4)

    def refusal(number, nonce, sequence, address):
        return session.refusal(Head(number, nonce, sequence, 0, 100, 0, 0), address, 1000)

    assert refusal(8, 4, 1, here) == refusal(9, 5, 1, here) == refusal(9, 4, 1, other)
    assert refusal(9, 4, 1, other) == Refusal.FOREIGN
    assert session.heard == 0
    assert refusal(9, 4, 1, here) is None
    assert refusal(9, 4, 1, here) == Refusal.REPLAYED
    head = session.head(1500)
    assert (head.sequence, head.acknowledged, head.echo, head.held) == (1, 1, 100, 500)
    assert session.head(1600).sequence == 2


def test_a_nonce_is_of_session_address_secret_and_the_sessions_so_far():
    offers, address = Offers(bytes(range(32))), ("127.0.0.1", 50000)
    first = offers.nonce(7, address)
    others = offers.nonce(8, address), offers.nonce(7, ("127.0.0.2", 50000))
    others = *others, offers.nonce(7, ("127.0.0.1", 50001)), Offers().nonce(7, address)
    offers.taken()
    assert len({0, first, *others, offers.nonce(7, address)}) == 7


# ---------------------------------------------------------------- sockets


def test_without_a_key_only_loopback(tmp_path):
    for host in ("0.0.0.0", "192.0.2.1"):
        with pytest.raises(ConfigError, match="without a key; expected a loopback address"):
            Endpoint(ControllerMessage, host)
    with pytest.raises(ConfigError, match="key: got 3 bytes"):
        Endpoint(ControllerMessage, key=b"abc")
    endpoint = Endpoint(MachineMessage)
    with pytest.raises(ConfigError, match="without a key"):
        endpoint.send(PLAN, ("192.0.2.1", 9))
    with pytest.raises(ConfigError, match="expected a free one"):
        Endpoint(ControllerMessage, port=endpoint.address[1])
    file = tmp_path / "key"
    for text in (b"short\n", b"", bytes(5000)):
        file.write_bytes(text)
        with pytest.raises(ConfigError, match="--key: got"):
            read_key(file)
    with pytest.raises(ConfigError, match="No such file"):
        read_key(tmp_path / "none")
    file.write_bytes(b"x" * SHORTEST_KEY + b"\n")
    assert read_key(file) == b"x" * SHORTEST_KEY
    endpoint.close()


def test_an_endpoint_counts_what_it_refuses():
    ear, mouth = Endpoint(ControllerMessage, key=KEY), Endpoint(MachineMessage, key=KEY)
    good = encode(PLAN, KEY)
    bad = (b"", b"x", good[:-1], encode(PLAN), changed(good, 4, b"\4"), encode(STATE, KEY))
    for data in (good, *bad):
        mouth._socket.sendto(data, ear.address)
    assert [(encode(message, KEY), who) for message, who in ear.receive()] == [
        (good, mouth.address)
    ]
    assert list(ear.receive()) == []
    # A report is the other side's own.
    assert ear.refused == {Refusal.MALFORMED: 4, Refusal.KEY: 1, Refusal.VERSION: 1}
    ear.close()
    mouth.close()
    assert not mouth.send(PLAN, ("127.0.0.1", 9))
    assert mouth.unsent == 1


# ---------------------------------------------------------------- the C


@pytest.fixture(scope="module")
def codec(tmp_path_factory):
    """protocol_test.c, compiled with the sanitizers."""
    compiler = build.compiler()
    if compiler is None:
        pytest.skip("there is no C compiler")
    made = tmp_path_factory.mktemp("codec") / "protocol_test"
    sources = [str(build.FOLDER / "protocol.c"), str(TEMPLATES / "protocol_test.c")]
    sources += [f"-I{build.FOLDER}"]
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-g"]
    flags += ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run([*compiler, *flags, *sources, "-lm", "-o", str(made)], check=True)
    return made


def through_c(codec, datagrams, key):
    """Yield the cause of refusal in C, as a number, and the datagram written again."""
    lines = "".join(data.hex() + "\n" for data in datagrams)
    done = subprocess.run(
        [codec, key.decode()], input=lines, capture_output=True, text=True, check=True
    )
    for line in done.stdout.splitlines():
        number, _, text = line.partition(" ")
        yield int(number), bytes.fromhex(text)


def test_c_writes_and_reads_the_documented_bytes(codec):
    """Its messages are those of the table above, written in C."""
    done = subprocess.run([codec], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == "protocol: as documented\n"


IN_C = {None: 0, Refusal.MALFORMED: 1, Refusal.VERSION: 2, Refusal.KEY: 3}


def damaged(rng, data):
    """Return a datagram damaged at random."""
    kind = rng.randrange(6)
    if kind == 0:
        return data[: rng.randrange(len(data) + 1)]
    if kind == 1:
        return data + rng.randbytes(rng.randrange(1, 30))
    if kind == 2:
        return rng.randbytes(rng.randrange(200))
    if kind == 3:  # with the right length
        return data[:60] + rng.randbytes(len(data) - 60)
    place = rng.randrange(len(data))
    number = 1 if kind == 4 else rng.randrange(1, 9)
    return changed(data, place, rng.randbytes(min(number, len(data) - place)))


def compare_codecs(codec, rng, number):
    """Damaged and sound datagrams through both; the causes that were seen."""
    key = KEY if rng.random() < 0.5 else b""
    datagrams = []
    for _ in range(number):
        data = encode(any_message(rng), key or None)
        datagrams.append(data if rng.random() < 0.2 else damaged(rng, data)[: LONGEST + 1])
    seen = set()
    answers = list(through_c(codec, datagrams, key))
    assert len(answers) == len(datagrams)
    for data, (number, again) in zip(datagrams, answers, strict=True):
        expected = cause(data, key or None)
        assert number == IN_C[expected], data.hex()
        assert again == (data if expected is None else b"")
        if expected is None:
            assert encode(decode(data, key or None), key or None) == data
        seen.add(expected)
    return seen


def test_both_codecs_take_and_refuse_the_same(codec):
    rng = random.Random(202611)
    seen = set.union(*(compare_codecs(codec, rng, 300) for _ in range(6)))
    assert seen == set(IN_C)


@pytest.mark.soak
def test_both_codecs_take_and_refuse_the_same_for_five_minutes(codec):
    rng, end, number = random.Random(), time.monotonic() + 300, 0
    while time.monotonic() < end:
        compare_codecs(codec, rng, 1000)
        number += 1000
    print(f"{number} datagrams")
