"""Figures of chapters 01 and 02: values, slopes and the linear-quadratic world."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.style import (
    ERRORS,
    GREY,
    ONE,
    THREE,
    TRUTH,
    TWO,
    VALUES,
    panels,
    zero_line,
)


def plot_partial_sums(sums, totals, ax=None, title=""):
    """The discounted rewards, added up step by step, until nothing more comes.

    sums: a dict from a label to (T,); totals: the same labels to the whole return.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 2.9), layout="constrained")
    for (label, values), style in zip(sums.items(), (ONE, TWO, THREE)):
        ax.axhline(totals[label], **TRUTH)
        ax.plot(np.arange(1, len(values) + 1), values, marker="o", markersize=3,
                label=label, **style)
    ax.set(title=title, xlabel="rewards added up", ylabel="sum of γᵗ · reward")
    ax.legend()
    return ax


def plot_true_q(position, action, q, lines, axes=None, title=""):
    """The true Q over position and action: as a surface, and as a map from above.

    position (X,), action (Y,), q (Y, X); lines: a dict from a label to actions (X,).
    """
    if axes is None:
        figure = plt.figure(figsize=(7, 2.8), layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        axes = figure.add_subplot(1, 2, 1, projection="3d"), figure.add_subplot(1, 2, 2)
    hill, flat = axes
    hill.plot_surface(*np.meshgrid(position, action), q, edgecolor="white",
                      cmap=plt.get_cmap(VALUES, 12), rcount=9, ccount=9, linewidth=0.4)
    # The near corner has one label: two would meet there.
    hill.set(xticks=[-1, 0, 1], yticks=[0, 1], zticks=[-4, -2, 0])
    hill.set_box_aspect(None, zoom=1.15)
    hill.tick_params(pad=-3)
    hill.grid(False)
    for axis, name in zip((hill.xaxis, hill.yaxis, hill.zaxis),
                          ("position", "action", "true Q")):
        axis.set_label_text(name)
        axis.labelpad = -6
        axis.pane.set_visible(False)
    image = flat.contourf(position, action, q, 8, cmap=VALUES, antialiased=False)
    flat.figure.colorbar(image, ax=flat, label="true Q")
    for (label, actions), style in zip(lines.items(), ("-", "--")):
        flat.plot(position, actions, color="white", linewidth=3.5)
        flat.plot(position, actions, color="black", linestyle=style, label=label)
    flat.set(xlabel="position", ylabel="action", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    flat.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2)
    return axes


def plot_finite_differences(steps, errors, ax=None, title=""):
    """The error of finite differences against their step, both on log axes.

    steps (N,); errors: a dict from a label to (N,), absolute errors of the slope.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3), layout="constrained")
    for (label, values), style in zip(errors.items(), (ONE, TWO, THREE)):
        ax.loglog(steps, np.maximum(values, 1e-16), marker="o", markersize=3,
                  label=label, **style)
    ax.set(title=title, xlabel="step ε", ylabel="error of the slope")
    ax.legend(loc="lower left")
    return ax


def plot_slices(action, truth, guesses, tops=False, ax=None, title=""):
    """Q along the action at one state: the truth in black, and some critics.

    action (N,), truth (N,); guesses: a dict from a label to (N,). `tops` marks the
    highest point of every line.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3.1), layout="constrained")
    for (label, values), style in zip(guesses.items(), (ONE, TWO, THREE)):
        ax.plot(action, values, label=label, **style)
    ax.plot(action, truth, label="the truth", **TRUTH | {"linewidth": 1.8})
    if tops:
        for line in ax.lines[:]:
            top = np.argmax(line.get_ydata())
            x, y = action[top], line.get_ydata()[top]
            ax.plot(x, y, "o", markersize=7, zorder=4, color=line.get_color())
            ax.axvline(x, color=line.get_color(), linestyle=":", linewidth=1)
    ax.set(title=title, xlabel="action", ylabel="Q")
    ax.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return ax


