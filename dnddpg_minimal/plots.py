"""The book's figures: one function per figure.

Each takes what was measured, draws it, and returns the axes. None of them trains. Pass
`ax` (or `axes`) to draw into a figure of your own. Titles state the finding, so the
caller, who knows it, passes them.

| call | shows |
|---|---|
| `plot_memory(memory, batches)` | batches of states over all the states in memory |
| `plot_q(curves, truth)` | Q during training, and what it should become |
| `plot_bias(curves, predicted)` | Q minus truth during training, and its prediction |
| `plot_learning(records, evaluations)` | returns of the episodes and of evaluations |
| `plot_filmstrip(pictures)` | a rollout in ten pictures |
| `plot_truth(picture, path)` | the true Q over two state variables, and one path |
| `plot_error_plane(picture)` | truth, a critic, and its error, side by side |
| `plot_partial_sums(sums, totals)` | discounted rewards added up to a return |
| `plot_true_q(position, action, q, lines)` | the true Q as a surface and as a map |
| `plot_finite_differences(steps, errors)` | how a step's size spoils a slope |
| `plot_slices(action, truth, guesses)` | Q along the action, true and guessed |
| `plot_decay(errors)` | how fast different errors die |
| `plot_learned_q(…)` | Q − truth as maps, and its mean over the updates |
| `plot_hill(first, second, height, paths, top)` | J over two gains, and climbers |
| `plot_slope_ways(gain, slope, ways)` | one slope, found in several ways |
| `plot_actor(position, best, actors)` | an actor's actions beside the best ones |
| `plot_price(slopes, bias, lost)` | what a critic's slope costs |
| `plot_targets(targets, expected)` | what one noisy target says, as a histogram |
| `plot_maximum(…)` | the same, and its mean over the number of actions |
| `plot_growth(panels)` | a bias made anew in each target, piling up |
| `plot_steps(curves, points)` | two actors' steps on a true and a learned Q |
| `plot_error_and_share(pictures, limit)` | mean error planes, share of seeds above 0 |
| `plot_owed(table, owed, control, predicted)` | bias, what lag owes, frozen actors |
| `plot_along_action(action, cases, added)` | error along the action: offset and slope |
| `plot_one_backup(x, forms, samples)` | closed forms of one target, and samples |
| `plot_over_training(table, columns)` | measured quantities over the steps, by seed |
| `plot_parts(parts)` | a bias taken apart into two sums |
| `plot_mean_planes(planes, limit)` | mean error planes of several algorithms |
| `plot_distance(curves)` | how far apart two actors' actions are |
| `plot_differences_by_seed(differences)` | paired differences, mean and interval |

The same algorithm has the same colour and the same kind of line everywhere. What is
true is black. The colours (Okabe and Ito, 2008) are told apart by colour-blind readers.

    python -m dnddpg_minimal.plots notebooks/03_ddpg.ipynb

writes a chapter's last figure to `notebooks/figures/03_ddpg.png`, which the chapter
shows at its top.
"""

import base64
import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

STYLE = {  # of the lines of each algorithm
    "DDPG": dict(color="#D55E00", linestyle="-"),
    "DCN-DDPG": dict(color="#0072B2", linestyle="--"),
    "DN-DDPG": dict(color="#009E73", linestyle="-."),
}
TRUTH = dict(color="black", linestyle="-", linewidth=1.2)
WRONG = dict(color="#CC79A7", linestyle=":", linewidth=2.4)  # a fault, on purpose
VALUES, ERRORS = "cividis", "RdBu_r"  # maps of values, and of errors around 0
SIGN = "overestimates ↑ / underestimates ↓"
GREY = "0.6"

plt.rcParams.update({
    "figure.dpi": 90,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
})


def plot_memory(memory, batches, axes=None):
    """Batches of states, each over the same memory. One panel per batch.

    memory (N, 2): angle in radians and velocity in radians per second; batches: a
    dict from a panel's title to rows (B,) of memory.
    """
    if axes is None:
        _, axes = plt.subplots(1, len(batches), figsize=(6.6, 2.7), sharey=True,
                               layout="constrained")
    for ax, (title, rows) in zip(axes, batches.items(), strict=True):
        ax.plot(*memory.T, "s", color="0.8", markersize=1.6, markeredgewidth=0)
        ax.plot(*memory[rows].T, "o", color=STYLE["DDPG"]["color"], markersize=4,
                markeredgewidth=0)
        ax.set(title=title, xlabel="angle (0 is upright)")
        _angle_ticks(ax)
    axes[0].set_ylabel("velocity")
    return axes


