"""The book's interactive panels, for a notebook.

| call | shows |
|---|---|
| `maximisation_laboratory(...)` | the bias of one target, chapters 04 to 06 |

A panel is sliders, one line of text, and one picture. The text says what the picture
shows, since a picture has no words for a screen reader. Every slider has its name as a
label and works with the arrow keys. A panel only ever changes the value of its text
and of its picture, so that a notebook with a panel in it can still be tested.
"""

import io
import math

import ipywidgets
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dnddpg_minimal import bias, plots
from dnddpg_minimal.dnddpg import stream, td_target


class Panel(ipywidgets.VBox):
    """A column of widgets. What is printed of it is the same on every machine."""

    title = ""

    def __repr__(self):
        return f"Panel: {self.title}"


def panel(title, sliders, draw, size=(6.4, 2.9)):
    """Sliders (a dict from a name to a widget) above a text and a picture.

    `draw(figure, **values)` fills an empty matplotlib Figure and returns the text. It
    is called now, and again whenever a slider moves.
    """
    text = ipywidgets.Label()
    picture = ipywidgets.Image(format="png")
    figure = Figure(figsize=size, dpi=90)  # without pyplot, which would keep it
    canvas = FigureCanvasAgg(figure)

    def update(_=None):
        figure.clear()
        text.value = draw(figure, **{name: s.value for name, s in sliders.items()})
        file = io.BytesIO()
        canvas.print_png(file, pil_kwargs={"compress_level": 1})  # quick, not small
        picture.value = file.getvalue()

    for slider in sliders.values():
        slider.observe(update, names="value")
    update()
    whole = Panel([*sliders.values(), text, picture])
    whole.title = title
    return whole


def slider(label, value, low, high, step):
    """A slider of whole numbers, or of numbers, with its name in full beside it."""
    whole = isinstance(step, int)
    kind = ipywidgets.IntSlider if whole else ipywidgets.FloatSlider
    more = {} if whole else {"readout_format": ".2f"}
    return kind(value=value, min=low, max=high, step=step, description=label,
                style={"description_width": "18em"},
                layout=ipywidgets.Layout(width="38em"), **more)


# --- The maximisation laboratory: chapters 04 to 06 -----------------------------------

DRAWS = 10_000  # simulated targets
RULES = ("max_min", "single", "paired_min", "selected", "soft")
LABORATORY = {  # label, lowest, highest, step
    "actors": ("number of actions, K", 1, 30, 1),
    "critics": ("number of critics, C", 1, 5, 1),
    "sigma": ("noise σ of the critic", 0.0, 2.0, 0.1),
    "rho": ("correlation ρ between actions", 0.0, 1.0, 0.01),
    "kappa": ("correlation κ between critics", 0.0, 1.0, 0.01),
    "gap": ("first action is truly better by", 0.0, 4.0, 0.1),
}


def expected_max(n):
    """m_n: the mean of the largest of n independent standard normal numbers.

    The largest lies below z if all n do, so its density is n φ(z) Φ(z)^(n-1).
    """
    z = np.linspace(-8, 8, 2_001)
    density = np.exp(-z**2 / 2) / math.sqrt(2 * math.pi)
    below = np.cumsum(density) - density / 2  # Φ, by rectangles
    below *= z[1] - z[0]
    return float(np.sum(z * n * density * below ** (n - 1)) * (z[1] - z[0]))


def simulated_targets(critics=1, actors=2, sigma=1.0, rho=0.0, kappa=1.0, gap=0.0,
                      rule="max_min", draws=DRAWS):
    """What a target says of a next state whose best action is truly worth 0: (draws,).

    The errors e[c, k] are normal, mean 0, standard deviation σ. Two actions within one
    critic correlate by ρ, two critics at one action by κ, both at once by κρ; ρ and κ
    lie between 0 and 1. The first action is worth 0, the others −gap.
    """
    rng = stream(0, "noise")

    def z(*shape):
        return rng.standard_normal((*shape, draws))

    error = (math.sqrt(kappa * rho) * z(1, 1)  # shared by all
             + math.sqrt((1 - kappa) * rho) * z(critics, 1)  # by a critic's actions
             + math.sqrt(kappa * (1 - rho)) * z(1, actors)  # by all critics
             + math.sqrt((1 - kappa) * (1 - rho)) * z(critics, actors))  # by none
    q_next = sigma * error  # (C, K, draws)
    q_next[:, 1:] -= gap
    nothing = np.zeros(draws)
    return td_target(nothing, nothing, q_next, gamma=1.0, rule=rule)


def closed_form(critics=1, actors=2, sigma=1.0, rho=0.0, kappa=1.0, gap=0.0,
                rule="max_min"):
    """The mean of `simulated_targets`, or None where we know no formula."""
    if gap > 0 and actors > 1:
        return None
    if critics == 1 and rule == "max_min":  # Eq. 5
        return sigma * math.sqrt(1 - rho) * expected_max(actors)
    if actors == 1:  # Eq. 11
        return -sigma * math.sqrt(1 - kappa) * expected_max(critics)
    if critics <= 2 and actors <= 2:  # readings of Eqs. 11 and 12
        return bias.predict(sigma, kappa if critics > 1 else math.nan, rho, rule)
    return None


def maximisation_laboratory(sliders=("actors", "sigma", "rho"), rule="max_min",
                            **values):
    """Play with the bias that one target makes: a histogram, its mean, a closed form.

    `sliders` names what can be moved: any of critics, actors, sigma, rho, kappa, gap.
    `values` sets where they start, and what stands still: by default one critic, two
    actions, σ = 1, ρ = 0, κ = 0, no gap. `rule` is a `target_rule`. Examples:

        chapter 04   maximisation_laboratory(actors=10)
        chapter 05   maximisation_laboratory(("sigma", "kappa"), critics=2, actors=1)
        chapter 06   maximisation_laboratory(("rho", "kappa", "gap"), critics=2)

    ValueError for a name or a value that the panel does not have.
    """
    usual = dict(critics=1, actors=2, sigma=1.0, rho=0.0, kappa=0.0, gap=0.0)
    for name in (*sliders, *values):
        if name not in usual:
            raise ValueError(f"{name!r} is no quantity of the laboratory: expected one "
                             f"of {', '.join(usual)}.")
    usual |= values
    for name, value in usual.items():
        low, high = LABORATORY[name][1:3]
        if not low <= value <= high:
            raise ValueError(f"{name}={value!r}: expected {low} to {high}.")

    def draw(figure, **moved):
        now = usual | moved
        targets = simulated_targets(rule=rule, **now)
        formula = closed_form(rule=rule, **now)
        ax = figure.add_axes((0.02, 0.16, 0.96, 0.8))
        plots.plot_targets(targets, formula, ax)
        known = "none known here" if formula is None else f"{formula:+.2f}"
        return (f"Bias of one target: simulated {targets.mean():+.2f}, "
                f"closed form {known}. Truth 0.")

    moving = {name: slider(LABORATORY[name][0], usual[name], *LABORATORY[name][1:])
              for name in sliders}
    return panel("the maximisation laboratory", moving, draw)
