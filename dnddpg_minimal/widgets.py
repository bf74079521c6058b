"""The book's interactive panels, for a notebook.

| call | shows |
|---|---|
| `maximisation_laboratory(...)` | the bias of one target, chapters 04 to 06 |
| `error_plane_explorer()` | a recorded agent on Pendulum: its error, state by state |
| `arm_explorer()` | the Arm: observation, reward, and what two actors propose |
| `figure_6_explorer()` | learning curves and scores, drawn in your own way |
| `live_training(config)` | a run in front of a class: start, pause, stop |

A panel is sliders, one line of text, and one picture. The text says what the picture
shows, since a picture has no words for a screen reader. Every slider has its name as a
label and works with the arrow keys. A panel only ever changes the value of its text
and of its picture, so that a notebook with a panel in it can still be tested.
"""

import io
import math
import threading

import ipywidgets
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from dnddpg_minimal import arm, bias, plots
from dnddpg_minimal.dnddpg import (
    ALGORITHMS,
    Config,
    Training,
    choose_actor,
    next_value,
    stream,
)


class Panel(ipywidgets.VBox):
    """A column of widgets. What is printed of it is the same on every machine."""

    title = ""

    def __repr__(self):
        return f"Panel: {self.title}"


# JupyterLab may call two sliders' functions in two threads, and a figure can't be drawn
# by two.
DRAWING = threading.RLock()


def panel(title, sliders, draw, size=(6.4, 2.9), lines=1, still=()):
    """Sliders (a dict from a name to a widget) above a text and a picture.

    `draw(figure, **values)` fills an empty matplotlib Figure and returns the text, or
    with `lines` above 1 a tuple of so many lines. It is called now, and again whenever
    a slider moves. `size` is the figure's, in inches; `title` names the panel in print.

    Most of the time goes into axes, ticks and maps. Where `still` names the sliders
    that change them, the figure is emptied only when one of those moves. Otherwise
    `draw` finds its axes there, and only artists made with `animated=True` are drawn
    anew, over a copy of the rest.
    """
    texts = [ipywidgets.Label() for _ in range(lines)]
    figure = Figure(figsize=size)  # without pyplot, which would keep it
    picture = image_of(figure)
    canvas = FigureCanvasAgg(figure)
    drawn = {}  # the rest: the values of `still` it is drawn for, and its pixels

    def update(_=None):
        with DRAWING:
            draw_again()

    def draw_again():
        values = {name: s.value for name, s in sliders.items()}
        kept = [values[name] for name in still]
        fresh = not still or drawn.get("for") != kept
        if fresh:
            figure.clear()
        said = draw(figure, **values)
        for text, line in zip(texts, (said,) if lines == 1 else said, strict=True):
            text.value = line
        if fresh:
            canvas.draw()
            drawn.update({"for": kept, "pixels": canvas.copy_from_bbox(figure.bbox)})
        canvas.restore_region(drawn["pixels"])
        for artist in figure.findobj(lambda artist: artist.get_animated()):
            figure.draw_artist(artist)
        file = io.BytesIO()
        Image.fromarray(np.asarray(canvas.buffer_rgba())).save(
            file, "PNG", compress_level=1)  # quick, not small
        picture.value = file.getvalue()

    for slider in sliders.values():
        slider.observe(update, names="value")
    update()
    whole = Panel([*sliders.values(), *texts, picture])
    whole.title = title
    return whole


def image_of(figure):
    """An Image widget as wide as the figure; without a width the page stretches it."""
    width = f"{figure.get_figwidth() * figure.dpi:.0f}px"
    return ipywidgets.Image(format="png", layout=ipywidgets.Layout(
        width=width, max_width="100%"))


def slider(label, value, low, high, step):
    """A slider from `low` to `high` that begins at `value`, with its `label` beside it.

    It moves over whole numbers if `step` is an int, else over numbers.
    """
    whole = isinstance(step, int)
    kind = ipywidgets.IntSlider if whole else ipywidgets.FloatSlider
    more = {} if whole else {"readout_format": ".2f"}
    return kind(value=value, min=low, max=high, step=step, description=label,
                style={"description_width": "18em"},
                layout=ipywidgets.Layout(width="38em"), **more)


# --- The maximisation laboratory: chapters 04 to 06 -----------------------------------

