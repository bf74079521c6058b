"""Figures of chapter 03: replay, learning, the truth and the error over a plane."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.style import (
    ERRORS,
    GREY,
    SIGN,
    STYLE,
    TRUTH,
    VALUES,
    WRONG,
    angle_ticks,
    draw_lines,
    draw_map,
    is_angle,
    legend_below,
    note_level,
    pale,
    panels,
    shrink,
    thousands,
)


def plot_memory(memory, batches, axes=None):
    """Batches of states, each over the same memory. One panel per batch.

    memory (N, 2): angle in radians and velocity in radians per second; batches: a
    dict from a panel's title to rows (B,) of memory.
    """
    if axes is None:
        _, axes = plt.subplots(1, len(batches), figsize=(6.6, 2.7), sharey=True,
                               layout="constrained")
    for ax, (title, rows) in zip(np.ravel(axes), batches.items(), strict=True):
        ax.plot(*memory.T, "s", color="0.8", markersize=1.6, markeredgewidth=0)
        ax.plot(*memory[rows].T, "o", color=STYLE["DDPG"]["color"], markersize=4,
                markeredgewidth=0)
        ax.set(title=title, xlabel="angle (0 is upright)")
        angle_ticks(ax)
    np.ravel(axes)[0].set_ylabel("velocity")
    return axes


def plot_q(curves, truth, ax=None, title=""):
    """Q during training: a line for each run, a black line for the truth.

    curves: a dict from a label to (updates (M,), q (M,)); truth: one number.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3), layout="constrained")
    ax.axhline(truth, **TRUTH)
    note_level(ax, truth, "truth")
    draw_lines(ax, curves)
    ax.set(title=title, xlabel="updates", ylabel="Q")
    ax.margins(y=0.12)
    return ax


def plot_bias(curves, predicted=None, ax=None, title=""):
    """Q − truth during training: a line for each run, a black line at zero.

    curves: a dict from a label to (updates (M,), bias (M,)); predicted: a dict from a
    label to one bias, drawn as a thin grey line.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    ax.axhline(0, **TRUTH)
    note_level(ax, 0, SIGN)
    for label, level in (predicted or {}).items():
        ax.axhline(level, color=GREY, linewidth=1)
        note_level(ax, level, label, above=level == max(predicted.values()))
    draw_lines(ax, curves)
    ax.set(title=title, xlabel="updates", ylabel="bias = Q − truth")
    ax.margins(y=0.12)
    return ax


def plot_learning(records, evaluations, random=None, ax=None, title=""):
    """Returns during training: each episode as a dot, evaluations as a line.

    records: `Record`s of kind "episode", played with noise. evaluations: the dicts
    `Measurement.evaluation`; the bar is two standard errors over their n starts.
    random: the return of random actions.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3.1), layout="constrained")
    name = evaluations[0]["algorithm"]
    ax.plot([r.step for r in records], [r.episode_return for r in records], "o",
            color=GREY, markersize=3, label="an episode of training, with noise")
    columns = ("step", "mean", "standard_error")
    step, mean, error = np.array([[e[c] for c in columns] for e in evaluations]).T
    ax.errorbar(step, mean, 2 * error, linewidth=1.8, marker="o", markersize=4,
                label=f"{name} without noise, mean of {evaluations[0]['n']} starts",
                **STYLE.get(name, {}))
    if random is not None:
        ax.axhline(random, color=GREY, linestyle=":")
        note_level(ax, random, "random actions")
    ax.set(title=title, xlabel="environment steps", ylabel="return of an episode")
    thousands(ax)
    legend_below(ax)
    return ax


def plot_ablations(runs, whole, axes=None, title=""):
    """What becomes of the return when one part is taken out: a panel for each part.

    runs: a dict from a panel's title to (steps (M,), returns (S, M)), a thin line for
    each of S seeds and their mean; whole: (steps, returns) with nothing taken out, its
    mean alone, in every panel.
    """
    axes = panels(axes, title, 1, len(runs), figsize=(6.8, 2.5), sharey=True)
    flat = np.ravel(axes)
    for ax, (name, (steps, returns)) in zip(flat, runs.items(), strict=True):
        ax.plot(steps, returns.T, color=pale(WRONG["color"], 0.7), linewidth=0.7)
        ax.plot(whole[0], whole[1].mean(axis=0), linewidth=1.8, label="whole DDPG",
                **STYLE["DDPG"])
        ax.plot(steps, returns.mean(axis=0), label="one part missing", **WRONG)
        ax.set_title(f"{name} (n = {len(returns)})", loc="center", fontsize=9)
        ax.set(xlabel="environment steps")
        ax.xaxis.set_major_locator(plt.MaxNLocator(3))
        thousands(ax)
    flat[0].set_ylabel("return of an episode")
    flat[-1].legend(loc="lower right")
    return axes


