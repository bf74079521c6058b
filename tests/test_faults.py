"""Bad luck and bad input: nothing is lost, nothing wrong is believed, and one is told.

Fuzzed values, damaged files, a full disk. What may come out is the right thing, or a
ValueError (a refusal in our own words); never another error, and never a NaN that
travels on.
"""

import copy
import io
import json
import math
import os
import subprocess
import sys
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dnddpg_minimal import (
    Batch,
    Config,
    NumpyAgent,
    Training,
    check,
    make_env,
    read_npz,
    stream,
    study,
    td_target,
)
from dnddpg_minimal.__main__ import main
from dnddpg_minimal.study import load_study

ROOT = Path(__file__).parents[1]
SMALL = dict(hidden=(8,), steps=300, warmup=100, batch_size=8, evaluate_every=100)
JUNK = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=6),
    st.sampled_from(("ddpg", "max_min", "Pendulum-v1", "1", (0,), (64, 64.5), {}, [],
                     b"x", math.nan, math.inf, -0.0, 10**30, object, np.float32(0.5))))


@settings(max_examples=400, deadline=None)
@given(st.dictionaries(st.sampled_from([f.name for f in fields(Config)]), JUNK,
                       min_size=1, max_size=3))
@example({"algorithm": "C0-K0"})
@example({"algorithm": {}})
@example({"critics": 0})
def test_a_config_is_right_or_refused_in_a_sentence(values):
    try:
        config = Config(**values)
    except ValueError as error:
        message = str(error)
        assert len(message) > 20, message
        assert any(name in message for name in values), message
    else:
        assert Config.from_json(config.to_json()) == config
        assert 0 <= config.gamma <= 1 and config.batch_size >= 1


NUMBERS = st.one_of(st.floats(-1e6, 1e6),
                    st.sampled_from((math.nan, math.inf, -math.inf)))


@settings(max_examples=150, deadline=None)
@given(st.lists(NUMBERS, min_size=1, max_size=4), st.integers(1, 3), st.integers(1, 3),
       st.integers(0, 5), st.sampled_from(("max_min", "single", "paired_min", "x")),
       NUMBERS)
def test_a_target_is_finite_or_refused(reward, critics, actors, size, rule, q):
    q_next = np.full((critics, actors, size), q)
    with np.errstate(all="ignore"):
        try:
            y = td_target(np.array(reward), np.zeros(len(reward)), q_next, 0.99, rule)
        except ValueError as error:
            assert len(str(error)) > 20
        else:
            assert y.shape == (len(reward),)
            assert np.isfinite(y).all()


WORDS = st.lists(st.sampled_from((
    "train", "watch", "study", "check", "benchmark", "--task", "Pendulum-v2", "--steps",
    "-1", "nan", "--out", "/no/folder/x.npz", "--film", "x.mp4", "--budget", "huge",
    "--", "", "--algorithm", "TD3", "--hidden", "64", "x", "--seeds", "--dry-run",
    "--resume", "é\x00")), max_size=5)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(WORDS)
def test_a_wrong_command_line_ends_without_a_traceback(words):
    if {"train", "benchmark", "study"} & set(words):  # a right one would set to work
        words = [*words, "--no-such-option"]
    try:
        code = main(words)
    except SystemExit as ended:  # tyro's own way: usage, and code 2
        code = ended.code
    assert code in (0, 1, 2)


def said_by_main(words):
    """The exit code of a command line, and what it wrote on the error stream."""
    with redirect_stderr(io.StringIO()) as said, redirect_stdout(io.StringIO()):
        try:
            code = main(words)
        except SystemExit as ended:
            return ended.code, "tyro"
    return code, said.getvalue()