def plot_q(curves, truth, ax=None, title=""):
    """Q during training: a line for each run, a black line for the truth.

    curves: a dict from a label to (updates (M,), q (M,)); truth: one number.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3), layout="constrained")
    ax.axhline(truth, **TRUTH)
    _note(ax, truth, "truth")
    _lines(ax, curves)
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
    _note(ax, 0, SIGN)
    for label, level in (predicted or {}).items():
        ax.axhline(level, color=GREY, linewidth=1)
        _note(ax, level, label, above=False)
    _lines(ax, curves)
    ax.set(title=title, xlabel="updates", ylabel="bias = Q − truth")
    ax.margins(y=0.12)
    return ax


def style_of(label):
    """The line of a run whose label begins with an algorithm's name."""
    fault = " with " in label  # "DDPG with the wrong line": a fault, made on purpose
    return WRONG if fault else STYLE.get(label.split(",")[0], WRONG)


def _lines(ax, curves):
    for label, (updates, values) in curves.items():
        ax.plot(updates, values, label=label, **{"linewidth": 1.8} | style_of(label))
    _legend_below(ax)


def _legend_below(ax):
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=3)


def _note(ax, level, text, above=True):
    """Write above or below a horizontal line, at its right end."""
    ax.annotate(text, (0.995, level), xycoords=("axes fraction", "data"), ha="right",
                xytext=(0, 5 if above else -5), textcoords="offset points",
                va="bottom" if above else "top", fontsize=8.5)


def _thousands(ax):
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}".replace(",", " "))


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
        _note(ax, random, "random actions")
    ax.set(title=title, xlabel="environment steps", ylabel="return of an episode")
    _thousands(ax)
    _legend_below(ax)
    return ax


def plot_filmstrip(pictures, ax=None, title="", count=10, dt=0.05):
    """A rollout as `count` pictures side by side, the time written under each.

    pictures: arrays (height, width, 3) uint8, one per step of `dt` seconds.
    """
    chosen = np.linspace(0, len(pictures) - 1, count).round().astype(int)
    height, width = pictures[0].shape[:2]
    if ax is None:
        _, ax = plt.subplots(figsize=(8, 8 * height / width / count + 0.5),
                             layout="constrained")
    coarse = max(1, round(width / 80))  # pixels per pixel: a strip is small
    small = [_shrink(pictures[i], coarse) for i in chosen]
    ax.imshow(np.concatenate(small, axis=1), interpolation="nearest")
    w = small[0].shape[1]
    for n in range(1, count):
        ax.axvline(n * w - 0.5, color="0.85", linewidth=1)
    ax.set_xticks([(n + 0.5) * w for n in range(count)],
                  [f"{i * dt:.1f} s" for i in chosen])
    ax.set(yticks=[], title=title)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    return ax


