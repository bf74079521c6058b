"""Figures of chapter 12: instruments that read six faulty agents."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.style import (
    GREY,
    ONE,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    pale,
    panels,
    thousands,
)


def plot_line_up(agents, axes=None, title=""):
    """Return, and Q beside the truth, of each agent: two panels above each other.

    agents: a dict from a letter to a dict with
        right   (step (M,), return (R, M)) of R runs of the right agent: a pale band
                from the lowest to the highest
        tests   (step (M,), return (S, M)) of S runs: a line each
        q       (step (M,), Q (M,), truth (M,)) of one run, mean over start states
    A letter with an empty dict gets panels that say so. Three letters in a row.
    """
    rows = 2 * -(-len(agents) // 3)
    axes = panels(axes, title, rows, 3, figsize=(7.6, 1.3 * rows + 0.8), squeeze=False)
    grid = np.reshape(axes, (rows, 3))
    for n, (letter, agent) in enumerate(agents.items()):
        above, below = grid[2 * (n // 3):2 * (n // 3) + 2, n % 3]
        above.set_title(letter, loc="left", fontweight="bold")
        for ax in (above, below):
            few_steps(ax)
        if not agent:
            above.annotate("not recorded here", (0.5, 0.5), ha="center",
                           xycoords="axes fraction")
            above.set(xticks=[], yticks=[])
            below.set(xticks=[], yticks=[])
            continue
        step, runs = agent["right"]
        above.fill_between(step, runs.min(axis=0), runs.max(axis=0), color="0.8",
                           linewidth=1.5)
        step, runs = agent["tests"]
        above.plot(step, np.transpose(runs), color=THREE["color"], linewidth=1.5)
        step, q, truth = agent["q"]
        below.plot(step, truth, **TRUTH)
        below.plot(step, q, **STYLE["DDPG"], linewidth=1.8)
        above.set_xticklabels([])
        low, high = above.get_ylim()
        if high - low < 50:  # hardly any change: do not enlarge it
            above.set_ylim(low - 25, high + 25)
    for row in range(rows):
        grid[row, 0].set_ylabel("return" if row % 2 == 0 else "Q, truth")
    for ax in grid[-1]:
        ax.set_xlabel("environment steps")
    grid[0, 0].plot([], [], color=THREE["color"], label="this agent, tests")
    grid[0, 0].plot([], [], color="0.8", linewidth=6, label="right agents, tests")
    grid[1, 0].plot([], [], **STYLE["DDPG"], label="Q at starts")
    grid[1, 0].plot([], [], label="truth there", **TRUTH)
    handles = [h for ax in grid[:2, 0] for h in ax.get_legend_handles_labels()[0]]
    grid[0, 0].figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return axes


def few_steps(ax):
    """At most three steps are written at the axis."""
    ax.xaxis.set_major_locator(plt.MaxNLocator(2))
    thousands(ax)


def plot_practice(agents, axes=None, title=""):
    """Returns in training, episode by episode, and in tests, over the steps.

    agents: a dict from a panel's title to a dict with
        episodes  (step (E,), return (E,)): with noise, a dot each
        tests     (step (M,), return (M,)): without noise, from many starts, a line
    """
    columns = min(len(agents), 4)
    rows = -(-len(agents) // columns)
    axes = panels(axes, title, rows, columns, figsize=(7.8, 1.7 * rows + 0.5),
                  squeeze=False)
    every = np.ravel(axes)
    for ax in every[len(agents):]:
        ax.set_visible(False)
    for ax, (name, agent) in zip(every, agents.items()):
        ax.plot(*agent["episodes"], ".", markersize=3.5, color=TWO["color"],
                label="an episode of training")
        ax.plot(*agent["tests"], color="black", linewidth=1.4,
                label="tests from 100 starts")
        ax.set_title(name, loc="left", fontweight="bold")
        few_steps(ax)
    for row in np.reshape(every, (rows, columns)):
        row[0].set_ylabel("return")
    for ax in every[:len(agents)][-columns:]:  # the lowest of each column
        ax.set_xlabel("environment steps", fontsize=8.5)
    handles = every[0].get_legend_handles_labels()[0]
    every[0].figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return axes


def plot_questions(groups, axes=None, title=""):
    """One critic, asked in three ways, and the truth: a group of marks per agent.

    groups: a dict from a panel's title to a dict from a letter to (q (3,), truth (3,)):
    at start states with the policy's action, at visited states with the policy's
    action, at visited states with the action that was done. Each panel has an axis of
    its own.
    """
    widths = [len(agents) for agents in groups.values()]
    axes = panels(axes, title, 1, len(groups), figsize=(7.4, 2.9), width_ratios=widths,
                  squeeze=False)
    names = ("Q at starts", "Q at visited states", "Q there, for the action done")
    for ax, (panel, agents) in zip(np.ravel(axes), groups.items()):
        ax.axhline(0, color=GREY, linewidth=0.8)
        for n, (q, truth) in enumerate(agents.values()):
            for m, style in enumerate((ONE, TWO, THREE)):
                x = n + 0.22 * (m - 1)
                ax.plot([x - 0.09, x + 0.09], [truth[m]] * 2, color="black",
                        linewidth=2)
                ax.plot([x, x], [truth[m], q[m]], color=pale(style["color"], 0.4),
                        linewidth=1.5, zorder=0)
                ax.plot(x, q[m], "osD"[m], markersize=5.5, color=style["color"])
        ax.set_xticks(range(len(agents)), list(agents))
        ax.set_xlim(-0.5, len(agents) - 0.5)
        ax.set_title(panel, loc="center", fontsize=9)
    first = np.ravel(axes)[0]
    first.set_ylabel("value")
    for m, (name, style) in enumerate(zip(names, (ONE, TWO, THREE))):
        first.plot([], [], "osD"[m], color=style["color"], label=name)
    first.plot([], [], color="black", linewidth=2, label="truth")
    first.figure.legend(loc="outside lower center", ncols=4)
    return axes


def plot_decays(curves, limits, ax=None, title=""):
    """How fast an error that all states share dies, for several update rules.

    curves: a dict from a label to (update (M,), error (M,)); limits: the same labels
    to the error that is predicted (M,), or None.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6, 2.7), layout="constrained")
    for (label, (update, error)), style in zip(curves.items(), (ONE, TWO, THREE)):
        ax.plot(update, error, label=label, **style)
        if limits.get(label) is not None:
            ax.plot(update, limits[label], color="black", linestyle=":", linewidth=1)
    if limits:
        ax.plot([], [], color="black", linestyle=":", linewidth=1, label="formula")
    ax.set(title=title, xlabel="updates", ylabel="error / first error", ylim=0)
    thousands(ax)
    ax.legend()
    return ax
