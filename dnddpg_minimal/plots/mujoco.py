"""Figures of chapter 09: the four bodies, states put back, runs on MuJoCo's tasks.

The labelled pictures of the bodies are files in notebooks/figures/. Made anew by

    python -c "from dnddpg_minimal.plots import write_bodies as write;
    write('notebooks/figures')"
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patheffects import withStroke

from dnddpg_minimal.dnddpg import ALGORITHMS, MUJOCO_TASKS, Config
from dnddpg_minimal.plots.ddpg import plot_learning
from dnddpg_minimal.plots.style import (
    MARKS,
    ONE,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    pale,
    panels,
)

CAMERA = dict(azimuth=90, elevation=-8)  # from the side, a little from above, degrees
CAMERAS = {  # task: distance in metres, and the point looked at
    "HalfCheetah-v5": dict(distance=1.9, lookat=(0.06, 0, 0.42)),
    "Hopper-v5": dict(distance=2.3, lookat=(0, 0, 0.68)),
    "Walker2d-v5": dict(distance=2.3, lookat=(0, 0, 0.68)),
    "Humanoid-v5": dict(distance=2.5, lookat=(0, 0, 0.85), azimuth=180),
}
ASTRIDE = {"Walker2d-v5": (0, -0.03, 0, -0.25, 0, 0, 0.35, -0.35, 0)}  # joints, radians
OVER_UNDER = "Q − truth\n(over ↑, under ↓)"


# --- The bodies -----------------------------------------------------------------------


def photograph(task, size=420):
    """A picture of a task's body at its start, and where its joints are in it.

    Returns the picture (size, size, 3) uint8, and a dict from a label to (x, y) in
    pixels. A label holds the place of a motor in the action (a0, a1, …), the joint's
    name, and the places of its angle and of its velocity in the observation (s0, s1,
    …); the first one is the torso's. ValueError where no picture can be made.
    """
    from dnddpg_minimal.films import make_camera_env

    camera = {"trackbodyid": -1} | CAMERA | CAMERAS[task]
    options = dict(width=size, height=size, default_camera_config=camera)
    env = make_camera_env(Config(task, task_options=options))
    import mujoco  # after the camera, which says how it is to draw

    body = env.unwrapped
    model = body.model
    model.mat_reflectance[:] = 0
    model.geom_matid[0], model.geom_rgba[0] = -1, (0.5, 0.5, 0.5, 1)  # a plain floor
    model.vis.headlight.ambient[:] = 0.45
    # Walker2d's legs hide each other where it starts: a step apart
    body.set_state(body.init_qpos + ASTRIDE.get(task, 0), body.init_qvel)
    viewer = body.mujoco_renderer.viewer
    viewer.scn.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = 0  # the sky is black: to white
    picture = env.render().copy()
    picture[(picture == 0).all(axis=2)] = 255
    view = viewer.scn.camera  # of the left and of the right eye
    torso = tuple(project(view, body.data.xipos[1], size))
    found = {}
    for i, (joint, _) in enumerate(model.actuator_trnid):
        place = tuple(project(view, body.data.xanchor[joint], size))
        found.setdefault(place, []).append((i, model.joint(joint).name,
                                            *places_in_obs(body, joint)))
    env.close()
    return picture, {torso_label(body): torso} | {
        label(motors): place for place, motors in found.items()}


def places_in_obs(body, joint):
    """Two indices: where a body's joint, an index too, has its angle and its velocity.

    Both count in the observation.
    """
    parts, model = body.observation_structure, body.model
    return (int(model.jnt_qposadr[joint]) - parts["skipped_qpos"],
            int(model.jnt_dofadr[joint]) + parts["qpos"])


def torso_label(body):
    """What the observation holds of a body's torso, and what it leaves out."""
    hidden, n = (body.observation_structure[name] for name in ("skipped_qpos", "qpos"))
    if hidden == 1:
        return f"torso: height s0, tilt s1\nspeeds s{n}–s{n + 2}, not seen: x"
    return f"torso: height s0, turn s1–s4\nspeeds s{n}–s{n + 5}, not seen: x, y"


