"""Figures of chapters 05 and 06: closed forms, two critics, two actors."""

import matplotlib.pyplot as plt
import numpy as np

from dnddpg_minimal.plots.style import (
    ERRORS,
    ONE,
    SIGN,
    SIGN_BAR,
    SIGN_TURNED,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    angle_ticks,
    draw_map,
    is_angle,
    legend_below,
    note_level,
    pale,
    panels,
    shades,
    thousands,
)


def plot_one_backup(x, forms, samples, measured=None, xlabel="", legend="best",
                    ax=None, title=""):
    """The bias that one target makes: closed forms as lines, samples as marks.

    x (N,); forms: a dict from a label to (N,), in units of σ; samples: the same labels
    to (x, bias) of simulated errors. measured: (low, high), the range of x that was
    measured on trained critics, drawn as a grey band. xlabel: what x is; legend: its
    place, as Matplotlib's `loc`.
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
    ax.set(title=title, xlabel=xlabel, ylabel=f"bias of one target / σ\n{SIGN_TURNED}")
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
    axes = panels(axes, title, 1, len(columns), figsize=(7, 2.7), squeeze=False)
    for ax, (column, label) in zip(np.ravel(axes), columns.items()):
        if column == "bias":
            ax.axhline(0, **TRUTH)
        for name, runs in table.groupby("algorithm", sort=False):
            seeds = runs.pivot(index="step", columns="seed", values=column).dropna()
            style = STYLE[name]
            ax.plot(seeds.index, seeds, color=pale(style["color"]), linewidth=0.6)
            ax.plot(seeds.index, seeds.mean(axis=1), linewidth=2, label=name, **style,
                    zorder=3)
        ax.set(xlabel="environment steps", ylabel=label)
        if column in log:
            ax.set_yscale("log")
        ax.set_ylim((limits or {}).get(column))
        if column == "bias":
            low, high = ax.get_ylim()
            ax.set_ylim(low - 0.08 * (high - low), high)  # room for the words
            note_sign(ax)
        ax.xaxis.set_major_locator(plt.MaxNLocator(4))
        thousands(ax)
    if table.algorithm.nunique() > 1:
        np.ravel(axes)[-1].legend(loc="best", fontsize=8, handlelength=3)
    return axes


def plot_parts(parts, ax=None, title=""):
    """A bias and the two sums that it is made of: a mark for each run.

    parts: a dict from an algorithm to (runs, 3): how far the critic lies above its own
    targets, what the rule of the target adds, and both together, the bias.
    """
    if ax is None:
        _, ax = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    ax.axhline(0, **TRUTH)
    note_level(ax, 0, SIGN)
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
    ax.set(title=title, ylabel="part of Q − truth,\nmean over start states",
           xlim=(-0.5, 2.9))
    legend_below(ax)
    return ax


def note_sign(ax):
    """Write which side of zero is which into the corner at the lower right."""
    ax.annotate(SIGN, (0.995, 0.02), xycoords="axes fraction", ha="right",
                fontsize=8.5)


def note_mean(ax, error):
    """Write the mean of a map of errors (N, N) into its corner."""
    ax.annotate(f"mean {error.mean():+.0f}".replace("-", "−"), (0.97, 0.04),
                xycoords="axes fraction", ha="right", fontsize=8.5,
                bbox=dict(facecolor="white", edgecolor="none", pad=1))


def plot_mean_planes(planes, limit, axes=None, title=""):
    """Maps of the mean error: a row for each algorithm, a column for each time.

    planes: a dict from an algorithm to a dict from a step to a picture with x (N,),
    y (N,) and error (N, N). Colours end at ±limit.
    """
    rows, columns = len(planes), len(next(iter(planes.values())))
    axes = panels(axes, title, rows, columns, sharex=True, sharey=True,
                  figsize=(1.6 * columns + 1, 1.2 * rows + 0.7), squeeze=False)
    grid = np.reshape(axes, (rows, columns))
    for r, (name, pictures) in enumerate(planes.items()):
        for ax, (step, picture) in zip(grid[r], pictures.items()):
            shown = shades(picture["error"], limit, 5)
            image = draw_map(ax, picture, shown, ERRORS, -limit, limit)
            note_mean(ax, picture["error"])
            if is_angle(picture["x"]):
                angle_ticks(ax, every=2)
            if r == 0:
                ax.set_title(f"step {step:,}".replace(",", " "), loc="center",
                             fontsize=9)
            if r < rows - 1:
                ax.set_xlabel("")
        grid[r, 0].set_ylabel(f"{name}\nvelocity")
    bar = grid[0, 0].figure.colorbar(image, ax=axes, extend="both")
    bar.set_label(SIGN_BAR, fontsize=8)
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
    rows = max(map(len, differences.values()))
    axes = panels(axes, title, 1, len(differences), sharey=True,
                  figsize=(8, 1 + 0.6 * rows))
    for ax, (label, pairs) in zip(np.ravel(axes), differences.items()):
        ax.axvline(0, **TRUTH)
        for n, (values, interval) in enumerate(pairs.values()):
            ax.plot(values, np.full(len(values), n + 0.18), "o", markersize=4.5,
                    markerfacecolor="white", markeredgecolor="0.4")
            ax.plot(interval, [n, n], color="black", linewidth=1.5)
            ax.plot(np.mean(values), n, "D", color="black", markersize=6)
        for name, value in (predicted or {}).get(label, {}).items():
            cross, = ax.plot(value, list(pairs).index(name) - 0.2, "x", markersize=7,
                             markeredgewidth=2, color=THREE["color"])
            cross.set_label("predicted")
        ax.set_yticks(range(len(pairs)), list(pairs))
        ax.set(xlabel=label, ylim=(len(pairs) - 0.5, -0.5))
        shown = dict(zip(*reversed(ax.get_legend_handles_labels())))  # each label once
        if shown:
            ax.legend(shown.values(), shown, loc="lower right",  # above the axes
                      bbox_to_anchor=(1, 1), borderpad=0)
    return axes
