"""Figures of chapter 08: energy, noise, visited states, a critic that saw nothing."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.style import (
    ERRORS,
    GREY,
    MARKS,
    ONE,
    SIGN_BAR,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    VALUES,
    draw_map,
    panels,
)

GOAL = 0.45  # position of the flag


def plot_energy_paths(x, y, energy, paths, ax=None, title=""):
    """Paths of the car over lines of equal energy.

    x (N,) and y (M,): position and velocity; energy (M, N), in units of what the goal
    asks for: the line 1 is drawn thick. paths: a dict from a label to (T, 2), at most
    three; each begins at a ring and ends at a star.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.2, 3.4), layout="constrained")
    ax.contour(x, y, energy, [0.1, 0.25, 0.5, 0.75], colors="0.8", linewidths=0.8)
    goal_line(ax, x, y, energy)
    for (label, path), style in zip(paths.items(), (ONE, TWO, THREE)):
        ax.plot(*np.transpose(path), label=label, **style)
        for row, marker, size in ((0, "o", 7), (-1, "*", 13)):
            ax.plot(*path[row], marker, markersize=size, markerfacecolor="white",
                    markeredgecolor=style["color"], markeredgewidth=1.5, zorder=4)
    ax.set(title=title, xlabel="position", ylabel="velocity", xlim=(x[0], x[-1]),
           ylim=(y[0], y[-1]))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    return ax


def goal_line(ax, x, y, energy):
    """The line of the goal's energy, and the flag.

    x (N,), y (M,) and energy (M, N) as in `plot_energy_paths`.
    """
    energy = np.where(x > GOAL + 0.01, np.nan, energy)  # beyond it the hill falls again
    ax.contour(x, y, energy, [1.0], colors="black", linewidths=1.6, linestyles="--")
    ax.axvline(GOAL, color="black", linewidth=1, linestyle=":")


def plot_pushes(cases, axes=None, title=""):
    """Random pushes, and where they move the car: one row per kind.

    cases: a dict from a row's label to (push (T,), position (T + 1,)). Of the pushes
    only the first 200 are drawn.
    """
    axes = panels(axes, title, len(cases), 2, sharex="col", sharey="col",
                  figsize=(7.4, 1.5 * len(cases) + 0.8), squeeze=False)
    grid = np.reshape(axes, (len(cases), 2))
    for row, (label, (push, position)), style in zip(grid, cases.items(),
                                                     (TWO, ONE, THREE)):
        plain = style | {"linestyle": "-", "linewidth": 1}
        row[0].plot(push[:200], **plain)
        row[0].axhline(0, **TRUTH)
        row[0].set_ylabel(f"{label}\npush", fontsize=8.5)
        row[1].plot(position, **plain | {"linewidth": 1.5})
        row[1].axhline(GOAL, color="black", linestyle=":", linewidth=1.2)
        row[1].axhline(-np.pi / 6, color=GREY, linewidth=0.8)
        row[1].set_ylabel("position", fontsize=8.5)
    grid[0, 1].annotate("flag", (0.01, GOAL), ha="left", va="top", fontsize=8.5,
                        xycoords=("axes fraction", "data"), xytext=(0, -3),
                        textcoords="offset points")
    grid[0, 1].annotate("valley", (0.01, -np.pi / 6), ha="left", va="top", fontsize=8.5,
                        xycoords=("axes fraction", "data"), xytext=(0, -16),
                        textcoords="offset points")
    for ax in grid[-1]:
        ax.set_xlabel("step")
    return axes


def plot_climbing(predicted, measured, best, usual, axes=None, title=""):
    """Energy that a random push brings, in theory and in simulated episodes.

    predicted: θ (M,) and the energy after one episode by the closed form (M,), in
    units of what the goal asks for; measured: θ (N,) and the share of episodes that
    reach the goal (N,).
    best, usual: values of θ that are marked in both panels.
    """
    axes = panels(axes, title, 1, 2, figsize=(7.4, 2.8), sharex=True)
    axes[0].plot(*predicted, color="black", linewidth=1.8)
    axes[0].axhline(1, color=GREY, linewidth=1)
    axes[0].annotate("what the goal asks for", (0.02, 1), xytext=(0, -4), va="top",
                     xycoords=("axes fraction", "data"), fontsize=8.5,
                     textcoords="offset points")
    axes[0].set(ylim=0, ylabel="predicted energy / needed")
    theta, share = measured[0], 100 * np.asarray(measured[1])
    axes[1].plot(theta, share, "o-", markersize=5,
                 markerfacecolor="white", color=ONE["color"])
    axes[1].set(ylim=(-4, 104), ylabel="episodes that arrive (%)")
    axes[1].annotate("no memory", (theta[-1], share[-1]), xytext=(-9, -1),
                     textcoords="offset points", ha="right", va="center", fontsize=8.5)
    for ax, name in zip(axes, ("closed form", "simulated")):
        ax.set(xscale="log", xlabel="θ  (short memory →)")
        ax.set_title(name, loc="center", fontsize=9)
        for value, text, style in ((best, "θ = ω", "--"), (usual, "usual", ":")):
            ax.axvline(value, color="black", linestyle=style, linewidth=1, zorder=0)
            ax.annotate(text, (value, 0.2), xycoords=("data", "axes fraction"),
                        xytext=(-2, 0) if text != "usual" else (2, 0),
                        textcoords="offset points", rotation=90, fontsize=8.5,
                        ha="right" if text != "usual" else "left", va="bottom")
    return axes


