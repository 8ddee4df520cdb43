"""Files that are no such file at all, and what they must not be able to do."""

import json
import pickle
import subprocess
from pathlib import Path

import pytest

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import data_root
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.loading import load_controller, load_scenario
from stewart_drake.scenario.reference_files import read_csv, read_waypoints
from stewart_drake.tuner.network import load_network, save_network
from tests.faults import Loader, complaint, refusal, tree, written
from tests.test_cli import command
from tests.test_network import small_network

HEADER = "time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]"
SAMPLES = "\n".join([HEADER, *(f"{k / 10},0,0,0,0,0,0.38" for k in range(6))]) + "\n"
WAYPOINTS = "times: [0.0, 1.0]\nposes: [[0, 0, 0, 0, 0, 0.38], [0, 0, 0, 0, 0, 0.4]]\n"

LOADERS: dict[str, tuple[Loader, str]] = {
    "scenario": (load_scenario, "mine.yaml"),
    "controller": (load_controller, "mine.yaml"),
    "mechanism": (load_mechanism, "mine.yaml"),
    "waypoints": (read_waypoints, "mine.yaml"),
    "csv": (read_csv, "mine.csv"),
    "weights": (load_network, "mine.json"),
}


def good_text(kind: str, folder: Path) -> str:
    """A file of this kind that loads."""
    if kind == "weights":
        save_network(small_network(), folder / "good.json")
        return (folder / "good.json").read_text()
    return (data_root() / "models" / "paper.yaml").read_text()


def run_me(path: str) -> None:
    """What a pickle would call."""
    Path(path).write_text("executed")


CONTENTS: dict[str, bytes] = {
    "empty": b"",
    "binary": bytes(range(256)) * 4,
    "a pickle": pickle.dumps(run_me),
    "too large": b"#" * 60_000_000,
    "html": b"<!doctype html><html><body>404</body></html>",
    "a list": b"[1, 2]",
}


@pytest.mark.parametrize("kind", LOADERS)
@pytest.mark.parametrize("content", CONTENTS)
def test_what_is_no_such_file(content, kind, tmp_path):
    load, name = LOADERS[kind]
    path = written(tmp_path / name, CONTENTS[content])
    complaint(load, path)


@pytest.mark.parametrize("kind", ["mechanism", "weights"])
def test_a_file_cut_off_anywhere_is_refused(kind, tmp_path):
    """Every part of these must be there but the last section of a mechanism."""
    load, name = LOADERS[kind]
    text = good_text(kind, tmp_path)
    end = text.rfind("motor:") if kind == "mechanism" else len(text.rstrip())
    for length in range(0, end, max(1, end // 20)):
        complaint(load, written(tmp_path / name, text[:length]))


# ---------------------------------------------------------------- nothing is executed


YAML_THAT_ACTS = [
    "!!python/object/apply:os.system ['touch {mark}']",
    "!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ['{mark}']]",
    "!!python/name:os.system ''",
    "!<tag:yaml.org,2002:python/object/new:subprocess.check_call> [[touch, {mark}]]",
    "%TAG ! tag:yaml.org,2002:python/\n---\n!object/apply:os.system ['touch {mark}']",
    "{{=1:1}}",
    "${{mark}}",
    "`touch {mark}`",
]


@pytest.mark.parametrize("kind", ["scenario", "waypoints"])
def test_yaml_executes_nothing(kind, tmp_path):
    load, name = LOADERS[kind]
    mark = tmp_path / "mark"
    for text in YAML_THAT_ACTS:
        for whole in (text, f"duration: {text}", f"- {text}", f"? {text}\n: 1"):
            with pytest.raises(ConfigError):
                load(written(tmp_path / name, whole.replace("{mark}", str(mark))))
            assert not mark.exists()


class Acting:
    """Its pickle leaves a mark when it is loaded."""

    def __init__(self, mark: Path) -> None:
        self._mark = mark

    def __reduce__(self):
        return run_me, (str(self._mark),)


def test_weights_execute_nothing(tmp_path):
    mark, path = tmp_path / "mark", tmp_path / "w.json"
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        complaint(load_network, written(path, pickle.dumps(Acting(mark), protocol)))
    save_network(small_network(), path)
    data = json.loads(path.read_text())
    data["card"] = {"__class__": "os.system", "args": [f"touch {mark}"]}
    load_network(written(path, json.dumps(data)))
    assert not mark.exists()


# ---------------------------------------------------------------- as a user meets them


@pytest.mark.parametrize(
    ("setting", "name", "content"),
    [
        ("reference.file", "motion.csv", SAMPLES.replace("[m]", "[ft]", 1)),
        ("tuner.weights", "net.json", "{}"),
        ("mechanism", "./m.yaml", "name: [1]"),
    ],
)
def test_files_that_a_scenario_names(setting, name, content, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / name, content)
    kinds = {"reference.file": "reference.kind=csv", "tuner.weights": "tuner.kind=ann"}
    kind = kinds.get(setting, "duration=1")
    before = tree(tmp_path)
    arguments = ["simulate", "--set", kind, "--set", f"{setting}={name}", "--out", "out"]
    assert Path(name).name in refusal(arguments, capsys)
    assert tree(tmp_path) == before


def test_a_process_says_the_same(tmp_path):
    path = written(tmp_path / "mine.yaml", "duration: 2021-05-30")
    done = subprocess.run(
        command("simulate", str(path)),
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (f"error: {path}: duration: got '2021-05-30'; expected a valid number\n")
