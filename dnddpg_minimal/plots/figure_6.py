"""Figures of chapter 10: the paper's Figure 6, and what it takes to judge it."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.style import (
    MARKS,
    ONE,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    pale,
    panels,
    thousands,
)

FEWEST = 3  # runs for an interval, as in statistics.py
VERDICTS = {  # first words of a verdict: colour of its field, colour of its text
    "holds alone": ("#B3D4E8", "black"),  # not after correction for all questions
    "holds": ("#0072B2", "white"),
    "does not hold alone": ("#F2CDB3", "black"),
    "does not hold": ("#D55E00", "white"),
    "not distinguishable": ("#DDDDDD", "black"),
    "not tested": ("white", "0.35"),
}


def plot_eight_tasks(curves, interval=None, seeds=False, limits=None, xlabel="",
                     axes=None, title=""):
    """Learning curves of several tasks, a panel each: the mean of the runs.

    curves: a dict from a task to a dict from an algorithm to (x (M,), values (S, M));
    a task without algorithms gets an empty panel that says how to record it. interval:
    a function of values that gives (low, high), drawn as a shade from 3 runs on; seeds:
    every run as a thin line; limits: a dict from a task to its axis' (low, high);
    xlabel: what x is. Axes of your own get neither this label nor a legend.
    """
    own = axes is None
    if own:
        rows = -(-len(curves) // 4)
        axes = panels(None, title, rows, min(4, len(curves)), squeeze=False,
                      figsize=(7, 1.55 * rows + 0.4))
        axes[0, 0].figure.supxlabel(xlabel, fontsize=9)
        axes[0, 0].figure.supylabel("return of an episode", fontsize=9)
    flat = np.ravel(axes)
    for n, (ax, (task, of_algorithms)) in enumerate(zip(flat, curves.items())):
        counts = [len(values) for _, values in of_algorithms.values()]
        several = f"{min(counts)}–{max(counts)}" if len(set(counts)) > 1 else counts[:1]
        runs = f", n = {several}".translate({ord(c): None for c in "[]"})
        ax.set_title(f"({chr(ord('a') + n)}) {short(task)}{runs if counts else ''}",
                     fontsize=8.5)
        ax.tick_params(labelsize=7)
        if not of_algorithms:
            not_recorded(ax, task)
        for name, (x, values) in of_algorithms.items():
            style = STYLE[name]
            if interval is not None and len(values) >= FEWEST:
                ax.fill_between(x, *interval(values), color=pale(style["color"], 0.6),
                                alpha=0.55, linewidth=0)
            if seeds:
                ax.plot(x, values.T, color=pale(style["color"], 0.45), linewidth=0.4)
            ax.plot(x, values.mean(axis=0), linewidth=1.2, zorder=3, label=name,
                    **style)
        if of_algorithms:
            ax.xaxis.set_major_locator(plt.MaxNLocator(2))
            ax.yaxis.set_major_locator(plt.MaxNLocator(3))
            ax.set_ylim((limits or {}).get(task))
            thousands(ax)
    lines = {label: line for ax in flat
             for line, label in zip(*ax.get_legend_handles_labels())}
    if own and lines:
        flat[0].figure.legend(lines.values(), lines, loc="upper right", ncols=3,
                              fontsize=8, borderaxespad=0.1)
    return axes


def short(task):
    """A task's name without its version, as it fits over a small panel."""
    return task.rpartition("-v")[0].replace("Continuous", "")


def not_recorded(ax, task):
    """An empty panel that says what would fill it: a study of the task."""
    text = f"not recorded yet:\npython -m\ndnddpg_minimal\nstudy --task\n{task}"
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center",
            fontsize=6.5, color="0.35")
    ax.set(xticks=[], yticks=[])


def plot_coverage(n, shares, axes=None, title=""):
    """How often 95 % intervals hold the truth, over the runs: a panel per law.

    n (N,); shares: a dict from a law to a dict from a kind of interval to (N,).
    """
    axes = panels(axes, title, 1, len(shares), figsize=(7, 2.6), sharey=True)
    flat = np.ravel(axes)
    for ax, (law, kinds) in zip(flat, shares.items()):
        ax.axhline(0.95, **TRUTH)
        for (kind, values), style, mark in zip(kinds.items(), (ONE, TWO, THREE), "osD"):
            ax.plot(n, values, marker=mark, markersize=4.5, label=kind, **style)
        ax.set(xscale="log", xlabel="runs, n", title=law)
        ax.minorticks_off()
        ax.set_xticks(n, [str(one) for one in n])
        ax.yaxis.set_major_formatter(lambda y, _: f"{y:.0%}")
    flat[0].set_ylabel("intervals that hold the truth")
    flat[0].annotate("claimed: 95%", (0.99, 0.95), ha="right",
                     xycoords=("axes fraction", "data"), xytext=(0, 6),
                     textcoords="offset points", fontsize=8)
    flat[-1].legend(loc="lower right")
    return axes


