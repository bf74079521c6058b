"""The recorded study: it loses nothing, doubles nothing, and repeats itself exactly."""

import contextlib
import dataclasses
import errno
import itertools
import json
import multiprocessing
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dnddpg_minimal import (
    Batch,
    Config,
    NumpyAgent,
    ReplayBuffer,
    Training,
    bias,
    bugs,
    make_agent,
    records,
    study,
    to_env,
)
from dnddpg_minimal.td3 import TD3Training

pytestmark = pytest.mark.slow

TINY = dict(steps=600, warmup=100, hidden=(16, 16), batch_size=16, evaluate_every=300)
SPAWN = multiprocessing.get_context("spawn")


def tiny(algorithm="DN-DDPG", seed=0, task="Pendulum-v1", bug=None, **choices):
    variant = "tiny" if bug is None else f"bug={bug}"
    return study.Run(Config(task, algorithm, seed, **TINY | choices), variant, bug)


def content(path):
    """A record's meta, and its arrays; without what says when it was made."""
    with np.load(path) as file:
        arrays = dict(file)
    meta = json.loads(str(arrays.pop("meta")))
    for name in ("seconds", "revision", "code"):  # other files may be edited meanwhile
        del meta[name]
    return meta, arrays


def assert_same_record(left, right):
    (meta_left, left), (meta_right, right) = content(left), content(right)
    assert meta_left == meta_right
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name], err_msg=name)


def path_of(run, folder):
    return folder / f"{run.name}.npz"


@pytest.fixture(scope="module")
def runs():
    return [tiny(name, seed) for seed in (0, 1) for name in ("DDPG", "DN-DDPG")]


@pytest.fixture(scope="module")
def undisturbed(runs, tmp_path_factory):
    """The records of `runs`, each made in one go."""
    folder = tmp_path_factory.mktemp("undisturbed")
    for run in runs:
        assert study.record(run, folder, folder / "scratch")[0] == "done"
    return folder


# --- which runs -----------------------------------------------------------------------


@pytest.mark.parametrize("budget", ["quick", "class", "paper"])
def test_every_run_has_a_name_of_its_own_that_windows_accepts(budget):
    runs = study.list_of(budget)
    names = [run.name for run in runs]
    assert len(set(names)) == len(names)
    assert len({name.lower() for name in names}) == len(names)
    assert not any(set(name) & set('<>:"\\|?*') or ". " in name for name in names)
    assert {run.config.task for run in runs} == set(study.TASKS)


@pytest.mark.parametrize("budget", ["quick", "class", "paper"])
def test_seeds_are_the_outer_loop_and_small_tasks_come_first(budget):
    order = [(run.config.seed, study.TASKS.index(run.config.task))
             for run in study.list_of(budget)]
    assert order == sorted(order)


def test_the_class_budget_is_the_issues_list():
    names = [run.name for run in study.list_of("class")]

    def count(prefix):
        return sum(name.startswith(prefix) for name in names)

    for task, seeds in (("Pendulum-v1", 10), ("ArmEasy-v0", 10), ("ArmHard-v0", 10),
                        ("MountainCarContinuous-v0", 5), ("HalfCheetah-v5", 10),
                        ("Hopper-v5", 10), ("Walker2d-v5", 10), ("Humanoid-v5", 5)):
        assert count(f"{task}/class/") == 3 * seeds
    assert count("MountainCarContinuous-v0/noise=gaussian/") == 9
    assert count("MountainCarContinuous-v0/noise=gaussian,sigma=0.95/DDPG-") == 3
    for variant in ("target_rule=single", "target_rule=paired_min", "y_min=-20",
                    "target_rule=selected", "target_rule=soft", "act_rule=max_min",
                    "act_rule=first", "climbs=first"):
        assert count(f"Pendulum-v1/{variant}/DN-DDPG-") == 10
    assert count("Pendulum-v1/slow=paper/") == 30
    for task in ("MountainCarContinuous-v0", "Hopper-v5"):
        for ends in ("none", "any_end"):
            assert count(f"{task}/ends={ends}/DDPG-") == 5
    assert count("ArmEasy-v0/success_terminates") == 15
    assert count("HalfCheetah-v5/frozen/") == count("Hopper-v5/frozen/") == 3
    assert count("Pendulum-v1/ablation=") == 15
    assert count("Pendulum-v1/bug=") == 25 and "bug=no_end" in " ".join(names)
    assert count("HalfCheetah-v5/400-300/") == 3
    bodies = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")
    for task in bodies:
        assert count(f"{task}/td3/DCN-DDPG-") == 10
    for task in ("Pendulum-v1", "ArmHard-v0", *bodies):
        assert count(f"{task}/updates_per_step=2/DCN-DDPG-") == 10
    for task in ("ArmHard-v0", "Hopper-v5"):
        assert count(f"{task}/target_rule=single/DN-DDPG-") == 10
        assert count(f"{task}/act_rule=first/DN-DDPG-") == 10


def test_a_control_has_as_many_weights_as_the_agent_it_stands_for():
    ours = make_agent(Config("Pendulum-v1", "DN-DDPG"), 3, 1)
    wide = make_agent(Config("Pendulum-v1", "DDPG", hidden=(92, 92)), 3, 1)
    assert len(wide.theta) == pytest.approx(len(ours.theta), rel=0.03)


def test_an_unknown_budget_or_what_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match="'weekend'.*quick, class, paper"):
        study.list_of("weekend")
    with pytest.raises(ValueError, match="'pictures'.*evaluations, bias"):
        study.load_study(what="pictures", folder=tmp_path)


# --- what a record holds --------------------------------------------------------------


