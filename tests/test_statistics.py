"""What several runs say: numbers worked out by hand, and rules that must not bend."""

import warnings

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from dnddpg_minimal import plots
from dnddpg_minimal import statistics as st
from dnddpg_minimal.records import TASKS, load_study, score


def table(**of_runs):
    """Evaluations at steps 1, 2, …: name="DDPG_0" holds a run's values, Pendulum."""
    rows = [dict(task="Pendulum-v1", algorithm=name.split("_")[0], variant="class",
                 seed=int(name.split("_")[1]), step=step, mean=float(value))
            for name, values in of_runs.items()
            for step, value in enumerate(values, 1)]
    return pd.DataFrame(rows)


# --- scores and curves ----------------------------------------------------------------


def test_a_score_is_the_mean_of_the_last_ten_evaluations_and_never_the_best():
    run = table(DDPG_0=[100, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9])
    of_kind = {kind: st.scores(run, kind).item()
               for kind in ("end", "whole", "final", "maximum")}
    assert of_kind == {"end": 4.5, "whole": 145 / 11, "final": 9, "maximum": 100}


def test_the_score_is_that_of_the_study():
    recorded = load_study("Pendulum-v1")
    ours = st.scores(recorded)
    theirs = score(recorded).droplevel("variant")
    assert np.allclose(ours, theirs.reindex(ours.index))


def test_the_order_of_the_rows_does_not_matter():
    rows = table(DDPG_0=range(12), DDPG_1=range(5, 17))
    shuffled = rows.sample(frac=1, random_state=3)
    for kind in ("end", "whole", "final", "maximum", "spread"):
        one, other = st.scores(rows, kind), st.scores(shuffled, kind)
        assert np.allclose(one, other.reindex(one.index)), kind


def test_spread_is_the_mean_distance_from_the_middle_run():
    rows = table(DDPG_0=[0, 0], DDPG_1=[1, 10], DDPG_2=[5, 12])  # middle: 1 and 10
    assert st.scores(rows, "spread").tolist() == [5.5, 0, 3]
    alone = rows.assign(task="Hopper-v5")  # a task that fewer algorithms have done
    both = pd.concat([rows, rows.assign(algorithm="DN-DDPG"), alone])
    assert st.scores(both, "spread")["Hopper-v5"].tolist() == [5.5, 0, 3]


def test_an_unknown_kind_of_score_is_refused_by_name():
    with pytest.raises(ValueError, match="best_of"):
        st.scores(table(DDPG_0=[1]), "best_of")


def test_a_score_over_two_variants_is_refused_by_their_names():
    rows = pd.concat([table(DDPG_0=[1, 2]), table(DDPG_0=[3]).assign(variant="frozen")])
    for kind in ("end", "whole", "final", "maximum", "spread"):
        with pytest.raises(ValueError, match="class, frozen"):
            st.scores(rows, kind)


def test_a_block_that_is_not_full_is_dropped():
    assert st.block_means([1, 3, 5, 7, 100], block=2).tolist() == [2, 6]
    assert st.block_means([1], block=2).tolist() == []


def test_training_returns_become_rows_that_end_with_the_shortest_run():
    common = dict(task="Pendulum-v1", algorithm="DDPG", variant="class")
    runs = [common | dict(seed=0, episode_return=np.array([1, 3, 5, 7, 9, 11])),
            common | dict(seed=1, episode_return=np.array([0, 0, 4, 4]))]
    episodes, values = st.by_step(st.training_table(runs, block=2))
    assert episodes.tolist() == [2, 4]
    assert values.tolist() == [[2, 6], [0, 4]]
    assert st.training_table([]).empty


def test_a_task_without_records_has_an_empty_dict_of_curves():
    found = st.curves(table(DDPG_0=[1, 2]), ["Pendulum-v1", "Hopper-v5"])
    assert found["Hopper-v5"] == {}
    steps, values = found["Pendulum-v1"]["DDPG"]
    assert steps.tolist() == [1, 2] and values.tolist() == [[1, 2]]


# --- intervals ------------------------------------------------------------------------


def test_the_t_interval_of_one_two_three_by_hand():
    low, high = st.t_interval([1, 2, 3])  # s = 1, t = 4.3027 with 2 degrees
    assert low == pytest.approx(2 - 4.3027 / np.sqrt(3), abs=1e-4)
    assert high == pytest.approx(2 + 4.3027 / np.sqrt(3), abs=1e-4)


