"""What the study recorded: loading it, scoring it, and the table as measured.

A record is one small file: recordings/<task>/<variant>/<algorithm>-<seed>.npz.

| call | meaning |
|---|---|
| `load_study(task, algorithm, ...)` | what was recorded, as tables and arrays |
| `score(table, column)` | one number per run: the mean of its last evaluations |
| `load_agent_at(weights, i)` | an agent from recorded weights |
| `owed(columns, config, ends)` | what each row of bias owes to lag alone |
| `results(variant)`, `claims(runs)` | the table as measured, and the paper's claims |
| `predictions(runs)` | the bias that the targets' rules foretell, and as measured |
| `write_readme(folder)` | the same, put into recordings/README.md |
"""

import json
import warnings
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np

from dnddpg_minimal import bias
from dnddpg_minimal.dnddpg import (
    ALGORITHMS,
    CHOICES,
    MUJOCO_TASKS,
    Config,
    _nearest,
    _no_choice,
    make_agent,
)

FORMAT = 1  # of a record
RECORDINGS = Path(__file__).parent / "recordings"
SMALL = ("Pendulum-v1", "ArmEasy-v0", "ArmHard-v0")
TASKS = (*SMALL, "MountainCarContinuous-v0", *MUJOCO_TASKS)  # small ones first
FILMED = [f"{task}/class/DN-DDPG-0" for task in TASKS]  # agents with a film
FILMED += [f"{task}/class/{algorithm}-0" for task in (*SMALL, "HalfCheetah-v5")
           for algorithm in ("DDPG", "DCN-DDPG")] + ["ArmEasy-v0/bonus/DN-DDPG-0"]
BINS = 40  # of the histogram of visited states, in each direction
PLANES = {  # task: (x, y) of a state in the histogram of visits, from obs; their ranges
    "Pendulum-v1": (lambda obs: (np.arctan2(obs[:, 1], obs[:, 0]), obs[:, 2]),
                    ((-np.pi, np.pi), (-8.0, 8.0))),
    "MountainCarContinuous-v0": (lambda obs: (obs[:, 0], obs[:, 1]),
                                 ((-1.2, 0.6), (-0.07, 0.07))),
}

# --- 1. Loading -----------------------------------------------------------------------

TABLES = ("evaluations", "bias")
WHAT = (*TABLES, "episodes", "planes", "weights", "visits", "meta")


def load_study(task=None, algorithm=None, variant="class", what="evaluations",
               folder=None, rule=None):
    """What was recorded. `None` for task, algorithm or variant means all of them.

    folder: of the recordings, by default the package's.

    what="evaluations", "bias": one pandas DataFrame. A bias is that of the policy that
    acts; `rule="max_min"` or `"paired"` asks for that of the policy that chooses its
    action so (measured for two actors on Pendulum, MountainCar and the Arms). `owed` is
    computed here, so that old and new records have the same; `ends` is the share of the
    transitions in memory that end the world.
    Anything else: a list of dicts, one per run, with task, algorithm, variant, seed and

        episodes  step, length, episode_return                         (E,)
        planes    step (T,), x (N,), y (N,), q (T, C, N, N), truth (T, N, N)
        weights   step (T,), theta (T, P); for `load_agent_at`
        visits    counts (N, N) of the states in memory at the run's end (`class`: of
                  all), x (N + 1,) and y (N + 1,), the cells' edges
        meta      config, versions, processor, seconds, ..., first_losses (20, C)

    T times of the run, N points of an axis; pictures have the axes [y, x]. A damaged
    or foreign file is named in a warning and skipped. What is planned and not recorded
    yet is an empty table or list. ValueError for an unknown `what`, and for a task, an
    algorithm or a variant that is neither planned nor recorded.
    """
    if what not in WHAT:
        raise ValueError(f"what={what!r}: expected one of {', '.join(WHAT)}.")
    if rule not in (None, *CHOICES["act_rule"]):
        raise _no_choice("rule", rule, CHOICES["act_rule"])
    asked = dict(task=task, variant=variant, algorithm=algorithm)
    folder, found = Path(folder or RECORDINGS), []
    for name in _names(folder):
        path, known = folder / name, _named(name)
        if not all(known[field] and value in (None, known[field])
                   for field, value in asked.items()):
            continue
        try:
            found += _read(path, name, what, rule)
        except Exception as error:  # zipfile and NumPy raise a dozen kinds
            why = ("it is damaged, or no record of this study", "Delete it, and "
                   "`study` makes it again.")
            if isinstance(error, PermissionError):
                why = "you may not read it", "See its owner and its rights."
            warnings.warn(f"{path} is skipped: {why[0]} ({type(error).__name__}: "
                          f"{error}). {why[1]}", stacklevel=2)
    if not found:
        _refuse_unknown(folder, asked)
    found.sort(key=lambda one: _order(*(one[name] for name in RUN)))
    return _frame(found) if what in TABLES else found