def _shrink(picture, factor):
    """Mean over squares of factor × factor pixels."""
    height, width = (side // factor * factor for side in picture.shape[:2])
    squares = picture[:height, :width].reshape(height // factor, factor,
                                               width // factor, factor, -1)
    return squares.mean(axis=(1, 3)).astype(np.uint8)


def plot_truth(picture, path=None, ax=None, title=""):
    """The true Q over the state plane, and the path of one rollout.

    picture: what `bias.plane` returns; path (T, 2): the two state variables, from the
    ring to the star. An angle that passes ±π leaves on one side, returns on the other.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(5.2, 3.3), layout="constrained")
    image = _map(ax, picture, picture["truth"], VALUES)
    ax.figure.colorbar(image, ax=ax, label="true Q (discounted return)")
    if path is not None:
        path = np.array(path)
        if _is_angle(picture["x"]):
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


def plot_error_plane(picture, critic=0, axes=None, title="", limit=None):
    """Truth, critic and error over the state plane, side by side.

    picture: what `bias.plane` returns. The first two panels share one scale. In the
    third, red is where the critic overestimates, blue where it underestimates; colours
    end at ±`limit`, by default the 99th percentile of the error's size.
    """
    if axes is None:
        figure, axes = plt.subplots(1, 3, figsize=(7.6, 2.7), sharey=True,
                                    layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    q, truth = picture["q"][critic], picture["truth"]
    error = q - truth
    limit = np.quantile(np.abs(error), 0.99) if limit is None else limit
    low, high = min(q.min(), truth.min()), max(q.max(), truth.max())
    _map(axes[0], picture, truth, VALUES, low, high)
    image = _map(axes[1], picture, q, VALUES, low, high)
    axes[0].figure.colorbar(image, ax=axes[:2])
    image = _map(axes[2], picture, error, ERRORS, -limit, limit)
    bar = axes[0].figure.colorbar(image, ax=axes[2], extend="both")
    # Turned by 90 degrees, the arrows point down and up.
    bar.set_label("← underestimates    overestimates →", fontsize=8)
    for ax, name in zip(axes, ("the truth", "what the critic says", "Q − truth"),
                        strict=True):
        ax.set_title(name, loc="center", fontsize=9)
    axes[0].set_ylabel("velocity")
    return axes


def _map(ax, picture, values, colours, low=None, high=None):
    """One map over the state plane; its axes are [y, x]."""
    x, y = picture["x"], picture["y"]
    colours = plt.get_cmap(colours, 25)  # few colours: a small file
    image = ax.imshow(values, origin="lower", aspect="auto", cmap=colours, vmin=low,
                      vmax=high, extent=(x[0], x[-1], y[0], y[-1]),
                      interpolation="nearest")
    ax.spines[:].set_visible(False)
    ax.set_xlabel("angle (0 is upright)")
    if _is_angle(x):
        _angle_ticks(ax)
    return image


def _is_angle(x):
    return np.allclose((x[0], x[-1]), (-np.pi, np.pi), atol=0.01)  # recorded: float16


def _angle_ticks(ax):
    ax.set_xticks([-np.pi, -np.pi / 2, 0, np.pi / 2, np.pi],
                  ["−π", "−π/2", "0", "π/2", "π"])


# --- chapters 01, 02 ------------------------------------------------------------------

ONE = dict(color="#E69F00", linestyle="-", linewidth=2)  # lines of no algorithm
TWO = dict(color="#56B4E9", linestyle="--", linewidth=2)
THREE = dict(color="#CC79A7", linestyle=":", linewidth=2.4)


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
        figure = plt.figure(figsize=(6, 2.3), layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
        axes = figure.add_subplot(1, 2, 1, projection="3d"), figure.add_subplot(1, 2, 2)
    hill, flat = axes
    hill.plot_surface(*np.meshgrid(position, action), q, edgecolor="white",
                      cmap=plt.get_cmap(VALUES, 12), rcount=9, ccount=9, linewidth=0.4)
    hill.set(xticks=[-1, 0, 1], yticks=[-1, 0, 1], zticks=[-4, -2, 0])
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
    flat.legend(loc="lower left", fontsize=8, frameon=True)
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


def plot_decay(errors, share=0.01, ax=None, title=""):
    """What is left of an error after n backups, as a share of its first size.

    errors: a dict from a label to (N,), starting with 1. A thin line marks `share`.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3), layout="constrained")
    for (label, values), style in zip(errors.items(), (ONE, TWO, THREE)):
        ax.semilogy(values, label=label, **style)
    ax.axhline(share, color=GREY, linewidth=1)
    ax.annotate(f"{share:.0%} is left", (0.99, share), ha="right", va="bottom",
                xycoords=("axes fraction", "data"), color="0.4")
    ax.set(title=title, xlabel="backups", ylabel="share of the error",
           ylim=(share / 5, 1.2))
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
    _zero_line(below)
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
    if axes is None:
        figure, axes = plt.subplots(1, 2, figsize=(6.6, 2.8), layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    marks = (("o", ONE), ("s", TWO), ("^", THREE))
    _zero_line(axes[0])
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
    axes[0].set(ylabel="Q − truth")
    axes[0].margins(y=0.2)
    axes[1].set(ylabel="true value lost")
    return axes


def _zero_line(ax):
    """The line where a critic is right, and which side of it is which."""
    ax.axhline(0, color="black", linewidth=0.8)
    _note(ax, 0, SIGN, above=False)


# --- chapters 05, 06 ------------------------------------------------------------------


def plot_one_backup(x, forms, samples, measured=None, xlabel="", legend="best",
                    ax=None, title=""):
    """The bias that one target makes: closed forms as lines, samples as marks.

    x (N,); forms: a dict from a label to (N,), in units of σ; samples: the same labels
    to (x, bias) of simulated errors. measured: (low, high), the range of x that was
    measured on trained critics, drawn as a grey band.
    legend: its place, as Matplotlib's `loc`.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    ax.axhline(0, **TRUTH)
    if measured is not None:
        ax.axvspan(*measured, color="0.85", linewidth=0)
        ax.annotate("measured", (np.mean(measured), 0.03), ha="center", va="bottom",
                    rotation=90, xycoords=("data", "axes fraction"), fontsize=8)
    for (label, values), style in zip(forms.items(), (ONE, TWO, THREE)):
        ax.plot(x, values, label=label, **style)
        if label in samples:
            ax.plot(*samples[label], "o", markersize=4.5, markerfacecolor="white",
                    markeredgecolor=style["color"])
    ax.set(title=title, xlabel=xlabel, ylabel=f"bias of one target / σ\n{SIGN}")
    ax.yaxis.label.set_size(8)
    ax.legend(loc=legend)
    return ax


def plot_over_training(table, columns, log=(), limits=None, axes=None, title=""):
    """Recorded quantities during training: a thin line for each seed, their mean thick.

    table: a DataFrame of `load_study`, any algorithms, one row per evaluation. columns:
    a dict from a column's name to a panel's label. "bias" gets a zero line; a column
    named in `log` a logarithmic axis; limits: a column's name to (low, high). Steps at
    which something was not measured (NaN) are passed over.
    """
    if axes is None:
        figure, axes = plt.subplots(1, len(columns), figsize=(6.2, 2.5), squeeze=False,
                                    layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    for ax, (column, label) in zip(np.ravel(axes), columns.items()):
        if column == "bias":
            ax.axhline(0, **TRUTH)
            label = f"{label}\n{SIGN}"
        for name, runs in table.groupby("algorithm", sort=False):
            seeds = runs.pivot(index="step", columns="seed", values=column).dropna()
            style = STYLE[name]
            # Pale and without smooth edges: few colours, a small file.
            ax.plot(seeds.index, seeds, color=_pale(style["color"]), linewidth=0.6,
                    antialiased=False)
            ax.plot(seeds.index, seeds.mean(axis=1), linewidth=2, label=name, **style,
                    zorder=3)
        ax.set(xlabel="environment steps", ylabel=label)
        ax.yaxis.label.set_size(7.5 if column == "bias" else 9)
        if column in log:
            ax.set_yscale("log")
        ax.set_ylim((limits or {}).get(column))
        ax.xaxis.set_major_locator(plt.MaxNLocator(4))
        _thousands(ax)
    if table.algorithm.nunique() > 1:
        np.ravel(axes)[-1].legend(loc="best", fontsize=8)
    return axes


def _pale(colour, share=0.65):
    """The colour, mixed with white."""
    rgb = np.array(plt.matplotlib.colors.to_rgb(colour))
    return share + (1 - share) * rgb


def plot_parts(parts, ax=None, title=""):
    """A bias and the two sums that it is made of: a mark for each run.

    parts: a dict from an algorithm to (runs, 3): how far the critic lies above its own
    targets, what the rule of the target adds, and both together, the bias.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    ax.axhline(0, **TRUTH)
    _note(ax, 0, SIGN)
    for n, (name, values) in enumerate(parts.items()):
        style = STYLE[name]
        for m, column in enumerate(np.transpose(values)):
            x = m + 0.2 * (n - (len(parts) - 1) / 2)
            ax.plot([x - 0.07, x + 0.07], [column.mean()] * 2, linewidth=2.5,
                    color=style["color"], label=name if m == 0 else None)
            ax.plot(np.full(len(column), x), column, "o", markersize=4.5,
                    markerfacecolor="white", markeredgecolor=style["color"])
    ax.set_xticks(range(3), ["critic above its targets", "rule of the target",
                             "sum = bias"])
    ax.set(title=title, ylabel="mean over start states", xlim=(-0.5, 2.9))
    _legend_below(ax)
    return ax


def plot_mean_planes(planes, limit, axes=None, title=""):
    """Maps of the mean error: a row for each algorithm, a column for each time.

    planes: a dict from an algorithm to a dict from a step to a picture with x (N,),
    y (N,) and error (N, N). Colours end at ±limit.
    """
    rows, columns = len(planes), len(next(iter(planes.values())))
    if axes is None:
        figure, axes = plt.subplots(rows, columns, sharex=True, sharey=True,
                                    figsize=(1.6 * columns + 1, 1.2 * rows + 0.7),
                                    squeeze=False, layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    for r, (name, pictures) in enumerate(planes.items()):
        for ax, (step, picture) in zip(axes[r], pictures.items()):
            # Few shades, a small file; none is white, so that the sign is always seen.
            shades = (np.floor(picture["error"] / limit * 5) + 0.5) / 5 * limit
            image = _map(ax, picture, shades, ERRORS, -limit, limit)
            mean = picture["error"].mean()
            ax.annotate(f"mean {mean:+.0f}".replace("-", "−"), (0.97, 0.04),
                        xycoords="axes fraction", ha="right", fontsize=8.5,
                        bbox=dict(facecolor="white", edgecolor="none", pad=1))
            if np.allclose(picture["x"][-1], np.pi, atol=0.01):
                _angle_ticks(ax)
            if r == 0:
                ax.set_title(f"step {step:,}".replace(",", " "), loc="center",
                             fontsize=9)
            if r < rows - 1:
                ax.set_xlabel("")
        axes[r, 0].set_ylabel(f"{name}\nvelocity")
    bar = axes[0, 0].figure.colorbar(image, ax=axes, extend="both")
    bar.set_label("← underestimates    overestimates →", fontsize=8)
    return axes


def plot_distance(curves, ax=None, title=""):
    """The distance of two actors during their first updates: a line for each start.

    curves: a dict from a label to (updates (M,), distance (M,)).
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6, 2.7), layout="constrained")
    for (label, values), style in zip(curves.items(), (ONE, TWO, THREE)):
        ax.plot(*values, label=label, **style)
    ax.set(title=title, xlabel="updates", ylabel="mean |a₁ − a₂|, a in [−1, 1]")
    ax.legend()
    return ax


def plot_differences_by_seed(differences, predicted=None, axes=None, title=""):
    """Paired differences: a dot for each seed, the mean, and its 95 % t interval.

    differences: a dict from a panel's label to a dict from a pair's name to a pair
    (values (n,), (low, high)). predicted: the same labels and names to one number, a
    cross; a panel without a prediction may be missing.
    """
    if axes is None:
        rows = max(map(len, differences.values()))
        figure, axes = plt.subplots(1, len(differences), sharey=True,
                                    figsize=(8, 1 + 0.6 * rows), layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    for ax, (label, pairs) in zip(np.ravel(axes), differences.items()):
        ax.axvline(0, **TRUTH)
        for n, (values, interval) in enumerate(pairs.values()):
            ax.plot(values, np.full(len(values), n + 0.18), "o", markersize=4.5,
                    markerfacecolor="white", markeredgecolor="0.4")
            ax.plot(interval, [n, n], color="black", linewidth=1.5)
            ax.plot(np.mean(values), n, "D", color="black", markersize=6)
        for name, value in (predicted or {}).get(label, {}).items():
            ax.plot(value, list(pairs).index(name) - 0.2, "x", markersize=7,
                    markeredgewidth=2, color=THREE["color"])
        ax.set_yticks(range(len(pairs)), list(pairs))
        ax.set(xlabel=label, ylim=(len(pairs) - 0.5, -0.5))
    return axes


# --- chapter 04 -----------------------------------------------------------------------


def plot_targets(targets, expected=None, ax=None, title=""):
    """How simulated targets scatter around the truth, 0: their histogram and mean.

    targets (N,); expected: the closed form of their mean, or None.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(4, 2.9), layout="constrained")
    color = STYLE["DDPG"]["color"]
    ax.hist(targets, np.linspace(-6, 8, 85), density=True, histtype="stepfilled",
            color=color, alpha=0.45)  # one shape: quick to draw
    ax.axvline(0, label="truth", **TRUTH)
    ax.axvline(targets.mean(), color=color, linewidth=2.5,
               label=f"mean {targets.mean():+.2f}")
    if expected is not None:
        ax.axvline(expected, color="black", linestyle=":", linewidth=1.8,
                   label=f"closed form {expected:+.2f}")
    ax.set(title=title, xlabel="what the target says − truth", yticks=[], xlim=(-6, 8))
    ax.legend(loc="upper left")
    return ax


def plot_maximum(targets, expected, counts, curves, samples, axes=None, title=""):
    """Eq. 5: how maxima scatter, and their mean against the number of actions.

    targets (N,) and expected as in `plot_targets`. counts (M,); curves: a dict from a
    label to the closed form (M,); samples: the same labels to simulated means (M,).
    """
    if axes is None:
        figure, axes = plt.subplots(1, 2, figsize=(8, 2.9), layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    plot_targets(targets, expected, axes[0])
    ax = axes[1]
    ax.axhline(0, **TRUTH)
    for (label, values), style in zip(curves.items(), (ONE, TWO, THREE)):
        ax.plot(counts, values, label=label, **style)
        ax.plot(counts, samples[label], "o", markersize=4.5, markerfacecolor="white",
                markeredgecolor=style["color"])
    ax.set(xlabel="number of actions", ylabel="mean of the maximum / σ")
    ax.legend()
    return axes


def plot_growth(panels, axes=None, title=""):
    """How a bias grows from sweep to sweep: a line for each case, its limit dotted.

    panels: a dict from a panel's title to a dict from a label to (bias (N,), limit).
    """
    if axes is None:
        figure, axes = plt.subplots(1, len(panels), figsize=(7.4, 2.7),
                                    layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    for ax, (name, cases) in zip(axes, panels.items()):
        for (label, (values, limit)), style in zip(cases.items(), (ONE, TWO, THREE)):
            sweep = np.unique(np.geomspace(1, len(values), 50).astype(int))
            ax.plot(sweep, values[sweep - 1], label=label, **style)
            ax.axhline(limit, color="black", linestyle=":", linewidth=1.2)
        positive = min(values.min() for values, _ in cases.values()) > 0
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
    if axes is None:
        figure, axes = plt.subplots(1, len(curves), figsize=(8, 2.9), sharey=True,
                                    layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
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
    np.ravel(axes)[0].legend(loc="center right", bbox_to_anchor=(1, 0.72))
    return axes


def plot_error_and_share(pictures, limit, axes=None, title=""):
    """Maps over the state plane at some times: the mean error, and its sign.

    pictures: a dict from a step to a dict with x (N,), y (N,) and error (S, N, N) of S
    seeds. Above: the mean over seeds; colours end at ±limit. Below: the share of seeds
    that overestimate.
    """
    if axes is None:
        figure, axes = plt.subplots(2, len(pictures), figsize=(7, 3.2), sharex=True,
                                    sharey=True, layout="constrained", dpi=75)
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    for n, (step, picture) in enumerate(pictures.items()):
        error = picture["error"]
        mean = _map(axes[0, n], picture, error.mean(axis=0), ERRORS, -limit, limit)
        share = _map(axes[1, n], picture, 100 * (error > 0).mean(axis=0), "PuOr_r",
                     0, 100)
        axes[0, n].set_title(f"step {step:,}".replace(",", " "), loc="center",
                             fontsize=9)
        axes[0, n].set_xlabel("")
        axes[1, n].set_xlabel("" if n else "angle (0 is upright)")
    for row in axes:
        row[0].set_ylabel("velocity")
    figure = axes[0, 0].figure
    bar = figure.colorbar(mean, ax=axes[0], extend="both")
    bar.set_label("Q − truth\n← under   over →", fontsize=8)
    bar = figure.colorbar(share, ax=axes[1])
    bar.set_label("seeds that\noverestimate (%)", fontsize=8)
    return axes


def plot_owed(table, owed, control, predicted, axes=None, title=""):
    """Bias during training, what is owed to lag, and a control with a frozen actor.

    table: bias of recorded runs, one row per evaluation, any algorithms; each seed of
    DDPG is a thin line. owed: (step (M,), bias (M,)) of DDPG. The scale is linear up to
    ±40 and logarithmic beyond. Right: control, a dict from a label to (updates (N,),
    bias (S, N)) of S agents, one dot each; predicted: (updates (M,), bias (M,)) of the
    frozen ones.
    """
    if axes is None:
        figure, axes = plt.subplots(1, 2, figsize=(7.2, 2.7), layout="constrained",
                                    width_ratios=(3, 2), dpi=75)  # a small file
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    ax, right = axes
    for name, runs in table.groupby("algorithm", sort=False):
        seeds = runs.pivot(index="step", columns="seed", values="bias")
        if name == "DDPG":
            ax.plot(seeds, color="#F0B58A", linewidth=0.8, antialiased=False)
        ax.plot(seeds.mean(axis=1), linewidth=2, label=name, **STYLE[name])
    ax.plot(*owed, color="0.5", linewidth=3, linestyle=(0, (1, 1)),
            label="owed by DDPG")
    ax.set_yscale("symlog", linthresh=40, linscale=2)
    ticks = [-40, -20, 0, 20, 40, 600]
    ax.set_yticks(ticks, [f"{tick:+d}".replace("-", "−") for tick in ticks])
    ax.set_yticks([], minor=True)
    ax.set(xlabel="environment steps", xticks=[0, 20_000, 40_000], ylim=(-45, 9_000))
    ax.set_ylabel(f"Q − truth, start states\n{SIGN}", fontsize=8)
    ax.legend(loc="upper right", ncols=2)

    for (label, (updates, runs)), style in zip(control.items(), (ONE, TWO)):
        right.plot(updates, np.transpose(runs), "o", markersize=4,
                   markerfacecolor="white", markeredgecolor=style["color"])
        right.plot(updates, np.mean(runs, axis=0), label=label, **style)
    right.plot(*predicted, label="predicted", color="black", linestyle=":")
    right.set(xlabel="further updates", xticks=[0, 1_000, 2_000])
    right.set_ylim(-5, 1.6 * right.get_ylim()[1])  # room for the legend
    right.legend(loc="upper right")
    for ax, name in zip(axes, ("training", "control")):
        ax.axhline(0, **TRUTH)
        _thousands(ax)
        ax.set_title(name, loc="center", fontsize=9)
    return axes


def plot_along_action(action, cases, added, axes=None, title=""):
    """Critic and truth along the action at some states, each less its own mean.

    action (N,); cases: a dict from a panel's title to (critic (N,), truth (N,)). The
    triangles mark where each is largest. Last panel, added: a dict from a label to
    (size (M,), share of costly choices (M,), %) when that error is added to a critic.
    """
    if axes is None:
        figure, axes = plt.subplots(1, len(cases) + 1, figsize=(7.6, 2.7),
                                    layout="constrained")
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    styles = dict(critic=STYLE["DDPG"] | {"linewidth": 2}, truth=TRUTH)
    for ax, (name, pair) in zip(axes, cases.items()):
        for (label, style), values in zip(styles.items(), pair):
            level, top = values - values.mean(), values.argmax()
            ax.plot(action, level, label=label, **style)
            ax.plot(action[top], level[top], "v", color=style["color"], markersize=9)
        ax.set(xlabel="action")
        ax.set_title(name, loc="center", fontsize=9)
    axes[0].set_ylabel("value − mean over actions")
    axes[0].legend()
    for (label, values), style in zip(added.items(), (TWO, ONE)):
        axes[-1].plot(*values, marker="o", markersize=4, label=label, **style)
    axes[-1].set(xlabel="size of the added error", ylim=0)
    axes[-1].set_title("costly choices (% of states)", loc="center", fontsize=9)
    axes[-1].legend(loc="lower right")
    return axes


def save_last_figure(notebook):
    """Write the last figure of an executed notebook beside it, → the file's path."""
    notebook = Path(notebook)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    figures = [output["data"]["image/png"] for cell in cells
               for output in cell.get("outputs", [])
               if "image/png" in output.get("data", {})]
    if not figures:
        raise ValueError(f"{notebook} holds no figure: run it first.")
    path = notebook.parent / "figures" / f"{notebook.stem}.png"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(base64.b64decode("".join(figures[-1])))
    return path


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(save_last_figure(argument))