def project(view, point, size):
    """Where a point of the world (3,), metres, lies in a square picture: (2,) pixels.

    The picture's side has `size` pixels. `view` holds MuJoCo's two cameras
    (mjvGLCamera), one for each eye; a flat picture is taken from their middle. A camera
    is a pinhole; `frustum_near` in front of it stands a window of half height
    `frustum_top`.
    """
    one = view[0]
    right = np.cross(one.forward, one.up)
    away = np.asarray(point) - (view[0].pos + view[1].pos) / 2
    scale = one.frustum_near / (away @ one.forward) / one.frustum_top
    return size / 2 * (1 + scale * np.array([away @ right, -(away @ one.up)]))


NAMES = {"thigh_left_joint": "left thigh", "leg_left_joint": "left leg",
         "foot_left_joint": "left foot",
         "bthigh": "back thigh", "bshin": "back shin", "bfoot": "back foot",
         "fthigh": "front thigh", "fshin": "front shin", "ffoot": "front foot"}


def label(motors):
    """Two lines: motors and joint, then their places in the observation."""
    numbers, names, angles, speeds = zip(*motors)
    names = [NAMES.get(name, name.replace("_joint", "").replace("_", " "))
             for name in names]
    stem = names[0].rstrip("xyz12").strip() if len(names) > 1 else names[0]
    ends = ", ".join(name.removeprefix(stem).strip() for name in names)
    alike = len(names) > 1 and all(name.startswith(stem) for name in names)
    joint = f"{stem} {ends}" if alike and stem != names[0] else ", ".join(names)

    def several(letter, indices):
        in_a_row = list(indices) == list(range(indices[0], indices[0] + len(indices)))
        if len(indices) > 1 and in_a_row:
            return f"{letter}{indices[0]}–{letter}{indices[-1]}"
        return ", ".join(f"{letter}{i}" for i in indices)

    plural = "s" if len(names) > 1 else ""
    return (f"{several('a', numbers)}: {joint}\nangle{plural} {several('s', angles)}, "
            f"speed{plural} {several('s', speeds)}")


def spread(wanted, low, high, gap):
    """The wanted places (N,), sorted, moved as little as it takes to stand `gap` apart.

    They lie between `low` and `high`; if there is no room, the first ones below `low`.
    """
    places = np.clip(np.array(wanted, float), low, high)
    for i in range(1, len(places)):
        places[i] = max(places[i], places[i - 1] + gap)
    places[-1:] = np.minimum(places[-1:], high)
    for i in range(len(places) - 1, 0, -1):
        places[i - 1] = min(places[i - 1], places[i] - gap)
    return places


def plot_body(picture, joints, ax=None, title=""):
    """A body, and labels beside it, each with a line to its joint.

    picture (H, W, 3) uint8; joints: a dict from a label to (x, y) in pixels.
    """
    height, width, _ = picture.shape
    if ax is None:
        _, ax = plt.subplots(figsize=(7.6, 3.4))
        ax.set_position([0.28, 0.01, 0.44, 0.98])
    ax.imshow(picture)
    line = dict(arrowstyle="-", color="black", linewidth=0.9, shrinkA=1, shrinkB=0)
    outline = [withStroke(linewidth=2.5, foreground="white")]
    ordered = sorted(joints.items(), key=lambda one: (round(one[1][0]), one[1][1]))
    half = (len(ordered) + 1) // 2
    for side, part in ((0, ordered[:half]), (1, ordered[half:])):
        part.sort(key=lambda one: one[1][1])
        wanted = [place[1] for _, place in part]
        places = spread(wanted, 0.06 * height, 0.94 * height, 0.13 * height)
        for (text, place), y in zip(part, places):
            note = ax.annotate(
                text, place, (width * (1.03 if side else -0.03), y), va="center",
                ha="left" if side else "right", fontsize=8, annotation_clip=False,
                arrowprops=line)
            note.arrow_patch.set_path_effects(outline)
            ax.plot(*place, "o", markersize=5, color="white", markeredgecolor="black")
    ax.set(title=title, xlim=(0, width), ylim=(height, 0))
    ax.set_axis_off()
    return ax


def write_bodies(folder):
    """Photograph and label the four bodies → the PNG files' paths, in `folder`."""
    from PIL import Image

    paths = []
    for task in MUJOCO_TASKS:
        name = task.partition("-")[0]
        ax = plot_body(*photograph(task))
        path = Path(folder) / f"09_{name.lower()}.png"
        ax.figure.savefig(path, dpi=100)
        plt.close(ax.figure)
        Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)
        paths.append(path)
    return paths


