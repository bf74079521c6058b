"""Figures of chapter 04: one target, its growth, the evidence."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.critics import note_mean, note_sign
from dnddpg_minimal.plots.style import (
    ERRORS,
    GREY,
    ONE,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    angle_ticks,
    draw_map,
    panels,
    thousands,
)


def plot_y(y, expected=None, ax=None, title=""):
    """How simulated targets y scatter around the truth, 0: their histogram and mean.

    y (N,); expected: the closed form of their mean, or None.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(4, 2.9), layout="constrained")
    color = STYLE["DDPG"]["color"]
    ax.hist(y, np.linspace(-6, 8, 85), density=True, histtype="stepfilled",
            color=color, alpha=0.45)  # one shape: quick to draw
    ax.axvline(0, label="truth", **TRUTH)
    ax.axvline(y.mean(), color=color, linewidth=2.5, label=f"mean {y.mean():+.2f}")
    if expected is not None:
        ax.axvline(expected, color="black", linestyle=":", linewidth=1.8,
                   label=f"closed form {expected:+.2f}")
    ax.set(title=title, xlabel="what the target says − truth", yticks=[], xlim=(-6, 8))
    ax.spines["left"].set_visible(False)  # beside the truth it looks like a second one
    ax.legend(loc="upper left" if y.mean() > 2 else "upper right", handlelength=1.5)
    return ax


def plot_maximum(y, expected, counts, curves, samples, axes=None, title=""):
    """Eq. 5: how maxima scatter, and their mean against the number of actions.

    y (N,) and expected as in `plot_y`. counts (M,); curves: a dict from a label to the
    closed form (M,); samples: the same labels to simulated means (M,).
    """
    axes = panels(axes, title, 1, 2, figsize=(8, 2.9))
    plot_y(y, expected, axes[0])
    ax = axes[1]
    ax.axhline(0, **TRUTH)
    for (label, values), style in zip(curves.items(), (ONE, TWO, THREE)):
        ax.plot(counts, values, label=label, **style)
        ax.plot(counts, samples[label], "o", markersize=4.5, markerfacecolor="white",
                markeredgecolor=style["color"])
    ax.set(xlabel="number of actions", ylabel="mean of the maximum / σ")
    ax.legend()
    return axes


def plot_growth(cases, axes=None, title=""):
    """How a bias grows from sweep to sweep: a line for each case, its limit dotted.

    cases: a dict from a panel's title to a dict from a label to (bias (N,), limit).
    """
    axes = panels(axes, title, 1, len(cases), figsize=(7.4, 2.7))
    for ax, (name, curves) in zip(np.ravel(axes), cases.items()):
        for (label, (values, limit)), style in zip(curves.items(), (ONE, TWO, THREE)):
            sweep = np.unique(np.geomspace(1, len(values), 50).astype(int))
            ax.plot(sweep, values[sweep - 1], label=label, **style)
            ax.axhline(limit, color="black", linestyle=":", linewidth=1.2)
        positive = min(values.min() for values, _ in curves.values()) > 0
        ax.set(xscale="log", yscale="log" if positive else "linear", xlabel="sweeps",
               ylabel="Q − truth")
        ax.set_title(name, loc="center", fontsize=9)
        ax.legend(loc="upper left" if positive else "lower right")
    return axes


def plot_steps(curves, points, axes=None, title=""):
    """Two actors take one step from the same action: one panel per case.

    curves: a dict from a panel's title to (action (N,), critic (N,), truth (N,)).
    points: the same titles to (start, climbs the critic, climbs the truth): actions.
    Dots lie on both curves, above the two actions that were reached.
    """
    axes = panels(axes, title, 1, len(curves), figsize=(8, 2.9), sharey=True)
    for ax, (name, (action, critic, truth)) in zip(np.ravel(axes), curves.items()):
        ax.plot(action, truth, label="truth $Q^π$", **TRUTH | {"linewidth": 2})
        ax.plot(action, critic, label="critic $Q_θ$", linewidth=2,
                **STYLE["DDPG"])
        start, *reached = points[name]
        for label, a in zip(("approx", "true"), reached):
            ax.axvline(a, color=GREY, linewidth=0.8, zorder=0)
            both = [np.interp(a, action, q) for q in (critic, truth)]
            ax.plot([a, a], both, "o", color="black", markersize=5)
            ax.annotate(label, (a, 0.02), xycoords=("data", "axes fraction"),
                        ha="center", fontsize=8.5,
                        bbox=dict(facecolor="white", edgecolor="none", pad=1))
            ax.annotate("", (a, 1), (start, 1), ("data", "axes fraction"),
                        arrowprops=dict(arrowstyle="->", color="0.3"))
        ax.set(xlabel="action")
        ax.set_title(name, loc="center", fontsize=9, pad=10)
    np.ravel(axes)[0].set_ylabel("value")
    np.ravel(axes)[0].legend(loc="center", bbox_to_anchor=(0.5, 0.3))
    return axes


