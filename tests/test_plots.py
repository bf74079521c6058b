"""Figures draw what they are given, and mean the same thing everywhere."""

import inspect
import re
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from dnddpg_minimal import ALGORITHMS, Record, plots


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture
def picture():
    """What `bias.plane` returns: the critic is 3 too high everywhere but one cell."""
    x, y = np.linspace(-np.pi, np.pi, 5), np.linspace(-8, 8, 4)
    truth = -(x**2) - y[:, None] ** 2
    q = truth[None] + 3
    q[0, 0, 0] -= 5
    return dict(x=x, y=y, q=q, truth=truth)


def test_all_figures_grow_with_the_dots_of_the_page(monkeypatch):
    """A lecturer sets one number; a figure with its own would stay small."""
    for path in Path(plots.__file__).parent.glob("*.py"):
        text = path.read_text(encoding="utf-8").replace("savefig(path, dpi=100)", "")
        assert not re.search(r"\bdpi=\d", text), path.name
    monkeypatch.setitem(plt.rcParams, "figure.dpi", 180)
    steps = {"Pendulum-v1": {"DDPG": (np.arange(3), np.ones((2, 3)))}}
    plots.plot_eight_tasks(steps)
    assert plt.gcf().dpi == 180


def test_each_algorithm_has_a_colour_and_a_kind_of_line_of_its_own():
    assert set(plots.STYLE) == set(ALGORITHMS)
    for part in ("color", "linestyle"):
        assert len({style[part] for style in plots.STYLE.values()}) == len(ALGORITHMS)


def test_an_algorithms_line_is_the_same_in_every_figure():
    curves = {name: (np.arange(3), np.arange(3.0)) for name in ALGORITHMS}
    records = [Record("episode", 200, 0, 0, -900.0, 200, None, None)]
    for name in ALGORITHMS:
        evaluation = dict(algorithm=name, step=1_000, mean=-150.0,
                          standard_error=9.0, n=100)
        axes = (plots.plot_q(curves, truth=2), plots.plot_bias(curves),
                plots.plot_learning(records, [evaluation]))
        for ax in axes:
            (line,) = [line for line in ax.get_lines()
                       if (line.get_color(), line.get_linestyle())
                       == tuple(plots.STYLE[name].values())]
            assert len(line.get_xdata()) > 0


def test_a_fault_never_looks_like_an_algorithm():
    assert plots.style_of("DDPG") == plots.STYLE["DDPG"]
    assert plots.style_of("DDPG, seed 3") == plots.STYLE["DDPG"]
    assert plots.style_of("DDPG with the wrong line") == plots.WRONG


def test_the_truth_is_a_black_line():
    ax = plots.plot_q({"DDPG": (np.arange(3), np.ones(3))}, truth=10)
    (truth,) = [line for line in ax.get_lines() if line.get_color() == "black"]
    assert set(truth.get_ydata()) == {10}


def test_the_zero_line_of_a_bias_says_which_side_is_which():
    ax = plots.plot_bias({"DDPG": (np.arange(3), np.ones(3))})
    assert "overestimates ↑ / underestimates ↓" in [t.get_text() for t in ax.texts]


def test_overestimation_is_red_and_underestimation_blue(picture):
    axes = plots.plot_error_plane(picture, limit=4)
    image = axes[2].get_images()[0]
    over, under = image.to_rgba([3.0, -2.0])
    assert over[0] > over[2] and under[2] > under[0]  # red, green, blue
    assert image.get_clim() == (-4, 4)  # white is zero
    assert np.allclose(image.get_array(), picture["q"][0] - picture["truth"])


def test_a_path_over_the_edge_of_the_angle_is_not_drawn_through_the_picture(picture):
    path = np.array([[3.0, 1.0], [3.3, 1.0], [3.6, 1.0]])  # passes π
    ax = plots.plot_truth(picture, path)
    angle = ax.get_lines()[0].get_xdata()
    assert np.isnan(angle).sum() == 1
    assert np.nanmax(np.abs(angle)) <= np.pi


def test_a_filmstrip_shows_the_first_and_the_last_picture():
    pictures = [np.full((90, 90, 3), value, np.uint8) for value in range(31)]
    ax = plots.plot_filmstrip(pictures, count=4)
    strip = ax.get_images()[0].get_array()
    assert (strip[0, 0] == 0).all() and (strip[0, -1] == 30).all()
    assert [t.get_text() for t in ax.get_xticklabels()] == ["0.0 s", "0.5 s", "1.0 s",
                                                            "1.5 s"]


def test_a_figure_can_be_drawn_into_axes_of_ones_own(picture):
    figure, axes = plt.subplots(1, 3)
    assert plots.plot_error_plane(picture, axes=axes) is axes
    assert plots.plot_truth(picture, ax=axes[0]) is axes[0]
    assert plt.get_fignums() == [figure.number]


