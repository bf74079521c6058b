"""What several runs say about an algorithm: scores, intervals, verdicts.

The unit is the run: one seed, one number, agreed on before looking. Everything here is
a few lines around SciPy, and needs no training.

| call | meaning |
|---|---|
| `scores(table, kind)` | one number per run, from the evaluations |
| `training_table(runs)` | training returns by episode, means of blocks |
| `by_step(table)`, `curves(table, tasks)` | learning curves |
| `band`, `t_interval`, `bootstrap_interval` | mean of runs, give or take: (low, high) |
| `coverage(law, n, interval, rng)` | how often an interval holds the truth |
| `paired(scores, first, second)` | differences of runs that started alike |
| `normalised(scores)`, `NORMALISER` | 0 is random actions, 1 a stated reference |
| `interquartile_mean`, `iqm_interval` | a mean over tasks that outliers do not move |
| `profile(scores, levels)` | share of runs that reach a level |
| `share_of_the_paper`, `settled`, `tested` | is the budget enough for a claim? |
| `verdict(differences, ...)` | holds, does not hold, not distinguishable, not tested |
| `all_of(verdicts)` | the verdict on a claim of several parts |
| `deciding_p(whole, parts)` | the p-value that it rests on |
"""

import numpy as np
from scipy import stats

from dnddpg_minimal.dnddpg import MUJOCO_TASKS
from dnddpg_minimal.records import score

CONFIDENCE = 0.95
FEWEST = 3  # paired runs for a verdict
# Returns that count as 0 and as 1. Zero: uniform random actions, measured over 10 to
# 100 episodes. One: Pendulum and MountainCar, where the field calls them solved; the
# Arms, the reference by inverse kinematics (arm.reference_action, 200 episodes); on
# MuJoCo, round numbers near TD3's after a million steps on the older v4.
NORMALISER = {
    "Pendulum-v1": (-1230, -150),
    "ArmEasy-v0": (-132, -3.7),
    "ArmHard-v0": (-138, -4.5),
    "MountainCarContinuous-v0": (-33, 90),
    "HalfCheetah-v5": (-230, 10_000),
    "Hopper-v5": (17, 3_000),
    "Walker2d-v5": (2, 4_000),
    "Humanoid-v5": (113, 5_000),
}

# --- 1. One number per run, one curve per run -----------------------------------------


def scores(table, kind="end", column="mean"):
    """One number per run: a Series over (task, algorithm, seed).

    table: evaluations as `load_study` gives them; column: the one that is scored, by
    default the return. kind:

        "end"      the mean of the last ten evaluations (five on MuJoCo), study.score
        "whole"    the mean of all evaluations: the area under the learning curve
        "final"    the last evaluation alone
        "maximum"  the best evaluation: chosen after looking, so too high; only to
                   show that
        "spread"   how far the run lies from the middle one of its algorithm's runs:
                   mean over steps of |value − median over seeds|. Differences of it
                   compare the width of two algorithms' bands (Brown and Forsythe,
                   1974, for a curve)

    ValueError for another kind, and for a table that holds one run's seed in several
    variants: a mean over them would be of nothing.
    """
    runs = ["task", "algorithm", "seed"]
    if (table.groupby(runs).variant.nunique() > 1).any():
        variants = ", ".join(table.variant.unique())
        raise ValueError(f"scores() of the variants {variants}: they would be mixed. "
                         "Choose one of them.")
    in_order = table.set_index(runs).index.unique()
    groups = table.sort_values("step", kind="stable").groupby(runs)[column]
    if kind == "end":
        found = score(table, column).droplevel("variant")
    elif kind == "whole":
        found = groups.mean()
    elif kind == "final":
        found = groups.last()
    elif kind == "maximum":
        found = groups.max()
    elif kind == "spread":
        # Among the seeds that all algorithms have: a median of more runs lies farther.
        seeds = table.groupby(["task", "seed"])["algorithm"].transform("nunique")
        table = table[seeds == seeds.groupby(table["task"]).transform("max")]
        middle = table.groupby(["task", "algorithm", "step"])[column]
        away = (table[column] - middle.transform("median")).abs()
        found = away.groupby([table[name] for name in runs]).mean()
    else:
        raise ValueError(f"kind={kind!r}: expected one of end, whole, final, maximum, "
                         "spread.")
    return found.reindex(in_order)


