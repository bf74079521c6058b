"""The command line, used as a reader uses it: in a process of its own."""

import inspect
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from dataclasses import fields

import numpy as np
import pytest
from PIL import Image

from dnddpg_minimal import Config, NumpyAgent, Training, make_agent
from dnddpg_minimal.__main__ import command, main

pytestmark = pytest.mark.slow

SMALL = ["--hidden", "8", "8", "--batch-size", "8", "--warmup", "100"]
signals = pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT to send")


def cli(*words, cwd=None, **variables):
    """Run `python -m dnddpg_minimal` with these words to its end."""
    return subprocess.run(
        [sys.executable, "-m", "dnddpg_minimal", *map(str, words)],
        cwd=cwd, capture_output=True, encoding="utf-8", timeout=120,
        env=os.environ | {"PYTHONUTF8": "1", "COLUMNS": "88"} | variables)


def fails_in_one_line(capsys, *words):
    """The one line that `main` writes about a mistake in these words."""
    assert main([str(word) for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("dnddpg_minimal: ") and err.count("\n") == 1
    return err


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A file of 400 steps on Pendulum, made by the command line, and what it said."""
    folder = tmp_path_factory.mktemp("trained")
    done = cli("train", "--steps", 400, *SMALL, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / "Pendulum-v1-DN-DDPG-0.npz", done


# --- help -----------------------------------------------------------------------------


def test_a_stream_that_knows_no_greek_gets_it_escaped():
    """A file on Windows is written in cp1252, say."""
    shown = cli("train", "--help", PYTHONUTF8="0", PYTHONIOENCODING="ascii")
    assert shown.returncode == 0 and "\\u03b3" in shown.stdout, shown.stderr


def test_help_explains_every_field_of_config():
    text = " ".join(cli("train", "--help").stdout.replace("│", " ").split())
    source = inspect.getsource(Config)
    for field in fields(Config):
        comment = re.search(rf"^    {field.name}: .*  # (.*)$", source, re.M)[1]
        flag = "--" + field.name.replace("_", "-")
        assert re.search(rf"{flag} [^-]*{re.escape(comment)}", text), flag
    assert "--out PATH" in text and "--resume PATH" in text


def test_help_names_the_commands():
    text = cli("--help").stdout
    for name in ("train", "watch"):
        assert f"• {name}" in text


def test_help_needs_neither_torch_nor_a_simulator():
    code = ("import sys; from dnddpg_minimal.__main__ import main\n"
            "try: main(['train', '--help'])\n"
            "except SystemExit: print({'torch', 'mujoco', 'pygame', 'pandas',"
            " 'matplotlib'} & set(sys.modules))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          env=os.environ | {"PYTHONUTF8": "1"})
    assert done.stdout.splitlines()[-1] == "set()"


# --- mistakes -------------------------------------------------------------------------


@pytest.mark.parametrize("words, expected", [
    (["--task", "Pendulumm-v1"], "Did you mean 'Pendulum-v1'"),
    (["--task", "CartPole-v1"], "Discrete(2)"),
    (["--algorithm", "DNDDPG"], "Did you mean 'DN-DDPG'"),
    (["--gamma", "3"], "gamma=3.0"),
    (["--steps", "0"], "steps=0"),
    (["--steps", "10", "--episodes", "3"], "give one of the two"),
    (["--critics", "1", "--actors", "2"], "actors <= critics"),
    (["--task-options", "colour=red"], "colour"),
    (["--task-options", "g=abc"], "does not begin with task_options={'g': 'abc'}"),
    (["--task", "Hopper-v5", "--task-options", "frame_skip=0"], "ZeroDivisionError"),
    (["--task", "Hopper-v5", "--task-options", "reset_noise_scale=abc"], "'abc'"),
    (["--buffer-size", "1000000000000"], "at most 1e+09"),
    (["--task", "Humanoid-v5", "--buffer-size", "1000000000"], "not enough memory"),
    (["--out", "no-such-folder/a.npz"], "no-such-folder"),
    (["--resume", "no-such-file.npz"], "no-such-file.npz: No such file"),
])
def test_a_mistake_gets_one_line(capsys, tmp_path, monkeypatch, words, expected):
    monkeypatch.chdir(tmp_path)
    assert expected in fails_in_one_line(capsys, "train", *words)


def test_a_mistake_exits_with_2_and_shows_no_traceback(tmp_path):
    done = cli("train", "--task", "Pendulumm-v1", cwd=tmp_path)
    assert done.returncode == 2
    assert "Pendulumm-v1" in done.stderr and "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [
    ["train", "--gamma", "much"], ["train", "--gama", "0.9"], ["watch"], ["trian"],
    ["train", "--task-options", "goal_area"],
])
def test_what_cannot_be_read_is_refused(capsys, words):
    with pytest.raises(SystemExit) as exit_code:
        main(words)
    assert exit_code.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_foreign_file_is_refused(capsys, tmp_path):
    letter = tmp_path / "letter.npz"
    letter.write_text("Dear reader")
    for words in (["watch"], ["train", "--resume"]):
        assert "letter.npz" in fails_in_one_line(capsys, *words, letter)


def test_a_file_that_exists_is_not_overwritten(capsys, trained):
    file, _ = trained
    before = file.read_bytes()
    said = fails_in_one_line(capsys, "train", "--steps", 100, "--out", file)
    assert "exists" in said and f"--resume {shlex.quote(str(file))}" in said
    assert file.read_bytes() == before


def test_resuming_takes_no_other_choices(capsys, trained):
    file, _ = trained
    # Also what equals a default: the run in the file may have another seed
    for words, name in ((["--gamma", 0.5], "--gamma"), (["--seed=0"], "--seed")):
        said = fails_in_one_line(capsys, "train", "--resume", file, *words)
        assert f"leave {name} out" in said


# --- train ----------------------------------------------------------------------------


def test_train_writes_a_file_that_loads(trained):
    file, done = trained
    training = Training.load(file)
    assert training.finished and training.step == 400 and training.episode == 2
    assert training.config == Config(steps=400, hidden=(8, 8), batch_size=8, warmup=100)
    assert NumpyAgent.load(file).act(np.zeros(3)).shape == (1,)
    mean = np.mean([r.episode_return for r in training.records if r.kind == "episode"])
    assert f"last 2 episodes, exploration noise included: {mean:.1f}" in done.stdout
    assert file.name in done.stdout


def test_the_bar_shows_the_return_and_steps_a_second(trained):
    _, done = trained
    assert re.search(r"400/400 .*steps/s, return -\d+\.\d\]", done.stderr)


def test_options_of_the_task_reach_the_environment(tmp_path, capsys):
    out = tmp_path / "arm.npz"
    assert main(["train", "--task", "ArmEasy-v0", "--steps", "20", *SMALL, "--out",
                 str(out), "--task-options", "goal_area=window",
                 "success_terminates=true"]) == 0
    options = Training.load(out).config.task_options
    assert options == {"goal_area": "window", "success_terminates": True}


def test_checkpoints_are_written_on_the_way(tmp_path, monkeypatch):
    steps = []
    monkeypatch.setattr("dnddpg_minimal.__main__.SAVE_EVERY", 0)
    monkeypatch.setattr(Training, "save", lambda self, path: steps.append(self.step))
    main(["train", "--steps", "450", *SMALL, "--out", str(tmp_path / "a.npz")])
    assert steps == [200, 400, 450]  # at each episode's end, and at the run's end


# --- Ctrl-C ---------------------------------------------------------------------------


def start_and_wait_until_it_learns(*words, cwd):
    """A `train` process that has passed its first records."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dnddpg_minimal", "train", *map(str, words)], cwd=cwd,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"TQDM_MININTERVAL": "0"})
    read = ""
    while not re.search(r"[1-9]\d*/\d+ \[", read):
        character = process.stderr.read(1)
        assert character, f"it ended too early: {read}"
        read += character
    threading.Thread(target=process.stderr.read, daemon=True).start()  # keep it flowing
    return process


