"""What all figures share: colours, kinds of line, small helpers.

The same algorithm has the same colour and the same kind of line everywhere. What is
true is black. The colours (Okabe and Ito, 2008) are told apart by colour-blind readers.
"""

import matplotlib.pyplot as plt
import numpy as np

STYLE = {  # of the lines of each algorithm
    "DDPG": dict(color="#D55E00", linestyle="-"),
    "DCN-DDPG": dict(color="#0072B2", linestyle="--"),
    "DN-DDPG": dict(color="#009E73", linestyle="-."),
}
MARKS = {"DDPG": "o", "DCN-DDPG": "s", "DN-DDPG": "D"}  # of single runs
TRUTH = dict(color="black", linestyle="-", linewidth=1.2)
WRONG = dict(color="#CC79A7", linestyle=":", linewidth=2.4)  # a fault, on purpose
VALUES, ERRORS = "cividis", "RdBu_r"  # maps of values, and of errors around 0
SIGN = "overestimates ↑ / underestimates ↓"
SIGN_TURNED = "← underestimates / overestimates →"  # beside an upright axis
SIGN_BAR = "← underestimates    overestimates →"  # beside an upright colour bar
GREY = "0.6"
ONE = dict(color="#E69F00", linestyle="-", linewidth=2)  # lines of no algorithm
TWO = dict(color="#56B4E9", linestyle="--", linewidth=2)
THREE = dict(color="#CC79A7", linestyle=":", linewidth=2.4)

DPI = 100  # of a figure on the page; `plt.rcParams["figure.dpi"] = 150` is for a wall
plt.rcParams.update({
    "figure.dpi": DPI,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
})


def panels(axes, title, *shape, **how):
    """`axes`, or if that is None those of a new figure; shape, how: as plt.subplots."""
    if axes is not None:
        return axes
    figure, axes = plt.subplots(*shape, layout="constrained", **how)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    return axes


def style_of(label):
    """The line of a run whose label begins with an algorithm's name."""
    fault = " with " in label  # "DDPG with the wrong line": a fault, made on purpose
    return WRONG if fault else STYLE.get(label.split(",")[0], WRONG)


def draw_lines(ax, curves):
    """One line for each entry of curves, {label: (x, y)}, in its algorithm's style."""
    for label, (updates, values) in curves.items():
        ax.plot(updates, values, label=label, **{"linewidth": 1.8} | style_of(label))
    legend_below(ax)


def legend_below(ax):
    """The legend under the axes, out of the way of the lines."""
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=3)


def note_level(ax, level, text, above=True):
    """Write a text above or below a horizontal line at `level`, at its right end."""
    ax.annotate(text, (0.995, level), xycoords=("axes fraction", "data"), ha="right",
                xytext=(0, 5 if above else -5), textcoords="offset points",
                va="bottom" if above else "top", fontsize=8.5)


def thousands(ax):
    """Numbers of steps on the x axis with a space between thousands: 40 000."""
    ax.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}".replace(",", " "))


def shrink(picture, factor):
    """A smaller picture: the mean over squares of factor × factor pixels.

    picture (H, W, 3) uint8 → (H // factor, W // factor, 3) uint8.
    """
    height, width = (side // factor * factor for side in picture.shape[:2])
    squares = picture[:height, :width].reshape(height // factor, factor,
                                               width // factor, factor, -1)
    return squares.mean(axis=(1, 3)).astype(np.uint8)


def draw_map(ax, picture, values, colours, low=None, high=None):
    """One map of values (N, N) over the state plane; its axes are [y, x].

    picture: a dict with the axes x (N,) and y (N,), as of `bias.plane`. colours: the
    name of a colour map, from `low` to `high`.
    """
    x, y = picture["x"], picture["y"]
    colours = plt.get_cmap(colours, 25)  # few colours: a small file
    image = ax.imshow(values, origin="lower", aspect="auto", cmap=colours, vmin=low,
                      vmax=high, extent=(x[0], x[-1], y[0], y[-1]),
                      interpolation="nearest")
    ax.spines[:].set_visible(False)
    ax.set_xlabel("angle (0 is upright)")
    if is_angle(x):
        angle_ticks(ax)
    return image


def shades(error, limit, count):
    """Errors (N, N), rounded for a map to `count` shades on each side of 0.

    A shade is limit / count wide. None of them is white: the sign is always seen.
    """
    return (np.floor(error / limit * count) + 0.5) / count * limit


def is_angle(x):
    """Does the axis x (N,) go once around the circle?"""
    return np.allclose((x[0], x[-1]), (-np.pi, np.pi), atol=0.01)  # recorded: float16


def angle_ticks(ax, every=1):
    """Ticks at multiples of π/2 on the x axis; of π, in a small panel, if every=2."""
    ax.set_xticks([-np.pi, -np.pi / 2, 0, np.pi / 2, np.pi][::every],
                  ["−π", "−π/2", "0", "π/2", "π"][::every])


def zero_line(ax):
    """The line where a critic is right, and which side of it is which."""
    ax.axhline(0, color="black", linewidth=0.8)
    note_level(ax, 0, SIGN, above=False)


def pale(colour, share=0.65):
    """The colour, mixed with a share of white: (3,)."""
    rgb = np.array(plt.matplotlib.colors.to_rgb(colour))
    return share + (1 - share) * rgb