def block_means(returns, block=10):
    """Means of `block` episodes in a row: returns (E,) -> (E // block,).

    Episodes that fill no block are dropped. The paper's curves (section 4.4), where a
    block has 100 episodes.
    """
    returns = np.asarray(returns, np.float64)
    whole = len(returns) // block * block
    return returns[:whole].reshape(-1, block).mean(axis=1)


def training_table(runs, block=10):
    """Training returns in the shape of evaluations: a DataFrame, a row per block.

    runs: dicts of `load_study(what="episodes")`. "step" counts episodes here, and
    "mean" is a block's mean return, noise included. So `scores` and `by_step` read it.
    """
    import pandas as pd

    names, parts = ["task", "algorithm", "variant", "seed"], []
    for run in runs:
        mean = block_means(run["episode_return"], block)
        one = {name: run[name] for name in names}
        parts.append(pd.DataFrame(one | dict(
            step=block * np.arange(1, len(mean) + 1), mean=mean)))
    return (pd.concat(parts, ignore_index=True) if parts
            else pd.DataFrame(columns=[*names, "step", "mean"]))


def by_step(table, column="mean"):
    """Learning curves of one algorithm's runs on a task: (steps (M,), values (S, M)).

    table: a row per run and step, as `load_study` gives them; column: what is drawn.
    Steps at which a run has no value are left out: the curves end with the shortest.
    """
    wide = table.pivot(index="step", columns="seed", values=column).dropna()
    return wide.index.to_numpy(), wide.to_numpy().T


def curves(table, tasks):
    """Learning curves of all tasks: task -> algorithm -> (steps (M,), values (S, M)).

    A task that has no rows in `table` gets an empty dict.
    """
    found = {task: {} for task in tasks}
    for (task, name), rows in table.groupby(["task", "algorithm"], sort=False):
        if task in found:
            found[task][name] = by_step(rows)
    return found


# --- 2. Intervals ---------------------------------------------------------------------


def band(values, axis=0):
    """Mean ± standard deviation of runs, as in the paper's Figure 6: (low, high).

    values: a number per run, along `axis`. The band says where runs lie, not where
    their mean lies; it does not shrink with n. With one run both are NaN.
    """
    values = np.asarray(values, np.float64)
    if values.shape[axis] < 2:
        return _nothing(values, axis)
    mean, deviation = values.mean(axis=axis), values.std(axis=axis, ddof=1)
    return mean - deviation, mean + deviation


def t_interval(values, confidence=CONFIDENCE, axis=0):
    """Mean ± t·s/√n, Student's interval: (low, high).

    values: n runs along `axis`; s is their standard deviation with n − 1. If the runs
    are normal, a share `confidence` of such intervals holds the true mean. With one run
    NaN.
    """
    values = np.asarray(values, np.float64)
    n = values.shape[axis]
    if n < 2:
        return _nothing(values, axis)
    mean, deviation = values.mean(axis=axis), values.std(axis=axis, ddof=1)
    half = stats.t.ppf((1 + confidence) / 2, n - 1) * deviation / np.sqrt(n)
    return mean - half, mean + half


def bootstrap_interval(values, confidence=CONFIDENCE, method="percentile", axis=0,
                       resamples=2_000, seed=0):
    """Bootstrap interval of the mean: (low, high).

    values: n runs along `axis`. Draw n of them with replacement, `resamples` times, and
    keep the middle share `confidence` of the means (Efron 1979). method: "percentile",
    or "BCa", which corrects its bias and skewness. `seed` fixes the draws. One run, or
    runs that are all equal: see `t_interval`.
    """
    values = np.moveaxis(np.asarray(values, np.float64), axis, 0)
    if len(values) < 2:
        return _nothing(values, 0)
    low, high = map(np.array, t_interval(values))  # right where all runs are equal
    varies = np.ptp(values, axis=0) > 0
    if np.any(varies):
        low[varies], high[varies] = stats.bootstrap(
            (values[:, varies],), np.mean, axis=0, confidence_level=confidence,
            method=method, n_resamples=resamples, rng=np.random.default_rng(seed)
        ).confidence_interval
    return low[()], high[()]


def _nothing(values, axis):
    shape = np.delete(values.shape, axis)
    return np.full(shape, np.nan), np.full(shape, np.nan)


def coverage(law, n, interval, rng, trials=2_000):
    """How often `interval` holds the true mean: a share between 0 and 1.

    law(rng, shape): draws of runs whose true mean is 0. n: runs in one experiment.
    interval: a function of values (n, trials), such as `t_interval`.
    """
    low, high = interval(law(rng, (n, trials)))
    return float(np.mean((low <= 0) & (0 <= high)))