def test_tables_have_the_columns_of_the_contract(undisturbed):
    table = study.load_study(variant="tiny", folder=undisturbed)
    assert len(table) == 4 * 2  # four runs, two evaluations
    assert list(table.columns[:9]) == ["task", "algorithm", "variant", "seed", "step",
                                       "updates", "mean", "standard_error", "n"]
    assert {"delta", "sigma", "kappa", "rho", "actor_distance"} <= set(table.columns)
    assert list(table.step.unique()) == [300, 600]
    assert list(table.updates.unique()) == [200, 500]

    rows = study.load_study(variant="tiny", what="bias", folder=undisturbed)
    assert {"states", "action", "critic", "q", "truth", "bias", "standard_error", "n",
            "owed", "step", "updates"} <= set(rows.columns)
    assert set(rows.critic) == {"0", "1", "min"}
    np.testing.assert_allclose(rows.bias, rows.q - rows.truth, rtol=1e-3, atol=0.01)
    key = ["algorithm", "seed", "step", "states", "action", "critic"]
    assert not rows.duplicated(key).any()  # one row per measurement
    other = study.load_study(variant="tiny", what="bias", rule="max_min",
                             folder=undisturbed)
    assert set(other.algorithm) == {"DN-DDPG"} and set(other.rule) == {"max_min"}


def test_what_is_measured_is_what_bias_evaluate_says(undisturbed, runs):
    training = Training(runs[1].config)
    for item in training:
        if item.kind == "grid" and item.step == 600:
            break
    found = bias.evaluate(training)
    table = study.load_study(algorithm="DN-DDPG", variant="tiny", folder=undisturbed)
    row = table[(table.seed == 0) & (table.step == 600)].iloc[0]
    assert row["mean"] == np.float32(found.evaluation["mean"])
    assert row["delta"] == np.float32(found.operator["delta"])


def test_owed_is_that_of_the_runs_own_values(undisturbed, runs):
    rows = study.load_study(algorithm="DDPG", variant="tiny", what="bias",
                            folder=undisturbed)
    one = rows[(rows.seed == 0) & (rows.states == "start") & (rows.critic == "0")]
    expected = bias.owed(one.updates, one.truth, runs[0].config)
    np.testing.assert_allclose(one.owed, expected, rtol=1e-5)
    assert one.owed.iloc[0] == -one.truth.iloc[0] > 0  # at first all of V is owed


def test_all_rows_of_one_evaluation_owe_the_same():
    config = Config("HalfCheetah-v5", "DDPG")
    common = dict(rule="paired", action="policy", critic="min")
    rows = [common | dict(states="on_policy", updates=n, step=n, truth=float(n))
            for n in (1_000, 2_000, 3_000)]
    rows.append(common | dict(states="recent", updates=2_000, step=2_000, truth=5e3))
    rows.append(rows[-1] | dict(truth=np.nan, action="replay", critic="0"))
    study.owed_to(rows, dataclasses.asdict(config), np.zeros((0, 3)))
    expected = bias.owed([1_000, 2_000, 3_000], [1e3, 2e3, 3e3], config)
    assert [row["owed"] for row in rows] == [*expected, expected[1], expected[1]]


def test_the_share_of_ends_counts_what_was_stored_as_an_end():
    steps, episodes = [500, 1_000, 2_000], np.array([[400, 400, 1], [1_400, 1_000, 1],
                                                     [1_900, 500, 1]])

    def share(bug=None, **choices):
        config = dataclasses.asdict(Config(**dict(task="Hopper-v5") | choices))
        return study.share_of_ends(episodes, steps, config, bug).tolist()

    assert share() == [1 / 500, 1 / 1_000, 2 / 2_000]
    assert share(ends="none") == share("no_end") == [0, 0, 0]
    assert share(ends="any_end") == share("time_limit") == [1 / 500, 1 / 1_000,
                                                            3 / 2_000]
    assert share(task="ArmEasy-v0") == [0, 0, 0]  # success is a truncation there
    # Of the last 1 000 transitions only: the first fall is overwritten by step 2 000
    assert share(buffer_size=1_000) == [1 / 500, 1 / 1_000, 1 / 1_000]
    assert share(task="mine/Unknown-v0") == [1 / 500, 1 / 1_000, 2 / 2_000]


def test_episodes_losses_and_versions_are_recorded(undisturbed, runs):
    one = study.load_study("Pendulum-v1", "DN-DDPG", "tiny", "episodes", undisturbed)[0]
    training = Training(runs[1].config)
    episodes = [item for item in training if item.kind == "episode"]
    assert list(one["step"]) == [item.step for item in episodes] == [200, 400, 600]
    np.testing.assert_array_equal(
        one["episode_return"], np.float32([item.episode_return for item in episodes]))
    meta = study.load_study(variant="tiny", what="meta", folder=undisturbed)[0]
    assert meta["first_losses"].shape == (20, 1)
    assert {"python", "numpy", "gymnasium", "mujoco"} <= set(meta["versions"])
    assert meta["seconds"] > 0 and meta["processor"]
    assert Config.from_json(json.dumps(meta["config"])) == runs[0].config


@pytest.mark.parametrize("task", ["Hopper-v5", "Pendulum-v1"])
def test_a_run_of_so_many_episodes_is_measured_in_full_at_its_four_quarters(
        task, tmp_path):
    choices = dict(steps=None, episodes=8, max_episode_steps=20, evaluate_every=10)
    run = tiny("DN-DDPG", task=task, **choices)
    study.record(run, tmp_path, tmp_path / "scratch")
    table = study.load_study(variant="tiny", folder=tmp_path)
    last = study.load_study(variant="tiny", what="episodes", folder=tmp_path)[0]["step"]
    assert table.step.is_unique and table.step.max() == last[-1]  # 100 %: the very end
    if task == "Pendulum-v1":  # its equations are known: everything, each time
        rows = study.load_study(variant="tiny", what="bias", folder=tmp_path,
                                rule="max_min")
        assert set(rows.step) == set(table.step)
    else:
        assert list(table.quarter.unique()) == [0, 1, 2, 3, 4]


