"""Figures of chapter 07: the arm, its fastest path, what was learned, and hovering."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import BoundaryNorm

from dnddpg_minimal import arm
from dnddpg_minimal.plots.style import (
    ERRORS,
    GREY,
    ONE,
    SIGN_BAR,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    VALUES,
    pale,
    panels,
    shades,
    thousands,
)

GOAL = "#569CD6"  # as the environment draws it
SEEN = ("elbow x", "elbow y", "finger x", "finger y", "elbow to goal x",
        "elbow to goal y", "finger to goal x", "finger to goal y", "on goal")
PROPOSALS = (ONE, TWO)  # the lines of actor 1, actor 2
FATES = {"arrives and stays": "#009E73", "crosses the edge": "#E69F00",
         "rests beside it": "#CC79A7", "anything else": "0.75"}


def draw_arm(ax, state, colour="0.35", alpha=1.0, **more):
    """One arm on axes in px from the base: links, elbow, finger. state (5,).

    colour, alpha and whatever `more` says are the links', as Matplotlib knows them.
    """
    elbow, finger = arm.locate(np.atleast_2d(state)[:, :2])[0]
    x, y = np.array([[0, 0], elbow, finger]).T
    ax.plot(x, y, color=colour, linewidth=4, alpha=alpha, solid_capstyle="round",
            **more)
    ax.plot(x[:2], y[:2], "o", color="black", markersize=4, alpha=alpha)
    ax.plot(*finger, "o", color=STYLE["DDPG"]["color"], markersize=6, alpha=alpha)


def draw_room(ax, goal):
    """The disk that the finger can reach, and the goal square; goal (xy) px, window."""
    half, centre = arm.GOAL_HALF, np.asarray(goal) - arm.BASE
    ax.add_patch(plt.Circle((0, 0), arm.REACH, color="0.95", zorder=0))
    ax.add_patch(plt.Rectangle(centre - half, 2 * half, 2 * half, color=GOAL,
                               alpha=0.6, linewidth=0, zorder=1))
    ax.plot(*centre, ".", color="white", markersize=3)
    ax.set(xlim=(-205, 205), ylim=(-205, 205), aspect="equal")
    ax.set_xticks([-200, 0, 200])
    ax.set_yticks([-200, 0, 200])
    ax.tick_params(labelsize=7)


def plot_arm(state, paths=(), q=None, axes=None, title=""):
    """One state: the arm in its room, the observation, Q of each actor's proposal.

    state (5,). paths: one (T, xy) per actor, px from the base: the finger's way if that
    actor alone acts. q (C, K): critic c's opinion of actor k's proposal, or None.
    axes: three of them.
    """
    axes = panels(axes, title, 1, 3, figsize=(7.6, 2.8), width_ratios=(1, 0.6, 0.8))
    room, seen, opinion = axes
    draw_room(room, state[2:4])
    for k, path in enumerate(paths):
        room.plot(*np.transpose(path), **PROPOSALS[k % 2], zorder=4)
        room.plot(*path[-1], "o", markersize=4, color=PROPOSALS[k % 2]["color"],
                  zorder=4)
    draw_arm(room, state)
    room.set(xticks=[], yticks=[])  # few ticks: a panel must be quick
    room.spines[:].set_visible(False)
    obs = arm.observe(np.atleast_2d(state))[0]
    rows = np.arange(len(obs))
    seen.hlines(rows, 0, obs, color=GREY, linewidth=7)
    seen.axvline(0, **TRUTH)
    for row, name, value in zip(rows, SEEN, obs):
        seen.text(-1.15, row, name, ha="right", va="center", fontsize=7.5)
        text = f"{value:+.2f}".replace("-", "−")
        seen.text(1.15, row, text, ha="left", va="center", fontsize=7.5)
    seen.set(xlim=(-1.1, 1.1), ylim=(len(obs) - 0.5, -0.5), xticks=[], yticks=[])
    seen.spines[:].set_visible(False)
    for ax, name in zip(axes, ("the arm", "its observation", "Q of the proposals")):
        ax.set_title(name, loc="center", fontsize=8.5)
    draw_opinion(opinion, q)
    return axes


def draw_opinion(ax, q):
    """Each critic's Q of each actor's proposal, as dots with numbers. q (C, K)."""
    ax.spines[:].set_visible(False)
    ax.set(xticks=[], yticks=[])
    if q is None:
        ax.text(0.5, 0.5, "no agent recorded", ha="center")
        return
    critics, actors = np.shape(q)
    low, high = np.min(q), np.max(q)
    room = max(high - low, 0.05)
    for k in range(actors):
        x = np.arange(critics) + k * (critics + 0.6)
        colour = PROPOSALS[k % 2]["color"]
        ax.plot(x, q[:, k], "o", markersize=8, color=colour)
        for c in range(critics):
            value = f"{q[c, k]:.2f}".replace("-", "−")
            ax.text(x[c], q[c, k] + 0.12 * room, value, ha="center", fontsize=7.5)
            ax.text(x[c], low - 0.35 * room, f"Q{c + 1}", ha="center", fontsize=8)
        ax.text(x.mean(), low - 0.58 * room, f"actor {k + 1}", ha="center", fontsize=8)
    ax.set(xlim=(-0.7, x[-1] + 0.7), ylim=(low - 0.65 * room, high + 0.4 * room))


def draw_joints(ax, values, colours, low=None, high=None, norm=None):
    """A map over the two joints, 0 to 2π each; values (N, N), [joint 2, joint 1].

    colours: a colour map, from `low` to `high` or by `norm`, as Matplotlib's imshow.
    """
    turn = 2 * np.pi
    image = ax.imshow(values, origin="lower", extent=(0, turn, 0, turn), cmap=colours,
                      vmin=low, vmax=high, norm=norm, interpolation="nearest")
    ax.spines[:].set_visible(False)
    ax.set_xticks([0, np.pi, turn], ["0", "π", "2π"])
    ax.set_yticks([0, np.pi, turn], ["0", "π", "2π"])
    return image


def draw_goal_over_joints(ax):
    """The edge of the easy goal over the two joints: a spot for each branch."""
    side = np.linspace(0, 2 * np.pi, 161)
    states = np.zeros((side.size**2, 5))
    states[:, 0], states[:, 1] = np.tile(side, side.size), np.repeat(side, side.size)
    states[:, 2:4] = arm.EASY_GOAL
    on_goal = arm.observe(states)[:, 8].reshape(side.size, side.size)
    ax.contour(side, side, on_goal, [0.5], colors="black", linewidths=0.9)


def plot_fastest(steps, start, ends, counts, axes=None, title=""):
    """The fastest path: steps over the two joints, and two ways to one goal.

    steps (N, N): steps to the easy goal, [joint 2, joint 1]. start (5,); ends: a state
    (5,) for each elbow branch; counts: the steps that each takes.
    """
    axes = panels(axes, title, 1, 2, figsize=(7, 3), width_ratios=(1.15, 1))
    colours = plt.get_cmap(VALUES, 8)
    image = draw_joints(axes[0], steps, colours, norm=BoundaryNorm(range(0, 33, 4), 8))
    axes[0].figure.colorbar(image, ax=axes[0], label="steps to the goal")
    draw_goal_over_joints(axes[0])
    axes[0].plot(start[0], start[1], "o", markersize=8, markeredgecolor="black",
                 markerfacecolor="white")
    axes[0].set(xlabel="joint 1", ylabel="joint 2")
    draw_room(axes[1], start[2:4])
    draw_arm(axes[1], start, alpha=0.9)
    axes[1].annotate("start", arm.locate(start[None, :2])[0, 1], fontsize=8.5,
                     xytext=(6, 4), textcoords="offset points")
    for end, count, style in zip(ends, counts, PROPOSALS):
        draw_arm(axes[1], end, colour=style["color"], alpha=0.8)
        elbow, finger = arm.locate(end[None, :2])[0]
        beside = elbow + 0.5 * (elbow - finger / 2)  # on the outer side of the elbow
        axes[1].annotate(f"{count:.0f} steps", beside, ha="center", va="center",
                         fontsize=8.5)
    axes[1].set_xlabel("px from the base")
    return axes


def plot_reaching(tables, columns, references=None, log=(), axes=None, title=""):
    """Recorded numbers of several tasks during training: a row each.

    tables: a dict from a task's name to a DataFrame of `load_study`. columns: a dict
    from a column's name to its label; one named in `log` gets an axis that is
    logarithmic above 1. A thin line for each seed, the mean thick.
    references: {(task, column): one number}, drawn as a black line.
    """
    axes = panels(axes, title, len(tables), len(columns), figsize=(6, 3.1),
                  squeeze=False, sharex=True)
    grid = np.reshape(axes, (len(tables), len(columns)))
    for r, (task, table) in enumerate(tables.items()):
        for c, (column, label) in enumerate(columns.items()):
            ax = grid[r, c]
            for name, runs in table.groupby("algorithm", sort=False):
                seeds = runs.pivot(index="step", columns="seed", values=column)
                style = STYLE[name]
                if seeds.shape[1] > 1:
                    ax.plot(seeds.index, seeds, color=pale(style["color"]),
                            linewidth=0.6)
                ax.plot(seeds.index, seeds.mean(axis=1), label=name, linewidth=1.8,
                        zorder=3, **style)
            if (task, column) in (references or {}):
                ax.axhline(references[task, column], **TRUTH)
            if column in log:
                ax.set_yscale("symlog", linthresh=1)
                ax.set_yticks([0, 1, 10, 100], ["0", "1", "10", "100"])
                ax.minorticks_off()
                ax.set_ylim(bottom=-0.5)
            ax.set_title(label if r == 0 else "", loc="center", fontsize=9)
            thousands(ax)
            ax.xaxis.set_major_locator(plt.MaxNLocator(4))
        grid[r, 0].set_ylabel(task)
    for ax in grid[-1]:
        ax.set_xlabel("environment steps")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    grid[0, 0].figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return axes


def plot_joint_errors(pictures, limit, axes=None, title=""):
    """Maps of a critic's error over the two joints: tasks down, algorithms across.

    pictures: {task: {algorithm: error (N, N)}}, [joint 2, joint 1]. Colours end at
    ±limit. The black line is the edge of the goal.
    """
    rows, columns = len(pictures), max(map(len, pictures.values()))
    axes = panels(axes, title, rows, columns, sharex=True, sharey=True,
                  figsize=(1.75 * columns + 1.2, 1.6 * rows + 0.5), squeeze=False)
    grid = np.reshape(axes, (rows, columns))
    for r, (task, maps) in enumerate(pictures.items()):
        for ax in grid[r, len(maps):]:
            ax.axis("off")
        for ax, (name, error) in zip(grid[r], maps.items()):
            image = draw_joints(ax, shades(error, limit, 4), ERRORS, -limit, limit)
            draw_goal_over_joints(ax)
            mean = f"{round(error.mean(), 2) + 0.0:+.2f}".replace("-", "−")
            ax.set_title(f"{name}, mean {mean}", loc="center", fontsize=8.5)
            if r == rows - 1:
                ax.set_xlabel("joint 1")
        grid[r, 0].set_ylabel(f"{task}\njoint 2")
    bar = grid[0, 0].figure.colorbar(image, ax=axes, extend="both")
    bar.set_label(SIGN_BAR, fontsize=8)
    return axes


def plot_fates(fates, ax=None, title=""):
    """What became of 100 starts, for several agents: stacked bars.

    fates: a dict from an agent's label to a dict from a name of `FATES` to a share.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.6, 0.9 + 0.27 * len(fates)),
                             layout="constrained")
    left = np.zeros(len(fates))
    for name, colour in FATES.items():
        share = np.array([of.get(name, 0.0) for of in fates.values()])
        ax.barh(range(len(fates)), share, left=left, color=colour, label=name,
                height=0.75)
        left += share
    ax.set_yticks(range(len(fates)), list(fates), fontsize=8)
    ax.set(title=title, xlabel="share of the starts", xlim=(0, 1),
           ylim=(len(fates) - 0.5, -0.5))
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return ax