def plot_error_and_share(pictures, limit, axes=None, title=""):
    """Maps over the state plane at some times: the mean error, and its sign.

    pictures: a dict from a step to a dict with x (N,), y (N,) and error (S, N, N) of S
    seeds. Above: the mean over seeds; colours end at ±limit. Below: the share of seeds
    that overestimate.
    """
    axes = panels(axes, title, 2, len(pictures), figsize=(7, 3.2), sharex=True,
                  sharey=True)
    grid = np.reshape(axes, (2, len(pictures)))
    for n, (step, picture) in enumerate(pictures.items()):
        error = picture["error"]
        mean = draw_map(grid[0, n], picture, error.mean(axis=0), ERRORS, -limit, limit)
        share = draw_map(grid[1, n], picture, 100 * (error > 0).mean(axis=0), "PuOr_r",
                     0, 100)
        note_mean(grid[0, n], error)
        grid[0, n].set_title(f"step {step:,}".replace(",", " "), loc="center",
                             fontsize=9)
        grid[0, n].set_xlabel("")
        grid[1, n].set_xlabel("")
        angle_ticks(grid[1, n], every=2)
    for ax in grid[:, 0]:
        ax.set_ylabel("velocity")
    figure = grid[0, 0].figure
    figure.supxlabel("angle (0 is upright)", fontsize=9)
    bar = figure.colorbar(mean, ax=grid[0], extend="both")
    bar.set_label("Q − truth\n← under   over →", fontsize=8)
    bar = figure.colorbar(share, ax=grid[1])
    bar.set_label("seeds that\noverestimate (%)", fontsize=8)
    return axes


def plot_owed(table, owed, control, debt, axes=None, title=""):
    """Bias during training, what is owed to lag, and a control with a frozen actor.

    table: bias of recorded runs, one row per evaluation, any algorithms; each seed of
    DDPG is a thin line. owed: (step (M,), bias (M,)) of DDPG. The scale is linear up to
    ±40 and logarithmic beyond. Right: control, a dict from a label to (updates (N,),
    bias (S, N)) of S runs, a thin line each; debt: (updates (M,), bias (M,)), what is
    owed where the actor is frozen.
    """
    axes = panels(axes, title, 1, 2, figsize=(7.2, 2.7), width_ratios=(3, 2))
    ax, right = axes
    for name, runs in table.groupby("algorithm", sort=False):
        seeds = runs.pivot(index="step", columns="seed", values="bias")
        if name == "DDPG":
            ax.plot(seeds, color="#F0B58A", linewidth=0.8)
        ax.plot(seeds.mean(axis=1), linewidth=2, label=name, **STYLE[name])
    ax.plot(*owed, color="0.5", linewidth=3, linestyle=(0, (1, 1)),
            label="owed by DDPG")
    ax.set_yscale("symlog", linthresh=40, linscale=2)
    ticks = [-40, -20, 0, 20, 40, 600]
    ax.set_yticks(ticks, ["−40", "−20", "0", "+20", "+40", "+600"])
    ax.set_yticks([], minor=True)
    ax.set(xlabel="environment steps", xticks=[0, 20_000, 40_000], ylim=(-45, 9_000))
    ax.set_ylabel("Q − truth, start states")
    note_sign(ax)
    ax.legend(loc="upper right", ncols=2)

    for (label, (updates, runs)), style in zip(control.items(), (ONE, TWO)):
        right.plot(updates, np.transpose(runs), linewidth=0.5, color=style["color"])
        right.plot(updates, np.mean(runs, axis=0), label=label,
                   **style | {"linewidth": 2.5})
    right.plot(*debt, label="owed if frozen", color="0.5", linewidth=3,
               linestyle=(0, (1, 1)))
    right.set(xlabel="updates after the freeze", xticks=[0, 10_000, 20_000])
    right.set_ylim(None, 1.6 * right.get_ylim()[1])  # room for the legend
    right.legend(loc="upper right")
    for ax, name in zip(axes, ("training", "control")):
        ax.axhline(0, **TRUTH)
        thousands(ax)
        ax.set_title(name, loc="center", fontsize=9)
    return axes


def plot_along_action(action, cases, added, axes=None, title=""):
    """Critic and truth along the action at some states, each less its own mean.

    action (N,); cases: a dict from a panel's title to (critic (N,), truth (N,)). The
    triangles mark where each is largest. Last panel, added: a dict from a label to
    (size (M,), share of costly choices (M,), %) when that error is added to a critic.
    """
    axes = panels(axes, title, 1, len(cases) + 1, figsize=(7.6, 2.7))
    styles = dict(critic=STYLE["DDPG"] | {"linewidth": 2}, truth=TRUTH)
    flat = np.ravel(axes)
    for ax, (name, pair) in zip(flat, cases.items()):
        for (label, style), values in zip(styles.items(), pair):
            level, top = values - values.mean(), values.argmax()
            ax.plot(action, level, label=label, **style)
            ax.plot(action[top], level[top], "v", color=style["color"], markersize=9)
        ax.set(xlabel="action")
        ax.set_title(name, loc="center", fontsize=9)
    flat[0].set_ylabel("value − mean over actions")
    flat[0].legend()
    for (label, values), style in zip(added.items(), (TWO, ONE)):
        flat[-1].plot(*values, marker="o", markersize=4, label=label, **style)
    flat[-1].set(xlabel="size of the added error", ylim=0)
    flat[-1].set_title("costly choices (% of states)", loc="center", fontsize=9)
    flat[-1].legend(loc="lower right")
    return axes