# --- States put back ------------------------------------------------------------------


def plot_restored(gaps, axes=None, title=""):
    """How far a world that was put back is from the one it should repeat.

    gaps: a dict from a task to a dict from a way of putting back to (T,): the largest
    difference in observation and reward after 1, 2, … T steps of the same actions.
    Below 1e-16 the scale says 0.
    """
    floor = 1e-16
    axes = panels(axes, title, 1, len(gaps), figsize=(7.4, 2.6), sharey=True)
    for ax, (task, ways) in zip(np.ravel(axes), gaps.items()):
        for (way, gap), style in zip(ways.items(), (ONE, TWO, THREE)):
            gap = np.maximum(gap, floor)
            ax.plot(1 + np.arange(len(gap)), gap, label=way, **style)
        ax.set_title(task, loc="center", fontsize=9)
        ax.set(yscale="log", xlabel="steps afterwards")
    first = np.ravel(axes)[0]
    first.set_ylim(floor / 3, 1e3)
    ticks = [floor, 1e-12, 1e-8, 1e-4, 1]
    first.set_yticks(ticks, ["0", *(f"$10^{{{np.log10(t):.0f}}}$" for t in ticks[1:-1]),
                             "1"])
    first.set_yticks([], minor=True)
    first.set_ylabel("largest difference")
    first.figure.legend(*first.get_legend_handles_labels(), loc="outside lower center",
                        ncols=3)
    return axes


def plot_live(episodes, evaluations, q, truth, random, axes=None, title=""):
    """A run's learning curve, and beside it Q against the truth in states put back.

    episodes, evaluations, random: as in `plot_learning`; q, truth: as in `plot_kept`.
    """
    axes = panels(axes, title, 1, 2, figsize=(7.4, 3), width_ratios=(5, 4))
    plot_learning(episodes, evaluations, random, ax=axes[0])
    axes[0].legend(loc="upper left", fontsize=8)
    axes[0].set_ylim(top=1.35 * axes[0].get_ylim()[1])
    axes[0].xaxis.set_major_locator(plt.MaxNLocator(4))
    plot_kept(q, truth, ax=axes[1])
    return axes