@signals
def test_ctrl_c_saves_at_the_episodes_end_and_the_rest_equals_the_whole(tmp_path):
    words = ["--steps", 4000, *SMALL, "--out", "run.npz"]
    process = start_and_wait_until_it_learns(*words, cwd=tmp_path)
    process.send_signal(signal.SIGINT)
    said = process.stdout.read()
    assert process.wait() == 130
    assert said.count("\n") == 1

    stopped = Training.load(tmp_path / "run.npz")
    assert 0 < stopped.step < 4000 and stopped.step % 200 == 0  # Pendulum's episodes
    assert f"saved at step {stopped.step}." in said

    go_on = shlex.split(said.partition("Go on: ")[2])
    subprocess.run(go_on, cwd=tmp_path, check=True, capture_output=True)
    resumed = Training.load(tmp_path / "run.npz")
    whole = Training(resumed.config)
    for _ in whole:
        pass
    assert resumed.step == whole.step == 4000
    for name, array in whole.agent.arrays().items():
        np.testing.assert_array_equal(resumed.agent.arrays()[name], array, name)
    assert [r[:6] for r in resumed.records] == [r[:6] for r in whole.records]


@signals
def test_a_second_ctrl_c_leaves_at_once(tmp_path):
    # An episode of MountainCar lasts 999 steps: seconds, with networks of this size.
    words = ["--task", "MountainCarContinuous-v0", "--hidden", 256, 256, "--warmup", 10,
             "--batch-size", 256, "--yield-every", 20, "--out", "run.npz"]
    process = start_and_wait_until_it_learns(*words, cwd=tmp_path)
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    said = process.stdout.read()
    assert process.wait() == 130
    assert said == "Left at once, before the first checkpoint.\n"
    assert not list(tmp_path.iterdir())


