"""The command line: `python -m dnddpg_minimal train | watch | study | ...`.

`train` and `watch` are below; every other command is the `main(argv)` of the module of
its name, imported only when asked for. A user's mistake gets one line on the error
stream and exit code 2, never a traceback.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tqdm import tqdm

from dnddpg_minimal.dnddpg import Config, NumpyAgent, Training, make_env
from dnddpg_minimal.films import (
    FILM_LENGTH,
    check_display,
    check_window,
    make_camera_env,
    play,
    window_closed,
    write_film,
)

SAVE_EVERY = 120  # seconds between two checkpoints
INTERRUPTED = 130  # exit code of a program that Ctrl-C ended


# --- train ----------------------------------------------------------------------------


def train(
    config: Annotated[Config, tyro.conf.arg(name="")],
    out: Path | None = None,
    resume: Path | None = None,
) -> int:
    """Train one agent and save the run.

    A default of None means: from the task's preset, or no limit. Ctrl-C finishes the
    episode, saves, and says how to go on; a second Ctrl-C leaves at once. A file that
    exists is refused, and so is --resume with other options.

    Args:
        config: every choice of the run.
        out: file to write (.npz); None: TASK-ALGORITHM-SEED.npz in the current folder.
        resume: go on with the run in this file, as if it had never stopped.
    """
    if out is None:
        name = f"{config.task}-{config.algorithm}-{config.seed}.npz".replace("/", "-")
        out = resume or Path(name)
    if out != resume and out.exists():
        raise ValueError(f"{out} exists. Name another file by --out, or go on with "
                         f"it: {command('train --resume', out)}")
    check_can_write(out)
    if resume is None:
        try_out(config)
        return run(Training(config), out)
    return run(Training.load(resume), out)


def try_out(config):
    """ValueError where the task does not begin, whatever it raises."""
    try:
        with closing(make_env(config)) as env:
            env.reset(seed=0)
            env.step(env.action_space.sample())
    except ValueError:  # our own sentence, or the task's
        raise
    except Exception as error:
        raise ValueError(f"task={config.task!r} does not begin with task_options="
                         f"{config.task_options}: {type(error).__name__}: {error}."
                         ) from error


def described(config):
    """One line: what a run of this config is, presets filled in."""
    end = (f"{config.steps:,} steps" if config.episodes is None else
           f"{config.episodes:,} episodes")
    layers = "-".join(map(str, config.hidden))
    return (f"{config.algorithm} on {config.task}, seed {config.seed}: {end}, layers "
            f"{layers}, batch {config.batch_size}, γ {config.gamma:g}, τ "
            f"{config.tau:g}, {config.noise} noise {config.sigma:g}")


def run(training, out):
    """Go on with a training to its end, or to Ctrl-C; save it to `out` → exit code."""
    go_on = command("train --resume", out)
    saved_at = time.monotonic()
    print(described(training.config), file=sys.stderr)  # where the bar is
    scale = dict(total=training.config.steps, initial=training.step, unit=" steps")
    with Interrupt() as interrupt, tqdm(**scale) as bar:
        try:
            for record in training:
                bar.update(record.step - bar.n)
                if interrupt.asked:
                    bar.set_description_str("Ctrl-C: finishing the episode")
                if record.kind != "episode":
                    continue
                bar.set_postfix_str(f"return {record.episode_return:.1f}", False)
                if interrupt.asked:
                    break
                if time.monotonic() - saved_at > SAVE_EVERY:
                    training.save(out)
                    saved_at = time.monotonic()
            training.save(out)
        except KeyboardInterrupt:
            bar.close()
            print(f"Left at once. Go on from the last checkpoint: {go_on}"
                  if out.exists() else "Left at once, before the first checkpoint.")
            return INTERRUPTED
    if not training.finished:
        print(f"Stopped and saved at step {training.step}. Go on: {go_on}")
        return INTERRUPTED
    returns = [r.episode_return for r in training.records if r.kind == "episode"][-10:]
    print(f"Done: {training.step} steps, {training.episode} episodes, saved in {out}")
    if returns:
        print(f"Mean return of the last {len(returns)} episodes, exploration noise "
              f"included: {np.mean(returns):.1f}")
    print(f"See it: {command('watch', out)}")
    return 0


class Interrupt:
    """Inside `with`, the first Ctrl-C only sets `asked`; the second one interrupts."""

    def __enter__(self):
        self.asked = False
        self.before = signal.signal(signal.SIGINT, self.ask)
        return self

    def __exit__(self, *_):
        signal.signal(signal.SIGINT, self.before)

    def ask(self, *_):
        """Called by the signal."""
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


# --- watch ----------------------------------------------------------------------------


def watch(
    file: Annotated[Path, tyro.conf.Positional],
    film: Path | None = None,
    episodes: int = 1,
    seed: int = 0,
) -> int:
    """Show a saved agent at work, in a window or as a film, and print its return.

    The agent acts without exploration noise. Fewer than one episode, or a seed below 0,
    is refused.

    Args:
        file: what `train` saved, or an agent's own file.
        film: write a film to this file (.gif) instead of opening a window.
        episodes: how many to show.
        seed: of the first episode's start; the next episode has the next number.
    """
    if episodes < 1 or seed < 0:
        raise ValueError(f"episodes={episodes}, seed={seed}: expected 1 or more, and 0 "
                         "or more.")
    agent = NumpyAgent.load(file)  # also opens a PyTorch agent, and needs no PyTorch
    starts = range(seed, seed + episodes)
    if film is None:
        check_display()
        with closing(make_env(agent.config, render_mode="human")) as env:
            check_window(env)
            for start in starts:
                show(agent, env, start)
        return 0
    check_can_write(film, suffix=".gif")
    with closing(make_camera_env(agent.config)) as env:
        steps = sum(show(agent, env, start) for start in starts)
        every = math.ceil(steps / FILM_LENGTH)  # a picture every so many steps
        pictures = [env.render() for start in starts
                    for step, _ in enumerate(play(agent, env, start))
                    if step % every == 0]
        seconds = every / env.metadata.get("render_fps", 30)
    write_film(film, pictures, seconds)
    print(f"The film: {film}")
    return 0


def show(agent, env, start):
    """Play one episode of an agent in env and print its return → its number of steps.

    start: the seed of its start.

    A window that its user closes ends the command, as Ctrl-C does.
    """
    rewards = []
    for reward in play(agent, env, start):
        rewards.append(reward)
        if env.render_mode == "human" and window_closed(env):
            raise KeyboardInterrupt
    print(f"Seed {start}: return {sum(rewards):.1f} in {len(rewards)} steps")
    return len(rewards)


# --- the commands ---------------------------------------------------------------------

ELSEWHERE = {
    "study": "Run, resume and list the recorded study.",
    "benchmark": "Measure the speed, side by side with a peer.",
    "check": "Run an exercise notebook, and print its points.",
    "book": "Run chapters and write what they show, or measure how long they take.",
}


def main(argv: list[str] | None = None) -> int:
    """Run one command. argv: the words after `python -m dnddpg_minimal` → exit code."""
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        check_resume(argv)
        if argv and argv[0] in ELSEWHERE:
            module = importlib.import_module(f"dnddpg_minimal.{argv[0]}")
            return module.main(argv[1:])
        app = tyro.extras.SubcommandApp()
        app.command(train)
        app.command(watch)
        for name, text in ELSEWHERE.items():
            app.command(lambda: 0, name=name, help=text)
        return app.cli(
            args=argv,
            prog="python -m dnddpg_minimal",
            description="DDPG, a second critic, a second actor, and how wrong Q is.",
            config=(tyro.conf.DisallowNone,),
            registry=task_options_registry(),
        )
    except (ValueError, OSError, ImportError) as error:
        print(f"dnddpg_minimal: {in_words(error)}", file=sys.stderr)
        return 2
    except MemoryError as error:
        print(f"dnddpg_minimal: not enough memory: {in_words(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED


def check_resume(argv):
    """ValueError for an option of the run in `argv`, beside --resume."""
    options = {word.partition("=")[0] for word in argv if word.startswith("--")}
    others = options - {"--resume", "--out", "--help"}
    if "--resume" in options and others:
        raise ValueError("--resume goes on with a run as it was configured: leave "
                         f"{', '.join(sorted(others))} out.")


def task_options_registry():
    """Teach tyro `--task-options NAME=VALUE ...`."""
    registry = tyro.constructors.ConstructorRegistry()

    @registry.primitive_rule
    def rule(info):
        if info.type != (dict[str, Any] | None):
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs="*",
            metavar="NAME=VALUE ...",
            instance_from_str=task_options,
            is_instance=lambda value: value is None or isinstance(value, dict),
            str_from_instance=lambda value: [str(value)],  # for --help: "None"
        )

    return registry


def task_options(words):
    """Words such as "goal_area=window" → a dict; values as in JSON, else text.

    ValueError for a word that is not NAME=VALUE.
    """
    options = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name and equals):
            raise ValueError(f"task_options: expected NAME=VALUE, got {word!r}")
        try:
            options[name] = json.loads(value)
        except json.JSONDecodeError:
            options[name] = value  # a bare word is text
    return options


def command(words, path):
    """The command line that runs `words` on the file `path`, as one would type it."""
    line = [sys.orig_argv[0], "-m", "dnddpg_minimal", *words.split(), str(path)]
    return subprocess.list2cmdline(line) if os.name == "nt" else shlex.join(line)


def check_can_write(path, suffix=None):
    """ValueError if `path` can't be written, or has another suffix.

    Better now than after the run.
    """
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(f"{path}: there is no folder {folder}")
    if path.is_dir() or not os.access(folder, os.W_OK):
        raise ValueError(f"{path} can't be written here")
    if suffix and path.suffix.lower() != suffix:
        raise ValueError(f"{path}: expected a name that ends in {suffix}")


def in_words(error):
    """An error, an exception, as one line."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    for stream in (sys.stdout, sys.stderr):  # a file on Windows may know no γ
        stream.reconfigure(errors="backslashreplace")
    raise SystemExit(main())
