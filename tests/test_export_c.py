"""The controller as a folder of C: it builds strictly, and replays what Python answered."""

import dataclasses
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from stewart_drake.cli import main
from stewart_drake.core import build
from stewart_drake.export import controller as export_c
from stewart_drake.export.recording import EXPORTED, _refusal, record
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import shipped
from stewart_drake.loop.controller_margin import controller_margin
from stewart_drake.loop.preparation import prepare
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.compare import SERVOS
from tests.board import run as board
from tests.building import SANITIZED, c_compiler, keeping_objects, make

NOISE = "sensor.noise_std=[1e-5,1e-5,1e-5,1e-6,1e-6,1e-6,1e-4,1e-4,1e-4,1e-5,1e-5,1e-5]"
FAULTS = (
    "sensor.faults=[{kind: missing, from: 0.5, to: 0.6}, {kind: frozen, from: 0.9, to: 1.0}, "
    "{kind: spike, from: 1.2, to: 1.3}, {kind: spike, size: 0.3, from: 1.5, to: 1.55}]"
)
SATURATED = "actuator.torque_limit=0.025"
DRIFT = ("controller.delay_estimator=drifting", "controller.delay_steps=6", "delay.drift=-0.01")
PUSH = "plant.push={wrench: [0, 0, 0, 0.05, 0, 0], from: 2}"
ASIDE = "plant.payload_mass=0.4", "plant.payload_position=[0.03, -0.02, 0.05]", "start=on_reference"
MOTION = ("stewart_motion.o", "motion.o")
SHORT = ("plant.kind=exact", "duration=5.0")
FASTER = "duration=2.0"
"""Of a machine with a period of 20 ms."""
RUNS = {
    "paper": ("paper", ()),
    "bad measurements and outliers": ("desktop", (NOISE, FAULTS, FASTER)),
    "saturation, a fraction of a period": ("desktop", (SATURATED, "delay.fraction=0.37", FASTER)),
    "late measurements": ("motion_base", ("sensor.delay=0.2",)),
    "without estimator": ("gravity", ("controller.estimate=[]",)),
    "delay estimator": ("paper", DRIFT),
    "rule": ("desktop", ("tuner.kind=rule", FASTER)),
    "network of weights": ("desktop", ("tuner.kind=ann", FASTER)),
    "encoders": ("paper", ("sensor.kind=encoders", "sensor.bits=14", "sensor.samples=20")),
    "wrench": ("paper", ("start=on_reference", "controller.estimate=[payload,wrench]", PUSH)),
    "position": ("paper", (*ASIDE, "controller.estimate=[payload,payload_position]")),
    "measurements that get lost": ("desktop", ("sensor.loss=0.2", FASTER)),
    "network": ("desktop", ("link.kind=network", "link.loss=0.2", "link.burst=3", FASTER)),
}
QUICK = (
    *("bad measurements and outliers", "saturation, a fraction of a period"),
    *("encoders", "network", "delay estimator", "rule"),
)
BITS = {"bad measurements and outliers": (8, 16, 32), "saturation, a fraction of a period": (64,)}


@pytest.fixture(autouse=True)
def compiler():
    return c_compiler()


def exported(folder, name, settings, single=False):
    """Export a short run without the sizes of the README; return the folder."""
    scenario = load_scenario(name, settings=(*SHORT, *settings))
    export_c.write(export_c.exported(scenario, single, measured=False), folder)
    return folder


def objects(folder, *options):
    """Compile the controller in an export; return the names of its objects."""
    makefile = (folder / "Makefile").read_text().splitlines()
    [names] = [line.split()[2:] for line in makefile if line.startswith("STEWART = ")]
    make(folder, *options, *names)
    return names