# --- watch ----------------------------------------------------------------------------


def test_watch_writes_a_film_and_prints_the_return(trained, tmp_path):
    file, _ = trained
    done = cli("watch", file, "--film", tmp_path / "film.gif", "--seed", 3)
    assert done.returncode == 0, done.stderr
    assert re.match(r"Seed 3: return -\d+\.\d in 200 steps\n", done.stdout)
    with Image.open(tmp_path / "film.gif") as film:
        assert 50 < film.n_frames <= 200 and max(film.size) <= 300
        assert film.info["duration"] == 30  # ms; Pendulum is drawn 30 times a second
        colours = set()
        for index in range(0, film.n_frames, 20):
            film.seek(index)
            colours |= {colour for _, colour in film.convert("RGB").getcolors()}
    assert 1 < len(colours) <= 32
    assert (tmp_path / "film.gif").stat().st_size < 300_000


def test_a_film_must_be_a_gif(trained, capsys):
    assert ".gif" in fails_in_one_line(capsys, "watch", trained[0], "--film", "a.mp4")


@pytest.mark.parametrize("words", [("--seed", -1), ("--episodes", 0)])
def test_watch_refuses_a_start_and_a_number_that_do_not_exist(trained, capsys, words):
    said = fails_in_one_line(capsys, "watch", trained[0], "--film", "a.gif", *words)
    assert "expected 1 or more" in said


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a display")
def test_without_a_display_watch_asks_for_a_film(trained, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "--film" in fails_in_one_line(capsys, "watch", trained[0])


@pytest.mark.skipif(sys.platform != "linux", reason="a screen is DISPLAY only there")
@pytest.mark.parametrize("task, more", [
    ("Pendulum-v1", {}), ("Pendulum-v1", {"SDL_VIDEODRIVER": "x11"}),
    ("Hopper-v5", {})])
def test_with_a_dead_display_watch_asks_for_a_film(task, more, tmp_path):
    path = tmp_path / "agent.npz"
    make_agent(Config(task), *{"Pendulum-v1": (3, 1), "Hopper-v5": (11, 3)}[task]
               ).save(path)
    strange = {"SDL_VIDEODRIVER", "MUJOCO_GL", "WAYLAND_DISPLAY"}
    env = {k: v for k, v in os.environ.items() if k not in strange}
    said = subprocess.run(
        [sys.executable, "-m", "dnddpg_minimal", "watch", str(path)],
        env=env | more | {"DISPLAY": ":987", "XDG_RUNTIME_DIR": str(tmp_path)},
        capture_output=True, text=True, timeout=60)
    assert said.returncode == 2 and said.stdout == ""
    assert said.stderr.splitlines()[-1].endswith("with --film FILE.gif")
    assert "Traceback" not in said.stderr


def test_closing_the_window_ends_watch(trained, capsys, monkeypatch):
    monkeypatch.setenv("DISPLAY", "none: SDL draws into memory")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    flip, pictures = pygame.display.flip, []

    def close_after_the_third():
        flip()
        pictures.append(1)
        if len(pictures) == 3:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    monkeypatch.setattr(pygame.display, "flip", close_after_the_third)
    assert main(["watch", str(trained[0])]) == 130
    assert len(pictures) == 3
    assert not pygame.display.get_init()  # the window is gone
    assert capsys.readouterr().out == ""


def test_the_command_to_go_on_survives_a_strange_file_name():
    if os.name != "nt":
        line = command("train --resume", "my run's file.npz")
        assert shlex.split(line)[-3:] == ["train", "--resume", "my run's file.npz"]