DRAWS = 10_000  # of y
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
    """m_n of Eq. (4.2): the mean of the largest of n independent standard normals.

    The largest lies below z if all n do, so its density is n φ(z) Φ(z)^(n-1).
    """
    z = np.linspace(-8, 8, 2_001)
    density = np.exp(-z**2 / 2) / math.sqrt(2 * math.pi)
    below = np.cumsum(density) - density / 2  # Φ, by rectangles
    below *= z[1] - z[0]
    return float(np.sum(z * n * density * below ** (n - 1)) * (z[1] - z[0]))


def simulated_y(critics=1, actors=2, sigma=1.0, rho=0.0, kappa=1.0, gap=0.0,
                rule="max_min", draws=DRAWS):
    """Value of a next state whose best action is truly worth 0, by `rule`: (draws,).

    The errors e[c, k] of the critics at the actors' actions are normal, mean 0,
    standard deviation σ. Two actions within one critic correlate by ρ, two critics at
    one action by κ, both at once by κρ; ρ and κ lie between 0 and 1. The first action
    is worth 0, the others −gap. `rule` is a `target_rule`.
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
    return next_value(q_next, rule)


def closed_form(critics=1, actors=2, sigma=1.0, rho=0.0, kappa=1.0, gap=0.0,
                rule="max_min"):
    """The mean of `simulated_y` with these arguments, or None without a formula.

    Eq. (5) with one critic, Eq. (11) with one action, `bias.predict` up to two of each.
    """
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
    if rule in ("selected", "paired_min"):  # they need a critic for each actor
        critics, actors = (LABORATORY[name][1:3] if name in sliders else
                           (usual[name], usual[name]) for name in ("critics", "actors"))
        if actors[1] > critics[0] or (rule == "paired_min" and critics[1] > actors[0]):
            raise ValueError(f"rule={rule!r} needs a critic for each actor: expected "
                             "critics and actors that stand still, such as critics=2, "
                             "actors=2 without sliders for them.")
    for name, value in usual.items():
        low, high = LABORATORY[name][1:3]
        if not low <= value <= high:
            raise ValueError(f"{name}={value!r}: expected {low} to {high}.")

    def draw(figure, **moved):
        now = usual | moved
        y = simulated_y(rule=rule, **now)
        formula = closed_form(rule=rule, **now)
        ax = figure.add_axes((0.02, 0.16, 0.96, 0.8))
        plots.plot_y(y, formula, ax)
        known = ("none known here" if formula is None
                 else f"{round(formula, 2) + 0.0:+.2f}")  # no "−0.00"
        return (f"Bias of one target: simulated {y.mean():+.2f}, "
                f"closed form {known}. Truth 0.")

    moving = {name: slider(LABORATORY[name][0], usual[name], *LABORATORY[name][1:])
              for name in sliders}
    return panel("the maximisation laboratory", moving, draw)


# --- The error-plane explorer: Pendulum, recorded agents ------------------------------


def error_plane_explorer(folder=None):
    """Look at one recorded agent on Pendulum: its error plane, one state, its rollout.

    Choose algorithm, seed and time; choose a state by angle and velocity. The text
    gives every critic's Q there and the truth: the discounted sum of the rollout that
    is drawn. `folder` holds recordings, by default those of the package; seeds with
    recorded weights can be chosen. FileNotFoundError if there is none.
    """
    from dnddpg_minimal.study import load_agent_at, load_study

    def by_run(what):
        runs = load_study("Pendulum-v1", what=what, folder=folder)
        return {(run["algorithm"], run["seed"]): run for run in runs}

    planes, weights = by_run("planes"), by_run("weights")
    if not weights:
        raise FileNotFoundError("no recorded weights of Pendulum: record them with "
                                "python -m dnddpg_minimal study --task Pendulum-v1")
    algorithms = [name for name in ALGORITHMS if any(run[0] == name for run in weights)]
    seeds = sorted({seed for _, seed in weights})
    times = [int(step) for step in next(iter(weights.values()))["step"]]
    world = bias.dynamics(Config("Pendulum-v1"))
    one_plane = next(iter(planes.values()))  # all have the same axes
    agents = {}  # made when first looked at

    def draw(figure, algorithm, seed, step, angle, velocity):
        run, i = (algorithm, seed), times.index(step)
        if not figure.axes:
            prepare(figure, algorithm)
        image, here, way = moved = (*figure.axes[0].images, *figure.axes[0].lines,
                                    *figure.axes[1].lines)
        recorded = run in weights and run in planes
        for artist in moved:
            artist.set_visible(recorded)
        if not recorded:
            return f"{algorithm}, seed {seed}: not recorded."
        if (run, i) not in agents:
            agents[run, i] = load_agent_at(weights[run], i)
        agent, plane = agents[run, i], planes[run]
        state = np.array([[angle, velocity]])
        path, truth = follow(world, agent, state)
        obs = world.observe(state)
        q = agent.q_values(obs, agent.act(obs))[:, 0]  # (C,)
        image.set_data(plane["q"][i].min(axis=0) - plane["truth"][i])
        here.set_data([angle], [velocity])
        way.set_data(range(len(path)), np.cos(path[:, 0]))
        critics = ", ".join(f"Q{c + 1} {value:.1f}" for c, value in enumerate(q))
        return (f"{algorithm}, seed {seed}, step {step:,}: {critics}; truth "
                f"{truth:.1f}; min Q − truth {q.min() - truth:+.1f}.")

    def prepare(figure, algorithm):
        """All but the map, the chosen state and its rollout."""
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.2), gridspec_kw=dict(
            left=0.08, right=0.98, bottom=0.2, top=0.88, wspace=0.42))
        image = plots.draw_map(left, one_plane, np.zeros_like(one_plane["truth"][0]),
                               plots.ERRORS, -LIMIT, LIMIT)
        image.set_animated(True)
        left.plot([], [], "o", color="black", markerfacecolor="white", animated=True)
        left.set(ylabel="velocity", title=f"min Q − truth, colours to ±{LIMIT}")
        bar = figure.colorbar(image, ax=left, extend="both")
        bar.set_label("← under   over →", fontsize=8)
        right.plot([], [], animated=True, **plots.STYLE[algorithm])
        right.set(xlim=(0, SHOWN), ylim=(-1.1, 1.1), xlabel="step of the rollout",
                  title="height: 1 is upright, −1 hangs")

    def choice(kind, label, options, value):
        return kind(options=options, value=value, description=label,
                    style={"description_width": "18em"},
                    layout=ipywidgets.Layout(width="38em"))

    controls = {
        "algorithm": choice(ipywidgets.Dropdown, "algorithm", algorithms,
                            algorithms[0]),
        "seed": choice(ipywidgets.SelectionSlider, "seed", seeds, seeds[0]),
        "step": choice(ipywidgets.SelectionSlider, "environment step", times,
                       times[-1]),
        "angle": slider("angle (0 is upright), rad", 3.0, -3.1, 3.1, 0.1),
        "velocity": slider("velocity, rad/s", 0.0, -8.0, 8.0, 0.5),
    }
    return panel("the error-plane explorer", controls, draw, size=(7.4, 2.7),
                 still=("algorithm",))


SHOWN = 150  # steps of a rollout that are drawn
LIMIT = 80  # where the explorer's colours end: the same for all, to compare


def follow(world, agent, state, steps=500):
    """One rollout of an agent in a world of `bias.dynamics`, from state (1, S).

    Returns its first SHOWN states (T, S), and the truth: the discounted sum of `steps`
    rewards.
    """
    path, truth = [], 0.0
    for t in range(steps):
        if t < SHOWN:
            path.append(state[0])
        state, reward, _ = world.step(state, agent.act(world.observe(state)))
        truth += agent.config.gamma**t * reward[0]
    return np.array(path), truth


# --- The arm explorer: chapter 07 -----------------------------------------------------

WAY = 25  # steps for which each actor's own way is drawn


def arm_explorer(folder=None):
    """Move the arm and its goal: what does the agent see, and what do actors propose?

    Sliders for both joints and the goal. The text gives reward, observation, and each
    actor's proposal with every critic's Q; the picture also draws the finger's way if
    that actor alone acts. The agents are recorded DN-DDPG ones of the two Arms, the
    lowest seed with weights, at the end. `folder` holds recordings, by default those of
    the package. FileNotFoundError if there is none.
    """
    agents = recorded_arm_agents(folder)
    if not agents:
        raise FileNotFoundError("no recorded weights of DN-DDPG on an Arm: record them "
                                "with python -m dnddpg_minimal study --task "
                                "ArmEasy-v0 --algorithm DN-DDPG")

    def draw(figure, agent, joint_1, joint_2, goal_x, goal_y):
        state = np.array([[joint_1, joint_2, goal_x, goal_y, 0.0]])
        seen = look_at_arm(agents[agent], state)
        axes = figure.subplots(1, 3, width_ratios=(1, 0.6, 0.8), gridspec_kw=dict(
            left=0.01, right=0.98, bottom=0.04, top=0.9, wspace=0.6))
        plots.plot_arm(state[0], seen["paths"], seen["q"], axes)
        return (f"Finger {seen['distance']:.0f} px from the goal's centre: reward "
                f"{seen['reward']:+.3f}.", proposals_in_words(seen),
                "Observation: " + ", ".join(f"{x:+.2f}" for x in seen["obs"]) + ".")

    names = list(agents)
    controls = {
        "agent": ipywidgets.Dropdown(
            options=names, value=names[0], description="recorded agent",
            style={"description_width": "18em"},
            layout=ipywidgets.Layout(width="38em")),
        "joint_1": slider("joint 1, rad", 1.5, 0.0, 6.28, 0.05),
        "joint_2": slider("joint 2, against link 1, rad", 4.0, 0.0, 6.28, 0.05),
        "goal_x": slider("goal x, px in the window", 100.0, 0.0, 400.0, 5.0),
        "goal_y": slider("goal y, px in the window", 100.0, 0.0, 400.0, 5.0),
    }
    return panel("the arm explorer", controls, draw, size=(7.6, 2.9), lines=3)


def recorded_arm_agents(folder=None):
    """Recorded DN-DDPG agents of the Arms at the end: a dict from a name to an agent.

    The lowest seed with weights of each task; a task without any is not in the dict.
    `folder` holds recordings, by default those of the package.
    """
    from dnddpg_minimal.study import load_agent_at, load_study

    agents = {}
    for task in ("ArmEasy-v0", "ArmHard-v0"):
        runs = load_study(task, "DN-DDPG", what="weights", folder=folder)
        if runs:
            run = min(runs, key=lambda run: run["seed"])
            agents[f"DN-DDPG of {task}, seed {run['seed']}"] = load_agent_at(run)
    return agents


def look_at_arm(agent, state):
    """What an agent sees and says at one state (1, 5): a dict.

    obs (9,), distance in px, reward (of a step that ends here), actions (K, 2),
    q (C, K), chosen (the actor that acts), paths: (T, xy) px from the base, per actor.
    """
    obs = arm.observe(state)
    actions = agent.actions(obs)  # (K, 1, A)
    q = np.stack([agent.q_values(obs, a)[:, 0] for a in actions], axis=1)  # (C, K)
    chosen = int(choose_actor(q[:, :, None], agent.config.act_rule)[0])
    alone = np.repeat(state, len(actions), axis=0)  # row k: actor k acts alone
    rows, paths = np.arange(len(actions)), []
    for _ in range(WAY + 1):
        paths.append(arm.locate(alone[:, :2])[:, 1])
        alone, _, _ = arm.step(alone, agent.actions(arm.observe(alone))[rows, rows])
    gap = state[0, 2:4] - arm.BASE - paths[0][0]
    distance = float(np.hypot(*gap))
    return dict(obs=obs[0], distance=distance, reward=-distance / 400, q=q,
                actions=actions[:, 0], chosen=chosen, paths=np.swapaxes(paths, 0, 1))


def proposals_in_words(seen):
    """The proposals in `seen`, of `look_at_arm`, for the text below the sliders."""
    words = []
    for k, action in enumerate(seen["actions"]):
        values = ", ".join(f"Q{c + 1} {q:.2f}" for c, q in enumerate(seen["q"][:, k]))
        words.append(f"Actor {k + 1} turns ({action[0]:+.2f}, {action[1]:+.2f}): "
                     f"{values}.")
    return " ".join(words) + f" Actor {seen['chosen'] + 1} acts."


# --- The Figure 6 explorer: chapter 10 ------------------------------------------------

AXES = {"environment steps, evaluations": "evaluations",
        "episodes, training returns": "episodes"}
INTERVALS = {"t interval": "t_interval", "bootstrap": "bootstrap_interval",
             "band of standard deviation": "band"}
SCORES = {"end: the last ten (five on MuJoCo)": "end", "whole run": "whole",
          "the last one": "final", "the best one (do not)": "maximum"}


def figure_6_explorer(folder=None):
    """Draw the paper's Figure 6 in your own way, and see what the verdict does.

    Choose a task, the axis (evaluations over steps, or training returns over episodes,
    means of ten), the interval, and what counts as a run's score. Left the curves of
    all runs, right their scores. The text gives the paired difference of DN-DDPG and
    DDPG with its t interval, and the verdict on "DN-DDPG is better". `folder` holds
    recordings, by default those of the package.
    """
    from dnddpg_minimal import statistics
    from dnddpg_minimal.records import TASKS, load_study

    tables = {"evaluations": load_study(folder=folder), "episodes":
              statistics.training_table(load_study(what="episodes", folder=folder))}
    tables = {(task, axis): rows for axis, table in tables.items()
              for task, rows in table.groupby("task")}

    def draw(figure, task, axis, interval, score):
        table = tables.get((task, AXES[axis]))
        if table is None:
            return (f"{task}: not recorded yet. python -m dnddpg_minimal study "
                    f"--task {task}", "Nothing is drawn.")
        of_interval = getattr(statistics, INTERVALS[interval])
        found = statistics.scores(table, SCORES[score]).loc[task]
        left, right = figure.subplots(1, 2, width_ratios=(1.5, 1), gridspec_kw=dict(
            left=0.09, right=0.98, bottom=0.17, top=0.9, wspace=0.35))
        names = [name for name in ALGORITHMS if (table.algorithm == name).any()]
        for x, name in enumerate(names):
            style, values = plots.STYLE[name], found[name].to_numpy()
            curve = statistics.by_step(table[table.algorithm == name])
            draw_curve(left, *curve, of_interval, style, name)
            right.plot(np.full(len(values), x - 0.15), values, "o", markersize=4,
                       markerfacecolor="white", markeredgecolor=style["color"])
            right.plot([x + 0.15] * 2, of_interval(values), color=style["color"])
            right.plot(x + 0.15, values.mean(), "D", color=style["color"], markersize=5)
        left.set(title="mean of the runs, and each run", xlabel=axis.partition(",")[0])
        left.legend(fontsize=7.5)
        plots.thousands(left)
        for ax, most in ((left.xaxis, 4), (left.yaxis, 5), (right.yaxis, 5)):
            ax.get_major_locator().set_params(nbins=most)
        right.set_xticks(range(len(names)), names, fontsize=8)
        right.set(title="score of each run, mean", xlim=(-0.5, len(names) - 0.5))
        d = statistics.paired(found, "DN-DDPG", "DDPG")
        said = statistics.verdict(d)
        if len(d) < statistics.FEWEST:
            found = f"{task}: DN-DDPG better than DDPG: {said}."
        else:
            low, high = statistics.t_interval(d)
            found = (f"{task}, n = {len(d)}: DN − DDPG {d.mean():+.3g}, t interval "
                     f"[{low:+.3g}, {high:+.3g}]; “DN-DDPG is better”: {said}.")
        return found, f"Drawn: {axis}; shade: {interval}; score: {score}."

    return panel("the Figure 6 explorer", {
        "task": menu("task", TASKS), "axis": menu("axis", AXES),
        "interval": menu("interval", INTERVALS), "score": menu("score", SCORES),
    }, draw, size=(7.4, 2.9), lines=2)


def draw_curve(ax, x, values, of_interval, style, name):
    """Runs as thin lines, their mean as a thick one, an interval as a shade.

    x (M,), values (S, M). `of_interval` makes (low, high) of values; style: of lines,
    for Matplotlib; name: for the legend.
    """
    if len(values) > 1:
        ax.fill_between(x, *of_interval(values), color=style["color"], alpha=0.25,
                        linewidth=0)
    # One line with gaps for all runs is drawn sooner than many lines.
    runs = np.hstack([values, np.full((len(values), 1), np.nan)])
    ax.plot(np.tile(np.append(x, np.nan), len(values)), runs.ravel(), linewidth=0.4,
            color=style["color"], alpha=0.5)
    ax.plot(x, values.mean(axis=0), linewidth=1.8, label=name, **style)


def menu(label, options):
    """A menu of `options`, the first one chosen, with its `label` in full beside it."""
    options = list(options)
    return ipywidgets.Dropdown(options=options, value=options[0], description=label,
                               style={"description_width": "18em"},
                               layout=ipywidgets.Layout(width="38em"))


# --- The live training panel ----------------------------------------------------------


class LiveTraining(Panel):
    """Train in front of a class: start, pause, stop; progress, return and bias.

    The loop runs in a thread of its own, so that the buttons are heard. Nothing starts
    by itself. After a stop, or at the end, `training` holds the Training; start begins
    a new run of the same config, with the same numbers. A config that counts episodes
    is refused with a ValueError: the panel counts steps.
    """

    def __init__(self, config):
        self.config, self.training, self._thread = config, None, None
        self.title = f"live training of {config.algorithm} on {config.task}"
        if config.steps is None:
            raise ValueError(f"episodes={config.episodes}: the panel counts steps; "
                             "give steps instead.")
        self._go, self._stop = threading.Event(), None  # each run has its own stop
        buttons = [ipywidgets.Button(description=name, tooltip=f"{name} the training")
                   for name in ("start", "pause", "stop")]
        self.start_button, self.pause_button, self.stop_button = buttons
        for button, act in zip(buttons, (self.start, self.pause, self.stop),
                               strict=True):
            button.on_click(lambda _, act=act: act())
        self.progress = ipywidgets.IntProgress(max=config.steps, description="steps")
        self.text = ipywidgets.Label("Press start.")
        self._figure = Figure(figsize=(7.4, 2.7))
        self.picture = image_of(self._figure)
        self._canvas = FigureCanvasAgg(self._figure)
        super().__init__([ipywidgets.HBox(buttons), self.progress, self.text,
                          self.picture])

    def start(self):
        """Begin a run, or go on after a pause."""
        self._go.set()
        self.pause_button.description = "pause"
        runs = self._thread is not None and self._thread.is_alive()
        if not runs or self._stop.is_set():  # a stopped run ends by itself
            self._stop, before = threading.Event(), self._thread if runs else None
            self._thread = threading.Thread(target=self._work, daemon=True,
                                            args=(self._stop, before))
            self._thread.start()

    def pause(self):
        """Wait after the next record; once more: go on."""
        if self._go.is_set():
            self._go.clear()
            self.pause_button.description = "go on"
        else:
            self.start()

    def stop(self):
        """End the run after the next record."""
        if self._stop is not None:
            self._stop.set()
        self._go.set()
        self.pause_button.description = "pause"

    def _work(self, stop, before):
        if before is not None:
            before.join()
        try:
            self.training, found = Training(self.config), []
            for record in self.training:
                self.progress.value = record.step
                if record.kind == "episode":
                    self.text.value = (f"Step {record.step:,}: the last episode, with "
                                       f"noise, returned {record.episode_return:.0f}.")
                if record.kind == "grid":
                    found.append(bias.evaluate(self.training))
                    with DRAWING:
                        self._draw(found)
                while not self._go.wait(0.1):
                    pass
                if stop.is_set():
                    break
            self.text.value = f"Over at step {self.training.step:,}. " + self.text.value
        except Exception as error:  # a thread's error would be seen by nobody
            self.text.value = f"The run broke off: {error}"

    def _draw(self, found):
        step = [measured.evaluation["step"] for measured in found]
        rows = [next((row for row in measured.bias if row["action"] == "policy"
                      and row["critic"] == "min"), {"bias": math.nan})
                for measured in found]
        style = plots.STYLE.get(self.config.algorithm, {})
        self._figure.clear()
        left, right = self._figure.subplots(1, 2)
        left.plot(step, [m.evaluation["mean"] for m in found], marker="o", **style)
        left.set(title="return, without noise", xlabel="environment steps")
        right.axhline(0, color="black", linewidth=1)
        right.plot(step, [row["bias"] for row in rows], marker="o", **style)
        right.set(title="min Q − truth", xlabel="environment steps")
        right.set_ylabel(plots.SIGN_TURNED, fontsize=7)
        right.set_yscale("symlog", linthresh=30)
        self._figure.tight_layout()
        file = io.BytesIO()
        self._canvas.print_png(file)
        self.picture.value = file.getvalue()


def live_training(config=None):
    """The live training panel for a Config, by default DN-DDPG on Pendulum."""
    return LiveTraining(Config(steps=20_000) if config is None else config)