def statuses(folder):
    """Return the statuses of an exported recording."""
    listed = (folder / "stewart_test.c").read_text().split("status[STEPS] = {")[1].split("}")[0]
    return {int(status) for status in listed.split(",")}


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param(n, marks=() if n in QUICK else pytest.mark.soak) for n in RUNS]
)
def test_the_replay_is_exact(case, tmp_path):
    """1e-9 of the peak torque, the same statuses; strict, and under the sanitizers."""
    name, settings = RUNS[case]
    folder = exported(tmp_path, name, settings)
    said = make(folder, "test")
    passed, steps, *_ = said.split()
    assert passed == "passed:" and int(steps) >= 50 and "statuses that differ: 0" in said
    over_udp = (folder / "protocol.c").exists()
    assert said.endswith("protocol: as documented\n") == over_udp
    make(folder, "check")
    for bit in BITS.get(case, ()):
        assert any(status & bit for status in statuses(folder))


@pytest.mark.slow
def test_a_motion_that_jumps_where_a_torque_acts_is_repeated(tmp_path):
    """Samples are at rounded times, and the motion is another one on either side."""
    rows = ["time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]"]
    rows += [f"{t:.2f},{0.02 * t * t},0,0,0,0,0.38" for t in np.arange(0, 5.005, 0.05)]
    (tmp_path / "motion.csv").write_text("\n".join(rows))
    reference = f"reference={{kind: csv, file: {tmp_path}/motion.csv}}"
    (tmp_path / "board").mkdir()
    said = make(exported(tmp_path / "board", "paper", (reference,)), "test")
    assert said.startswith("passed: 51 steps")
    configuration = (tmp_path / "board" / "stewart_config.c").read_text()
    assert "  file: motion.csv\n" in configuration and str(tmp_path) not in configuration


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("paper", ("actuator.kind=servo",)),
        ("paper", ("actuator.kind=servo", "sensor.kind=encoders")),
        ("desktop", ("actuator.kind=position_servo", FASTER)),
    ],
)
def test_the_replay_of_servos_is_exact(name, settings, tmp_path):
    """Commands for position servos; none of the law for torques is in the folder.

    The servos of `desktop` reach their limit, which the status reports.
    """
    scenario = load_scenario(name, "servo_preview", settings=(*SHORT, *settings))
    export_c.write(export_c.exported(scenario, measured=False), tmp_path)
    assert "statuses that differ: 0" in make(tmp_path, "test")
    make(tmp_path, "check")
    assert not (tmp_path / "law.c").exists()
    assert any(status & 64 for status in statuses(tmp_path)) == (name == "desktop")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_gravity_is_exported_for_either_plant(tmp_path, kind):
    """The engine's steps of 1 ms, which lose the loop, are not part of the controller."""
    scenario = load_scenario("gravity", settings=(f"plant.kind={kind}",))
    export_c.write(export_c.exported(scenario, measured=False), tmp_path)
    said = make(tmp_path, "test")
    assert said.startswith("passed: 1000 steps") and "statuses that differ: 0" in said