RUN = ("task", "algorithm", "variant", "seed")


def _names(folder):
    """Where the records in a folder lie. A task's own name may hold one slash."""
    return [path.relative_to(folder).as_posix() for pattern in
            ("*/*/*-*.npz", "*/*/*/*-*.npz") for path in folder.glob(pattern)]


def _named(name):
    """task/variant/algorithm-seed as a dict."""
    task, variant, file = name.rsplit("/", 2)
    return dict(task=task, variant=variant, algorithm=file.rpartition("-")[0])


def _refuse_unknown(folder, asked):
    """ValueError if a name that was asked for is neither planned nor recorded."""
    from dnddpg_minimal.study import list_of

    names = [run.name for budget in ("class", "paper") for run in list_of(budget)]
    names += _names(folder)
    for field, value in asked.items():
        known = {_named(name)[field] for name in names}
        if value is not None and value not in known:
            raise ValueError(f"Nothing is planned or recorded with {field}={value!r}."
                             f"{_nearest(value, sorted(known))}")


def _order(task, algorithm, variant, seed):
    tasks, algorithms = [*TASKS, task], [*ALGORITHMS, algorithm]
    return (tasks.index(task), task, variant != "class", variant,
            algorithms.index(algorithm), algorithm, seed)


def _read(path, name, what, rule):
    """What the record at `path`, whose name is that, holds of `what`: [dict] or []."""
    with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
        meta = json.loads(str(content["meta"]))
        if meta["format"] != FORMAT:
            raise ValueError(f"format {meta['format']!r}, expected {FORMAT}")
        config = meta["config"]
        one = dict(task=config["task"], algorithm=config["algorithm"],
                   variant=meta["variant"], seed=config["seed"])
        own = "{task}/{variant}/{algorithm}-{seed}.npz".format(**one)
        if name != own:
            raise ValueError(f"it is a copy of {own}")  # and would count twice
        if what in TABLES:
            names, labels = meta[f"{what}_numbers"], meta[f"{what}_labels"]
            if not names:
                return []
            columns = dict(zip(names, content[what].astype(np.float64).T, strict=True))
            columns["ends"] = share_of_ends(content["episodes"], columns["step"],
                                            config, meta["bug"])
            rows = slice(None)
            if labels:
                words = content[f"{what}_labels"].T
                columns |= dict(zip(labels, words, strict=True))
                columns["owed"] = owed(columns, config, columns["ends"])
                rows = columns["rule"] == (rule or config["act_rule"])
            one |= {name: column[rows] for name, column in columns.items()}
        elif what == "episodes":
            step, length, total = content["episodes"].T
            one |= dict(step=step.astype(int), length=length.astype(int),
                        episode_return=total)
        elif what == "meta":
            one |= meta | dict(first_losses=content["first_losses"])
        elif what == "visits" and "visits" in content:
            x, y = PLANES[one["task"]][1]
            one |= dict(counts=content["visits"], x=np.linspace(*x, BINS + 1),
                        y=np.linspace(*y, BINS + 1))
        elif what == "planes" and "picture_q" in content:
            for name in ("x", "y", "q", "truth"):
                one[name] = content[f"picture_{name}"].astype(np.float32)
            one |= dict(step=content["picture_steps"], x=one["x"][0], y=one["y"][0])
        elif what == "weights" and "picture_theta" in content:
            one |= dict(step=content["picture_steps"], config=json.dumps(config),
                        theta=content["picture_theta"].astype(np.float32),
                        obs_dim=meta["obs_dim"], action_dim=meta["action_dim"])
        else:
            return []
    return [one]


def share_of_ends(episodes, steps, config, bug=None):
    """The share of the transitions in memory that were stored as the world's end: (M,).

    episodes (E, 3): step, length, return of each; steps (M,) ask; config: a dict of
    its fields. An episode that is shorter than its time limit has ended, on the Arms
    only with `success_terminates`; `ends` and `bug` may store something else. For a
    task that is not registered here the limit is the longest episode.
    """
    limit = config["max_episode_steps"]
    try:
        limit = limit or gymnasium.spec(config["task"]).max_episode_steps or np.inf
    except gymnasium.error.Error:
        limit = episodes[:, 1].max(initial=0)
    ended = episodes[:, 1] < limit
    if config["task"].startswith("Arm"):
        ended &= (config["task_options"] or {}).get("success_terminates", False)
    if config["ends"] == "none" or bug == "no_end":
        ended[:] = False
    elif config["ends"] == "any_end" or bug == "time_limit":
        ended[:] = True
    steps = np.asarray(steps)
    first = np.maximum(steps - config["buffer_size"], 0)  # older ones are gone
    stored, gone = (np.searchsorted(episodes[ended, 0], until, side="right")
                    for until in (steps, first))
    return (stored - gone) / np.maximum(steps - first, 1)