def test_a_band_does_not_shrink_with_more_runs_and_an_interval_does():
    few, many = [-1, 1] * 2, [-1, 1] * 50
    widths = {f: [np.diff(f(runs))[0] for runs in (few, many)]
              for f in (st.band, st.t_interval)}
    assert widths[st.band][1] == pytest.approx(2, abs=0.02)
    assert widths[st.t_interval][1] < widths[st.t_interval][0] / 5


def test_the_bootstrap_of_three_runs_reaches_from_the_smallest_to_the_largest():
    """Each end has probability 1/27, more than the 2.5 % that are cut off."""
    assert st.bootstrap_interval([4.0, 9.0, 1.0]) == (1, 9)


def test_one_run_has_no_interval():
    for interval in (st.band, st.t_interval, st.bootstrap_interval):
        assert np.isnan(interval([3.0])).all()
        assert np.isnan(interval(np.ones((1, 4)))).all()
        assert np.isnan(interval([])).all()


@pytest.mark.parametrize("method", ["percentile", "BCa"])
def test_runs_that_are_all_equal_have_an_interval_of_no_width(method):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert st.bootstrap_interval([2.0] * 4, method=method) == (2, 2)
        low, high = st.bootstrap_interval([[1, 2], [3, 2], [4, 2]], method=method)
    assert low[1] == high[1] == 2 and low[0] < 8 / 3 < high[0]


def test_intervals_of_curves_go_along_the_runs():
    values = np.array([[1, 10], [2, 20], [3, 30]])
    low, high = st.t_interval(values)
    assert np.allclose((low[1], high[1]), np.multiply(st.t_interval([1, 2, 3]), 10))
    other = st.t_interval(values.T, axis=1)
    assert np.allclose((low, high), other)


def test_a_bootstrap_is_the_same_at_every_call():
    values = np.arange(7.0) ** 2
    assert st.bootstrap_interval(values) == st.bootstrap_interval(values)


def test_three_runs_are_covered_three_times_in_four_by_the_bootstrap():
    """1 − 2·(1/2)³ = 3/4 for any law whose median is its mean."""
    def normal(rng, shape):
        return rng.standard_normal(shape)

    share = st.coverage(normal, 3, st.bootstrap_interval, np.random.default_rng(1))
    assert share == pytest.approx(0.75, abs=0.04)
    share = st.coverage(normal, 3, st.t_interval, np.random.default_rng(1))
    assert share == pytest.approx(0.95, abs=0.02)


# --- algorithms against each other ----------------------------------------------------


def test_differences_are_taken_between_runs_of_the_same_seed():
    index = [("DN-DDPG", 2), ("DN-DDPG", 0), ("DDPG", 0), ("DDPG", 1), ("DDPG", 2)]
    runs = pd.Series([5.0, 1.0, 10.0, 99.0, 20.0], pd.MultiIndex.from_tuples(
        index, names=["algorithm", "seed"]))
    assert st.paired(runs, "DN-DDPG", "DDPG").tolist() == [-9, -15]  # seed 1 is alone
    assert st.paired(runs, "DN-DDPG", "DCN-DDPG").tolist() == []


def test_random_is_zero_and_the_reference_is_one():
    index = pd.MultiIndex.from_tuples([("Pendulum-v1", "DDPG", seed) for seed in (0, 1)]
                                      + [("Hopper-v5", "DDPG", 0)],
                                      names=["task", "algorithm", "seed"])
    z = st.normalised(pd.Series([-1230.0, -150.0, 17 + 2983 / 2], index))
    assert np.allclose(z, [0, 1, 0.5])
    assert set(st.NORMALISER) == set(TASKS)


def test_the_interquartile_mean_rounds_down_what_it_cuts_off():
    assert st.interquartile_mean([1, 2, 9]) == 4  # nothing
    assert st.interquartile_mean([1, 2, 3, 4, 100]) == 3  # one at each end
    assert st.interquartile_mean([0, 0, 3, 3, 5, 5, 99, 99]) == 4  # two: a quarter
    assert st.interquartile_mean([0, 0, 3, 3, 3, 5, 5, 5, 99, 99]) == 4  # two


def test_the_interval_over_tasks_draws_runs_and_never_tasks():
    # Tasks of equal runs: whatever is drawn within a task, the mean stays.
    iqm, low, high = st.iqm_interval([np.zeros(3), np.ones(3)])
    assert iqm == low == high == 0.5
    iqm, low, high = st.iqm_interval([np.zeros(2), np.ones(3)])
    assert np.isnan([low, high]).all()