def test_a_record_names_neither_the_machine_nor_its_folders(undisturbed, runs):
    import platform

    text = json.dumps(content(path_of(runs[0], undisturbed))[0])
    assert platform.node() not in text
    assert str(Path.home()) not in text and str(undisturbed) not in text


def test_planes_weights_and_visits(tmp_path, monkeypatch):
    monkeypatch.setattr(bias, "plane", partial(bias.plane, size=9))
    config = tiny(steps=400, warmup=50, evaluate_every=100).config
    training = Training(config)
    planes = {}
    for item in training:
        if item.kind == "grid" and item.step in (100, 200, 400):
            planes[item.step] = bias.plane(training.agent, bias.dynamics(config))
    study.record(study.Run(config, "class"), tmp_path, tmp_path / "scratch")

    picture, = study.load_study(what="planes", folder=tmp_path)
    assert list(picture["step"]) == [100, 200, 400]  # 40, 10 %, is not on the grid
    for i, step in enumerate(picture["step"]):
        for name in ("q", "truth"):  # float16: three digits
            np.testing.assert_allclose(picture[name][i], planes[step][name], rtol=1e-3,
                                       atol=1e-3)
    np.testing.assert_allclose(picture["x"], planes[400]["x"], rtol=1e-6)

    weights, = study.load_study(what="weights", folder=tmp_path)
    agent = study.load_agent_at(weights, -1)
    np.testing.assert_allclose(agent.theta, training.agent.theta, rtol=1e-3, atol=1e-6)
    obs = training.replay.arrays.obs[:50]
    np.testing.assert_allclose(agent.act(obs), training.agent.act(obs), atol=0.01)

    visits, = study.load_study(what="visits", folder=tmp_path)
    assert visits["counts"].sum() == 400
    angle = np.arctan2(obs[0, 1], obs[0, 0])
    cell = (np.searchsorted(visits["y"], obs[0, 2]) - 1,
            np.searchsorted(visits["x"], angle) - 1)
    assert visits["counts"][cell] > 0


def test_a_state_at_the_wall_or_at_top_speed_is_a_visit_too():
    replay = ReplayBuffer(8, obs_dim=2, action_dim=1, rng=np.random.default_rng(0))
    for obs in ((-1.2, 0), (-0.5, 0.07), (-0.5, -0.07), (-0.5, 0)):  # float32: beyond
        replay.add(obs, 0.0, 0.0, obs, False)
    counts = study.visits("MountainCarContinuous-v0", replay)
    assert counts.sum() == 4
    assert counts[20, 0] == counts[39, 15] == counts[0, 15] == counts[20, 15] == 1


def test_the_score_is_the_mean_of_the_last_ten_evaluations_or_five_on_mujoco():
    import pandas as pd

    steps = np.arange(1, 21)
    parts = [pd.DataFrame(dict(task=task, algorithm="DDPG", variant="class", seed=0,
                               step=steps, mean=np.float64(steps)))
             for task in ("Pendulum-v1", "Hopper-v5")]
    scores = study.score(pd.concat(parts).sample(frac=1, random_state=0))
    assert scores["Pendulum-v1", "DDPG", "class", 0] == np.mean(steps[-10:])
    assert scores["Hopper-v5", "DDPG", "class", 0] == np.mean(steps[-5:])


# --- interruption ---------------------------------------------------------------------


class CrashError(Exception):
    pass


@pytest.mark.parametrize("task, choices", [
    ("Pendulum-v1", dict(buffer_size=500)),
    ("ArmHard-v0", {}),
    ("Hopper-v5", dict(steps=500, evaluate_every=100)),
])
def test_a_crash_and_a_resumption_change_nothing(task, choices, tmp_path, monkeypatch):
    run = tiny(task=task, **choices)
    study.record(run, tmp_path / "whole", tmp_path / "scratch")
    measure, crashes = study.measure, iter([210, 420, 450])
    crash_at = next(crashes)

    def measure_and_crash(run, training, item, notes):
        measure(run, training, item, notes)
        if crash_at is not None and item.step >= crash_at:
            raise CrashError

    monkeypatch.setattr(study, "measure", measure_and_crash)
    tries = 0
    while not path_of(run, tmp_path / "torn").exists():
        tries += 1
        try:
            study.record(run, tmp_path / "torn", tmp_path / "scratch", every=0)
        except CrashError:
            crash_at = next(crashes, None)
    assert tries == 4
    assert_same_record(*(path_of(run, tmp_path / name) for name in ("whole", "torn")))
    assert not list((tmp_path / "scratch").glob("*.npz"))


def test_killed_in_the_middle_a_run_goes_on_bit_for_bit(tmp_path, undisturbed, runs):
    run, scratch = runs[3], tmp_path / "scratch"
    checkpoint = study.Checkpoint(run, tmp_path, scratch)
    process = SPAWN.Process(target=study.record, args=(run, tmp_path, scratch),
                            kwargs=dict(every=0))
    process.start()
    deadline = time.monotonic() + 60
    while not checkpoint.training.exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.kill()  # kill -9
    process.join()
    assert not path_of(run, tmp_path).exists()
    resumed, _ = checkpoint.load()
    assert 0 < resumed.step < run.config.steps
    study.record(run, tmp_path, scratch)
    assert_same_record(path_of(run, undisturbed), path_of(run, tmp_path))


def test_what_a_kill_left_half_written_is_swept_away(tmp_path, runs):
    run = runs[0]
    checkpoint = study.Checkpoint(run, tmp_path, tmp_path / "scratch")
    path = path_of(run, tmp_path)
    litter = []  # the names under which write_npz writes
    for whole in (path, checkpoint.training, checkpoint.notes):
        whole.parent.mkdir(parents=True, exist_ok=True)
        study.write_npz(whole, save=lambda file: litter.append(Path(file.name)))
        whole.unlink()
    for part in litter:
        part.write_bytes(b"half")
    study.record(run, tmp_path, tmp_path / "scratch")
    assert path.exists() and not any(part.exists() for part in litter)