def plot_decay(errors, ax=None, title=""):
    """What is left of an error after n backups, as a share of its first size.

    errors: a dict from a label to (N,), starting with 1. A thin line marks 1 %.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3), layout="constrained")
    for (label, values), style in zip(errors.items(), (ONE, TWO, THREE)):
        ax.semilogy(values, label=label, **style)
    ax.axhline(0.01, color=GREY, linewidth=1)
    ax.annotate("1% is left", (0.99, 0.01), ha="right", va="bottom",
                xycoords=("axes fraction", "data"), color="0.4")
    ax.set(title=title, xlabel="backups", ylabel="share of the error",
           ylim=(0.002, 1.2))
    ax.legend(loc="upper right", bbox_to_anchor=(1, 0.9))
    return ax


def plot_learned_q(position, action, errors, curves, limit, axes=None, title=""):
    """Above: maps of Q − truth at some moments. Below: its mean over all that time.

    errors: a dict from an update to the error (Y, X) over action and position; colours
    end at ±limit. curves: a list, one for each first network, of arrays (3, M):
    updates, mean error, root mean square error (drawn for the first network only).
    """
    if axes is None:
        figure = plt.figure(figsize=(5.6, 3.5), layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        grid = figure.add_gridspec(2, len(errors))
        axes = [figure.add_subplot(grid[0, n]) for n in range(len(errors))]
        axes += [figure.add_subplot(grid[1, :])]
    for ax, (update, error) in zip(axes, errors.items()):
        image = ax.imshow(error, origin="lower", aspect="auto", vmin=-limit, vmax=limit,
                          cmap=plt.get_cmap(ERRORS, 17), interpolation="nearest",
                          extent=(position[0], position[-1], action[0], action[-1]))
        ax.set_title(f"after {update} updates", loc="center", fontsize=9)
        ax.set(xlabel="position", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    axes[0].set_ylabel("action")
    bar = axes[0].figure.colorbar(image, ax=axes[:-1], extend="both")
    bar.set_label("← under    over →", fontsize=8)
    below = axes[-1]
    for n, (updates, mean, rms) in enumerate(curves):
        style = dict(color=ONE["color"], linewidth=1.8 if n == 0 else 0.7)
        label = {0: "mean error", 1: "mean error, other seeds"}.get(n)
        below.plot(updates, mean, label=label, **style)
        if n == 0:
            below.plot(updates, rms, label="root mean square", **TWO)
    zero_line(below)
    below.set(xlabel="updates", ylabel="Q − truth")
    below.legend(loc="upper right")
    return axes


def plot_hill(first, second, height, paths, top, ax=None, title=""):
    """The objective J over two parameters of a policy, and paths that climb it.

    first (X,), second (Y,), height (Y, X); paths: a dict from a label to (T, 2), each
    from its ring to the star `top` (2,).
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(5.8, 3.4), layout="constrained")
    levels = height.max() - np.ptp(height) * np.linspace(0, 1, 13)[::-1] ** 2
    image = ax.contourf(first, second, height, levels, cmap=VALUES, antialiased=False)
    ax.figure.colorbar(image, ax=ax, label="J (mean discounted return)", format="%.2f",
                       ticks=levels[::2])
    for (label, path), style in zip(paths.items(), (ONE, TWO, THREE)):
        mark = "o" if len(path) < 20 else None  # a path of few, long steps
        ax.plot(*np.transpose(path), color="black", linewidth=3.2)
        ax.plot(*np.transpose(path), label=label, marker=mark, markersize=4, **style)
        ax.plot(*path[0], "o", markerfacecolor="white", markeredgecolor="black")
    ax.plot(*top, "*", markersize=15, markerfacecolor="white", markeredgecolor="black")
    ax.set(title=title, xlabel="gain of the position", ylabel="gain of the velocity")
    ax.legend(loc="lower left", frameon=True)
    return ax


def plot_slope_ways(gain, slope, ways, ax=None, title=""):
    """The slope of J against one gain, and the same slope found in other ways.

    gain (N,), slope (N,) the exact slope; ways: a dict from a label to (gains, slopes).
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3), layout="constrained")
    ax.axhline(0, color=GREY, linewidth=0.8)
    ax.plot(gain, slope, label="closed form", **TRUTH)
    marks = (("o", 10, ONE), ("s", 6.5, TWO), ("x", 5, dict(color="black")))
    for (label, (gains, slopes)), (marker, size, style) in zip(ways.items(), marks):
        ax.plot(gains, slopes, marker, markersize=size, markerfacecolor="none",
                markeredgecolor=style["color"], markeredgewidth=1.6, label=label)
    ax.set(title=title, xlabel="gain of the position", ylabel="slope of J")
    ax.legend()
    return ax


def plot_actor(position, best, actors, ax=None, title=""):
    """An actor's actions against the position, beside the best ones in black.

    position (N,), best (N,); actors: a dict from a label to actions (N,).
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 2.9), layout="constrained")
    ax.plot(position, best, label="the best action", **TRUTH | {"linewidth": 3})
    for (label, actions), style in zip(actors.items(), (TWO, THREE, ONE)):
        ax.plot(position, actions, label=label, **style)
    ax.set(title=title, xlabel="position (velocity 0)", ylabel="action")
    ax.legend()
    return ax


def plot_price(slopes, bias, lost, axes=None, title=""):
    """What a critic's slope m does: its error at the actor's action, and the loss.

    slopes (M,). bias, lost: dicts from a label to values: (M,) are measured, drawn as
    marks; a pair of arrays (x, y) is a prediction, drawn as a black line.
    """
    axes = panels(axes, title, 1, 2, figsize=(6.6, 2.8))
    marks = (("o", ONE), ("s", TWO), ("^", THREE))
    zero_line(axes[0])
    axes[1].axhline(0, color=GREY, linewidth=0.8)
    for ax, series in zip(axes, (bias, lost)):
        measured = iter(marks)
        for label, values in series.items():
            if isinstance(values, tuple):
                ax.plot(*values, label=label, **TRUTH)
            else:
                marker, style = next(measured)
                ax.plot(slopes, values, marker, color=style["color"], label=label)
        ax.set_xlabel("slope m of the critic's error along the action")
        ax.legend()
    axes[0].set(ylabel="critic − best policy's Q")
    axes[0].margins(y=0.2)
    axes[1].set(ylabel="true value lost")
    return axes
