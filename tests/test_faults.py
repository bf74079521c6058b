"""Bad luck and bad input: nothing is lost, nothing wrong is believed, and one is told.

Fuzzed values, damaged files, a full disk. What may come out is the right thing, or a
ValueError (a refusal in our own words); never another error, and never a NaN that
travels on.
"""

import math
import os
import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dnddpg_minimal import (
    Batch,
    Config,
    NumpyAgent,
    Training,
    make_env,
    read_npz,
    stream,
    td_target,
)
from dnddpg_minimal.__main__ import main
from dnddpg_minimal.study import load_study

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


def test_a_clock_that_goes_backwards_disturbs_nothing(monkeypatch, tmp_path):
    import time

    from dnddpg_minimal import study

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
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="not finite"):
        agent.update(nothing)
    np.testing.assert_array_equal(agent.arrays()["theta"], before)


def test_a_task_that_cannot_be_made_is_refused_in_words():
    for name in ("CartPole-v1", "NoSuchTask-v0", "no_module:Task-v0", "", "Pendulum "):
        with pytest.raises(ValueError, match="task="):
            make_env(Config(name))