def test_the_interval_over_tasks_never_leaves_the_runs_however_skewed_they_are():
    iqm, low, high = st.iqm_interval([[0, 0, 0, 0, 10, 10]])
    assert 0 <= low < iqm < high <= 10  # percentiles of means that were drawn


def test_a_task_with_more_runs_does_not_count_more():
    index = [(task, name, seed) for name in ("DDPG", "DN-DDPG")
             for task, n in (("Pendulum-v1", 4), ("Hopper-v5", 2)) for seed in range(n)]
    scores = pd.Series(np.arange(12.0), pd.MultiIndex.from_tuples(
        index, names=["task", "algorithm", "seed"]))
    found = st.balanced(scores, 2)
    assert {task: len(runs) for task, runs in found["DDPG"].items()} == {
        "Pendulum-v1": 2, "Hopper-v5": 2}
    assert list(st.balanced(scores, 3)["DN-DDPG"]) == ["Pendulum-v1"]
    assert st.balanced(scores, 5) == {"DDPG": {}, "DN-DDPG": {}}


def test_a_profile_is_the_share_of_runs_above_each_level():
    share = st.profile([[0.1, 0.9], [0.5]], levels=[0, 0.5, 0.8, 1])
    assert share.tolist() == [1, 0.25, 0.25, 0]  # "above", and each task counts alike


# --- budget and verdict ---------------------------------------------------------------


def test_our_cheetah_runs_are_two_per_cent_of_the_papers():
    assert st.share_of_the_paper("HalfCheetah-v5", 100_000) == 0.02
    assert st.share_of_the_paper("Pendulum-v1", 40_000) == pytest.approx(1 / 15)


def test_a_curve_that_still_climbs_is_not_settled():
    flat, climbing = [-1000] * 50 + [-150] * 50, np.linspace(-1230, -150, 100)
    for values, rests in ((flat, True), (climbing, False)):
        rows = table(DDPG_0=values)
        rows["step"] *= 400  # to 40 000, a fifteenth of the paper's
        assert st.settled(rows, "Pendulum-v1") is rests
        assert st.tested(rows, "Pendulum-v1") is rests
        rows["step"] *= 7.5  # to half of the paper's: no matter whether it rests
        assert st.tested(rows, "Pendulum-v1")
    assert not st.tested(rows, "Hopper-v5")  # nothing recorded


def test_a_verdict_needs_the_whole_interval_on_one_side():
    assert st.verdict([1, 2, 3]) == "not distinguishable"  # 2 ± 2.48
    assert st.verdict([1, 1.5, 2]) == "holds"  # 1.5 ± 1.24
    assert st.verdict([-1, -1.5, -2]) == "does not hold"
    assert st.verdict([-1, -1.5, -2], "less") == "holds"
    assert st.verdict([1, 1.5, 2], margin=0.5) == "not distinguishable"
    assert st.verdict([1, 1.5, 2], margin=3) == "does not hold"


def test_the_same_means_inside_a_margin_and_no_difference_found_is_not_enough():
    wide, narrow = [-3, 0, 3], [-0.1, 0, 0.1]
    assert st.verdict(narrow, "same", margin=1) == "holds"
    assert st.verdict(wide, "same", margin=1) == "not distinguishable"
    assert st.verdict([5, 5.1, 5.2], "same", margin=1) == "does not hold"
    assert st.verdict([-5, -5.1, -5.2], "same", margin=1) == "does not hold"
    with pytest.raises(ValueError, match="margin"):
        st.verdict(narrow, "same")


def test_two_runs_are_no_verdict_however_clear_they_look():
    assert st.verdict([]) == "not tested (n = 0)"
    assert st.verdict([100]) == "not tested (n = 1)"
    assert st.verdict([100, 100.1]) == "not tested (n = 2)"


def test_too_few_steps_are_no_verdict_however_many_runs():
    assert st.verdict([1, 1.5, 2], tested=False) == "not tested at this budget"


def test_a_claim_that_is_none_is_refused():
    with pytest.raises(ValueError, match="bigger"):
        st.verdict([1, 2, 3], "bigger")


def test_one_part_that_does_not_hold_refuses_the_whole_claim():
    holds, fails, open_ = st.HOLDS, st.FAILS, st.OPEN
    assert st.all_of([holds, holds]) == holds
    assert st.all_of([holds, open_, fails, "not tested (n = 1)"]) == fails
    assert st.all_of([holds, open_]) == open_
    assert st.all_of([holds, "not tested (n = 1)"]) == "not tested (n = 1)"


# --- the figures of chapter 10 --------------------------------------------------------