def plot_filmstrip(pictures, ax=None, title="", count=10):
    """A rollout as `count` pictures side by side, the time written under each.

    pictures: arrays (height, width, 3) uint8, one per step of 0.05 seconds.
    """
    chosen = np.linspace(0, len(pictures) - 1, count).round().astype(int)
    height, width = pictures[0].shape[:2]
    if ax is None:
        _, ax = plt.subplots(figsize=(8, 8 * height / width / count + 0.5),
                             layout="constrained")
    coarse = max(1, round(width / 80))  # pixels per pixel: a strip is small
    small = [shrink(pictures[i], coarse) for i in chosen]
    ax.imshow(np.concatenate(small, axis=1), interpolation="nearest")
    w = small[0].shape[1]
    for n in range(1, count):
        ax.axvline(n * w - 0.5, color="0.85", linewidth=1)
    ax.set_xticks([(n + 0.5) * w for n in range(count)],
                  [f"{i * 0.05:.1f} s" for i in chosen])
    ax.set(yticks=[], title=title)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    return ax


def plot_truth(picture, path=None, ax=None, title=""):
    """The true Q over the state plane, and the path of one rollout.

    picture: what `bias.plane` returns; path (T, 2): the two state variables, from the
    ring to the star. An angle that passes ±π leaves on one side, returns on the other.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(5.2, 3.3), layout="constrained")
    image = draw_map(ax, picture, picture["truth"], VALUES)
    ax.figure.colorbar(image, ax=ax, label="true Q (discounted return)")
    if path is not None:
        path = np.array(path)
        if is_angle(picture["x"]):
            path[:, 0] = (path[:, 0] + np.pi) % (2 * np.pi) - np.pi
        jumps = np.abs(np.diff(path[:, 0])) > np.ptp(picture["x"]) / 2
        broken = np.insert(path, np.flatnonzero(jumps) + 1, np.nan, axis=0)
        ax.plot(*broken.T, color="white", linewidth=3)
        ax.plot(*broken.T, color="black", linewidth=1.2)
        marks = dict(markeredgecolor="black", markerfacecolor="white", zorder=3,
                     clip_on=False)
        ax.plot(*path[0], "o", markersize=8, **marks)
        ax.plot(*path[-1], "*", markersize=14, **marks)
    ax.set(title=title, ylabel="velocity")
    return ax


def plot_error_plane(picture, axes=None, title="", limit=None):
    """Truth, first critic and error over the state plane, side by side.

    picture: what `bias.plane` returns. The first two panels share one scale. In the
    third, red is where the critic overestimates, blue where it underestimates; colours
    end at ±`limit`, by default the 99th percentile of the error's size.
    """
    axes = panels(axes, title, 1, 3, figsize=(7.6, 2.7), sharey=True)
    q, truth = picture["q"][0], picture["truth"]
    error = q - truth
    limit = np.quantile(np.abs(error), 0.99) if limit is None else limit
    low, high = min(q.min(), truth.min()), max(q.max(), truth.max())
    draw_map(axes[0], picture, truth, VALUES, low, high)
    image = draw_map(axes[1], picture, q, VALUES, low, high)
    bar = axes[0].figure.colorbar(image, ax=axes[:2])
    bar.set_label("value (discounted return)", fontsize=8)
    image = draw_map(axes[2], picture, error, ERRORS, -limit, limit)
    bar = axes[0].figure.colorbar(image, ax=axes[2], extend="both")
    # Turned by 90 degrees, the arrows point down and up.
    bar.set_label("← under    over →", fontsize=8)
    for ax, name in zip(axes, ("the truth", "what the critic says", "Q − truth"),
                        strict=True):
        ax.set_title(name, loc="center", fontsize=9)
        if is_angle(picture["x"]):
            angle_ticks(ax, every=2)
    axes[0].set_ylabel("velocity")
    return axes
