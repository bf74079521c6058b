"""Figures of chapter 11: the readings of the paper, and what they change."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.style import (
    GREY,
    ONE,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    WRONG,
    legend_below,
    pale,
    panels,
    thousands,
)


def plot_readings(added, ax=None, title=""):
    """What each reading of the target adds to Q on the same trained networks.

    added: a dict from a reading's name to (agents,), in units of return, a ring for
    each agent; the diamond is their mean.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 0.9 + 0.36 * len(added)),
                             layout="constrained")
    ax.axvline(0, **TRUTH)
    for n, values in enumerate(added.values()):
        ax.plot(values, np.full(len(values), n), "o", markersize=5,
                markerfacecolor="white", markeredgecolor="0.4")
        ax.plot(np.mean(values), n, "D", color="black", markersize=6)
    ax.set_yticks(range(len(added)), list(added))
    ax.set(title=title, ylim=(len(added) - 0.5, -0.5),
           xlabel="added to Q at the start states by the rule of the target")
    return ax


def plot_who_acts(constants, share, lost, axes=None, title=""):
    """A constant is added to critic 2: how often actor 2 acts, and what that costs.

    constants (M,); share and lost: a dict from a rule to (agents, M), the share of
    states in which actor 2 acts, and the true value that its choices lose. Thin lines
    are agents, thick ones their mean.
    """
    axes = panels(axes, title, 1, 2, figsize=(7.2, 2.7))
    for ax, curves, label in zip(axes, (share, lost), (
            "share of states\nin which actor 2 acts", "true value lost by the choice")):
        for (rule, values), style in zip(curves.items(), (ONE, TWO, THREE)):
            ax.plot(constants, np.transpose(values), linewidth=0.6,
                    color=pale(style["color"]))
            ax.plot(constants, np.mean(values, axis=0), label=rule, **style)
        ax.set(xlabel="constant added to critic 2", ylabel=label)
    axes[0].set_ylim(-0.03, 1.03)
    axes[1].set_ylim(0, 1.25 * np.max([*lost.values()]))
    axes[1].legend(loc="upper right", ncols=2)
    return axes


def plot_table_1(schedules, values, limit, axes=None, title=""):
    """Two numbers of Table 1: how fast slow copies follow, and a limit on y.

    schedules: a dict from a label to (updates (M,), share of the way (M,)).
    values (N,): true values of states; limit: a lower limit of y.
    """
    axes = panels(axes, title, 1, 2, figsize=(7.4, 2.7))
    styles = (ONE, TWO, THREE, dict(color="0.35", linestyle="-.", linewidth=1.4))
    for (label, curve), style in zip(schedules.items(), styles):
        axes[0].plot(*curve, label=label, **style)
    axes[0].set(xlabel="updates", ylabel="share of the way that is done",
                ylim=(0, 1.04), title="slow copies after a jump")
    axes[0].xaxis.set_major_locator(plt.MultipleLocator(1_000))
    thousands(axes[0])
    axes[0].legend(loc="center right", bbox_to_anchor=(1.03, 0.42), fontsize=8,
                   handlelength=1.5)
    axes[1].hist(values, 40, histtype="stepfilled", color=TWO["color"], alpha=0.7)
    axes[1].axvline(limit, **WRONG)
    axes[1].annotate(f"limit {limit}".replace("-", "−"), (limit, 0.97), ha="right",
                     xycoords=("data", "axes fraction"), va="top", xytext=(-5, 0),
                     textcoords="offset points")
    axes[1].set(xlabel="true value of a state", yticks=[], ylabel="share of states",
                title="true values, and a limit on y")
    for ax in axes:
        ax.title.set_size(9)
    return axes


