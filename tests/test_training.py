"""A whole run: what it reports, what it stores, and that nothing can be told apart
from a run that was killed and went on.
"""

import math
import random
import re
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest
import threadpoolctl
import toys

from dnddpg_minimal import (
    ALGORITHMS,
    Config,
    NumpyAgent,
    Record,
    Training,
    make_env,
    read_npz,
    stream,
    write_npz,
)

pytestmark = pytest.mark.slow

SMALL = dict(hidden=(8, 8), batch_size=8)
PENDULUM = SMALL | dict(task="Pendulum-v1", steps=130, warmup=30, max_episode_steps=20,
                        evaluate_every=25, yield_every=15, seed=3)


def run(**choices):
    """A short run on Pendulum, to its end, and everything that it yielded."""
    training = Training(Config(**PENDULUM | choices))
    return training, list(training)


@cache
def standard_run():
    """130 steps: six episodes of 20 and one of 10 that the run's end cuts off."""
    return run()


def toy_run(steps=60, **choices):
    choices = SMALL | dict(steps=steps, warmup=20) | choices
    training = Training(Config(toys.TASK, **choices))
    return training, list(training)


def assert_same_records(first, second):
    assert len(first) == len(second)
    for one, other in zip(first, second):
        for name in Record._fields:
            np.testing.assert_array_equal(  # NaN equals NaN here
                getattr(one, name), getattr(other, name), err_msg=f"{name} of {one}")


def assert_same_run(first, second, tmp_path):
    """Two finished runs: all records, and all that a file holds, bit for bit."""
    assert first.finished and second.finished
    assert_same_records(first.records, second.records)
    first.save(tmp_path / "first.npz")
    second.save(tmp_path / "second.npz")
    a, b = read_npz(tmp_path / "first.npz"), read_npz(tmp_path / "second.npz")
    assert a.keys() == b.keys()
    for name, array in a.items():
        np.testing.assert_array_equal(b[name], array, err_msg=name)


# --- an interrupt ---------------------------------------------------------------------