# Values that the parser lets pass, and values that it does not. No long runs.
OPTIONS = st.one_of(*(
    st.tuples(st.just(option), st.sampled_from(values.split(";")))
    for option, values in {
        "--task": "Pendulum-v1;ArmEasy-v0;MountainCarContinuous-v0;CartPole-v1;Pendulum"
                  ";no_module:Task-v0;C\x00;/",
        "--algorithm": "DDPG;DN-DDPG;C3-K2;C1-K2;C0-K0;TD3",
        "--critics": "1;2;0;-1;x", "--actors": "1;2;3;0",
        "--seed": "1;-1;1e3;340282366920938463463374607431768211456",
        "--steps": "1;2;0;-1;nan", "--episodes": "1;0", "--max-episode-steps": "1;0",
        "--task-options": "g=9.8;g=null;g={};reward=distance;reward=1;x=1;=;g",
        "--hidden": "4;0;-4;x;1000000000000000", "--batch-size": "1;3;0;x",
        "--gamma": "0;1;2;nan;x", "--tau": "1;0;-1;inf", "--target-every": "2;0",
        "--critic-lr": "1;0;nan;1e-300", "--actor-lr": "1;2;-0.0",
        "--warmup": "0;1;2;-1", "--buffer-size": "1;2;0;1000000000000000",
        "--updates-per-step": "0;2;-1", "--noise": "ou;gaussian;pink",
        "--sigma": "0;1e9;1e300;nan", "--theta": "0;1;2", "--noise-decay": "1;0;1e-300",
        "--target-rule": "single;paired_min;selected;soft;x",
        "--act-rule": "max_min;first;x", "--climbs": "first;x",
        "--init": "tied_actors;tied_critics;x", "--ends": "none;any_end;x",
        "--y-min": "0;-inf;nan;1e9", "--nu": "1;2", "--freeze-actors-after": "0;1;-1",
        "--evaluate-every": "1;0", "--yield-every": "1;0",
        "--backend": "numpy;torch;jax", "--device": "cpu;cuda;tpu;",
        "--dtype": "float64;int8",
    }.items()))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of NumPy and Gymnasium, about such values
def test_a_train_command_ends_with_0_or_with_one_line_and_2(tmp_path_factory):
    folder, seen = tmp_path_factory.mktemp("fuzz"), Counter()

    @settings(max_examples=150, deadline=None)
    @given(st.lists(OPTIONS, min_size=1, max_size=4, unique_by=lambda pair: pair[0]))
    @example([("--noise", "ou"), ("--dtype", "float64")])
    def try_out(options):
        out = folder / "run.npz"
        chosen = {"--steps": "2", "--warmup": "1", "--hidden": "4", "--batch-size": "2",
                  "--out": str(out)} | dict(options)
        code, said = said_by_main(["train", *(w for pair in chosen.items()
                                              for w in pair)])
        seen[code if said != "tyro" else "tyro"] += 1
        assert code in (0, 2), said
        if said == "tyro":
            return
        if code == 0:
            assert Training.load(out).finished
        else:
            assert said.startswith("dnddpg_minimal: ") and len(said) > 40, said
            assert said.count("\n") == 1, said
            assert not out.exists()
        out.unlink(missing_ok=True)

    try_out()
    assert min(seen[0], seen[2]) > 10, seen  # it did get past the parser


# --- files ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The bytes of a saved training."""
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    training = Training(Config("Pendulum-v1", "DDPG", **SMALL))
    for _ in training:
        pass
    training.save(path)
    return path.read_bytes()


def load_everything(path):
    """What each loader makes of a file: None for a refusal in words."""
    found = []
    for load in (read_npz, NumpyAgent.load, Training.load):
        try:
            found.append(load(path))
        except ValueError as error:
            assert str(path) in str(error)
            found.append(None)
    return found


def test_a_file_cut_short_anywhere_is_refused(saved, tmp_path):
    path, rng = tmp_path / "cut.npz", stream(0, "noise")
    for length in (0, 1, *rng.integers(2, len(saved) - 100, 40)):
        path.write_bytes(saved[:length])
        assert load_everything(path) == [None] * 3, length


def test_a_changed_byte_is_refused_or_does_no_harm(saved, tmp_path):
    """Each array of a `.npz` has a checksum: what is loaded is what was saved."""
    path, rng = tmp_path / "changed.npz", stream(1, "noise")
    path.write_bytes(saved)
    original = read_npz(path)
    for at in rng.integers(0, len(saved), 120):
        changed = bytearray(saved)
        changed[at] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        content = load_everything(path)[0]
        for name, array in (content or {}).items():
            if name in original:
                np.testing.assert_array_equal(array, original[name])