def plot_kept(q, truth, ax=None, title=""):
    """What a critic says of N states, against what is true: a mark for each state.

    q, truth (N,). On the line the critic is right; above it overestimates.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(3.4, 3.1), layout="constrained")
    both = np.concatenate([q, truth])
    room = 0.05 * np.ptp(both)
    limits = both.min() - room, both.max() + room
    ax.plot(limits, limits, **TRUTH)
    ax.plot(truth, q, "o", markersize=4.5, markerfacecolor="white",
            markeredgecolor=STYLE["DDPG"]["color"])
    for place, text, sides in (((0.03, 0.97), "overestimates", ("left", "top")),
                               ((0.97, 0.03), "underestimates", ("right", "bottom"))):
        ax.annotate(text, place, xycoords="axes fraction", ha=sides[0], va=sides[1],
                    fontsize=8.5)
    ax.set(title=title, xlabel="truth, 500 steps of the simulator", xlim=limits,
           ylim=limits, ylabel="Q")
    return ax


# --- Recorded runs --------------------------------------------------------------------


def draw_runs(ax, table, column):
    """A column of a table, by algorithm: each seed thin, their mean thick."""
    for name in ALGORITHMS:
        runs = table[table.algorithm == name]
        if len(runs) == 0:
            continue
        seeds = runs.pivot(index="step", columns="seed", values=column)
        style = STYLE[name]
        alone = seeds.shape[1] == 1  # one seed is its own mean
        if not alone:
            ax.plot(seeds.index, seeds, color=pale(style["color"], 0.55),
                    linewidth=0.6, zorder=1)
        # The mean only where all seeds were measured: else it jumps
        mean = seeds.mean(axis=1, skipna=False)
        ax.plot(seeds.index, mean, label=name, linewidth=1.1,
                **style)


def finish(axes, table):
    """Titles, ticks, one legend below the figure; axes (rows, 4), a column per task.

    Where `table` has no row of a task, its panels say so.
    """
    for column, task in zip(axes.T, MUJOCO_TASKS):
        column[0].set_title(task, loc="center", fontsize=9)
        if not (table.task == task).any():
            for ax in column:
                say_missing(ax)
    for ax in axes[-1]:
        ax.set_xlabel("steps / 1000")
        ax.xaxis.set_major_locator(plt.MaxNLocator(3))
        ax.xaxis.set_major_formatter(lambda x, _: f"{x / 1000:.0f}")
    for ax in np.ravel(axes):
        ax.tick_params(labelsize=8)
    one_legend(axes)


def say_missing(ax):
    """An empty panel that says why it is empty."""
    ax.annotate("not recorded\nyet", (0.5, 0.5), ha="center", fontsize=9,
                xycoords="axes fraction", color="0.4")
    ax.set_axis_off()


def one_legend(axes):
    """One legend below all panels of a figure; algorithms first, in their order."""
    found = {}
    for ax in np.ravel(axes):
        handles, labels = ax.get_legend_handles_labels()
        found |= dict(zip(labels, handles))
    names = [name for name in ALGORITHMS if name in found]
    names += [name for name in found if name not in names]
    ax.figure.legend([found[name] for name in names], names, ncols=5,
                     loc="outside lower center")


def plot_returns(table, title=""):
    """Recorded returns, one panel per task: each seed thin, their mean thick.

    table: evaluations from `load_study`, any tasks and algorithms. Returns axes (1, 4).
    """
    axes = panels(None, title, 1, 4, figsize=(7.6, 2.6), sharex=True, squeeze=False)
    for ax, task in zip(axes[0], MUJOCO_TASKS):
        draw_runs(ax, table[table.task == task], "mean")
    axes[0, 0].set_ylabel("return of an episode")
    finish(axes, table)
    return axes


def plot_lag(table, frozen_at=None, title=""):
    """Bias above, and below it what is owed to lag, on the same scale.

    table: rows of bias from `load_study`, one per run and evaluation. frozen_at: the
    step after which the actors did not learn any more; drawn grey. Returns axes (2, 4).
    """
    axes = panels(None, title, 2, 4, figsize=(7.6, 3.9), sharex=True)
    for column, task in zip(axes.T, MUJOCO_TASKS):
        runs = table[table.task == task]
        if len(runs) == 0:
            continue
        shown = runs[["bias", "owed"]].to_numpy()
        low, high = np.nanmin(shown), np.nanmax(shown)
        room = 0.06 * (high - low)
        for ax, what in zip(column, ("bias", "owed")):
            ax.axhline(0, **TRUTH)
            draw_runs(ax, runs, what)
            ax.set_ylim(low - room, high + room)
            if frozen_at is not None:
                ax.axvspan(frozen_at, runs.step.max(), color="0.92", linewidth=0,
                           zorder=0, label="actors frozen")
    axes[0, 0].set_ylabel(OVER_UNDER, fontsize=8.5)
    axes[1, 0].set_ylabel("owed to lag alone", fontsize=8.5)
    finish(axes, table)
    return axes


def plot_runs(scores, title=""):
    """Return against bias, one panel per task, one mark per run.

    scores: a DataFrame over (task, algorithm, seed) with "return" and "bias"; a filled
    mark is the mean of two or more runs of an algorithm.
    """
    axes = panels(None, title, 1, 4, figsize=(7.6, 2.7))
    for ax, task in zip(axes, MUJOCO_TASKS):
        ax.set_title(task, loc="center", fontsize=9)
        ax.set_xlabel("Q − truth", fontsize=8.5)
        ax.tick_params(labelsize=8)
        if task not in scores.index.get_level_values("task"):
            say_missing(ax)
            continue
        ax.axvline(0, **TRUTH)
        for name, runs in scores.loc[task].groupby("algorithm", sort=False):
            colour = STYLE[name]["color"]
            ax.plot(runs["bias"], runs["return"], MARKS[name], markersize=5,
                    markerfacecolor="white", markeredgecolor=colour, label=name)
            if len(runs) > 1:
                ax.plot(runs["bias"].mean(), runs["return"].mean(), MARKS[name],
                        markersize=8, color=colour)
        ax.margins(0.15)
    axes[0].set_ylabel("return of an episode")
    one_legend(axes)
    return axes