# --- 3. Algorithms against each other -------------------------------------------------


def paired(scores, first, second):
    """Differences first − second of runs with the same seed: (n,), in order of seed.

    scores: a Series over (algorithm, seed), of one task. Empty where an algorithm has
    no runs.
    """
    wide = scores.unstack("algorithm").reindex(columns=[first, second]).dropna()
    return (wide[first] - wide[second]).sort_index().to_numpy()


def normalised(scores):
    """(score − random) / (reference − random), with NORMALISER: a Series like `scores`.

    scores: a Series with a level "task". KeyError for a task that has no entry.
    """
    low, high = np.array([NORMALISER[task] for task in
                          scores.index.get_level_values("task")]).reshape(-1, 2).T
    return (scores - low) / (high - low)


def size_of(task):
    """Units of return between 0 and 1 of a task's NORMALISER."""
    low, high = NORMALISER[task]
    return high - low


def interquartile_mean(values, axis=-1):
    """The mean of the middle half: a quarter of the values is cut off at each end.

    Along `axis`. Of 3 values it is the plain mean, of 5 the mean of the middle three,
    of 10 that of the middle six: the number cut off is rounded down.
    """
    return stats.trim_mean(values, 0.25, axis=axis)


def iqm_interval(samples, confidence=CONFIDENCE, resamples=2_000, seed=0):
    """Interquartile mean over tasks, and its stratified bootstrap: (iqm, low, high).

    samples: a list of (n,), one per task, normalised. Runs are drawn anew within each
    task, never tasks: the interval is about these tasks. confidence, resamples, seed:
    as in `bootstrap_interval`. low and high are NaN with fewer than FEWEST runs in a
    task. Agarwal et al. 2021.
    """
    iqm = float(interquartile_mean(np.concatenate(samples)))
    if min(map(len, samples)) < FEWEST:
        return iqm, np.nan, np.nan

    def statistic(*drawn, axis=-1):
        return interquartile_mean(np.concatenate(drawn, axis=axis), axis=axis)

    low, high = stats.bootstrap(
        samples, statistic, confidence_level=confidence, method="percentile",
        n_resamples=resamples, rng=np.random.default_rng(seed)).confidence_interval
    return iqm, float(low), float(high)


def balanced(scores, runs):
    """The first `runs` seeds that all algorithms share, of tasks that have so many.

    scores: a Series over (task, algorithm, seed). Returns algorithm -> task -> (runs,).
    A task with more runs would count more in a pooled mean; here all count alike.
    """
    wide = scores.unstack("algorithm").dropna()
    found = {name: {} for name in wide}
    for task, rows in wide.groupby("task", sort=False):
        if len(rows) >= runs:
            for name in wide:
                found[name][task] = rows[name].sort_index().to_numpy()[:runs]
    return found


def profile(samples, levels):
    """Performance profile: the share of runs with a score above each level: (L,).

    samples: a list of (n,), one per task, normalised; every task counts alike. levels
    (L,). Agarwal et al. 2021.
    """
    levels = np.asarray(levels)
    return np.mean([(np.asarray(one)[:, None] > levels).mean(axis=0)
                    for one in samples], axis=0)


# --- 4. Is the budget enough? ---------------------------------------------------------


def paper_budget(task):
    """The task in the paper's section 4.3: (rounds, longest round in steps)."""
    return (5_000, 1_000) if task in MUJOCO_TASKS else (2_000, 300)


def share_of_the_paper(task, steps):
    """Our steps on a task as a share of the paper's, at least.

    The paper's rounds that end early have fewer steps, so the true share may be larger.
    """
    rounds, longest = paper_budget(task)
    return steps / (rounds * longest)


def settled(table, task, tolerance=0.05):
    """Have the learning curves of a task come to rest? A bool.

    table: evaluations as `load_study` gives them. True if from the third to the last
    quarter of the evaluations the mean over runs moves by less than `tolerance` of the
    NORMALISER's size, for every algorithm.
    """
    table = table[table.task == task]
    if table.empty:
        return False
    quarter = table.step / table.step.max()
    last, third = table[quarter > 0.75], table[(quarter > 0.5) & (quarter <= 0.75)]
    moved = (last.groupby("algorithm")["mean"].mean()
             - third.groupby("algorithm")["mean"].mean()).abs()
    return bool((moved < tolerance * size_of(task)).all())