@pytest.mark.parametrize("harm", ["truncated", "other code", "no notes"])
def test_a_checkpoint_of_no_use_means_a_new_start(harm, tmp_path, runs, undisturbed,
                                                  monkeypatch):
    run, scratch = runs[0], tmp_path / "scratch"
    checkpoint = study.Checkpoint(run, tmp_path, scratch)
    stop = SPAWN.Event()
    stop.set()
    assert study.record(run, tmp_path, scratch, stop)[0] == "stopped"
    if harm == "truncated":
        checkpoint.training.write_bytes(checkpoint.training.read_bytes()[:-500])
    elif harm == "no notes":
        checkpoint.notes.unlink()
    else:
        monkeypatch.setattr(study, "code", lambda: "another")
    training, notes = checkpoint.load()
    assert training.step == 0 and not notes.evaluations
    monkeypatch.undo()
    study.record(run, tmp_path, scratch)
    assert_same_record(path_of(run, undisturbed), path_of(run, tmp_path))


def children():
    """The process ids of the workers that this process started."""
    return [process.pid for process in multiprocessing.active_children()]


def test_a_worker_that_is_killed_costs_no_run(tmp_path, runs, undisturbed):
    killed = []

    def kill_one(done, running):
        if len(killed) < 2 and any(one.training.exists() for one in running):
            pid = children()[0]
            with contextlib.suppress(ProcessLookupError):  # gone by itself since then
                os.kill(pid, signal.SIGKILL if os.name != "nt" else signal.SIGTERM)
                killed.append(pid)

    failed = study.study(runs, tmp_path, tmp_path / "scratch", workers=2, every=0,
                         report=kill_one)
    assert failed == {} and killed
    for run in runs:
        assert_same_record(path_of(run, undisturbed), path_of(run, tmp_path))
    assert not children()


def test_a_run_that_fails_is_named_with_its_reason_and_the_others_go_on(tmp_path, runs):
    broken = study.Run(Config("NoSuchTask-v0", "DDPG", 0, steps=300), "tiny")
    failed = study.study([broken, runs[0]], tmp_path, tmp_path / "scratch", workers=1)
    assert list(failed) == ["NoSuchTask-v0/tiny/DDPG-0"]
    assert "'NoSuchTask-v0' is unknown" in failed[broken.name]
    assert path_of(runs[0], tmp_path).exists()


def test_a_run_that_cannot_write_says_where_its_files_lie(tmp_path, runs):
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, before[1]))  # the worker's too
    try:
        failed = study.study(runs[:1], tmp_path, tmp_path / "scratch", workers=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    (why,) = failed.values()
    assert "File too large" in why
    assert str(tmp_path) in why and str(tmp_path / "scratch") in why
    assert not list(tmp_path.rglob("*.npz")) and not list(tmp_path.rglob("*.part"))


def test_a_run_that_kills_its_process_is_given_up_after_three_deaths(
        tmp_path, runs, monkeypatch):
    deaths = []

    class DeadlySlot(study.Slot):
        def submit(self, work, run, *more):
            if run.config.seed == 1:
                deaths.append(run.name)
                return self.executor.submit(os._exit, 1)
            return super().submit(work, run, *more)

    monkeypatch.setattr(study, "Slot", DeadlySlot)
    failed = study.study(runs[1:3], tmp_path, tmp_path / "scratch", workers=1)
    why, = failed.values()
    assert failed.keys() == {runs[2].name} and len(deaths) == 3
    assert "its process died 3 times (a crash, a kill, or too little memory)" in why
    assert path_of(runs[1], tmp_path).exists()


# --- two studies, two clusters --------------------------------------------------------


def do_all(runs, folder, scratch):
    """What a study does, in this process: the number of runs that it did itself."""
    waiting, done = list(runs), 0
    while waiting:
        run = waiting.pop(0)
        what, arrays = study.record(run, folder, scratch, every=0)
        done += arrays is not None
        if what == "busy":
            waiting.append(run)
    return done


@pytest.mark.parametrize("option", ["folder", "scratch"])
def test_a_folder_that_takes_no_files_is_refused_before_any_run(option, tmp_path):
    (tmp_path / "file").touch()  # a folder cannot lie in a file, whoever asks
    folders = {"folder": tmp_path / "records", "scratch": tmp_path / "scratch"}
    folders[option] = tmp_path / "file" / "inside"
    with pytest.raises(OSError, match=f"nothing can be written there .* --{option} "):
        study.main(["--budget", "quick", "--task", "Pendulum-v1", "--workers", "1",
                    *itertools.chain(*((f"--{name}", str(path))
                                       for name, path in folders.items()))])
    assert not list(tmp_path.rglob("*.npz"))


def test_two_studies_on_one_folder_lose_and_double_nothing(tmp_path, runs, undisturbed):
    with ProcessPoolExecutor(2, mp_context=SPAWN) as pool:
        counts = [pool.submit(do_all, runs, tmp_path, tmp_path / "scratch")
                  for _ in range(2)]
        assert sum(count.result() for count in counts) == len(runs)
    for run in runs:
        assert_same_record(path_of(run, undisturbed), path_of(run, tmp_path))


def test_a_second_study_waits_for_the_first_ones_last_run(tmp_path, runs):
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(study.study, runs[:1], tmp_path, tmp_path / "scratch", 1)
                for _ in range(2)]
        assert [one.result() for one in both] == [{}, {}]
    assert path_of(runs[0], tmp_path).exists()