@pytest.mark.parametrize("content", (
    b"", b"PK\x03\x04", b"hello", b"\x80\x04\x95.",
    b"\x93NUMPY\x01\x00v\x00{'descr': '|O'"),
    ids=("empty", "half a zip", "text", "pickle", "object array"))
def test_a_foreign_file_is_refused_by_every_loader(content, tmp_path):
    path = tmp_path / "foreign.npz"
    path.write_bytes(content)
    assert load_everything(path) == [None] * 3
    record = tmp_path / "Pendulum-v1" / "class" / "DDPG-0.npz"
    record.parent.mkdir(parents=True)
    record.write_bytes(content)
    with pytest.warns(UserWarning, match="is skipped"):
        assert len(load_study(folder=tmp_path)) == 0


# --- what a student hands in ----------------------------------------------------------

FIRST_CELLS = 6  # of an exercise: given code, a stub, and its check of 2 points


def beginning_of_an_exercise(**nbgrader):
    """The bytes of a notebook; its check with other words for nbgrader in it."""
    nb = json.loads((ROOT / "exercises" / "01_value.ipynb").read_bytes())
    del nb["cells"][FIRST_CELLS:]
    nb["cells"][-1]["metadata"]["nbgrader"] |= nbgrader
    return json.dumps(nb).encode()


EXERCISE = beginning_of_an_exercise()
JSON_JUNK = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=6),
    st.sampled_from(("code", "markdown", "check-1-2", "check-1-99", "given-99-1", [],
                     {}, [[]], {"": 1}, "\ud800", 10**400, ["check-1-1"], "3", -1.5)))
NAMES = st.sampled_from(("01_value.ipynb", "99_x.ipynb", "anna.ipynb", "²³.ipynb"))


@st.composite
def damaged_bytes(draw):
    """A notebook's bytes: cut off, or with other ones in the middle."""
    at = draw(st.integers(0, len(EXERCISE)))
    middle = draw(st.binary(max_size=8))
    skip = draw(st.sampled_from((0, 1, 100, len(EXERCISE))))
    return EXERCISE[:at] + middle + EXERCISE[at + skip:]


def places(inside):
    """Where something stands in a value: (list or dict, index or key), at any depth."""
    if not isinstance(inside, dict | list):
        return
    for key in inside if isinstance(inside, dict) else range(len(inside)):
        yield inside, key
        yield from places(inside[key])


@st.composite
def damaged_notebooks(draw):
    """A notebook with one to three of its values changed, deleted, or doubled."""
    nb = json.loads(EXERCISE)
    for _ in range(draw(st.integers(1, 3))):
        everywhere = list(places(nb))
        by_nbgrader = [place for place in everywhere if "grade_id" in place[0]]
        here, key = draw(st.sampled_from(
            by_nbgrader if by_nbgrader and draw(st.booleans()) else everywhere))
        match draw(st.sampled_from(("change", "delete", "double"))):
            case "change":
                here[key] = copy.deepcopy(draw(JSON_JUNK))
            case "delete":
                del here[key]
            case "double" if isinstance(here, list):
                here.insert(0, copy.deepcopy(here[key]))
    return json.dumps(nb).encode()


@pytest.mark.slow
@pytest.mark.parametrize("solutions", (True, False), ids=("solutions", "none"))
@pytest.mark.parametrize("contents", (damaged_bytes(), damaged_notebooks()),
                         ids=("bytes", "values"))
def test_a_damaged_notebook_gets_points_or_a_sentence(contents, solutions,
                                                      tmp_path_factory):
    folder = tmp_path_factory.mktemp("handed in")

    @settings(max_examples=150, deadline=None)
    @given(contents, NAMES)
    @example(b"[" * 10_000, "deep.ipynb")
    @example(beginning_of_an_exercise(points=None), "01_value.ipynb")
    @example(beginning_of_an_exercise(points="many"), "01_value.ipynb")
    @example(beginning_of_an_exercise(grade_id="check-99-1"), "99_x.ipynb")
    @example(b'{"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}',
             "²³.ipynb")
    def hand_in(content, name):
        path = folder / "exercises" / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(check, "run", lambda *_: {})  # as if every cell had passed
            if not solutions:
                patch.setattr(check, "ROOT", folder)
            code, said = said_by_main(["check", str(path)])
        if code == 2:
            assert said.count("\n") == 1 and name in said, said
        else:
            assert code in (0, 1) and said == ""

    hand_in()