@pytest.mark.parametrize("option", ["-ffast-math", "-ffinite-math-only"])
def test_compiling_without_checks_for_nan_is_refused(option, tmp_path, compiler, monkeypatch):
    """Every source of the controller and the package's library refuse the option."""
    for source in ("matrix.c", "dynamics.c", "riccati.c", "law.c", "filter.c", "servo.c"):
        command = [*compiler, "-std=c99", option, "-fsyntax-only", str(build.FOLDER / source)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode != 0 and "compile without -ffast-math" in done.stderr, source
    monkeypatch.setenv("CC", f"{compiler[0]} {option}")
    problem = build.compile_library(tmp_path / "library.so")
    assert problem is not None and "compile without -ffast-math" in problem
    assert not list(tmp_path.iterdir())


@pytest.mark.soak
@pytest.mark.parametrize("compiler", ["clang", "arm-linux-gnueabihf-gcc -static"])
def test_other_compilers_and_processors(compiler, tmp_path):
    emulator = "qemu-arm" if compiler.startswith("arm") else ""
    for needed in (compiler.split()[0], emulator or "make"):
        if shutil.which(needed) is None:
            pytest.skip(f"there is no {needed}")
    folder = exported(tmp_path, "paper", ("duration=2.0",))
    said = make(folder, "test", f"CC={compiler}", f"EMULATOR={emulator}")
    assert "statuses that differ: 0" in said


@pytest.mark.slow
def test_the_makefile_compiles_again_for_other_options(tmp_path):
    """Objects of a host are not linked or measured as those of a board."""
    settings = (*SHORT, "actuator.kind=servo", "duration=0.5")
    scenario = load_scenario("paper", "servo_preview", settings)  # the smallest folder
    folder = tmp_path
    export_c.write(export_c.exported(scenario, measured=False), folder)
    make(folder, "test", "CFLAGS=-O0")
    compiled = (folder / "servo.o").stat().st_mtime_ns
    total = make(folder, "size", "CFLAGS=-O0").splitlines()[-1]
    assert (folder / "servo.o").stat().st_mtime_ns == compiled
    assert make(folder, "size", "CFLAGS=-O1").splitlines()[-1] != total
    make(folder, "test", "CFLAGS=-O1")
    assert make(folder, "size", "CFLAGS=-O0").splitlines()[-1] == total


@pytest.mark.slow
def test_a_controller_that_is_off_is_reported(tmp_path):
    """The replay reports a changed period and a changed status."""
    folder = exported(tmp_path, "paper", ("duration=2.0",))
    make(folder, "test", "CFLAGS=-O0")
    for name, old, new in (
        ("stewart_config.c", ".period = 0.1", ".period = 0.1000001"),
        ("stewart_test.c", "status[STEPS] = {0", "status[STEPS] = {8"),
    ):
        right = (folder / name).read_text()
        assert old in right
        (folder / name).write_text(right.replace(old, new))
        assert make(folder, "test", "CFLAGS=-O0", fails=True).startswith("failed: ")
        (folder / name).write_text(right)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("gravity", ()),
        ("gravity", ("controller.estimate=[]",)),
        ("motion_base", ("sensor.kind=encoders",)),
        ("paper", ("sensor.kind=encoders", "sensor.bits=14", "sensor.samples=20")),
        ("paper", ("controller.delay_estimator=constant", "controller.delay_steps=6")),
        ("paper", ("link.kind=network", "link.loss=0.1")),
    ],
    ids=["estimator", "measured state", "plan in flight", "encoders", "delay", "network"],
)
def test_single_precision_is_close(name, settings, tmp_path, monkeypatch):
    """1e-3 of the peak of the replay in double precision, over 10 s."""
    monkeypatch.setattr(export_c, "MOST_IN_SINGLE", 1000)
    scenario = load_scenario(name, settings=("plant.kind=exact", *settings))
    export_c.write(export_c.exported(scenario, single=True, measured=False), tmp_path)
    said = make(tmp_path, "test")
    assert "tolerance 1e-03" in said and "statuses that differ: 0" in said
    assert 1e-9 < float(said.split("largest error ")[1].split()[0]) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("paper", ("start=on_reference", "queue=reference")),
        ("paper", ("sensor.delay=0.2", "delay.fraction=0.3")),
        pytest.param("gravity", ("controller.estimate=[]",), marks=pytest.mark.soak),
        pytest.param("gravity", ("delay.steps=0",), marks=pytest.mark.soak),
    ],
    ids=["paper", "late", "without estimator", "no delay"],
)
def test_odd_inputs_are_survived(name, settings, tmp_path, compiler):
    """NaN, infinity, huge numbers, INT_MIN and INT_MAX, under both sanitizers."""
    folder = exported(tmp_path, name, (*settings, "duration=0.5"))
    shutil.copy(Path(__file__).with_name("odd_inputs.c"), folder)
    own = [*objects(folder, f"CFLAGS={' '.join(SANITIZED)}"), "odd_inputs.c"]
    own += ["stewart_motion.c", "motion.c"]
    command = [*compiler, "-std=c99", *SANITIZED, *own, "-lm", "-o", "odd_inputs"]
    subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run(["./odd_inputs"], cwd=folder, capture_output=True, text=True)
    assert (done.stdout, done.stderr, done.returncode) == ("odd inputs: survived\n", "", 0)


