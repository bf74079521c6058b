"""Chapter 09's figures: labels point at joints, and what is missing is said."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from dnddpg_minimal import plots
from dnddpg_minimal.dnddpg import MUJOCO_TASKS
from dnddpg_minimal.plots import mujoco

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture
def table():
    """Two seeds of DDPG on one task, three evaluations each."""
    rows = [dict(task="Hopper-v5", algorithm="DDPG", seed=seed, step=1_000 * step,
                 mean=10.0 * step + seed, bias=float(step), owed=-float(step))
            for seed in (0, 1) for step in (1, 2, 3)]
    return pd.DataFrame(rows)


def texts(ax):
    return [text.get_text() for text in ax.texts]


def test_a_label_names_motors_joint_and_places_in_the_observation():
    assert mujoco.label([(3, "fthigh", 5, 14)]) == (
        "a3: front thigh\nangle s5, speed s14")
    hip = [(3, "right_hip_x", 8, 31), (4, "right_hip_z", 9, 32),
           (5, "right_hip_y", 10, 33)]
    assert mujoco.label(hip) == (
        "a3–a5: right hip x, z, y\nangles s8–s10, speeds s31–s33")
    thighs = [(0, "thigh_joint", 2, 11), (3, "thigh_left_joint", 5, 14)]
    assert mujoco.label(thighs).startswith("a0, a3: thigh, left thigh\n")


def test_labels_stand_apart_and_inside_and_move_as_little_as_needed():
    assert list(mujoco.spread([10, 50], 0, 100, 20)) == [10, 50]
    places = mujoco.spread([95, 96, 97], 0, 100, 20)
    assert list(places) == [60, 80, 100]


def test_what_is_not_recorded_is_said_and_what_is_recorded_is_drawn(table):
    for axes in (plots.plot_returns(table), plots.plot_lag(table, frozen_at=2_000)):
        for ax, task in zip(axes[0], MUJOCO_TASKS):
            missing = task != "Hopper-v5"
            assert (texts(ax) == ["not recorded\nyet"]) == missing
            assert bool(ax.get_lines()) != missing


def test_bias_and_debt_share_one_scale(table):
    above, below = plots.plot_lag(table)[:, 1]
    assert above.get_ylim() == below.get_ylim()


def test_no_difference_is_drawn_at_the_foot_of_the_scale():
    gap = np.array([0.0, 1e-3])
    (ax,) = np.ravel(plots.plot_restored({"Hopper-v5": {"kept state": gap}}))
    assert list(ax.get_lines()[0].get_ydata()) == [1e-16, 1e-3]
    assert ax.get_yticklabels()[0].get_text() == "0"


def test_a_photograph_points_at_every_motor():
    try:
        picture, joints = plots.photograph("HalfCheetah-v5", size=120)
    except ValueError as error:
        pytest.skip(f"no picture can be made here: {error}")
    assert picture.shape == (120, 120, 3)
    assert len(joints) == 1 + 6  # the torso, and a joint for each motor
    for name, (x, y) in joints.items():
        assert 0 < x < 120 and 0 < y < 120
        rows, columns = (slice(int(v) - 2, int(v) + 3) for v in (y, x))
        around = picture[rows, columns].reshape(-1, 3)
        assert (np.ptp(around.astype(int), axis=1) > 10).any(), name  # skin, not grey