def owed(columns, config, ends):
    """What each row of a run's bias owes to lag alone (`bias.owed`): (M,).

    columns: a dict of arrays (M,), the columns of the table; config: a dict of its
    fields; ends (M,) of `share_of_ends`. V is the truth over start states (on MuJoCo
    over on-policy states) for the policy that acts: all rows of one evaluation are
    about one critic. NaN where V was not measured.
    """
    series = ((columns["rule"] == config["act_rule"]) & (columns["critic"] == "min")
              & (columns["action"] == "policy") & np.isfinite(columns["truth"])
              & np.isin(columns["states"], ("start", "on_policy")))
    updates = columns["updates"]
    found = bias.owed(updates[series], columns["truth"][series],
                      SimpleNamespace(**config), ends[series])
    known = dict(zip(updates[series].tolist(), found.tolist(), strict=True))
    return np.array([known.get(n, np.nan) for n in updates.tolist()])


def _frame(found):
    """One DataFrame of all runs' rows. A column that a run lacks is NaN there."""
    import pandas as pd

    whole = ("seed", "step", "updates", "n")
    columns = {}
    names = [*RUN, "step", "updates", *(name for one in found for name in one)]
    for name in dict.fromkeys(names):
        parts = [np.broadcast_to(one.get(name, np.nan), len(one["step"]))
                 for one in found]
        column = np.concatenate(parts) if parts else np.empty(0)
        columns[name] = column.astype(int) if name in whole else column
    return pd.DataFrame(columns)


def score(table, column="mean"):
    """A run's score, declared beforehand: the mean of its last ten evaluations.

    On MuJoCo of its last five; never the maximum over time. `table` holds a task's
    evaluations, or rows of bias that were chosen to be one per evaluation; `column` is
    the one that is scored. Returns a Series over (task, algorithm, variant, seed).
    """
    def last(runs):
        return runs.tail(5 if runs.name[0] in MUJOCO_TASKS else 10).mean()

    in_order = table.sort_values("step", kind="stable")
    return in_order.groupby([*RUN], sort=False)[column].apply(last)


def load_agent_at(weights, i=-1):
    """The agent of a run at its i-th recorded time; `weights` from `load_study`.

    The weights were stored in float16. Slow copies equal the networks, moments are 0:
    for acting and looking, not for going on with the training.
    """
    config = Config.from_json(weights["config"])
    agent = make_agent(config, weights["obs_dim"], weights["action_dim"])
    theta = weights["theta"][i]
    agent.set_arrays(agent.arrays() | dict(theta=theta, theta_target=theta))
    return agent


# --- 2. The table as measured ---------------------------------------------------------


def results(variant="class", folder=None, until=np.inf):
    """Return and bias of every task and algorithm: mean, standard error, n of runs.

    variant, folder: as in `load_study`; `until` leaves out what came after this step.

    Each run counts by its `score`. The bias is the first critic's, at the policy's
    action: over start states, on MuJoCo over on-policy states. Two DataFrames, the
    runs' and their summary over (task, variant, algorithm); "steps" is a run's length,
    "return", "bias" and "owed" hold (mean, error, n). ValueError if none is recorded.
    """
    import pandas as pd

    table = load_study(variant=variant, folder=folder)
    if table.empty:
        raise ValueError(f"No run of variant {variant!r} is recorded in "
                         f"{folder or 'the package'}.")
    table = table[table.step <= until]
    rows = load_study(variant=variant, what="bias", folder=folder)
    rows = rows[(rows.action == "policy") & (rows.critic == "0") & (rows.step <= until)]
    starts = rows[rows.states.isin(("start", "on_policy"))]
    runs = pd.DataFrame({
        "return": score(table), "bias": score(starts, "bias"),
        "owed": score(starts, "owed"),
        "recent": score(rows[rows.states == "recent"], "bias"),
        "steps": table.groupby([*RUN], sort=False)["step"].max()})
    by = runs.groupby(["task", "variant", "algorithm"], sort=False)
    summary = by[["return", "bias", "owed"]].agg(bias.summary)
    return runs, summary.assign(steps=by["steps"].max())


