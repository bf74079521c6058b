"""Films of an agent: an episode, its pictures, a GIF and a strip of ten pictures.

| call | meaning |
|---|---|
| `play(agent, env, seed)` | one greedy episode, step by step |
| `make_camera_env(config)` | an environment that draws without a window |
| `write_film(path, pictures, seconds)` | a GIF |
| `film(task, algorithm, ...)` | GIF and PNG of a recorded agent |
| `film_all(folder)` | of every recorded agent that the book shows |
"""

import math
import os
import sys
import warnings
from itertools import islice
from pathlib import Path

import numpy as np

from dnddpg_minimal.dnddpg import is_mujoco, make_env, to_env
from dnddpg_minimal.records import FILMED, RECORDINGS, load_agent_at, load_study

FILM_LENGTH = 200  # pictures at most
FILM_WIDTH = 300  # pixels at most
SECONDS, FRAMES, WIDTH = 10, 100, 200  # of a film of the study, at most
FILM_COLOURS = 32
SHORTEST_PICTURE = 20  # milliseconds; viewers slow down a film that is faster


def play(agent, env, seed):
    """One greedy episode of an agent in env, without noise; yields each step's reward.

    `seed` is that of its start, as in `env.reset`.
    """
    obs, _ = env.reset(seed=seed)
    over = False
    while not over:
        action = to_env(agent.act(obs), env.action_space)
        obs, reward, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        yield float(reward)


def write_film(path, pictures, seconds, width=FILM_WIDTH):
    """Write the pictures, each (height, width, 3) uint8, to the GIF at `path`.

    seconds: how long each picture stays; width: in pixels, at most.
    """
    from PIL import Image

    small = [Image.fromarray(picture) for picture in pictures]
    for image in small:
        image.thumbnail((width, width))
    samples = small[:: math.ceil(len(small) / 10)]
    width, height = small[0].size
    strip = Image.new("RGB", (width, height * len(samples)))
    for row, image in enumerate(samples):
        strip.paste(image, (0, row * height))
    palette = strip.quantize(FILM_COLOURS)
    none = Image.Dither.NONE  # dithering flickers, and does not compress
    first, *rest = [image.quantize(palette=palette, dither=none) for image in small]
    milliseconds = max(SHORTEST_PICTURE, round(1000 * seconds))
    first.save(path, save_all=True, append_images=rest, duration=milliseconds, loop=0)


def make_camera_env(config):
    """An environment of `config.task` that draws without a window.

    ValueError if that can't be done, with what is missing.
    """
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # before pygame is imported
    if not has_display():
        os.environ.setdefault("MUJOCO_GL", "egl")  # before mujoco is imported
    try:
        env = make_env(config, render_mode="rgb_array")
        if is_mujoco(env):  # MuJoCo on a CPU: 4 times as fast without
            quality = env.unwrapped.model.vis.quality  # fine shadows and fine edges,
            quality.shadowsize, quality.offsamples = 512, 0  # and shrinking smooths too
            follow_with_camera(env.unwrapped)
        env.reset(seed=0)
        if env.render() is None:
            raise ValueError(f"task={config.task!r} draws no pictures")
    except ValueError:
        raise
    except Exception as error:  # each library has its own for "no graphics here"
        sys.unraisablehook = lambda _: None  # half-made viewers fail again when deleted
        raise ValueError(
            f"no picture of {config.task!r} can be made here ({error}). Without a "
            "display MuJoCo needs EGL (Debian: libegl1, libgl1-mesa-dri).") from error
    return env


def follow_with_camera(env):
    """Look at env, of MuJoCo, through the model's own camera "track", if it has one.

    Gymnasium 1.4 looks through a free camera, from which HalfCheetah runs away.
    """
    for i in range(env.model.ncam):
        if env.model.camera(i).name == "track":
            env.mujoco_renderer.camera_id = i


def has_display():
    """False on a Linux that has no screen to open a window on."""
    return sys.platform != "linux" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_display():
    """ValueError if no window can be opened here."""
    if not has_display():
        raise ValueError("there is no display to open a window on: "
                         "write a film instead, with --film FILE.gif")


def check_window(env):
    """ValueError if env's window would open nowhere: DISPLAY may name a dead screen."""
    if is_mujoco(env):
        import glfw

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the sentence below says it
            opened = glfw.init()
    else:
        import pygame

        nowhere = {"offscreen", "dummy"} - {os.environ.get("SDL_VIDEODRIVER")}
        try:
            pygame.display.init()
            opened = pygame.display.get_driver() not in nowhere
        except pygame.error:
            opened = False
    if not opened:
        raise ValueError(f"no window opens on DISPLAY={os.environ.get('DISPLAY')}: "
                         "write a film instead, with --film FILE.gif")


def window_closed(env):
    """Has the user closed the window that `env` draws in? (Gymnasium does not look.)"""
    if is_mujoco(env):
        import glfw

        viewer = env.unwrapped.mujoco_renderer.viewer
        return bool(glfw.window_should_close(viewer.window))
    import pygame

    return pygame.display.get_init() and pygame.event.peek(pygame.QUIT)


def film(task, algorithm="DN-DDPG", variant="class", seed=0, folder=None):
    """Film a recorded agent from the start with seed 0, without noise.

    One episode, at most its first ten seconds: that is enough to see a gait.
    Writes films/<task>-<variant>-<algorithm>.gif, and a strip of ten pictures as .png,
    into the folder of the recordings. Returns both paths. ValueError where no weights
    are recorded, or no picture can be made.
    """
    from PIL import Image

    folder = Path(folder or RECORDINGS)
    weights = [one for one in load_study(task, algorithm, variant, "weights", folder)
               if one["seed"] == seed]
    if not weights:
        name = f"{task}/{variant}/{algorithm}-{seed}"
        raise ValueError(f"{folder} holds no weights of {name}")
    agent = load_agent_at(weights[0])
    env = make_camera_env(agent.config)
    fps = env.metadata.get("render_fps", 30)
    length = sum(1 for _ in islice(play(agent, env, seed=0), SECONDS * fps))
    every = -(-length // FRAMES)
    again = islice(play(agent, env, seed=0), length)
    images = [env.render() for step, _ in enumerate(again) if step % every == 0]
    env.close()
    path = folder / "films" / f"{task}-{variant}-{algorithm}.gif"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_film(path, images, every / fps, WIDTH)
    chosen = [Image.fromarray(images[i]).resize((150, 150), Image.Resampling.LANCZOS)
              for i in np.linspace(0, len(images) - 1, 10).astype(int)]
    strip = Image.new("RGB", (150 * len(chosen), 150))
    for i, image in enumerate(chosen):
        strip.paste(image, (150 * i, 0))
    strip.quantize(64).save(path.with_suffix(".png"), optimize=True)
    return path, path.with_suffix(".png")


def film_all(folder=None):
    """Film the recorded agents that the book shows; says which could not be.

    `folder` holds recordings, by default those of the package. Returns the exit code: 1
    if nothing could be filmed.
    """
    filmed = 0
    for name in FILMED:
        task, variant, file = name.split("/")
        algorithm, seed = file.rsplit("-", 1)
        try:
            print(*film(task, algorithm, variant, int(seed), folder))
            filmed += 1
        except ValueError as error:
            print(f"no film: {error}", file=sys.stderr)
    return 0 if filmed else 1