def plot_profile(levels, profiles, iqms, axes=None, title=""):
    """Share of runs above each level, and interquartile means with their intervals.

    levels (L,); profiles: algorithm -> (L,). iqms: a dict from a label to a dict from
    an algorithm to (iqm, low, high); an interval that is NaN is not drawn.
    """
    axes = panels(axes, title, 1, 2, figsize=(7.4, 2.7))
    left, right = axes
    for name, share in profiles.items():
        left.plot(levels, share, linewidth=1.8, label=name, **STYLE[name])
    left.set(xlabel="level of the normalised score", ylabel="share of runs above it",
             ylim=(-0.03, 1.03))
    left.legend(loc="lower left")
    for row, (_, of_algorithms) in enumerate(iqms.items()):
        for n, (name, (iqm, *interval)) in enumerate(of_algorithms.items()):
            y = row + 0.22 * (n - (len(of_algorithms) - 1) / 2)
            colour = STYLE[name]["color"]
            if np.isfinite(interval).all():
                right.plot(interval, [y, y], color=colour, linewidth=1.5)
            right.plot(iqm, y, MARKS[name], color=colour, markersize=5,
                       label=name if row == 0 else None)
    right.xaxis.set_major_locator(plt.MaxNLocator(4))
    right.set_yticks(range(len(iqms)), list(iqms))
    right.set(ylim=(len(iqms) - 0.5, -0.5),
              xlabel="interquartile mean of normalised scores")
    right.legend(loc="best", fontsize=7.5)
    return axes


def plot_paired_by_task(differences, axes=None, title="", xlabel=""):
    """Paired differences, task by task: a ring per seed, the mean, two intervals.

    differences: a dict from a pair's name to a dict from a task to (values (n,) in %, t
    interval, bootstrap interval), in the colours of `plot_coverage`. Fewer than 3
    values: rings only. xlabel: what the values are. The axis is linear within ±1 and
    logarithmic beyond.
    """
    if axes is None:
        rows = max(map(len, differences.values()))
        axes = panels(None, title, 1, len(differences), sharex=True, sharey=True,
                      figsize=(8, 0.8 + 0.34 * rows))
        np.ravel(axes)[0].figure.supxlabel(xlabel, fontsize=9)
    for ax, (pair, tasks) in zip(np.ravel(axes), differences.items()):
        ax.axvline(0, **TRUTH)
        for n, (values, t, bootstrap) in enumerate(tasks.values()):
            ax.plot(values, np.full(len(values), n + 0.3), "o", markersize=3.5,
                    markerfacecolor="white", markeredgecolor="0.45")
            if len(values) >= FEWEST:
                ax.plot(t, [n, n], color=ONE["color"], linewidth=2)
                ax.plot(bootstrap, [n - 0.27] * 2, color=TWO["color"], linewidth=2)
                ax.plot(np.mean(values), n, "|", color="black", markersize=9,
                        markeredgewidth=1.6)
        ax.set_xscale("symlog", linthresh=1, linscale=0.8)
        ax.xaxis.set_minor_locator(plt.NullLocator())
        ax.set_yticks(range(len(tasks)), [
            f"{short(task)}, n = " + "–".join(map(str, sorted(
                {len(pairs[task][0]) for pairs in differences.values()})))
            for task in tasks], fontsize=8)
        ax.set(title=pair, ylim=(len(tasks) - 0.5, -0.5))
    furthest = max((np.abs(found[0]).max(initial=1) for tasks in differences.values()
                    for found in tasks.values()), default=1)
    ticks = [t for t in (1, 10, 100, 1000) if t <= 1.5 * furthest]
    ticks = [-t for t in reversed(ticks)] + [0] + ticks
    np.ravel(axes)[0].set_xticks(ticks, [str(t).replace("-", "−") for t in ticks])
    for ax in np.ravel(axes):
        ax.tick_params(axis="x", labelsize=7)
    return axes


def plot_verdicts(table, tasks, ax=None, title=""):
    """The verdicts as a table: a row per claim, a column per task of `tasks`.

    table: a dict from a claim to a dict from a task to a verdict (statistics.verdict);
    a claim that does not speak of a task leaves its field empty. A verdict that a
    correction for many questions takes away again has " alone" at its end, and is pale.
    """
    ax = panels(ax, title, figsize=(7.8, 0.7 + 0.33 * len(table)))
    for y, row in enumerate(table.values()):
        for x, task in enumerate(tasks):
            if task not in row:
                continue
            words = next(key for key in VERDICTS if row[task].startswith(key))
            field, colour = VERDICTS[words]
            ax.add_patch(plt.Rectangle((x - 0.47, y - 0.43), 0.94, 0.86,
                                       facecolor=field, edgecolor="0.7",
                                       linewidth=0.8))
            text = row[task].replace("not distinguishable", "open").replace(
                "does not hold", "does not").replace("not tested at this budget",
                "too short").replace("not tested (", "").rstrip(")")
            text = text.replace(" alone", "\nalone")
            ax.text(x, y, text, ha="center", va="center", fontsize=7.5, color=colour,
                    linespacing=0.95)
    ax.set_xticks(range(len(tasks)), [short(task) for task in tasks], fontsize=7.5)
    ax.set_yticks(range(len(table)), list(table), fontsize=8)
    ax.tick_params(length=0, labeltop=True, labelbottom=False)
    ax.spines[:].set_visible(False)
    ax.set(xlim=(-0.5, len(tasks) - 0.5), ylim=(len(table) - 0.5, -0.5))
    return ax