def test_a_dask_cluster_makes_the_pools_records_even_if_a_worker_is_killed(
        tmp_path, runs, undisturbed):
    distributed = pytest.importorskip("distributed")
    killed, ended = [], []
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True,
                                  dashboard_address=None) as cluster:

        def kill_one(done, running):
            ended.extend(done)
            if not killed and any(one.training.exists() for one in running):
                killed.append(list(cluster.workers.values())[0].pid)
                os.kill(killed[0], signal.SIGTERM if os.name == "nt"
                        else signal.SIGKILL)

        failed = study.study(runs, tmp_path, tmp_path / "scratch", every=0,
                             scheduler=cluster.scheduler_address, report=kill_one)
    assert failed == {} and killed
    assert sorted(ended) == sorted(run.name for run in runs)  # none twice
    for run in runs:
        assert_same_record(path_of(run, undisturbed), path_of(run, tmp_path))


def test_without_a_common_folder_the_study_writes_what_the_worker_sends(
        tmp_path, runs, undisturbed):
    what, arrays = study.record(runs[0], tmp_path / "far", tmp_path / "scratch",
                                write=False)
    assert what == "done" and not (tmp_path / "far").exists()
    study.write_record(path_of(runs[0], tmp_path), arrays)
    assert_same_record(path_of(runs[0], undisturbed), path_of(runs[0], tmp_path))
    # Lost on the way? Whoever asks again gets the same, and waits for no training.
    what, again = study.record(runs[0], tmp_path / "far", tmp_path / "scratch",
                               write=False)
    assert what == "done" and again.keys() == arrays.keys()
    for name in arrays:
        np.testing.assert_array_equal(again[name], arrays[name])


def test_a_record_that_lies_on_the_workers_machine_only_is_sent(tmp_path, runs,
                                                                undisturbed):
    _, arrays = study._work(runs[0], str(undisturbed), tmp_path / "scratch", 120)
    study.write_record(path_of(runs[0], tmp_path), arrays)
    assert_same_record(path_of(runs[0], undisturbed), path_of(runs[0], tmp_path))


def test_a_kill_just_before_the_checkpoint_goes_leaves_nothing_behind(
        tmp_path, runs, undisturbed):
    run, scratch = runs[0], tmp_path / "scratch"
    checkpoint = study.Checkpoint(run, undisturbed, scratch)
    scratch.mkdir()
    checkpoint.training.write_bytes(b"of a run that is recorded")
    assert study.record(run, undisturbed, scratch) == ("done", None)
    assert not checkpoint.training.exists()