# --- a full disk ----------------------------------------------------------------------

FULL_DISK = """
import resource, signal, sys
from dnddpg_minimal import Config, Training
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # then the write fails, as on a full disk
training = Training(Config("Pendulum-v1", "DDPG", steps=300, warmup=300))
for _ in training:
    pass
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    training.save(sys.argv[1])
except OSError as error:
    print("refused:", error.strerror)
"""


@pytest.mark.skipif(os.name == "nt", reason="no limit of a file's size there")
def test_a_full_disk_leaves_the_old_file_and_no_rubbish(saved, tmp_path):
    path = tmp_path / "run.npz"
    path.write_bytes(saved)
    done = subprocess.run([sys.executable, "-c", FULL_DISK, path], text=True,
                          capture_output=True)
    assert "refused:" in done.stdout, done.stderr
    assert path.read_bytes() == saved
    assert list(tmp_path.iterdir()) == [path]


FULL_DISK_IN_A_STUDY = """
import resource, signal, sys
from dnddpg_minimal import Config, study
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
config, folder, scratch, every, limit = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), int(limit)))
try:
    study.record(study.Run(Config.from_json(config), "tiny"), folder, scratch,
                 every=float(every))
except OSError as error:
    print("refused:", error.strerror)
"""


@pytest.mark.skipif(os.name == "nt", reason="no limit of a file's size there")
@pytest.mark.parametrize("what, every, limit",
                         (("checkpoint", 0, 10_000), ("record", 1e9, 1_000)))
def test_a_run_that_met_a_full_disk_is_done_afterwards(what, every, limit, tmp_path):
    run = study.Run(Config("Pendulum-v1", "DDPG", **SMALL), "tiny")
    out, scratch = tmp_path / "out", tmp_path / "scratch"
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK_IN_A_STUDY, run.config.to_json(), out, scratch,
         str(every), str(limit)], text=True, capture_output=True)
    assert "refused:" in done.stdout, done.stderr
    assert [path for path in out.rglob("*") if path.is_file()] == []
    assert not list(scratch.glob("*.part"))
    said, arrays = study.record(run, out, scratch, every=every)
    assert said == "done" and (out / f"{run.name}.npz").exists()
    _, expected = study.record(run, tmp_path / "o", tmp_path / "s", write=False)
    for name in ("evaluations", "bias", "episodes"):
        np.testing.assert_array_equal(arrays[name], expected[name])


def test_a_clock_that_goes_backwards_disturbs_nothing(monkeypatch, tmp_path):
    import time

    def history():
        run = study.Run(Config("Pendulum-v1", "DDPG", **SMALL), "tiny")
        _, arrays = study.record(run, tmp_path / "out", tmp_path / "in", write=False)
        return arrays["evaluations"]

    normal = history()
    backwards = iter(range(10**9, 0, -7))
    monkeypatch.setattr(time, "time", lambda: next(backwards))
    monkeypatch.setattr(time, "monotonic", lambda: next(backwards))
    np.testing.assert_array_equal(history(), normal)


def test_an_agent_that_is_asked_nonsense_says_so():
    config = Config("Pendulum-v1", "DN-DDPG", **SMALL)
    agent = NumpyAgent(config, 3, 1)
    for obs in ([1.0], np.zeros((2, 3, 1)), "text", None):
        with pytest.raises((ValueError, TypeError)):
            agent.act(obs)
    nothing = Batch(np.full((8, 3), np.nan), np.zeros((8, 1)), np.zeros(8),
                    np.full((8, 3), np.nan), np.zeros(8))
    before = agent.arrays()["theta"].copy()
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="finite"):
        agent.update(nothing)
    np.testing.assert_array_equal(agent.arrays()["theta"], before)


def test_a_task_that_cannot_be_made_is_refused_in_words():
    for name in ("CartPole-v1", "NoSuchTask-v0", "no_module:Task-v0", "", "Pendulum "):
        with pytest.raises(ValueError, match="task="):
            make_env(Config(name))