def plot_visits(runs, x, y, energy, axes=None, title=""):
    """Where the car has been during training: one map per run.

    runs: a dict from a panel's title to what `load_study(what="visits")` holds of a
    run: counts (N, N), and the cells' edges x and y (N + 1,). Cells that were never
    visited stay white. x (N,), y (M,), energy (M, N): as in `plot_energy_paths`.
    """
    axes = panels(axes, title, 1, len(runs), figsize=(2.6 * len(runs) + 1.2, 2.7),
                  sharex=True, sharey=True, squeeze=False)
    colours = plt.get_cmap("viridis_r", 12)
    for ax, (label, run) in zip(np.ravel(axes), runs.items()):
        share = 100 * run["counts"] / run["counts"].sum()
        shown = np.log10(np.where(share > 0, share, np.nan))
        image = ax.imshow(shown, origin="lower", aspect="auto", cmap=colours, vmin=-3,
                          vmax=1, interpolation="nearest",
                          extent=(run["x"][0], run["x"][-1], run["y"][0], run["y"][-1]))
        goal_line(ax, x, y, energy)
        ax.set_title(label, loc="center", fontsize=9)
        ax.set_xlabel("position")
    np.ravel(axes)[0].set_ylabel("velocity")
    bar = np.ravel(axes)[0].figure.colorbar(image, ax=axes, ticks=[-3, -2, -1, 0, 1])
    bar.ax.set_yticklabels(["0.001", "0.01", "0.1", "1", "10"])
    bar.set_label("share of all steps (%)", fontsize=8)
    return axes


def plot_found_or_not(pictures, axes=None, title=""):
    """Truth, critic and error over position and velocity: one row per agent.

    pictures: a dict from a row's label to what `bias.plane` returns. All maps of values
    share one scale, and so do the errors; red is where the first critic overestimates,
    blue where it underestimates. The dotted line is the flag.
    """
    axes = panels(axes, title, len(pictures), 3, sharex=True, sharey=True,
                  figsize=(7.6, 1.9 * len(pictures) + 0.8), squeeze=False)
    grid = np.reshape(axes, (len(pictures), 3))
    for row, (label, picture) in zip(grid, pictures.items()):
        q, truth = picture["q"][0], picture["truth"]
        draw_map(row[0], picture, truth, VALUES, 0, 100)
        image = draw_map(row[1], picture, q, VALUES, 0, 100)
        errors = draw_map(row[2], picture, q - truth, ERRORS, -100, 100)
        for ax in row:
            ax.axvline(GOAL, color="white" if ax is not row[2] else "black",
                       linestyle=":", linewidth=1)
            ax.set_xlabel("")
        row[0].set_ylabel(f"{label}\nvelocity", fontsize=8.5)
    for ax, name in zip(grid[0], ("truth", "what the critic says", "Q − truth")):
        ax.set_title(name, loc="center", fontsize=9)
    for ax in grid[-1]:
        ax.set_xlabel("position")
    figure = grid[0, 0].figure
    bar = figure.colorbar(image, ax=grid[:, :2], extend="both")
    bar.set_label("discounted return", labelpad=-48)  # at its left
    bar = figure.colorbar(errors, ax=grid[:, 2], extend="both")
    bar.set_label(SIGN_BAR, fontsize=8)
    return axes


def plot_bias_and_return(groups, ax=None, title=""):
    """Bias and return, one mark per run.

    groups: a dict from a label to a DataFrame with the columns algorithm, bias and
    mean (return), one row per run. The marker's shape is the algorithm, its colour the
    group. Bias is linear up to ±1 and logarithmic beyond. ValueError for more groups
    than there are colours.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(7, 3.2), layout="constrained")
    ax.axvline(0, **TRUTH)
    colours = ("#0072B2", "#E69F00", "#56B4E9", "#CC79A7", "#009E73", "#D55E00")
    if len(groups) > len(colours):
        raise ValueError(f"{len(groups)} groups: expected {len(colours)} at the most.")
    for (label, runs), colour in zip(groups.items(), colours):
        for name, of_name in runs.groupby("algorithm", sort=False):
            ax.plot(of_name["bias"], of_name["mean"], MARKS[name], markersize=7,
                    markerfacecolor="none", markeredgecolor=colour, markeredgewidth=1.2)
        ax.plot([], [], "s", markersize=7, color=colour, label=label)
    for name in STYLE:
        ax.plot([], [], MARKS[name], color="0.3", markerfacecolor="none", label=name)
    ax.set_xscale("symlog", linthresh=1)
    low, high = ax.get_xlim()
    ax.set_xlim(min(low, -20), max(high, 20))
    ax.set_ylim(min(ax.get_ylim()[0], -20) - 5, 110)
    ax.set(title=title, ylabel="return of an episode",
           xlabel="Q − truth at start states")
    for text, side in (("← underestimates ", "right"), (" overestimates →", "left")):
        ax.annotate(text, (0, 0.25), xycoords=("data", "axes fraction"), ha=side,
                    fontsize=8.5)
    ax.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return ax