def claims(runs):
    """What the paper says, against the runs of `results`: one row per task and claim.

    Differences are paired by seed; a verdict needs three of them, and a 95 % t interval
    on one side of 0. `corrected` is the verdict after Holm's correction over all of
    these claims. `owed` is the part of a bias that a critic's lag alone explains;
    `beyond` is the verdict on the bias minus what its own run owes.
    """
    from dnddpg_minimal.statistics import OPEN, holm, p_value, verdict

    def of(name, algorithm):
        chosen = runs.index.get_level_values("algorithm") == algorithm  # may be none
        return runs[name][chosen].droplevel(["algorithm", "variant"])

    dn, dcn, ddpg = "DN-DDPG", "DCN-DDPG", "DDPG"
    said = {"return: DN > DDPG": lambda name: of(name, dn) - of(name, ddpg),
            "return: DN > DCN": lambda name: of(name, dn) - of(name, dcn),
            "bias: DDPG > 0": lambda name: of(name, ddpg),
            "bias: DCN < 0": lambda name: -of(name, dcn),
            "bias: DN > DCN": lambda name: of(name, dn) - of(name, dcn)}
    found = []
    for claim, difference in said.items():
        what = claim.partition(":")[0]
        owed = difference("owed")
        for task, group in difference(what).dropna().groupby(level="task", sort=False):
            mean, error, n = bias.summary(group)
            lag, beyond = np.nan, ""
            if what == "bias":
                lag = owed.reindex(group.index).mean()
                beyond = verdict((group - owed.reindex(group.index)).dropna())
            found.append(dict(task=task, claim=claim, mean=mean, error=error, n=n,
                              owed=lag, verdict=verdict(group), beyond=beyond,
                              p=p_value(group)))
    for one, p in zip(found, holm([one["p"] for one in found]), strict=True):
        one["corrected"] = OPEN if p >= 0.05 else one["verdict"]
    return found


def predictions(runs, folder=None):
    """What the rule of the target should add to the bias, and what was measured.

    `bias.grown` of delta, as measured (Eq. (5.4)) and as the closed form makes it of
    sigma, kappa, rho (chapters 05 and 06): each algorithm minus the one before, at the
    same seeds. delta is measured at states from memory, so the bias there is compared
    ("recent"), and that at start states stands beside it. `runs` as in `claims`, folder
    as in `load_study`. One dict per task with known equations and pair; values are
    means over n seeds.
    """
    import pandas as pd

    table = load_study(folder=folder)
    table = table[~table.task.isin(MUJOCO_TASKS)]  # there is no sigma there
    rule = Config().target_rule
    table = table.assign(closed=[
        0.0 if one.algorithm == "DDPG" else
        bias.predict(one.sigma, one.kappa, one.rho, rule)
        for one in table.itertuples()])
    grown = []
    for (task, *_), one in table.groupby([*RUN], sort=False):
        columns = {name: bias.grown(one.updates, one[name], Config(task), one.ends)
                   for name in ("delta", "closed")}
        grown.append(one.assign(**columns))
    table = pd.concat(grown) if grown else table
    found = pd.DataFrame({"delta": score(table, "delta"),
                          "closed": score(table, "closed"),
                          "start": runs.bias, "recent": runs.recent})
    found, rows = found.dropna().droplevel("variant"), []
    for task in [one for one in TASKS if one in found.index.levels[0]]:
        group = found[found.index.get_level_values("task") == task].droplevel("task")
        of = {name: one.droplevel("algorithm") for name, one in
              group.groupby(level="algorithm")}
        for first, second in (("DCN-DDPG", "DDPG"), ("DN-DDPG", "DCN-DDPG")):
            if first in of and second in of:
                d = (of[first] - of[second]).dropna()
                if len(d) == 0:
                    continue
                errors = {f"{name}_error": bias.summary(d[name])[1]
                          for name in ("recent", "start")}
                rows.append(dict(task=task, pair=f"{first} − {second}", n=len(d),
                                 **errors, **d.mean()))
    return rows