def test_a_file_system_without_locks_is_named_and_not_waited_for(
        tmp_path, runs, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def no_locks(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.raises(OSError, match="not implemented"):
        study.record(runs[0], tmp_path, tmp_path / "scratch")


# --- damaged, foreign, malicious ------------------------------------------------------


class Malicious:
    def __reduce__(self):
        return os.mkdir, ("executed",)


def test_a_record_of_no_use_is_named_and_skipped(tmp_path, undisturbed, runs,
                                                 monkeypatch):
    monkeypatch.chdir(tmp_path)
    good = path_of(runs[0], undisturbed).read_bytes()
    folder = tmp_path / "Pendulum-v1" / "tiny"
    folder.mkdir(parents=True)
    bad = {"DDPG-1": good[:len(good) // 2], "DDPG-2": b"", "DDPG-3": b"not a record",
           "DDPG-4": pickle.dumps(Malicious()),
           "DDPG-5": good[:200] + bytes(300) + good[500:]}
    for name, data in bad.items():
        (folder / f"{name}.npz").write_bytes(data)
    np.savez(folder / "DDPG-6.npz", meta=np.array(Malicious(), object))
    np.savez(folder / "DDPG-7.npz", weights=np.ones(3))
    (folder / "DDPG-8.npz").mkdir()
    (folder / "DDPG-0 (copy).npz").write_bytes(good)
    (folder / "DDPG-9.npz.77.part").write_bytes(b"half")
    (folder / "DDPG-0.npz").write_bytes(good)
    for what in records.WHAT:
        with pytest.warns(UserWarning) as caught:
            found = study.load_study(variant="tiny", what=what, folder=tmp_path)
        messages = " ".join(str(one.message) for one in caught)
        for number in (1, 2, 3, 4, 6, 7, 8):  # 5 harms one array, perhaps not this one
            assert f"DDPG-{number}.npz is skipped" in messages
        assert "DDPG-0 (copy).npz is skipped" in messages
        assert "DDPG-9" not in messages
        if what in records.TABLES:
            assert set(found.seed) <= {0} and len(found)
    assert not (tmp_path / "executed").exists()


def test_an_empty_folder_gives_an_empty_table(tmp_path):
    table = study.load_study("Pendulum-v1", folder=tmp_path)
    assert len(table) == 0 and "seed" in table.columns
    assert study.load_study(what="planes", folder=tmp_path) == []


def test_350_records_load_in_little_more_than_the_reading_of_their_arrays(
        tmp_path, undisturbed, runs):
    import pandas  # noqa: F401  its import is not ours to time

    with np.load(path_of(runs[1], undisturbed)) as file:
        arrays = dict(file)
    meta = json.loads(str(arrays["meta"]))
    for seed in range(350):
        meta["config"]["seed"] = seed
        study.write_record(path_of(tiny(seed=seed), tmp_path),
                           arrays | dict(meta=json.dumps(meta)))
    for what in records.TABLES:
        begun = time.process_time()
        table = study.load_study(variant="tiny", what=what, folder=tmp_path)
        loaded = time.process_time()
        for path in tmp_path.glob("*/*/*.npz"):
            with np.load(path) as file:
                json.loads(str(file["meta"]))
                assert len(file[what]) and file["episodes"].size
        bare = time.process_time() - loaded
        assert loaded - begun < 8 * bare  # 2 to 3 on an idle machine
        assert len(table) >= 350 * 2


# --- the command ----------------------------------------------------------------------


def test_status_and_dry_run_do_no_run(tmp_path, capsys):
    words = ["--budget", "quick", "--task", "Pendulum-v1", "--folder", str(tmp_path),
             "--scratch", str(tmp_path / "scratch")]
    assert study.main([*words, "--status"]) == 0
    assert "3 runs, 0 recorded, 3 to do" in capsys.readouterr().out
    assert study.main([*words, "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert "quick" in out and "core-hours" in out
    assert not list(tmp_path.rglob("*.npz"))


def test_one_run_is_never_shared_by_two_workers():
    assert study.time_needed([5, 1, 1, 1], workers=2) == 5
    assert study.time_needed([1, 1, 1, 5], workers=2) == 6  # in this order
    assert study.time_needed([80], workers=64) == 80
    assert study.time_needed([], workers=2) == 0


def test_a_dry_run_leaves_out_what_a_checkpoint_holds(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(study, "seconds_of", lambda run: 36_000.0)
    run = tiny()
    study.tell([run], [run], tmp_path, tmp_path, timed=True, workers=8)
    assert "10.0 core-hours, 10.0 hours with 8 workers" in capsys.readouterr().out
    study.Checkpoint(run, tmp_path, tmp_path).status.write_text("0.7500")
    study.tell([run], [run], tmp_path, tmp_path, timed=True, workers=8)
    assert "2.5 core-hours, 2.5 hours with 8 workers" in capsys.readouterr().out


def test_the_time_left_counts_only_what_was_done_since_the_start(tmp_path, capsys):
    run, other = tiny(), tiny(seed=1)
    checkpoint = study.Checkpoint(run, tmp_path, tmp_path)
    checkpoint.status.write_text("0.8000")  # another study came so far
    with study.Progress([run, other]) as progress:
        progress({}, [checkpoint])
        assert progress.bar.n == progress.bar.initial > 0
        checkpoint.status.write_text("0.9000")
        progress({}, [checkpoint])
        size = progress.size[run.name]
        assert progress.bar.n - progress.bar.initial == pytest.approx(0.1 * size)
        progress({run.name: "done", other.name: "ValueError: no such task"}, [])
    err = capsys.readouterr().err  # at once: a study may last for days
    assert f"failed: {other.name}: ValueError: no such task" in err
    assert f"failed: {run.name}" not in err


def test_the_quick_budget_does_every_task_and_algorithm(tmp_path):
    words = ["--budget", "quick", "--folder", str(tmp_path), "--nice", "0",
             "--scratch", str(tmp_path / "scratch")]
    assert study.main(words) == 0
    done = {(task, algorithm) for task in records.TASKS for algorithm in
            records.ALGORITHMS if len(study.load_study(task, algorithm, "quick",
                                                       folder=tmp_path))}
    assert len(done) == 24
    # A folder without `class` runs has the first table, and no claims
    shutil.copy(study.RECORDINGS / "README.md", tmp_path)
    records.write_readme(tmp_path)
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    planned = len(study.list_of("class"))
    assert f"0 of {planned} planned runs" in text and "| quick | 400 |" in text
    assert "not planned" in text and "| bias: DDPG > 0 |" not in text


def test_a_choice_that_matches_no_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no such run in 'class'.*target_rule=single"):
        study.main(["--task", "Pendulum", "--folder", str(tmp_path)])


def command_in(folder):
    return [sys.executable, "-m", "dnddpg_minimal", "study", "--budget", "quick",
            "--task", "Pendulum-v1", "MountainCarContinuous-v0",
            "--folder", str(folder), "--scratch", str(folder / "scratch")]


@pytest.mark.skipif(os.name == "nt", reason="has no such signals")
@pytest.mark.parametrize("polite", ["SIGINT", "SIGTERM"])
def test_ctrl_c_keeps_what_is_there_and_the_same_command_goes_on(polite, tmp_path):
    words = command_in(tmp_path)
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               text=True)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob("*/*/*.npz")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(getattr(signal, polite))
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "the same command goes on" in out and "Traceback" not in err
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/*/*.npz")}
    assert before
    again = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert again.returncode == 0, again.stderr
    assert "0 failed" in again.stdout
    records = list(tmp_path.glob("*/*/*.npz"))
    assert len(records) == 6
    assert all(path.stat().st_mtime_ns == then for path, then in before.items())


def alive(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0]
    except OSError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_workers_end_when_their_study_is_killed(tmp_path):
    process = subprocess.Popen(command_in(tmp_path), stdout=subprocess.DEVNULL)
    tasks = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    deadline = time.monotonic() + 60
    while not list((tmp_path / "scratch").glob("*.lock")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    workers = tasks.read_text().split()
    process.kill()
    process.wait()
    while any(alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert workers and not any(alive(pid) for pid in workers)


def test_the_readme_gets_its_tables_and_keeps_its_words(tmp_path, monkeypatch):
    monkeypatch.setattr(bias, "plane", partial(bias.plane, size=3))
    for algorithm, seed in itertools.product(records.ALGORITHMS, (0, 1)):
        run = study.Run(tiny(algorithm, seed, steps=300).config, "class")
        study.record(run, tmp_path, tmp_path / "scratch")
    shutil.copy(study.RECORDINGS / "README.md", tmp_path)
    before = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert study.main(["--readme", "--folder", str(tmp_path)]) == 0
    once = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert once.startswith(before[:before.index("<!-- measured -->")])
    assert re.search(r"\| Pendulum-v1 \| class \| \d+ \| DN-DDPG \| 2 of 10 \| ", once)
    assert "± " in once
    assert "| bias: DDPG > 0 | Pendulum-v1 | " in once
    records.write_readme(tmp_path)
    assert (tmp_path / "README.md").read_text(encoding="utf-8") == once


def test_a_name_that_nobody_planned_is_refused_and_a_planned_one_is_empty(tmp_path):
    for asked, words in ((dict(task="Pendulum"), "Did you mean 'Pendulum-v1'"),
                         (dict(algorithm="TD3"), "algorithm='TD3'"),
                         (dict(algorithm="DN"), "algorithm='DN'"),  # no part of a name
                         (dict(variant="bug=*"), "variant='bug=.'"),  # no pattern
                         (dict(rule="max-min"), "rule='max-min'"),
                         (dict(variant="target_rule=sinlge"), "target_rule=single")):
        with pytest.raises(ValueError, match=words):
            study.load_study(**asked)
    assert study.load_study(variant="paper", folder=tmp_path).empty
    study.record(study.Run(tiny(steps=300).config, "mine"), tmp_path, tmp_path / "s")
    assert len(study.load_study(variant="mine", folder=tmp_path))
    assert study.load_study("Hopper-v5", variant="mine", folder=tmp_path).empty
    with pytest.raises(ValueError, match="No run of variant 'paper' is recorded"):
        records.results("paper", tmp_path)


def test_records_of_a_task_in_a_namespace_are_found_and_copies_are_not(tmp_path):
    import gymnasium

    task = "mine/Pendulum-v0"
    gymnasium.register(task, "gymnasium.envs.classic_control:PendulumEnv",
                       max_episode_steps=200)
    try:
        run = tiny(steps=300, task=task)
        study.record(run, tmp_path, tmp_path / "s")
        table = study.load_study(task, variant=run.variant, folder=tmp_path)
        assert set(table.task) == {task} and len(table)
        shutil.copytree(tmp_path / "mine" / "Pendulum-v0", tmp_path / "old")
        with pytest.warns(UserWarning, match=f"it is a copy of {task}"):
            both = study.load_study(variant=None, folder=tmp_path)
        assert len(both) == len(table)
    finally:
        del gymnasium.registry[task]


def test_films_say_what_is_missing_and_fail_if_all_is(tmp_path, capsys):
    assert study.main(["--films", "--folder", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("no film: ") == len(records.FILMED)


def test_a_claim_needs_an_interval_on_one_side_of_zero():
    import pandas as pd

    index = pd.MultiIndex.from_tuples(
        [("T", a, "class", s) for a in records.ALGORITHMS for s in range(5)],
        names=records.RUN)
    noise = np.array([-1, 1, 0, 2, -2.0])
    runs = pd.DataFrame({"return": np.concatenate([noise, noise - 10, noise[::-1]]),
                         "bias": np.concatenate([noise - 9, noise - 5, noise]),
                         "owed": 0.0}, index)
    verdicts = {one["claim"]: one["verdict"] for one in records.claims(runs)}
    assert verdicts == {
        "return: DN > DDPG": "not distinguishable", "return: DN > DCN": "holds",
        "bias: DDPG > 0": "does not hold", "bias: DCN < 0": "holds",
        "bias: DN > DCN": "holds"}
    runs["owed"] = np.repeat([-9.0, -5.0, 0.0], 5)  # all of it is lag
    verdicts = {one["claim"]: one["verdict"] for one in records.claims(runs)}
    assert verdicts["bias: DCN < 0"] == verdicts["return: DN > DCN"] == "holds"
    beyond = {one["claim"]: one["beyond"] for one in records.claims(runs)}
    assert beyond == {
        "return: DN > DDPG": "", "return: DN > DCN": "",
        "bias: DDPG > 0": "not distinguishable", "bias: DCN < 0": "not distinguishable",
        "bias: DN > DCN": "not distinguishable"}


# --- ablations and bugs ---------------------------------------------------------------


def some_batch(rng, size=8):
    return Batch(rng.normal(size=(size, 3)), rng.uniform(-1, 1, (size, 1)),
                 rng.normal(size=size), rng.normal(size=(size, 3)),
                 (rng.random(size) < 0.3).astype(float))


def faulty_agent(kind):
    config = Config("Pendulum-v1", "DDPG", hidden=(6, 5), dtype="float64", batch_size=8)
    return kind(config, 3, 1)


def slope_of(agent, loss, i, step=1e-6):
    """The derivative of loss() by weight i, by a difference."""
    agent.theta[i] += step
    above = loss()
    agent.theta[i] -= 2 * step
    below = loss()
    agent.theta[i] += step
    return (above - below) / (2 * step)


@pytest.fixture
def critic_gradient(monkeypatch):
    """The gradients that updates hand to Adam for the critics, one after the other."""
    seen, adam = [], NumpyAgent._adam

    def spy(self, part, t, lr):
        if part.start == 0:
            seen.append(self.dtheta[part].copy())
        adam(self, part, t, lr)

    monkeypatch.setattr(NumpyAgent, "_adam", spy)
    return seen


def test_the_lost_axis_has_the_gradient_of_every_q_against_every_y(critic_gradient):
    rng = np.random.default_rng(0)
    agent, batch = faulty_agent(bugs.LostAxisAgent), some_batch(rng)
    right = super(bugs.LostAxisAgent, agent).td_target(batch)  # (B,)

    def wrong_loss():
        q = agent.q_values(batch.obs, batch.action).T  # (B, 1)
        return np.mean((q - right) ** 2)  # (B, B)

    chosen = rng.choice(agent.split, 12, replace=False)
    slopes = [slope_of(agent, wrong_loss, i) for i in chosen]
    loss = wrong_loss()
    assert agent.update(batch)["critic"][0] == pytest.approx(loss)
    np.testing.assert_allclose(critic_gradient[0][chosen], slopes, rtol=1e-5, atol=1e-8)


def test_the_gradient_through_y_is_that_of_the_whole_loss(critic_gradient):
    rng = np.random.default_rng(0)
    agent, batch = faulty_agent(bugs.ThroughYAgent), some_batch(rng)
    next_action = agent.act(batch.next_obs)

    def loss():
        y = batch.reward + 0.99 * (1 - batch.terminated) * agent.q_values(
            batch.next_obs, next_action)[0]
        return np.mean((agent.q_values(batch.obs, batch.action)[0] - y) ** 2)

    chosen = rng.choice(agent.split, 12, replace=False)
    slopes = [slope_of(agent, loss, i) for i in chosen]
    agent.update(batch)
    np.testing.assert_allclose(critic_gradient[0][chosen], slopes, rtol=1e-5, atol=1e-8)


def test_with_one_seed_every_episode_starts_alike():
    training = bugs.OneSeed(tiny("DDPG").config)
    starts = [training.env.reset(seed=seed)[0] for seed in (1, 2, 3)]
    np.testing.assert_array_equal(starts[0], starts[1])
    np.testing.assert_array_equal(starts[0], starts[2])


def test_in_env_units_replay_holds_what_the_torque_is():
    wrong, right = (kind(tiny("DDPG", steps=50).config) for kind in
                    (bugs.EnvUnits, Training))
    for training in (wrong, right):
        list(training)
    np.testing.assert_array_equal(
        wrong.replay.arrays.action[:50],
        to_env(right.replay.arrays.action[:50], right.env.action_space))
    np.testing.assert_array_equal(wrong.replay.arrays.obs, right.replay.arrays.obs)


def test_without_a_home_the_checkpoints_folder_is_asked_for(monkeypatch):
    def nowhere():
        raise RuntimeError("no home")

    monkeypatch.setattr(study.Path, "home", nowhere)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(name, "/somewhere")
    if sys.platform != "darwin":
        assert study.default_scratch() == Path("/somewhere/dnddpg_minimal")
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name)
    with pytest.raises(OSError, match="--scratch FOLDER"):
        study.default_scratch()


def test_a_faulty_agent_refuses_what_it_was_not_written_for():
    with pytest.raises(ValueError, match="written for DDPG"):
        bugs.LostAxis(tiny("DN-DDPG").config)


def repeats_when_stopped(run, tmp_path):
    stop = SPAWN.Event()
    stop.set()
    study.record(run, tmp_path, tmp_path / "a")
    for _ in range(9):
        what, _ = study.record(run, tmp_path / "b", tmp_path / "b", stop, every=0)
        stop.clear()
        if what == "done":
            break
    assert_same_record(path_of(run, tmp_path), path_of(run, tmp_path / "b"))


@pytest.mark.parametrize("bug", bugs.BUGS)
def test_a_bug_trains_silently_differs_and_resumes(bug, tmp_path):
    task, fields, _ = bugs.BUGS[bug]
    run = tiny("DDPG", task=task, bug=bug, **fields, steps=400, evaluate_every=400)
    repeats_when_stopped(run, tmp_path)


def test_a_run_of_td3_is_td3s_and_resumes(tmp_path):
    run = tiny("DCN-DDPG", steps=400, evaluate_every=400, target_every=2)
    run = run._replace(variant="td3")
    repeats_when_stopped(run, tmp_path)
    assert run.trainer is TD3Training
    same = run._replace(variant="dcn")
    study.record(same, tmp_path, tmp_path / "a")
    one, other = (study.read_npz(path_of(r, tmp_path))["evaluations"]
                  for r in (run, same))
    assert not np.array_equal(one, other, equal_nan=True)


def test_ablations_differ_from_the_class_run_in_one_field():
    for name, fields in bugs.ABLATIONS.items():
        run = next(run for run in study.list_of("class")
                   if run.variant == f"ablation={name}")
        right = json.loads(Config("Pendulum-v1", "DDPG", steps=20_000).to_json())
        wrong = json.loads(run.config.to_json())
        assert {key for key in right if right[key] != wrong[key]} == set(fields)
    assert bugs.ABLATIONS["no_replay"]["buffer_size"] == run.config.batch_size


# --- the shipped recordings -----------------------------------------------------------

SHIPPED = sorted(study.RECORDINGS.glob("*/*/*.npz"))
needs_recordings = pytest.mark.skipif(not SHIPPED, reason="nothing is recorded yet")


@needs_recordings
def test_all_that_is_shipped_loads_and_is_small():
    files = [path for path in study.RECORDINGS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 25e6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for what in records.WHAT:
            assert len(study.load_study(variant=None, what=what))
    planned = {f"{run.name}.npz" for run in study.list_of("class")}
    names = {path.relative_to(study.RECORDINGS).as_posix() for path in SHIPPED}
    assert names <= planned


@needs_recordings
@pytest.mark.parametrize("algorithm", records.ALGORITHMS)
def test_two_thousand_steps_of_a_recorded_run_repeat_themselves(algorithm):
    """Failing means: the algorithm has changed, and must be recorded again."""
    found = study.load_study("Pendulum-v1", algorithm, what="meta")
    if not found:
        pytest.skip(f"no recorded run of {algorithm}")
    # The kernels decide about the last bits, not the processor's name. The oldest
    # records don't say them.
    here = study.blas(), study.versions()["numpy"]
    same = [one for one in found if one.get("blas")
            and (one["blas"], one["versions"]["numpy"]) == here]
    assert any(one.get("blas") for one in found)
    meta = [*same, *found][0]
    training = Training(Config.from_json(json.dumps(meta["config"])))
    for item in training:
        if item.step == study.PROBE_STEP:
            break
    np.testing.assert_allclose(training.first_losses, meta["first_losses"], rtol=1e-4,
                               atol=1e-4)
    if same:
        assert study.fingerprint(training) == meta["probe"]