STATUSES = """
#define main replay
#include "stewart_test.c"
#undef main
int main(void) {
    begin();
    for (int k = 0; k < STEPS; k++) {
        real found[ANSWER];
        const int returned = answer(k, found);
        after_step(k);
        printf("%d %d\\n", returned & 0x138, stewart_unmeasured(returned));
    }
    return 0;
}
"""
"""Prints the bits of a measurement, and whether no part of it was used."""


@pytest.mark.slow
def test_a_status_distinguishes_single_values_from_a_whole_measurement(tmp_path, compiler):
    """One leg is missing, or all are: the board stops for the second only."""
    faults = "sensor.faults=[{kind: missing, leg: 2, from: 0.5, to: 0.8}, "
    faults += "{kind: missing, from: 1.0, to: 1.2}]"
    settings = ("sensor.kind=encoders", "start=on_reference", "duration=1.5", faults)
    folder = exported(tmp_path, "paper", settings)
    (folder / "statuses.c").write_text(STATUSES)
    make(folder, *MOTION)
    own = [*objects(folder), *MOTION, "meter.c", "statuses.c", "-lm", "-o", "statuses"]
    subprocess.run([*compiler, "-O1", *own], cwd=folder, check=True)
    said = subprocess.run(["./statuses"], cwd=folder, capture_output=True, text=True, check=True)
    rows = [tuple(map(int, line.split())) for line in said.stdout.splitlines()]
    assert set(rows) == {(0, 0), (8 + 256, 0), (8, 1)}
    assert rows.count((8, 1)) == 2


PAINTED = """
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
enum { SIZE = 1 << 18 };
int replay(void);
static void *run(void *failed) { *(int *)failed = replay(); return NULL; }
int main(void) {
    unsigned char *stack;
    pthread_attr_t attributes;
    pthread_t thread;
    int failed = 1, untouched = 0;
    if (posix_memalign((void **)&stack, 4096, SIZE) != 0) return 1;
    memset(stack, 0xA5, SIZE);
    pthread_attr_init(&attributes);
    pthread_attr_setstack(&attributes, stack, SIZE);
    pthread_create(&thread, &attributes, run, &failed);
    pthread_join(thread, NULL);
    while (stack[untouched] == 0xA5) untouched++;
    printf("stack %d\\n", SIZE - untouched);
    return failed;
}
"""
"""Runs the replay on a stack that was painted before, and says how much of it was used."""


@pytest.mark.slow
def test_the_stack_is_not_deeper_than_stated(tmp_path, compiler):
    folder = exported(tmp_path, "paper", ("duration=1.0",))
    (folder / "painted.c").write_text(PAINTED)
    command = [*compiler, "-O2", "-Dmain=replay", "-c", "stewart_test.c"]
    subprocess.run(command, cwd=folder, check=True)
    make(folder, *MOTION)
    own = [*objects(folder), *MOTION, "meter.c", "painted.c", "stewart_test.o"]
    command = [*compiler, "-O2", *own, "-lm", "-pthread", "-o", "painted"]
    subprocess.run(command, cwd=folder, check=True)
    said = subprocess.run(["./painted"], cwd=folder, capture_output=True, text=True, check=True)
    told = int((folder / "README.md").read_text().split("PC less than ")[1].split(" kB")[0])
    used = int(said.stdout.split("stack ")[1])
    assert 5000 < used < 1000 * told