X = np.arange(1.0, 4)
RUNS, MAP, ENDS = np.array([X, X]), np.outer(X, X) - 1, (0.0, 5.0)
PLANE = dict(x=X, y=X, q=MAP[None], truth=MAP)
TABLE = pd.DataFrame(dict(algorithm="DDPG", seed=0, step=X, bias=X))
STATE = np.array([0.0, 1.0, 300.0, 250.0, 0.0])  # of an arm
ONE_PANEL = {  # the least that each figure of panels can draw
    "plot_ablations": ({"no memory": (X, RUNS)}, (X, RUNS)),
    "plot_along_action": (X, {"a state": (X, X)}, {"offset": (X, X)}),
    "plot_arm": (STATE,),
    "plot_climbing": ((X, X), (X, X), 1, 2),
    "plot_consequences": ({"return": {"a reading": (X, ENDS)}},),
    "plot_coverage": (X, {"normal": {"t": X}}),
    "plot_differences_by_seed": ({"bias": {"a pair": (X, ENDS)}},),
    "plot_eight_tasks": ({"Hopper-v5": {"DDPG": (X, RUNS)}},),
    "plot_error_and_share": ({0: PLANE | {"error": MAP[None]}}, 1),
    "plot_error_plane": (PLANE,),
    "plot_fastest": (MAP, STATE, [STATE], [9]),
    "plot_found_or_not": ({"an agent": PLANE},),
    "plot_growth": ({"a case": {"γ = 0.9": (X, 3)}},),
    "plot_hovering": ({"arrive": 1}, {"an agent": X}),
    "plot_joint_errors": ({"ArmEasy-v0": {"DDPG": MAP}}, 1),
    "plot_learned_q": (X, X, {0: MAP}, [(X, X, X)], 1),
    "plot_line_up": ({"A": dict(right=(X, RUNS), tests=(X, RUNS), q=(X, X, X))},),
    "plot_live": ([Record("episode", 3, 0, 0, 1.0, 3, None, None)], [
        dict(algorithm="DDPG", step=3, mean=1, standard_error=1, n=2)], X, X, 0),
    "plot_maximum": (X, 1, X, {"closed form": X}, {"closed form": X}),
    "plot_mean_planes": ({"DDPG": {0: PLANE | {"error": MAP}}}, 1),
    "plot_memory": (np.array([X, X]), {"a batch": [0]}),
    "plot_over_training": (TABLE, {"bias": "Q − truth"}),
    "plot_owed": (TABLE, (X, X), {"frozen": (X, RUNS)}, (X, X)),
    "plot_paired_by_task": ({"a pair": {"Hopper-v5": (X, ENDS, ENDS)}},),
    "plot_practice": ({"A": dict(episodes=(X, X), tests=(X, X))},),
    "plot_price": (X, {"measured": X}, {"measured": X}),
    "plot_profile": (X, {"DDPG": X}, {"all tasks": {"DDPG": (1, *ENDS)}}),
    "plot_pushes": ({"noise": (X, X)},),
    "plot_questions": ({"agents": {"A": (X, X)}},),
    "plot_reaching": ({"ArmEasy-v0": TABLE}, {"bias": "Q − truth"}),
    "plot_restored": ({"Hopper-v5": {"kept": X}},),
    "plot_steps": ({"a case": (X, X, X)}, {"a case": (1, 2, 3)}),
    "plot_table_1": ({"slow": (X, X)}, X, -1),
    "plot_true_q": (X, X, MAP, {"best": X}),
    "plot_visits": ({"a run": dict(counts=MAP, x=X, y=X)}, X - 3, X, MAP),
    "plot_who_acts": (X, {"a rule": RUNS}, {"a rule": RUNS}),
}


@pytest.mark.parametrize("name", [
    name for name in plots.__all__ if name.startswith("plot_")
    and "axes" in inspect.signature(getattr(plots, name)).parameters])
def test_a_figure_of_panels_can_have_one_and_takes_axes_as_pyplot_gives_them(name):
    draw = getattr(plots, name)
    axes = draw(*ONE_PANEL[name])
    assert np.ravel(axes)[0].has_data()
    own = np.squeeze(axes)[()]  # without empty dimensions: one panel, or a row
    assert draw(*ONE_PANEL[name], axes=own) is own
    assert len(plt.get_fignums()) == 1


def test_every_group_of_runs_is_drawn_in_a_colour_of_its_own():
    runs = pd.DataFrame({"algorithm": ["DDPG"], "bias": [1.0], "mean": [2.0]})
    ax = plots.plot_bias_and_return({f"group {n}": runs for n in range(6)})
    marks = [line for line in ax.lines if len(line.get_xdata()) == 1]
    assert len({line.get_markeredgecolor() for line in marks}) == len(marks) == 6
    with pytest.raises(ValueError, match="7 groups: expected 6 at the most"):
        plots.plot_bias_and_return({f"group {n}": runs for n in range(7)})