def plot_ends(length, cut, whole, tasks, ax=None, title=""):
    """What a constant reward of 1 is worth, if each end cuts the target, or none does.

    length (M,): mean steps of an episode; cut (M,): Q if each end cuts; whole: Q if
    none does. tasks: a dict from a name to (length, is the end real?), drawn on the
    line that is the truth there.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.2, 2.9), layout="constrained")
    ax.axhline(whole, label="no end cuts: right for a clock", **ONE)
    ax.plot(length, cut, label="each end cuts: right for a real end", **TWO)
    for name, (steps, real) in tasks.items():
        level = np.interp(steps, length, cut) if real else whole
        ax.plot(steps, level, "o", markersize=7, color="black",
                markerfacecolor="black" if real else "white")
        ax.annotate(name, (steps, level), xytext=(9, -8) if real else (0, 7),
                    ha="left" if real else "center", textcoords="offset points",
                    fontsize=8.5)
    ax.set(title=title, xscale="log", xlabel="steps of an episode", ylabel="Q",
           ylim=(0, 1.16 * whole))
    thousands(ax)
    legend_below(ax)
    return ax


def plot_links(alpha, shares, ax=None, title=""):
    """In which share of random worlds each line of the proof is true.

    alpha (M,): lengths of the actor's step; shares: a dict from a label to (M,). The
    last one, the conclusion, is drawn in black.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.2, 3), layout="constrained")
    *links, conclusion = shares
    styles = (ONE, TWO, THREE, dict(color=STYLE["DN-DDPG"]["color"], linestyle="-."))
    for label, style in zip(links, styles):
        ax.plot(alpha, shares[label], label=label, **{"linewidth": 1.8} | style)
    ax.plot(alpha, shares[conclusion], color="black", linewidth=2.4, label=conclusion)
    ax.axhline(0.5, color=GREY, linewidth=0.8)
    ax.set(title=title, xscale="log", xlabel="length of the step, α",
           ylabel="share of worlds where it holds", ylim=(0, 1.03))
    ax.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return ax


def plot_consequences(found, expected=None, axes=None, title=""):
    """What each reading changes: paired differences, for several quantities.

    found: a dict from a quantity to a dict from a reading to (values (n,), interval):
    a tick for each seed; a diamond and a line, the mean and its 95 % interval, only
    where an interval is given, else None: then nothing is decided yet. A reading
    without values has an empty row. expected: the same names to one number, a cross.
    The scale is linear up to ±10 and logarithmic beyond.
    """
    rows = list(next(iter(found.values())))
    axes = panels(axes, title, 1, len(found), sharey=True,
                  figsize=(7.4, 0.9 + 0.21 * len(rows)))
    for ax, (quantity, readings) in zip(np.ravel(axes), found.items()):
        ax.axvline(0, **TRUTH)
        for n, (values, interval) in enumerate(readings.values()):
            ax.plot(values, np.full(len(values), n), "|", markersize=7, color="0.45",
                    markeredgewidth=1.4)
            if interval is not None:
                sure = interval[0] > 0 or interval[1] < 0
                color = "#AA3377" if sure else "black"
                ax.plot(interval, [n, n], color=color, linewidth=2)
                ax.plot(np.mean(values), n, "D", color=color, markersize=4.5)
        for name, value in (expected or {}).get(quantity, {}).items():
            ax.plot(value, rows.index(name), "x", markersize=7, markeredgewidth=2,
                    color=TWO["color"])
        reach = max([10.0, *(np.abs([*values, *(interval or ())]).max()
                             for values, interval in readings.values() if len(values))])
        ax.set_xscale("symlog", linthresh=10, linscale=2)
        far = 100 if reach < 700 else 1000
        ax.set_xticks([-far, -10, -5, 0, 5, 10, far])
        ax.xaxis.set_major_formatter(lambda x, _: f"{x:.0f}".replace("-", "−"))
        ax.minorticks_off()
        ax.tick_params(axis="x", labelsize=8)
        ax.set(xlim=(-1.6 * reach, 1.6 * reach), xlabel=f"difference in {quantity}")
    first = np.ravel(axes)[0]
    first.set_yticks(range(len(rows)), rows, fontsize=8)
    first.set_ylim(len(rows) - 0.5, -0.5)
    return axes