def write_readme(folder=None):
    """Put the tables as measured into recordings/README.md, between its two marks.

    ValueError if the folder has no record, or its README.md not both marks in order.
    """
    from dnddpg_minimal.study import list_of

    path = Path(folder or RECORDINGS) / "README.md"
    begin, end = "<!-- measured -->\n", "<!-- end -->"
    before, begun, rest = path.read_text(encoding="utf-8").partition(begin)
    _, ended, after = rest.partition(end)
    if not (begun and ended):
        raise ValueError(f"{path}: the tables go between the lines {begin.strip()} and "
                         f"{end}, in this order. It lacks one of them.")
    if load_study(variant=None, folder=folder).empty:
        raise ValueError(f"{path.parent} holds no record yet: there is nothing to put "
                         "into the tables.")
    runs, table = results(None, folder)
    plan = Counter(run.name.rpartition("-")[0] for run in list_of("class"))
    names = {run.name for run in list_of("class")}
    known = names & {f"{task}/{variant}/{algorithm}-{seed}"
                     for task, algorithm, variant, seed in runs.index}
    text = [f"{len(known)} of {len(names)} planned runs. Each number: "
            "mean ± standard error over the runs. A run counts by the mean of its last "
            "ten evaluations, on MuJoCo five. What has fewer steps than `class` stands "
            "beside `class` cut at these steps. *runs*: how many there are, of how "
            "many the plan names; where some are missing, the row is interim.\n"]
    row = "| {} |".format
    heads = ["task", "variant", "steps", "algorithm", "runs", "return", "bias of Q",
             "owed to lag"]
    text += [row(" | ".join(heads)), row(" | ".join("---" for _ in heads))]
    lines = [(names, values) for names, values in table.iterrows()]
    full = table.steps.groupby(level=["task", "variant"]).max()
    shorter = {(task, steps) for (task, _), steps in full.items()
               if steps < full.get((task, "class"), 0)}
    for task, steps in shorter:
        early = results("class", folder, steps)[1].xs(task, drop_level=False)
        lines += [((task, f"class, until step {steps:.0f}", name[2]), values)
                  for name, values in early.iterrows()]
    lines.sort(key=lambda line: _order(line[0][0], line[0][2], line[0][1], 0)[:4])
    for (task, variant, algorithm), values in lines:
        cells = ["{:.4g} ± {:.2g}".format(*value) if value[2] > 1 else
                 "{:.4g}".format(*value) for value in values[:3]]
        planned = plan[f"{task}/{variant.partition(', ')[0]}/{algorithm}"]
        count = f"{values['return'][2]} of {planned}" if planned else "not planned"
        text.append(row(" | ".join([task, variant, f"{values.steps:.0f}", algorithm,
                                    count, *cells])))
    of_class = runs[runs.index.get_level_values("variant") == "class"]
    if len(of_class):
        text += _claims_and_predictions(of_class, folder)
    part = Path(f"{path}.part")
    part.write_text(before + begin + "\n".join(text) + "\n" + end + after,
                    encoding="utf-8", newline="\n")
    part.replace(path)


def _claims_and_predictions(runs, folder):
    """The second and the third table of `write_readme`, as lines of text."""
    from dnddpg_minimal.statistics import OPEN

    row = "| {} |".format
    heads = ["claim", "task", "difference", "owed to lag", "verdict",
             "after Holm's correction", "verdict beyond lag"]
    text = ["", row(" | ".join(heads)), row(" | ".join("---" for _ in heads))]
    found = claims(runs)
    for one in found:
        owed = f"{one['owed']:.3g}" if np.isfinite(one["owed"]) else "–"
        text.append("| {claim} | {task} | {mean:.3g} ± {error:.2g} ({n}) | {} | "
                    "{verdict} | {corrected} | {beyond} |".format(owed, **one))
    many = [one for one in found if one["n"] > 2]
    text += ["", f"{len(many)} verdicts at 95 %: by chance alone {len(many) / 20:.1f} "
             f"would leave 0 out. {sum(one['p'] < 0.05 for one in many)} do, and "
             f"{sum(one['corrected'] != OPEN for one in many)} still after Holm's "
             "correction."]
    heads = ["difference in bias", "task", "grown from δ as measured",
             "grown from σ, κ, ρ", "measured, states from memory",
             "measured, start states"]
    text += ["", "In brackets behind a prediction: does the mean measured at states "
             "from memory lie within four standard errors of it?", "",
             row(" | ".join(heads)), row(" | ".join("---" for _ in heads))]
    for one in predictions(runs, folder):
        near = ["–" if one["n"] < 3 else
                "yes" if abs(one[name] - one["recent"]) <= 4 * one["recent_error"] else
                "no" for name in ("delta", "closed")]
        text.append("| {pair} | {task} | {delta:.3g} ({}) | {closed:.3g} ({}) | "
                    "{recent:.3g} ± {recent_error:.2g} ({n}) | {start:.3g} ± "
                    "{start_error:.2g} ({n}) |".format(*near, **one))
    return text