@pytest.mark.parametrize("call", range(2, 6))
def test_an_interrupt_while_an_episodes_end_is_noted_leaves_the_one_before(
        call, monkeypatch, tmp_path):
    choices = dict(buffer_size=30)  # an episode overwrites most of it
    training = Training(Config(**PENDULUM, **choices))
    arrays, calls = training.agent.arrays, []

    def interrupted():
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return arrays()

    monkeypatch.setattr(training.agent, "arrays", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(training)
    monkeypatch.undo()
    training.save(tmp_path / "run.npz")
    resumed = Training.load(tmp_path / "run.npz")
    list(resumed)
    assert_same_run(resumed, run(**choices)[0], tmp_path)


# --- the same seed, the same history --------------------------------------------------


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_the_same_seed_gives_the_same_history(backend, tmp_path):
    (first, told), (second, told_again) = (run(backend=backend, steps=80)
                                           for _ in range(2))
    assert_same_records(told, told_again)
    assert_same_run(first, second, tmp_path)


def test_another_seed_gives_another_history():
    (_, told), (_, others) = standard_run(), run(seed=4)
    assert told[-1].episode_return != others[-1].episode_return


def test_the_global_random_generators_have_no_say():
    np.random.seed(1)
    random.seed(1)
    _, told = run()
    np.random.seed(2)
    random.seed(2)
    assert_same_records(told, standard_run()[1])


def test_looking_at_the_agent_on_the_way_changes_nothing():
    training, told = Training(Config(**PENDULUM)), []
    for record in training:
        told.append(record)
        obs = np.ones((5, 3))
        training.agent.q_values(obs, training.agent.act(obs))
    assert_same_records(told, standard_run()[1])


# --- records --------------------------------------------------------------------------


def test_an_episode_record_comes_at_each_episodes_end():
    _, told = standard_run()
    episodes = [record for record in told if record.kind == "episode"]
    assert [record.step for record in episodes] == [20, 40, 60, 80, 100, 120]
    assert [record.episode for record in episodes] == [0, 1, 2, 3, 4, 5]
    assert {record.length for record in episodes} == {20}


def test_grid_records_lie_on_the_grid_and_progress_in_between():
    _, told = standard_run()
    for kind, steps in dict(grid=[25, 50, 75, 100, 125],
                            progress=[15, 30, 45, 60, 90, 105, 120, 130]).items():
        assert [record.step for record in told if record.kind == kind] == steps
    assert {record.kind for record in told} == {"episode", "grid", "progress"}
    assert [record.step for record in told] == sorted(record.step for record in told)


def test_a_grid_record_comes_before_the_episode_record_of_its_step():
    kinds = [record.kind for record in standard_run()[1] if record.step == 100]
    assert kinds == ["grid", "episode"]


def test_the_run_remembers_its_episodes_and_its_grid_only():
    training, told = standard_run()
    assert_same_records(training.records,
                        [record for record in told if record.kind != "progress"])


def test_a_record_tells_the_return_and_length_so_far():
    _, told = toy_run(max_episode_steps=10, evaluate_every=4, yield_every=3)
    for record in told:
        assert record.episode_return == record.length  # Toy pays 1 a step
        in_episode = record.step - 10 * record.episode
        assert record.length == in_episode and 1 <= in_episode <= 10


def test_a_record_tells_the_mean_losses_of_its_episode(monkeypatch):
    training = Training(Config(**PENDULUM))
    told, losses = [], []
    update = training.agent.update

    def spy(*args, **kwargs):
        losses.append(update(*args, **kwargs))
        return losses[-1]

    monkeypatch.setattr(training.agent, "update", spy)
    for record in training:
        if record.kind == "episode":
            told.append((record, losses))
            losses = []
    first = told[0][0]
    assert np.isnan(first.critic_loss).all() and np.isnan(first.actor_loss).all()
    assert first.critic_loss.shape == first.actor_loss.shape == (2,)
    counts = [len(losses) for _, losses in told]
    assert counts == [0, 10, 20, 20, 20, 20]  # the warm-up lasted into the second
    for record, losses in told[1:]:
        for name in ("critic", "actor"):
            mean = np.mean([np.float64(loss[name]) for loss in losses], axis=0)
            np.testing.assert_allclose(getattr(record, f"{name}_loss"), mean, rtol=1e-5)


def test_steps_are_exact_and_the_iterator_stays_at_its_end():
    training, told = standard_run()
    assert training.finished and training.step == told[-1].step == 130
    assert len(training.replay.arrays.reward) == training.replay.size == 130
    with pytest.raises(StopIteration):
        next(training)


def test_a_record_is_told_before_the_next_step_is_taken():
    training = Training(Config(toys.TASK, **SMALL, steps=35, warmup=5, yield_every=7))
    for record in training:
        assert training.step == record.step == len(training.env.unwrapped.actions)
        assert training.updates == record.updates == training.agent.updates


def test_with_episodes_given_the_run_ends_after_that_episode():
    training, told = toy_run(steps=None, episodes=4, task_options={"ends_after": 7})
    assert training.finished and training.episode == 4 and training.step == 28
    assert told[-1].kind == "episode" and told[-1].episode == 3
    assert training.config.steps is None and training.replay.capacity == 100_000


def test_with_episodes_given_the_grid_is_still_one_of_steps():
    _, told = toy_run(steps=None, episodes=4, evaluate_every=8)
    assert [record.step for record in told if record.kind == "grid"] == [
        8, 16, 24, 32, 40]


# --- what happens in a step -----------------------------------------------------------


def test_warm_up_makes_no_update():
    training, told = standard_run()
    for record in told:
        assert record.updates == max(0, record.step - 30)
    assert training.updates == 100


def test_updates_per_step_are_counted():
    training, _ = toy_run(steps=30, warmup=20, updates_per_step=3)
    assert training.updates == 30


def test_a_run_that_is_all_warm_up_learns_nothing():
    training, _ = run(warmup=130)
    start = NumpyAgent(training.config, 3, 1)
    obs = np.ones((2, 3))
    np.testing.assert_array_equal(training.agent.actions(obs), start.actions(obs))
    assert training.updates == 0


def test_warm_up_actions_are_uniform_over_the_whole_range():
    training, _ = toy_run(steps=1_000, warmup=1_000, task_options=dict(
        low=[-3, 0], high=[3, 10]))
    action = training.replay.arrays.action
    se = math.sqrt(1 / 3 / 1_000)
    assert (abs(action.mean(axis=0)) < 4 * se).all()
    assert abs(action).max() <= 1 and (abs(action).max(axis=0) > 0.98).all()
    executed = np.array(training.env.unwrapped.actions)
    np.testing.assert_allclose(executed, [0, 5] + action * [3, 5], atol=1e-5)


def test_actions_are_clipped_after_the_noise_and_stored_as_executed():
    training, _ = toy_run(steps=200, warmup=0, sigma=3.0,
                          task_options=dict(low=[-3, 0], high=[3, 10]))
    executed = np.array(training.env.unwrapped.actions)
    assert (executed >= [-3, 0]).all() and (executed <= [3, 10]).all()
    at_a_bound = (executed == [-3, 0]) | (executed == [3, 10])
    assert 0.3 < at_a_bound.mean() < 1  # noise this wide often leaves the range
    np.testing.assert_allclose(
        executed, [0, 5] + training.replay.arrays.action * [3, 5], atol=1e-5)


def test_the_greedy_action_gets_noise_of_size_sigma():
    training, _ = toy_run(steps=1_000, warmup=0, updates_per_step=0, sigma=0.2,
                          task_options=dict(low=[-3, 0], high=[3, 10]))
    stored = training.replay.arrays
    noise = stored.action - training.agent.act(stored.obs)
    free = (abs(stored.action) < 1).all(axis=1)
    assert free.mean() > 0.8
    np.testing.assert_allclose(noise[free].std(axis=0), 0.2, atol=0.04)
    assert abs(np.corrcoef(noise[free].T)[0, 1]) < 0.15  # each dimension has its own


def test_noise_decays_from_episode_to_episode():
    training, _ = run(steps=60, warmup=0, freeze_actors_after=0, updates_per_step=0,
                      noise_decay=1e-3, sigma=0.5, act_rule="first")
    stored = training.replay.arrays
    noise = abs(stored.action - training.agent.act(stored.obs)).reshape(3, 20)
    assert noise[0].mean() > 0.1
    assert 1e-5 < noise[1].mean() < 1e-3 and noise[2].mean() < 2e-6


def test_every_episode_starts_from_a_seed_of_its_own():
    training, _ = toy_run(max_episode_steps=10)
    seeds = training.env.unwrapped.seeds
    assert len(set(seeds)) == 6 and None not in seeds
    again, _ = toy_run(max_episode_steps=10)
    assert again.env.unwrapped.seeds == seeds


def test_replay_holds_the_transitions_in_order():
    training, _ = toy_run(max_episode_steps=10)
    stored = training.replay.arrays
    in_episode = np.arange(60) % 10
    np.testing.assert_array_equal(stored.obs[:, 0], in_episode)
    np.testing.assert_array_equal(stored.next_obs[:, 0], in_episode + 1)
    np.testing.assert_array_equal(stored.obs[1:10], stored.next_obs[:9])
    np.testing.assert_array_equal(stored.reward, 1)


def test_freeze_actors_after_keeps_the_actors_and_lets_the_critics_learn():
    training = Training(Config(**PENDULUM, freeze_actors_after=75))
    obs, action = np.ones((4, 3)), np.zeros((4, 1))
    actions, qs = {}, {}
    for record in training:
        actions[record.step] = training.agent.actions(obs)
        qs[record.step] = training.agent.q_values(obs, action)
    assert (actions[60] != actions[75]).all()
    for step in (80, 100, 130):
        np.testing.assert_array_equal(actions[step], actions[75])
        assert (qs[step] != qs[75]).all()
    collected = training.replay.arrays.action[75:]
    assert abs(np.diff(collected[:, 0])).min() > 0  # noise goes on
    until_then, _ = run(steps=75)
    np.testing.assert_array_equal(actions[75], until_then.agent.actions(obs))


def test_frozen_actors_slow_copies_come_to_rest_on_them():
    training, _ = run(freeze_actors_after=60, tau=0.3)
    obs = np.ones((4, 3))
    np.testing.assert_allclose(training.agent.actions(obs, slow=True),
                               training.agent.actions(obs), atol=1e-5)


# --- ends: of the world, and of the clock ---------------------------------------------


def ends_stored(ends, **task_options):
    """`terminated` in replay after 60 steps on Toy with a time limit of 10."""
    training, _ = toy_run(ends=ends, max_episode_steps=10, task_options=task_options)
    return training.replay.arrays.terminated.tolist()


def every(n, steps=60):
    return [float(step % n == 0) for step in range(1, steps + 1)]


def test_truncation_still_bootstraps():
    assert ends_stored("terminated") == [0.0] * 60


def test_an_end_of_the_world_cuts_the_bootstrap():
    assert ends_stored("terminated", ends_after=4) == every(4)


def test_an_end_in_the_very_step_of_the_time_limit_is_an_end():
    assert ends_stored("terminated", ends_after=10) == every(10)


def test_ends_none_bootstraps_through_everything_as_the_paper_prints_it():
    assert ends_stored("none", ends_after=4) == [0.0] * 60


def test_ends_any_end_is_the_common_bug():
    assert ends_stored("any_end") == every(10)
    assert ends_stored("any_end", ends_after=4) == every(4)


# --- kept simulator states ------------------------------------------------------------


def test_one_state_in_156_steps_is_kept_from_before_its_step():
    training, _ = run(steps=1_000, warmup=1_000)
    kept, stored = training.kept, training.replay.arrays
    windows = [state["step"] // 156 for state in kept]
    assert windows[:6] == [0, 1, 2, 3, 4, 5] and len(kept) in (6, 7)
    for state in kept:
        step = state["step"]
        np.testing.assert_array_equal(state["obs"], stored.obs[step])
        np.testing.assert_array_equal(state["action"], stored.action[step])
        angle, velocity = state["state"]
        np.testing.assert_allclose(
            state["obs"], [math.cos(angle), math.sin(angle), velocity], atol=1e-6)
        assert state["xipos"].shape == (0, 3)


def test_the_oldest_kept_states_are_dropped_at_64():
    training, _ = toy_run(steps=12_000, warmup=12_000, max_episode_steps=500)
    steps = [state["step"] for state in training.kept]
    assert len(steps) == 64 and steps == sorted(steps)
    assert 12_000 - 66 * 156 < steps[0] < 12_000 - 62 * 156


def test_which_steps_are_kept_is_drawn_from_the_seed_alone():
    first, second, third = (
        [state["step"] for state in run(steps=700, warmup=700, **choices)[0].kept]
        for choices in (dict(algorithm="DDPG"), dict(algorithm="DN-DDPG", sigma=0.9),
                        dict(seed=9)))
    assert first == second != third
    assert first[0] == stream(3, "keep").integers(156)


# --- what a task must not return ------------------------------------------------------


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
def test_a_reward_that_is_not_finite_stops_the_run_by_step_and_value(bad):
    said = f"step 23 of 'Toy-v0': reward {bad!r}"  # 1e300 does not fit into float32
    with pytest.raises(ValueError, match=re.escape(said)):
        toy_run(task_options=dict(bad_step=23, bad_reward=bad))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_observation_that_is_not_finite_stops_the_run_by_step_and_value(bad):
    with pytest.raises(ValueError, match=f"step 23 .*Toy-v0.*observation.*{bad}"):
        toy_run(task_options=dict(bad_step=23, bad_obs=bad))


@pytest.mark.parametrize("bad", [
    dict(bad_reward=np.array([1.0])), dict(bad_reward=None), dict(bad_reward="1"),
    dict(bad_reward=np.ones(2)), dict(bad_reward=1e30), dict(bad_obs=1e30)])
def test_what_is_no_plain_number_is_refused_with_its_step(bad):
    with pytest.raises(ValueError, match="step 23 of 'Toy-v0'.*expected one finite"):
        run = Training(Config(toys.TASK, steps=40, **SMALL))
        run.env.unwrapped.bad_step = 23
        vars(run.env.unwrapped).update(bad)
        list(run)


@pytest.mark.parametrize("shape", [(1, 2), (1,), (), (3,)])
def test_an_observation_of_another_shape_is_refused_not_broadcast(shape, monkeypatch):
    real = toys.Toy.step
    monkeypatch.setattr(toys.Toy, "step", lambda env, action: (
        np.zeros(shape, np.float32), *real(env, action)[1:]))
    with pytest.raises(ValueError, match="step 1 of 'Toy-v0'.*2 of them on one axis"):
        toy_run(steps=5)


def test_a_run_that_breaks_off_in_its_last_step_is_not_over():
    training = Training(Config(toys.TASK, steps=40, **SMALL))
    training.env.unwrapped.bad_step, training.env.unwrapped.bad_obs = 40, math.nan
    with pytest.raises(ValueError, match="step 40"):
        list(training)
    with pytest.raises(RuntimeError, match="broke off at step 40"):
        list(training)


def test_a_first_observation_that_is_not_finite_stops_the_run():
    with pytest.raises(ValueError, match="step 0 of 'Toy-v0'.*nan"):
        toy_run(task_options=dict(bad_step=0, bad_obs=math.nan))


def test_a_run_that_broke_off_says_so_and_goes_on_from_its_file(tmp_path, monkeypatch):
    def interrupt(env):
        if len(env.actions) == 25:
            raise KeyboardInterrupt

    config = Config(toys.TASK, **SMALL, steps=40, warmup=5,
                    task_options=dict(ends_after=10))
    undisturbed = list(Training(config))
    monkeypatch.setattr(toys.Toy, "on_step", interrupt)
    training = Training(config)
    with pytest.raises(KeyboardInterrupt):
        list(training)
    with pytest.raises(RuntimeError, match="broke off at step 25"):
        list(training)  # a notebook's cell, run again
    training.save(tmp_path / "run.npz")
    monkeypatch.undo()
    rest = list(Training.load(tmp_path / "run.npz"))
    assert rest[-1].step == 40
    np.testing.assert_equal(rest[-1], undisturbed[-1])


@pytest.mark.parametrize("name, value", [
    ("state", lambda self: 3), ("state", {"x": 1}), ("state", (1, (2, 3))),
    ("model", "a net")])
def test_a_foreign_task_may_use_our_names(name, value, monkeypatch):
    monkeypatch.setattr(toys.Toy, name, value, raising=False)
    monkeypatch.setattr(toys.Toy, "data", {}, raising=False)
    training, _ = toy_run(steps=200)
    assert training.kept[0]["state"].shape == (0,)


def test_training_refuses_a_task_that_does_not_fit():
    with pytest.raises(ValueError, match="CartPole-v1.*Discrete"):
        Training(Config("CartPole-v1"))


def test_one_thread_inside_and_the_callers_number_outside(monkeypatch):
    seen = []

    def look(_):
        seen.append({pool["num_threads"] for pool in threadpoolctl.threadpool_info()
                     if pool["user_api"] == "blas"})

    monkeypatch.setattr(toys.Toy, "on_step", look)
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        for _ in Training(Config(toys.TASK, **SMALL, steps=12, warmup=5,
                                 yield_every=4)):
            outside = {pool["num_threads"] for pool in threadpoolctl.threadpool_info()
                       if pool["user_api"] == "blas"}
            assert outside == {2}
    assert seen == [{1}] * 12


def test_two_trainings_in_two_threads_take_turns():
    """Limits of threads are the process's: one would take back the other's."""
    def blas():
        return {pool["num_threads"] for pool in threadpoolctl.threadpool_info()
                if pool["user_api"] == "blas"}

    seen, inside, before = [], [], blas()

    def step():
        inside.append(1)
        time.sleep(0.005)  # long enough for the other one to come in
        seen.append((len(inside), blas()))
        inside.pop()

    config = Config(toys.TASK, **SMALL, steps=40, warmup=5, yield_every=1)
    runs = [Training(config) for _ in range(2)]
    for run in runs:
        run.env.unwrapped.on_step = step
    threads = [threading.Thread(target=list, args=(run,)) for run in runs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [(1, {1})] * 80
    assert blas() == before


# --- resume, bit for bit --------------------------------------------------------------


def resumed(training, save_at, path):
    """Stop `training` at the first record of step `save_at`, save, load, finish."""
    for record in training:
        if record.step >= save_at:
            break
    training.save(path)
    again = Training.load(path)
    list(again)
    return again, record


RESUMES = {
    "at an episode's end": (dict(), 60),
    "in the middle of an episode": (dict(), 75),
    "in the first episode": (dict(), 15),
    "in the warm-up": (dict(warmup=65), 50),
    "with a replay that wraps": (dict(buffer_size=35), 90),
    "with a replay shorter than an episode": (dict(buffer_size=9), 75),
    "with OU noise that fades": (dict(noise="ou", noise_decay=0.8), 75),
    "with episodes for an end": (dict(steps=None, episodes=6), 75),
    "with one critic": (dict(algorithm="DDPG"), 75),
    "with slow copies that move rarely": (dict(target_every=7), 75),
    "with frozen actors": (dict(freeze_actors_after=55), 75),
    "with PyTorch": (dict(backend="torch", steps=80), 50),
}


@pytest.mark.parametrize("what", RESUMES)
def test_a_saved_run_goes_on_as_if_never_stopped(what, tmp_path):
    choices, save_at = RESUMES[what]
    whole, _ = run(**choices)
    training = Training(Config(**PENDULUM | choices))
    again, record = resumed(training, save_at, tmp_path / "run.npz")
    assert record.step == save_at  # a record was there to stop at
    assert_same_run(again, whole, tmp_path)


def test_what_resumes_is_the_last_episodes_end(tmp_path):
    training = Training(Config(**PENDULUM))
    for record in training:
        if record.step == 75:
            break
    training.save(tmp_path / "run.npz")
    again = Training.load(tmp_path / "run.npz")
    assert (again.step, again.episode, again.updates) == (60, 3, 30)
    assert [r.step for r in again.records if r.kind == "episode"] == [20, 40, 60]
    assert_same_records(again.records, training.records[:len(again.records)])


def test_saving_does_not_disturb_the_run_that_goes_on(tmp_path):
    training, told = Training(Config(**PENDULUM | dict(buffer_size=9))), []
    for record in training:
        training.save(tmp_path / "run.npz")
        told.append(record)
    whole, others = run(buffer_size=9)
    assert_same_records(told, others)
    assert_same_run(training, whole, tmp_path)


def test_a_run_may_be_resumed_again_and_again(tmp_path):
    path = tmp_path / "run.npz"
    whole, _ = run(buffer_size=25)
    training = Training(Config(**PENDULUM | dict(buffer_size=25)))
    while not training.finished:  # one episode, then a new life
        for record in training:
            if record.kind == "episode":
                break
        training.save(path)
        training = Training.load(path)
    assert_same_run(training, whole, tmp_path)


def test_a_finished_run_is_finished_when_loaded(tmp_path):
    whole, _ = standard_run()
    whole.save(tmp_path / "run.npz")
    again = Training.load(tmp_path / "run.npz")
    assert again.finished and list(again) == []
    assert_same_run(again, whole, tmp_path)
    obs = np.random.default_rng(0).normal(size=(9, 3))
    np.testing.assert_array_equal(again.agent.act(obs), whole.agent.act(obs))


def test_a_run_saved_before_its_first_step_starts_there(tmp_path):
    Training(Config(**PENDULUM)).save(tmp_path / "run.npz")
    again = Training.load(tmp_path / "run.npz")
    assert again.step == 0
    list(again)
    assert_same_run(again, standard_run()[0], tmp_path)


def test_kept_states_and_first_losses_survive(tmp_path):
    choices = dict(steps=400, warmup=373)  # saved at 380, with 7 losses of 20
    whole, _ = run(**choices)
    again, _ = resumed(Training(Config(**PENDULUM | choices)), 390,
                       tmp_path / "run.npz")
    assert len(whole.kept) in (2, 3) and len(whole.first_losses) == 20
    for one, other in zip(whole.kept, again.kept, strict=True):
        assert one.keys() == other.keys()
        for name in one:
            np.testing.assert_array_equal(one[name], other[name], err_msg=name)
            assert np.asarray(one[name]).dtype == np.asarray(other[name]).dtype
    np.testing.assert_array_equal(whole.first_losses, again.first_losses)


# --- killed at a random moment --------------------------------------------------------

CHILD = """
import sys, time
from dnddpg_minimal import Config, Training

training = Training(Config.from_json(sys.argv[1]))
for record in training:
    time.sleep(0.0005)
    if record.kind == "episode":
        training.save(sys.argv[2])
        print(record.step, flush=True)
    if record.step > 0.9 * training.config.steps:
        time.sleep(600)  # the kill comes before the end, however slow it is
"""
KILLED = {
    "Pendulum-v1": dict(max_episode_steps=30),
    "ArmHard-v0": dict(max_episode_steps=30),
    "MountainCarContinuous-v0": dict(max_episode_steps=30),
    "Hopper-v5": dict(),  # ends itself when it falls
}


@pytest.mark.parametrize("task", KILLED)
def test_a_run_killed_at_a_random_moment_goes_on_as_if_never_killed(task, tmp_path):
    config = Config(task, seed=6, steps=300, warmup=50, buffer_size=70, **SMALL,
                    yield_every=3, evaluate_every=50, **KILLED[task])
    path = tmp_path / "run.npz"
    child = subprocess.Popen([sys.executable, "-c", CHILD, config.to_json(), str(path)],
                             stdout=subprocess.PIPE)
    try:
        assert child.stdout.readline()  # the first checkpoint is there
        moment = random.random() * 0.3  # seconds; any moment must do
        time.sleep(moment)
        assert child.poll() is None
    finally:
        child.kill()  # SIGKILL: nothing can be tidied up
        child.communicate()
    again = Training.load(path)
    assert 0 < again.step < 300
    list(again)
    whole = Training(config)
    list(whole)
    assert_same_run(again, whole, tmp_path)


# --- files that are no runs -----------------------------------------------------------


def test_two_threads_may_write_one_file(tmp_path):
    def write(number):
        for _ in range(50):
            write_npz(tmp_path / "one.npz", number=np.full(1_000, number))

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, range(2)))  # raises what a thread raised
    assert len(set(read_npz(tmp_path / "one.npz")["number"])) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["one.npz"]


def test_a_damaged_or_foreign_run_is_refused(tmp_path):
    training, path = standard_run()[0], tmp_path / "good.npz"
    training.save(path)
    content, whole = read_npz(path), path.read_bytes()
    bad = tmp_path / "bad.npz"
    for text in (b"", b"no numbers", whole[:len(whole) // 2], whole[100:]):
        bad.write_bytes(text)
        with pytest.raises(ValueError, match="bad.npz"):
            Training.load(bad)
    training.agent.save(bad)  # an agent is less than a run
    with pytest.raises(ValueError, match="bad.npz"):
        Training.load(bad)
    for missing in content:
        write_npz(bad, **{name: content[name] for name in content if name != missing})
        try:
            Training.load(bad)
        except ValueError as error:
            assert "bad.npz" in str(error)
        else:  # the task's own sizes can be told; files from before lack `climbs`
            assert missing in ("obs_dim", "action_dim", "climbs")


def test_a_pickled_run_is_refused_unopened(tmp_path):
    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    training, path = standard_run()[0], tmp_path / "run.npz"
    training.save(path)
    np.savez(path, **read_npz(path) | {"reward": np.array([Trap()], dtype=object)})
    with pytest.raises(ValueError, match="run.npz"):
        Training.load(path)
    assert not (tmp_path / "sprung").exists()


def test_a_run_of_another_task_than_its_arrays_is_refused(tmp_path):
    training, path = standard_run()[0], tmp_path / "run.npz"
    training.save(path)
    content = read_npz(path)
    swapped = str(content["config"]).replace("Pendulum-v1", "MountainCarContinuous-v0")
    write_npz(path, **content | {"config": swapped})
    with pytest.raises(ValueError, match="run.npz"):
        Training.load(path)


def test_there_is_nothing_to_load_where_nothing_is(tmp_path):
    with pytest.raises(FileNotFoundError):
        Training.load(tmp_path / "nothing.npz")


# --- the eight tasks ------------------------------------------------------------------


@pytest.mark.parametrize("task", [
    "Pendulum-v1", "MountainCarContinuous-v0", "ArmEasy-v0", "ArmHard-v0",
    "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Humanoid-v5"])
def test_all_three_algorithms_run_on_every_task(task):
    for algorithm in ALGORITHMS:
        training = Training(Config(task, algorithm, steps=12, warmup=8, **SMALL,
                                   yield_every=5))
        assert [*training][-1].step == 12 and training.updates == 4


def test_mujocos_warnings_are_pythons_and_leave_no_file(tmp_path, monkeypatch):
    """By itself MuJoCo writes MUJOCO_LOG.TXT into the folder of whoever trains."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    env = make_env(Config("Hopper-v5"))
    env.reset(seed=0)
    env.unwrapped.data.qvel[:] = 1e12
    with pytest.warns(UserWarning, match="unstable"):
        env.step(np.zeros(3))
    assert not list(tmp_path.iterdir())


def test_mujocos_harmless_note_is_not_shown():
    pytest.importorskip("mujoco")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for task in ("HalfCheetah-v5", "Humanoid-v5"):
            make_env(Config(task)).reset(seed=0)