def test_what_is_not_exported_is_refused_by_its_field(tmp_path, capsys):
    """tests/test_native_law.py has the fields."""
    folder = tmp_path / "board"
    options = ["--out", str(folder), "--set", "controller.prediction=linear"]
    assert main(["export-c", "paper", *options]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    said = "controller.prediction: got linear, which is not exported; expected nonlinear, as in"
    assert said in error
    assert not folder.exists()


@pytest.mark.parametrize("name", shipped("controller"))
def test_a_shipped_controller_is_exported_or_refused_by_its_name(name):
    actuator = f"actuator.kind={'servo' if name in SERVOS else 'torque'}"
    scenario = load_scenario("paper", name, ("plant.kind=exact", "duration=0.2", actuator))
    if name in EXPORTED:
        assert record(scenario).steps
        return
    said = f"controller: {name} is not exported, because of .*; exported are {EXPORTED[0]}"
    with pytest.raises(ConfigError, match=said):
        record(scenario)


def test_a_law_of_the_user_is_refused_by_what_it_is():
    said = _refusal(load_scenario("paper"), "law")
    assert said.startswith("law: got a law of your own, which is not exported")


def test_a_run_that_does_not_end_is_refused():
    scenario = load_scenario("gravity", settings=("plant.kind=exact", "queue=zero"))
    with pytest.raises(ConfigError, match=r"can replay to its end\. .*: try queue=reference with"):
        export_c.exported(scenario, measured=False)
    better = load_scenario(
        "paper", settings=("plant.gravity=true", "queue=reference", "delay.steps=2")
    )
    assert record(better).steps


@pytest.mark.parametrize(("name", "tight"), [("gravity", True), ("paper", False)])
def test_a_loop_that_tolerates_hardly_any_error_is_warned_of(name, tight):
    """`gravity` is stable for delay errors from -0.0039 to +0.0028 ms."""
    margin = controller_margin(prepare(load_scenario(name)))
    assert export_c._is_tight(margin) == tight


@pytest.mark.slow
def test_the_command_writes_all_files_or_none_and_states_sizes(tmp_path, capsys, monkeypatch):
    """The text of `paper` is at most 196 kB, its state 16.4 kB."""
    folder = tmp_path / "board"
    command = ["export-c", "paper", "--out", str(folder), "--set", "duration=0.5"]
    with monkeypatch.context() as patch:
        for name, value in keeping_objects().items():
            patch.setenv(name, value)
        assert main(command) == 0
    assert "make test" in capsys.readouterr().out
    names = {path.name for path in folder.iterdir()} - {export_c.DIGESTS}
    assert {"law.h", "law.c", "stewart_config.c", "stewart_test.c", "Makefile"} < names
    readme = (folder / "README.md").read_text()
    assert "`measures[7]` = -|pitch| (rad) is above" in readme
    text = int(readme.split("(TOTALS)")[0].splitlines()[-1].split()[0])
    state = int(readme.split("state ")[1].split()[0])
    assert 50_000 < text <= 196_000 and 3000 < state <= 16_400
    assert "@" not in readme
    # The other exports are about files.
    monkeypatch.setattr(export_c, "_sizes", lambda files: "unmeasured")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    files = {**dict.fromkeys(names, "other"), "nowhere/law.c": ""}
    with pytest.raises(FileNotFoundError):
        export_c.write(files, folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    # What its user changed is kept, what no export has written is not replaced.
    (folder / "stewart_board.c").write_text("mine")
    assert main([*command, "--set", "sensor.kind=encoders"]) == 0
    assert "last export: stewart_board.c; delete" in capsys.readouterr().out
    assert not (folder / "stewart_machine.c").exists()
    assert main(command) == 0
    assert "last export: stewart_board.c; delete" in capsys.readouterr().out
    assert (folder / "stewart_board.c").read_text() == "mine"
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    own = dict.fromkeys(("stewart_board.c", "README.md", export_c.DIGESTS))  # of its times
    assert after | own == before | own
    (folder / export_c.DIGESTS).unlink()
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "stewart_board.c: no export has written it; exp" in error


BODY = "{ (void)context, (void)number, (void)times, (void)rows; }"
ENCODERS = ("sensor.kind=encoders", "sensor.samples=20")
FEW = ("sensor.kind=encoders", "sensor.samples=8", "link.kind=network")
DESCRIBED = {
    "torques": ("paper", None, (), ("= 8 periods after", "(here 9)", "**gravity 0 (off)**")),
    "late measurements": ("paper", None, ("sensor.delay=0.2",), ("up to 12 (`.longest_",)),
    "encoders": (
        "paper",
        None,
        ENCODERS,
        ("has 120 numbers: 20 rows", "All rows are used", "of `sensor.samples: 20`"),
    ),
    "encoders without estimator": (
        *("paper", None, (*ENCODERS, "controller.estimate=[]"), ("Only the last row is used",)),
    ),
    "network": ("paper", None, ("link.kind=network",), ("packets of 17 rows", "holds the last")),
    "encoders over a network": (
        "paper",
        None,
        FEW,
        ("not here because of `sensor.kind: encoders`",),
    ),
    "unknown delay": (
        "paper",
        "adaptive_lqi",
        (),
        ("It is assumed to be 8 periods", "--delay 0.8 --no-gravity"),
    ),
    "weights": ("desktop", None, ("tuner.kind=ann",), ("stewart_tuned_step(", "= 3 periods")),
    "servos": (
        *("paper", "servo_preview", ("actuator.kind=servo",)),
        ("angles, rates and torques", "because of `actuator.kind: servo`"),
    ),
    "setpoints": (
        *("reachy_mini", "servo_feedforward", ()),
        (
            "1216 numbers",
            "20 rows of mean",
            "because of `controller.estimate`",
            "gravity 9.81 m/s²",
        ),
    ),
    "setpoints without estimator": ("reachy_mini", None, (), ("adds fifteen planned setpoints",)),
}


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("case", DESCRIBED)
def test_the_readme_is_that_of_the_composition(case, single, tmp_path):
    """Its words, its files, and its wiring, which compiles as C and as C++."""
    name, controller, settings, present = DESCRIBED[case]
    settings = ("plant.kind=exact", "duration=0.2", *settings)
    files = export_c.exported(load_scenario(name, controller, settings), single, measured=False)
    export_c.write(files, tmp_path)
    readme = files["README.md"]
    for words in present:
        assert words in " ".join(readme.split()), words
    for words in ("@", "{%", "None"):
        assert words not in readme, words
    over_udp = "stewart_udp.c" in files
    if over_udp:  # Jinja reads `@-1@` as 1
        unknown_age = -1 if "link.kind=network" in settings else 0
        assert f"int age = {unknown_age}," in files["stewart_udp.c"]
    assert over_udp == ("make udp" in readme)
    make(tmp_path, "--dry-run", "udp", fails=not over_udp)
    listed = readme.split("```text\n")[-1].split("```")[0].split()
    assert set(listed) <= files.keys() and "stewart_config.c" in listed
    code = readme.split("```c\n")[1].split("```")[0].replace("{ .. }", BODY)
    included, _, rest = code.partition("\n\n")
    assert included in readme.split("```cpp\n")[1]
    declared = "extern void read_plate(real *), read_encoders(real *);\n"
    declared += "extern void drive(const real *), send_torques(const real *);\n"
    declared += "extern void send_packet(const real *);\n"
    report = "stewart_report" if "stewart_report" in rest else "real"
    declared += f"extern int read_report({report} *);\nvoid setup(void), every_period(void);\n"
    declared += "extern int age_of_measurement(void);\nextern void stop_safely(void);\n"
    (tmp_path / "wiring.c").write_text(f"{included}\n{declared}{rest}", encoding="utf-8")
    headers = {"stewart_motion.h", "motion.h", "stewart_board.h", "protocol.h", "udp.h", "meter.h"}
    own = sorted(headers & files.keys())
    assert ("stewart_machine.c" in files) == ("./stewart_machine" in readme)
    all_headers = "\n".join([included, *(f'#include "{name}"' for name in own)])
    other = f'extern "C" {{\n{all_headers}\n{declared}}}\n{rest}'
    (tmp_path / "wiring.cpp").write_text(other, encoding="utf-8")
    strict = ["-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]
    strict += ["-fsyntax-only"]
    commands = [[*c_compiler(), "-std=c99", *strict, "wiring.c"]]
    if shutil.which("g++") is not None:
        commands.append(["g++", "-std=c++11", *strict, "wiring.cpp"])
    for command in commands:
        subprocess.run(command, cwd=tmp_path, check=True)


# ---------------------------------------------------------------- time on a board


def test_gravity_and_coarse_encoders_shorten_the_longest_gap():
    """The machine falls from a pose that is less and less certain."""
    prompt = ("controller.period=0.02", "delay.steps=4", "start=on_reference", "queue=reference")
    heavy, coarse = "plant.gravity=true", "sensor={kind: encoders, bits: 12}"
    found = []
    for settings in ((), (heavy,), (heavy, coarse)):
        scenario = load_scenario("paper", settings=(*SHORT, *prompt, *settings))
        config = export_c.exported(scenario, measured=False)["stewart_config.h"]
        [line] = [line for line in config.splitlines() if "STEWART_LONGEST_GAP" in line]
        found.append(float(line.split()[2]))
    assert found[0] == 1.0 > found[1] > found[2] >= 0.08


@pytest.mark.parametrize(
    ("settings", "single", "said"),
    [
        (
            (),
            True,
            "2.24 million instructions, up to 6.58 where it plans; 13 and 39 ms on a Cortex-M4",
        ),
        (
            ("controller.period=0.0125",),
            False,
            "the longest step takes longer than the period of 12",
        ),
        (("controller.period=0.01",), True, "a usual step takes longer than the period of 10 ms"),
        (("controller.delay_estimator=constant",), True, "the longest step takes longer than the"),
    ],
)
def test_the_readme_estimates_a_step_and_warns_of_a_short_period(settings, single, said):
    scenario = load_scenario("paper", settings=(*SHORT, *settings))
    readme = export_c.exported(scenario, single, measured=False)["README.md"]
    assert said in readme
    assert ("**By that estimate" in readme) == bool(settings)


def board_table():
    """Return name, precision, stack, median and most of each row in docs/howto/board.md."""
    table = board.PAGE.read_text("utf-8").split(board.MARKS[0])[1].split(board.MARKS[1])[0]
    for line in table.strip().splitlines()[2:]:
        name, processor, *_, stack, median, most, _, _ = (
            cell.strip(" *") for cell in line.strip("|").split("|")
        )
        yield name, processor == "M4", int(stack), float(median), float(most)


def test_the_estimates_are_those_of_the_table():
    found = {(name, single): row for name, single, *row in board_table()}
    for name, by_precision in export_c.MILLIONS.items():
        for single, (median, most) in by_precision.items():
            stack, *counted = found.pop((name, single))
            if name == "delay estimator":  # a new search for the delay is not in the table
                counted[1] = max(counted[1], 42.0)
            assert counted == [median, most]
            assert single or stack <= 1000 * export_c.STACKS[name] < stack + 1200
    assert list(found) == [("ideal, outliers", False)]


def test_a_row_shows_in_bold_what_takes_longer_than_the_period():
    sizes = {"flash": 90000, "state": 1, "workspace": 1, "stack": 1}
    found = board.Counted(**sizes, median=2.0, most=20.0, error=1e-6, period=100.0)
    assert board.cells(board.ROWS[3], found)[-4:-1] == ["2.00", "**20.00**", "**119**"]
    found = dataclasses.replace(found, period=10.0)
    assert board.cells(board.ROWS[3], found)[-4:-1] == ["**2.00**", "**20.00**", "**119**"]


def test_make_board_writes_the_table_between_its_marks(tmp_path, monkeypatch, capsys):
    page = tmp_path / "board.md"
    page.write_text(f"a\n{board.MARKS[0]}old{board.MARKS[1]}\nb\n", "utf-8")
    monkeypatch.setattr(board, "PAGE", page)
    monkeypatch.setattr(board, "ROWS", ())
    monkeypatch.setattr(board, "missing", list)
    assert board.main() == 0 and "| controller | processor |" in capsys.readouterr().out
    text = page.read_text("utf-8")
    assert "old" not in text and "| controller |" in text
    assert text.startswith("a\n") and text.endswith("\nb\n")