def plot_hovering(worth, counters, axes=None, title=""):
    """Left: what each way to behave is worth. Right: steps on goal in a row, in time.

    worth: a dict from a way's name to its value; the first is drawn black: to arrive.
    counters: a dict from a label to the counter (T,) of one episode, one panel each.
    axes: the left one, then one for each counter.
    """
    if axes is None:
        figure = plt.figure(figsize=(7.4, 1.2 + 0.62 * len(counters)),
                            layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        grid = figure.add_gridspec(len(counters), 2, width_ratios=(1, 1.2))
        axes = [figure.add_subplot(grid[:, 0])]
        axes += [figure.add_subplot(grid[n, 1]) for n in range(len(counters))]
    bars, *traces = axes
    colours = ["black"] + [THREE["color"]] * (len(worth) - 1)
    bars.barh(range(len(worth)), list(worth.values()), color=colours, height=0.6)
    for n, value in enumerate(worth.values()):
        bars.annotate(f"{value:.1f}", (value, n), xytext=(3, 0), va="center",
                      textcoords="offset points", fontsize=8)
    bars.set_yticks(range(len(worth)), list(worth), fontsize=8)
    bars.set(xlabel="discounted return from arrival on", ylim=(len(worth) - 0.5, -0.5))
    bars.margins(x=0.18)
    for ax, (label, counter) in zip(traces, counters.items()):
        ax.plot(np.arange(1, len(counter) + 1), counter, color=THREE["color"],
                linewidth=1.3)
        ax.axhline(arm.HOLD + 1, **TRUTH)  # success
        ax.set(xlim=(0, 300), ylim=(0, 58), yticks=[0, arm.HOLD + 1])
        ax.set_title(label, fontsize=8.5, pad=2)
        if ax is not traces[-1]:
            ax.set_xticklabels([])
    traces[len(traces) // 2].set_ylabel("steps in a row\non the goal", fontsize=8.5)
    traces[-1].set_xlabel("step of the episode")
    return axes