@pytest.fixture
def close_figures():
    yield
    plt.close("all")


@pytest.mark.usefixtures("close_figures")
def test_a_task_without_records_says_which_command_records_it():
    curve = np.arange(3), np.ones((3, 3))
    axes = plots.plot_eight_tasks({"Pendulum-v1": {"DDPG": curve}, "Hopper-v5": {}},
                                  interval=st.t_interval, seeds=True)
    drawn, empty = np.ravel(axes)
    assert "n = 3" in drawn.get_title(loc="left")
    assert len(drawn.get_lines()) == 4 and len(drawn.collections) == 1  # runs, mean
    words = "".join(text.get_text() for text in empty.texts).split()
    assert " ".join(words) == ("not recorded yet: python -m dnddpg_minimal study "
                               "--task Hopper-v5")


@pytest.mark.usefixtures("close_figures")
def test_fewer_than_three_runs_have_no_shade():
    curve = np.arange(3), np.ones((2, 3))
    axes = plots.plot_eight_tasks({"Pendulum-v1": {"DDPG": curve}}, st.t_interval)
    assert len(axes[0, 0].collections) == 0


@pytest.mark.usefixtures("close_figures")
def test_every_verdict_has_a_field_and_a_claim_about_no_task_has_none():
    table = {"one": {"Pendulum-v1": st.HOLDS, "Hopper-v5": st.FAILS},
             "two": {"Pendulum-v1": st.OPEN, "Hopper-v5": "not tested (n = 1)"},
             "three": {"Pendulum-v1": f"{st.HOLDS} alone", "Hopper-v5": st.UNTESTED}}
    ax = plots.plot_verdicts(table, ["Pendulum-v1", "Hopper-v5"])
    assert [text.get_text() for text in ax.texts] == [
        "holds", "does not", "open", "n = 1", "holds\nalone", "too short"]
    assert len({patch.get_facecolor() for patch in ax.patches}) == 5


@pytest.mark.usefixtures("close_figures")
def test_a_single_difference_is_drawn_without_a_mean_and_without_an_interval():
    one, none = np.array([3.0]), np.empty(0)
    found = {"DN − DDPG": {
        task: (d, st.t_interval(d), st.bootstrap_interval(d))
        for task, d in (("Pendulum-v1", one), ("Hopper-v5", none))}}
    (ax,) = np.ravel(plots.plot_paired_by_task(found))
    assert "|" not in [line.get_marker() for line in ax.get_lines()]


# --- many questions -------------------------------------------------------------------


def test_p_value_and_interval_agree():
    rng = np.random.default_rng(0)
    for _ in range(200):
        d = rng.normal(0.5, 1, rng.integers(3, 12))
        low, high = st.t_interval(d)
        assert (st.p_value(d) < 0.05) == (low > 0 or high < 0)
    assert np.isnan(st.p_value([1.0, 2.0]))
    assert (st.p_value([0.0] * 4), st.p_value([2.0] * 4)) == (1, 0)


def test_holm_by_hand():
    """0.01 · 4, 0.02 · 3, 0.03 · 2; 0.04 · 1 may not fall below the one before."""
    found = st.holm([0.04, np.nan, 0.01, 0.03, 0.02])
    assert np.allclose(found, [0.06, np.nan, 0.04, 0.06, 0.06], equal_nan=True)
    assert st.holm([0.6, 0.9]).tolist() == [1, 1]
    assert len(st.holm([])) == 0


def test_holm_is_wrong_about_one_of_many_in_one_study_of_twenty_at_most():
    rng = np.random.default_rng(0)
    p = rng.uniform(size=(4_000, 10))  # no difference is real
    wrong = np.mean([(st.holm(one) < 0.05).any() for one in p])
    assert 0.035 < wrong < 0.065 < np.mean((p < 0.05).any(axis=1))


def test_a_claim_rests_on_its_weakest_part_and_its_refusal_on_the_surest():
    holds, fails, open_ = st.HOLDS, st.FAILS, st.OPEN
    assert st.deciding_p(holds, [(holds, 0.01), (holds, 0.2)]) == 0.2
    assert st.deciding_p(fails, [(fails, 0.03), (fails, 0.2), (holds, 0.001)]) == 0.03
    assert st.deciding_p(open_, [(open_, 0.6), (holds, 0.01)]) == 0.6


def test_a_missing_run_is_refused_not_passed_over():
    for judge in (st.verdict, st.p_value):
        with pytest.raises(ValueError, match="expected finite numbers"):
            judge([5, 5.1, np.nan, 5.2, 4.9])