def tested(table, task):
    """May a claim about the whole of the paper's training be judged? A bool.

    table, task: as in `settled`. Yes with half of the paper's steps on the task, or
    with a twentieth if the curves are settled.
    """
    table = table[table.task == task]
    share = share_of_the_paper(task, table.step.max() if len(table) else 0)
    return bool(share >= 0.5 or (share >= 0.05 and settled(table, task)))


HOLDS, FAILS = "holds", "does not hold"
OPEN, UNTESTED = "not distinguishable", "not tested at this budget"


def _finite(differences):
    differences = np.asarray(differences, np.float64)
    if not np.isfinite(differences).all():
        raise ValueError(f"differences={differences}: expected finite numbers. Leave "
                         "out the pairs of which a run is missing.")
    return differences


def p_value(differences):
    """Chance of a mean so far from 0, were the true one 0: t test, two-sided.

    differences (n,). Below 0.05 where the 95 % t interval leaves 0 out. NaN for fewer
    than three. ValueError if one is not finite.
    """
    differences = _finite(differences)
    if len(differences) < FEWEST:
        return np.nan
    if np.ptp(differences) == 0:  # all equal: sure, or nothing at all
        return float(differences[0] == 0)
    return float(stats.ttest_1samp(differences, 0).pvalue)


def holm(p_values):
    """Holm's correction (1979) for many questions: adjusted p-values, (m,).

    The smallest of m is multiplied by m, the next by m - 1, and so on; none may become
    smaller than the one before it. Of those that stay below 0.05, the chance of even
    one error is 5 % at the most, whatever the questions have in common. p_values (m,);
    NaN counts as not asked, and stays NaN.
    """
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p)[:np.isfinite(p).sum()]  # NaN are sorted to the end
    adjusted = np.full(p.shape, np.nan)
    raised = np.arange(len(order), 0, -1) * p[order]
    adjusted[order] = np.minimum(1, np.maximum.accumulate(raised))
    return adjusted


def verdict(differences, claim="greater", margin=0.0, tested=True,
            confidence=CONFIDENCE):
    """What paired differences say about a claim, by their t interval: a text.

        "holds"                      the interval lies where the claim says
        "does not hold"              it lies wholly on the other side
        "not distinguishable"        it reaches into both
        "not tested at this budget"  `tested` is False
        "not tested (n = 1)"         fewer than three differences

    differences (n,). claim: "greater" than `margin`, "less" than −`margin`, or "same":
    within ± `margin`. confidence: that of the interval. ValueError for another claim, a
    negative margin, a difference that is not finite, and for "same" without a margin,
    which no measurement could ever confirm.
    """
    if claim not in ("greater", "less", "same"):
        raise ValueError(f"claim={claim!r}: expected greater, less or same.")
    if margin < 0 or (claim == "same" and margin == 0):
        raise ValueError(f"margin={margin!r}: expected 0 or more, and more than 0 for "
                         "the claim 'same'.")
    differences = _finite(differences)
    if len(differences) < FEWEST:
        return f"not tested (n = {len(differences)})"
    if not tested:
        return UNTESTED
    low, high = t_interval(-differences if claim == "less" else differences, confidence)
    if claim == "same":
        inside = -margin < low and high < margin
        outside = high < -margin or low > margin
    else:
        inside, outside = low > margin, high < margin
    return HOLDS if inside else FAILS if outside else OPEN


def all_of(verdicts):
    """The verdict on a claim of several parts, from theirs: a text.

    One part that does not hold is enough to refuse it; to hold, it needs all of them.
    """
    verdicts = list(verdicts)
    if FAILS in verdicts:
        return FAILS
    missing = [one for one in verdicts if one.startswith("not tested")]
    if missing:
        return min(missing, key=lambda one: ("n =" not in one, one))  # the fewest
    return OPEN if OPEN in verdicts else HOLDS


def deciding_p(whole, parts):
    """The p-value on which the verdict on a claim of several parts rests: a float.

    whole: the claim's verdict, by `all_of`. parts: (verdict, p-value) of each of its
    differences. One part is enough to refuse: then it is the smallest p of the parts
    that do. To hold, a claim needs all of them: then it is the largest.
    """
    if whole == FAILS:
        return min(p for found, p in parts if found == FAILS)
    return max(p for _, p in parts)
