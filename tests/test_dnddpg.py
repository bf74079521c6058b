"""What each part of `dnddpg.py` promises, with numbers that were worked out by hand."""

import dataclasses
import math
import pickle
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import toys

from dnddpg_minimal import (
    ALGORITHMS,
    Batch,
    Config,
    Noise,
    NumpyAgent,
    ReplayBuffer,
    TorchAgent,
    Training,
    choose_actor,
    make_agent,
    make_env,
    read_npz,
    stream,
    td_target,
    to_env,
    write_npz,
)
from dnddpg_minimal.dnddpg import adam

# --- targets: Eq. (11) and Eq. (12) ---------------------------------------------------

# Two critics (rows), two actors (columns), two transitions: [c][k] = (first, second).
#   first:   min at actor 1 is 2, at actor 2 is 5; Eq. (12) compares 8 with 6: actor 1
#   second:  min at actor 1 is 3, at actor 2 is 7; Eq. (12) compares 3 with 10: actor 2
Q_NEXT = np.array([[[8.0, 3.0], [5.0, 7.0]],
                   [[2.0, 4.0], [6.0, 10.0]]])
REWARD, GO_ON = np.array([1.0, -1.0]), np.zeros(2)
BY_HAND = {  # with gamma = 0.5: reward + value / 2
    "max_min": [3.5, 2.5],  # values 5, 7
    "single": [2.0, 0.5],  # values 2, 3
    "paired_min": [4.0, 0.5],  # values min(8, 6), min(3, 10)
    "selected": [2.0, 2.5],  # values 2, 7
    "soft": [3.35, 2.3],  # values 0.9 * 5 + 0.1 * 2, 0.9 * 7 + 0.1 * 3
}


@pytest.mark.parametrize("rule", BY_HAND)
def test_every_target_rule_equals_its_worked_example(rule):
    y = td_target(REWARD, GO_ON, Q_NEXT, 0.5, rule)
    assert y.shape == (2,)
    np.testing.assert_allclose(y, BY_HAND[rule], rtol=1e-15)


def test_the_default_target_is_the_max_over_actors_of_the_min_over_critics():
    y = td_target(REWARD, GO_ON, Q_NEXT, 0.5)
    np.testing.assert_array_equal(y, BY_HAND["max_min"])


@pytest.mark.parametrize("rule", BY_HAND)
def test_one_critic_and_one_actor_have_ddpgs_target_under_every_rule(rule):
    y = td_target(REWARD, GO_ON, Q_NEXT[:1, :1], 0.5, rule)
    np.testing.assert_allclose(y, [1 + 8 / 2, -1 + 3 / 2], rtol=1e-15)


def test_the_literal_equation_ignores_the_second_actor():
    changed = Q_NEXT.copy()
    changed[:, 1] += 100
    for rule, moves in dict(single=False, max_min=True, paired_min=True, selected=True,
                            soft=True).items():
        same = np.array_equal(td_target(REWARD, GO_ON, Q_NEXT, 0.5, rule),
                              td_target(REWARD, GO_ON, changed, 0.5, rule))
        assert same != moves, rule


def test_every_minimum_is_over_all_critics():
    third = np.array([[[1.0, 9.0], [4.0, 0.0]]])
    three = np.concatenate([Q_NEXT, third])  # minima (1, 4) and (3, 0)
    for rule, value in dict(max_min=[4, 3], single=[1, 3], selected=[1, 0],
                            soft=[0.9 * 4 + 0.1 * 1, 0.9 * 3 + 0.1 * 0]).items():
        y = td_target(np.zeros(2), GO_ON, three, 1.0, rule)
        np.testing.assert_allclose(y, value, rtol=1e-15, err_msg=rule)


def test_nu_weighs_the_minimum_over_actors():
    def y(nu):
        return td_target(REWARD, GO_ON, Q_NEXT, 0.5, "soft", nu=nu)

    np.testing.assert_array_equal(y(0), BY_HAND["max_min"])
    np.testing.assert_array_equal(y(1), [1 + 2 / 2, -1 + 3 / 2])  # min of both
    np.testing.assert_allclose(y(0.5), [1 + 3.5 / 2, -1 + 5 / 2])


def test_an_end_of_the_world_leaves_the_reward_alone():
    y = td_target(REWARD, np.array([1.0, 0.0]), Q_NEXT, 0.5)
    np.testing.assert_array_equal(y, [1.0, 2.5])


def test_after_an_end_the_critics_do_not_even_enter_the_sum():
    broken = np.full((2, 2, 2), np.nan)
    np.testing.assert_array_equal(td_target(REWARD, np.ones(2), broken, 0.5), REWARD)


def test_gamma_zero_is_greedy_for_the_reward():
    np.testing.assert_array_equal(td_target(REWARD, GO_ON, Q_NEXT, 0.0), REWARD)


def test_y_min_limits_the_target_from_below():
    y = td_target(REWARD, GO_ON, Q_NEXT, 0.5, y_min=3.0)
    np.testing.assert_array_equal(y, [3.5, 3.0])


def test_paired_min_needs_as_many_actors_as_critics():
    with pytest.raises(ValueError, match=r"\(2, 1, 2\)"):
        td_target(REWARD, GO_ON, Q_NEXT[:, :1], 0.5, "paired_min")


@pytest.mark.parametrize("reward, terminated, q_next", [
    (REWARD, GO_ON, Q_NEXT[..., 0]),  # (C, K): an axis is missing
    (REWARD[:, None], GO_ON, Q_NEXT),  # (B, 1) would broadcast to a table
    (REWARD, GO_ON[:, None], Q_NEXT),
    (REWARD, GO_ON, Q_NEXT[..., :1]),  # one value for two rewards
    (1.0, 0.0, Q_NEXT),
])
def test_shapes_that_would_broadcast_in_silence_are_refused(reward, terminated, q_next):
    with pytest.raises(ValueError, match="shape|expects"):
        td_target(reward, terminated, q_next, 0.5)


def test_a_target_that_is_not_finite_is_refused():
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match=str(bad)):
            td_target(np.array([1.0, bad]), GO_ON, Q_NEXT, 0.5)


@pytest.mark.parametrize("bad", [0.5, -1, math.nan])
def test_an_end_is_0_or_1(bad):
    with pytest.raises(ValueError, match="expected 0 or 1"):
        td_target(REWARD, np.array([0, bad]), Q_NEXT, 0.5)


def test_more_actors_than_critics_are_refused_where_each_needs_its_own():
    q = np.zeros((1, 2, 2))  # (C, K, B)
    with pytest.raises(ValueError, match=r"a critic for each actor; got q \(1, 2, 2\)"):
        choose_actor(q, "paired")
    for rule in ("selected", "paired_min"):
        with pytest.raises(ValueError, match="actor"):
            td_target(REWARD, GO_ON, q, 0.5, rule)


def test_a_wrong_rule_is_answered_with_the_nearest_right_one():
    with pytest.raises(ValueError, match="'minmax'.*'max_min'.*'single'"):
        td_target(REWARD, GO_ON, Q_NEXT, 0.5, "minmax")
    with pytest.raises(ValueError, match="Did you mean 'selected'"):
        td_target(REWARD, GO_ON, Q_NEXT, 0.5, "Selected")


@pytest.mark.parametrize("critics, actors, closed_form", [
    (1, 1, 0.0),
    (2, 1, -1 / math.sqrt(math.pi)),  # -0.564: two pessimists
    (1, 2, 1 / math.sqrt(math.pi)),  # +0.564: the max that overestimates
    (2, 2, (4 * (0.25 + math.asin(1 / 3) / (2 * math.pi))
            + 2 * (0.25 + math.asin(1 / 3) / (2 * math.pi)) - 2)
     / math.sqrt(math.pi)),  # B(0) = -0.099 of the readings
])
def test_pure_noise_moves_the_target_as_the_closed_form_says(critics, actors,
                                                             closed_form):
    n = 200_000
    errors = np.random.default_rng(0).standard_normal((critics, actors, n))
    y = td_target(np.zeros(n), np.zeros(n), errors, 1.0)
    assert abs(y.mean() - closed_form) < 4 * y.std() / math.sqrt(n)


# --- the better of two actions: Eq. (12) ----------------------------------------------


def test_eq_12_takes_the_actor_whose_own_critic_is_happier():
    np.testing.assert_array_equal(choose_actor(Q_NEXT), [0, 1])  # 8 > 6, 3 < 10
    np.testing.assert_array_equal(choose_actor(Q_NEXT, "paired"), [0, 1])


def test_max_min_takes_the_actor_whose_worst_critic_is_happier():
    np.testing.assert_array_equal(choose_actor(Q_NEXT, "max_min"), [1, 1])


def test_first_takes_the_first():
    np.testing.assert_array_equal(choose_actor(Q_NEXT, "first"), [0, 0])


def test_a_critic_that_praises_everything_wins_eq_12_and_not_max_min():
    """Q2 = Q1 + 10 says nothing about the actions, but its actor wins (reading 2)."""
    first = np.array([[[3.0], [1.0]]])  # critic 1: action 1 is better
    q = np.concatenate([first, first + 10])
    assert choose_actor(q, "paired") == [1]
    assert choose_actor(q, "max_min") == [0]


def test_a_third_critic_without_actor_has_a_say_in_max_min_only():
    q = np.concatenate([Q_NEXT, [[[9.0, 9.0], [0.0, 0.0]]]])
    np.testing.assert_array_equal(choose_actor(q, "paired"), [0, 1])
    np.testing.assert_array_equal(choose_actor(q, "max_min"), [0, 0])


def test_a_wrong_act_rule_is_answered_with_the_nearest_right_one():
    with pytest.raises(ValueError, match="Did you mean 'paired'"):
        choose_actor(Q_NEXT, "pared")


# --- replay ---------------------------------------------------------------------------


def numbered(replay, numbers):
    """Add transitions in which every entry is the transition's number."""
    for n in numbers:
        replay.add([n, n], [n], n, [n, n], n % 2 == 0)


def test_replay_gives_back_what_was_stored():
    replay = ReplayBuffer(5, 2, 1, stream(0, "replay"))
    replay.add([1, 2], [-0.5], 3, [4, 5], True)
    batch = replay.sample(3)
    assert isinstance(batch, Batch)
    for row in range(3):
        np.testing.assert_array_equal(batch.obs[row], [1, 2])
        np.testing.assert_array_equal(batch.action[row], [-0.5])
        np.testing.assert_array_equal(batch.next_obs[row], [4, 5])
        assert batch.reward[row] == 3 and batch.terminated[row] == 1
    assert [part.shape for part in batch] == [(3, 2), (3, 1), (3,), (3, 2), (3,)]
    assert {part.dtype for part in batch} == {np.dtype(np.float32)}


def test_a_full_replay_forgets_the_oldest():
    replay = ReplayBuffer(4, 2, 1, stream(0, "replay"))
    numbered(replay, range(3))
    assert replay.size == 3
    assert set(replay.sample(200).reward) == {0, 1, 2}  # never an empty row
    numbered(replay, range(3, 10))
    assert replay.size == 4
    assert set(replay.sample(200).reward) == {6, 7, 8, 9}


def test_replay_draws_all_rows_alike_and_may_draw_one_twice():
    replay = ReplayBuffer(10, 2, 1, stream(0, "replay"))
    numbered(replay, range(10))
    drawn = replay.sample(20_000).reward
    counts = np.bincount(drawn.astype(int))
    assert abs(counts - 2_000).max() < 4 * math.sqrt(20_000 * 0.1 * 0.9)


def test_a_batch_is_a_copy():
    replay = ReplayBuffer(3, 2, 1, stream(0, "replay"))
    numbered(replay, [7, 7, 7])
    replay.sample(2).obs[:] = -1
    np.testing.assert_array_equal(replay.sample(50).obs, 7)


def test_an_empty_replay_has_no_batch():
    with pytest.raises(ValueError, match="empty"):
        ReplayBuffer(3, 2, 1, stream(0, "replay")).sample(1)


def test_replay_draws_from_its_own_stream_only():
    first, second = (ReplayBuffer(9, 2, 1, stream(4, "replay")) for _ in range(2))
    numbered(first, range(9))
    numbered(second, range(9))
    np.random.seed(1)  # the global generator has no say
    a = first.sample(30)
    np.random.seed(2)
    np.testing.assert_array_equal(a.reward, second.sample(30).reward)


# --- random streams -------------------------------------------------------------------


def test_every_use_has_a_stream_of_its_own():
    roles = ("critic", "actor", "replay", "noise", "warmup", "environment",
             "evaluation", "keep")
    numbers = {tuple(stream(seed, role, index).integers(2**62, size=2))
               for seed in (0, 1, 2) for role in roles for index in (0, 1)}
    assert len(numbers) == 3 * 8 * 2


def test_a_stream_starts_again_at_the_same_number():
    assert stream(3, "noise").random() == stream(3, "noise").random()


# --- exploration noise ----------------------------------------------------------------


def test_gaussian_noise_is_drawn_anew_for_each_dimension_and_step():
    noise = Noise(Config(noise="gaussian", sigma=0.2), 2, stream(0, "noise"))
    draws = np.array([noise.sample() for _ in range(20_000)])
    se = 0.2 / math.sqrt(20_000)
    np.testing.assert_allclose(draws.mean(axis=0), 0, atol=4 * se)
    np.testing.assert_allclose(draws.std(axis=0), 0.2, atol=4 * se)
    between, in_time = (np.corrcoef(draws[:, 0], other)[0, 1]
                        for other in (draws[:, 1], np.roll(draws[:, 0], 1)))
    assert abs(between) < 4 / math.sqrt(20_000)
    assert abs(in_time) < 4 / math.sqrt(20_000)


def test_ou_noise_follows_its_recursion_and_restarts_each_episode():
    """x <- x - theta x + sigma N(0, 1), from 0, by hand from the same stream."""
    noise = Noise(Config(noise="ou", sigma=0.5, theta=0.15), 1, stream(0, "noise"))
    n = stream(0, "noise").standard_normal(4)
    noise.reset()
    x = [noise.sample()[0] for _ in range(3)]
    np.testing.assert_allclose(x[0], 0.5 * n[0])
    np.testing.assert_allclose(x[1], 0.85 * 0.5 * n[0] + 0.5 * n[1])
    np.testing.assert_allclose(
        x[2], 0.85**2 * 0.5 * n[0] + 0.85 * 0.5 * n[1] + 0.5 * n[2])
    noise.reset()
    np.testing.assert_allclose(noise.sample()[0], 0.5 * n[3])


def test_ou_noise_has_its_known_spread():
    """The variance of the recursion is sigma^2 / (1 - (1 - theta)^2)."""
    noise = Noise(Config(noise="ou", sigma=0.5, theta=0.15), 2_000, stream(0, "noise"))
    for _ in range(60):
        x = noise.sample()
    known = 0.5 / math.sqrt(1 - 0.85**2)  # 0.949
    assert abs(x.std() - known) < 4 * known / math.sqrt(2 * 2_000)


def test_sigma_zero_is_no_noise():
    for kind in ("gaussian", "ou"):
        noise = Noise(Config(noise=kind, sigma=0), 3, stream(0, "noise"))
        np.testing.assert_array_equal(noise.sample(), np.zeros(3))


# --- configuration --------------------------------------------------------------------


def test_nothing_given_is_dn_ddpg_on_pendulum():
    config = Config()
    assert (config.task, config.algorithm) == ("Pendulum-v1", "DN-DDPG")
    assert (config.critics, config.actors) == (2, 2)


def test_an_algorithm_is_two_numbers():
    assert ALGORITHMS == {"DDPG": (1, 1), "DCN-DDPG": (2, 1), "DN-DDPG": (2, 2)}
    for name, numbers in ALGORITHMS.items():
        config = Config(algorithm=name)
        assert (config.critics, config.actors) == numbers
        config = Config(critics=numbers[0], actors=numbers[1])
        assert config.algorithm == name
    assert Config(critics=3, actors=2).algorithm == "C3-K2"
    assert Config(algorithm="C3-K2").critics == 3


def test_numbers_that_contradict_the_name_are_refused():
    with pytest.raises(ValueError, match="critics=3.*'DDPG'.*1"):
        Config(algorithm="DDPG", critics=3)
    with pytest.raises(ValueError, match="actors=2.*'DCN-DDPG'.*1"):
        Config(algorithm="DCN-DDPG", actors=2)
    Config(algorithm="DDPG", critics=1, actors=1)  # the same thing said twice is fine


def test_an_actor_needs_a_critic_to_climb():
    with pytest.raises(ValueError, match="actors=3.*critics=2"):
        Config(critics=2, actors=3)


def test_paired_min_is_refused_before_the_run_starts():
    with pytest.raises(ValueError, match="paired_min"):
        Config(algorithm="DCN-DDPG", target_rule="paired_min")


MUJOCO = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Humanoid-v5")
CLASS_TABLE = {  # the contract's: steps, hidden, batch, gamma, noise, sigma, evaluate
    "Pendulum-v1": (40_000, (64, 64), 64, 0.99, "gaussian", 0.1, 1_000),
    "ArmEasy-v0": (40_000, (128, 128), 128, 0.95, "gaussian", 0.3, 1_000),
    "ArmHard-v0": (40_000, (128, 128), 128, 0.95, "gaussian", 0.3, 1_000),
    "MountainCarContinuous-v0": (100_000, (64, 64), 64, 0.99, "ou", 0.5, 5_000),
    **{task: (100_000, (128, 128), 128, 0.99, "gaussian", 0.1, 5_000)
       for task in MUJOCO},
    "Reacher-v5": (40_000, (64, 64), 64, 0.99, "gaussian", 0.1, 1_000),  # any other
}


@pytest.mark.parametrize("task", CLASS_TABLE)
def test_the_class_preset_is_the_contracts_table(task):
    c = Config(task)
    assert CLASS_TABLE[task] == (c.steps, c.hidden, c.batch_size, c.gamma, c.noise,
                                 c.sigma, c.evaluate_every)
    assert (c.critic_lr, c.actor_lr, c.tau, c.target_every) == (1e-3, 1e-3, 0.005, 1)
    assert (c.warmup, c.theta, c.updates_per_step) == (1_000, 0.15, 1)
    assert (c.noise_decay, c.y_min, c.nu, c.episodes) == (1.0, None, 0.1, None)
    assert (c.target_rule, c.act_rule, c.climbs, c.init, c.ends) == (
        "max_min", "paired", "own", "independent", "terminated")
    assert (c.backend, c.device, c.dtype) == ("numpy", "cpu", "float32")


def test_what_is_given_beats_the_preset():
    config = Config("ArmHard-v0", gamma=0.5, hidden=[10])
    assert (config.gamma, config.hidden, config.sigma) == (0.5, (10,), 0.3)


def test_replay_holds_the_run_up_to_100_000():
    assert Config(steps=500).buffer_size == 500
    assert Config(steps=1_000_000).buffer_size == 100_000
    assert Config(episodes=10).buffer_size == 100_000
    assert Config(buffer_size=77).buffer_size == 77


@pytest.mark.parametrize("task", MUJOCO)
def test_paper_is_table_1_on_mujoco(task):
    c = Config.paper(task, "DCN-DDPG", 3)
    assert (c.algorithm, c.seed, c.task) == ("DCN-DDPG", 3, task)
    assert (c.actor_lr, c.critic_lr, c.hidden, c.batch_size) == (
        1e-4, 1e-4, (400, 300), 256)
    assert (c.tau, c.target_every, c.gamma, c.buffer_size) == (0.01, 10, 0.99, 100_000)
    assert (c.episodes, c.steps, c.max_episode_steps) == (5_000, None, None)


def test_paper_on_a_small_task_is_class_with_the_papers_episodes():
    for task in ("Pendulum-v1", "MountainCarContinuous-v0", "ArmHard-v0"):
        paper, preset = Config.paper(task, "DDPG", 0), Config(task, "DDPG")
        assert (paper.episodes, paper.max_episode_steps) == (2_000, 300)
        assert paper.steps is None and paper.buffer_size == 100_000
        for name in ("hidden", "batch_size", "gamma", "tau", "target_every", "noise",
                     "critic_lr", "evaluate_every"):
            assert getattr(paper, name) == getattr(preset, name), name


WRONG = [  # field, wrong value, what the sentence must also say
    ("algorithm", "DDPQ", "Did you mean 'DDPG'"),
    ("algorithm", "dn-ddpg", "Did you mean 'DN-DDPG'"),
    ("target_rule", "maxmin", "Did you mean 'max_min'"),
    ("act_rule", "last", "'first'"),
    ("climbs", "both", "'own'"),
    ("init", "tied", "'tied_actors'"),
    ("ends", "truncated", "Did you mean 'terminated'"),
    ("noise", "normal", "'gaussian'"),
    ("backend", "pytorch", "Did you mean 'torch'"),
    ("dtype", "float16", "'float32'"),
    ("device", "gpu", "'cuda'"),
    ("seed", -1, "0 or more"),
    ("seed", 1.5, "whole number"),
    ("seed", True, "whole number"),
    ("steps", 0, "1 or more"),
    ("episodes", 0, "1 or more"),
    ("critics", 0, "1 or more"),
    ("batch_size", 0, "1 or more"),
    ("batch_size", "64", "whole number"),
    ("buffer_size", 0, "1 or more"),
    ("target_every", 0, "1 or more"),
    ("updates_per_step", -1, "0 or more"),
    ("warmup", -1, "0 or more"),
    ("max_episode_steps", 0, "1 or more"),
    ("freeze_actors_after", -1, "0 or more"),
    ("evaluate_every", 0, "1 or more"),
    ("yield_every", 0, "1 or more"),
    ("gamma", 1.1, "at most 1"),
    ("gamma", math.nan, "number"),
    ("gamma", "0.9", "number"),
    ("tau", 0, "above 0"),
    ("tau", 1.5, "at most 1"),
    ("critic_lr", 0.0, "above 0"),
    ("actor_lr", -1e-3, "above 0"),
    ("sigma", -0.1, "0 or more"),
    ("sigma", math.inf, "number"),
    ("theta", 1.5, "at most 1"),
    ("noise_decay", 0, "above 0"),
    ("nu", -0.5, "0 or more"),
    ("y_min", math.nan, "number"),
    ("hidden", (), "widths"),
    ("hidden", 64, "widths"),
    ("task", 7, "name"),
]


@pytest.mark.parametrize("field, value, also", WRONG)
def test_a_wrong_value_is_refused_by_field_value_and_what_is_allowed(field, value,
                                                                     also):
    with pytest.raises(ValueError) as refusal:
        Config(**{field: value})
    text = str(refusal.value)
    assert field in text and repr(value) in text and also in text, text


@pytest.mark.parametrize("width", [0, 2.5, True, "64", None])
def test_a_wrong_width_of_a_layer_is_named(width):
    with pytest.raises(ValueError, match=f"hidden={width!r}.*whole number, 1 or more"):
        Config(hidden=(64, width))


def test_steps_and_episodes_cannot_both_end_a_run():
    with pytest.raises(ValueError, match="steps=10.*episodes=3"):
        Config(steps=10, episodes=3)


def test_numpy_runs_on_the_cpu_only():
    with pytest.raises(ValueError, match="device='cuda'.*backend"):
        Config(device="cuda")


def test_a_config_cannot_be_changed_only_replaced():
    config = Config(seed=1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.seed = 2
    assert dataclasses.replace(config, seed=2).seed == 2


def test_a_config_goes_through_json_unchanged():
    for config in (Config(), Config.paper("Hopper-v5", "DDPG", 4),
                   Config("ArmHard-v0", critics=3, actors=1, y_min=-20.0,
                          task_options={"goal_area": "window"})):
        assert Config.from_json(config.to_json()) == config
        assert Config(**dataclasses.asdict(config)) == config


# --- units of the task ----------------------------------------------------------------

SPACE = gym.spaces.Box(np.float32([-2, 0]), np.float32([2, 10]))


def test_to_env_maps_minus_one_to_one_onto_the_tasks_bounds():
    np.testing.assert_array_equal(to_env(np.array([-1, -1]), SPACE), [-2, 0])
    np.testing.assert_array_equal(to_env(np.array([1, 1]), SPACE), [2, 10])
    np.testing.assert_array_equal(to_env(np.array([0, 0]), SPACE), [0, 5])
    np.testing.assert_array_equal(to_env(np.array([0.5, -0.2]), SPACE), [1, 4])


def test_to_env_works_on_a_batch():
    action = np.array([[-1, -1], [1, 1], [0.5, -0.2]])
    np.testing.assert_array_equal(to_env(action, SPACE), [[-2, 0], [2, 10], [1, 4]])


# --- which tasks are accepted ---------------------------------------------------------


def test_any_flat_task_with_bounded_actions_is_accepted():
    env = make_env(Config(toys.TASK, task_options=dict(low=[-3, 0], high=[3, 1])))
    assert env.action_space.shape == (2,)


def test_task_options_and_the_time_limit_reach_the_task():
    env = make_env(Config("Pendulum-v1", max_episode_steps=7, task_options={"g": 5.0}))
    assert env.unwrapped.g == 5.0 and env.spec.max_episode_steps == 7


def test_without_a_time_limit_given_the_tasks_own_holds():
    assert make_env(Config("Pendulum-v1")).spec.max_episode_steps == 200


@pytest.mark.parametrize("task, options, words", [
    ("Pendulm-v1", {}, "unknown.*Did you mean 'Pendulum-v1'"),
    ("Pendulum-v99", {}, "Pendulum-v99"),
    ("nosuchmodule:Task-v0", {}, "nosuchmodule"),
    ("Pendulum-v1:", {}, "Pendulum-v1:"),
    ("CartPole-v1", {}, "action_space Discrete.*continuous"),
    ("FrozenLake-v1", {}, "Discrete"),
    (toys.TASK, toys.UNBOUNDED, "unbounded"),
    (toys.TASK, {"high": [math.inf]}, "unbounded"),
    (toys.TASK, {"low": [-3e38], "high": [3e38]}, "unbounded"),  # their width is inf
    ("dnddpg_minimal:ArmEasy-v0", {}, "names a module: import it first"),
    (toys.TASK, {"obs_shape": (2, 2)}, "observation_space.*flat"),
    (toys.TASK, {"colour": "red"}, "task_options.*colour"),
    ("Pendulum-v1", {"gravity": 3}, "task_options.*gravity"),
])
def test_a_task_that_does_not_fit_is_refused_with_the_reason(task, options, words):
    with pytest.raises(ValueError, match=words) as refusal:
        make_env(Config(task, task_options=options))
    assert repr(task) in str(refusal.value)


# --- agents ---------------------------------------------------------------------------

TINY = dict(hidden=(6, 5), batch_size=4, warmup=0)
AGENTS = pytest.mark.parametrize("kind", [NumpyAgent, TorchAgent])


def tiny_agent(kind=NumpyAgent, **choices):
    """An agent for observations of 3 numbers and actions of 2."""
    return kind(Config(**TINY | choices), 3, 2)


def random_batch(size=4, seed=0, terminated=0.0):
    rng = np.random.default_rng(seed)
    return Batch(rng.normal(size=(size, 3)).astype(np.float32),
                 rng.uniform(-1, 1, (size, 2)).astype(np.float32),
                 rng.normal(size=size).astype(np.float32),
                 rng.normal(size=(size, 3)).astype(np.float32),
                 (rng.random(size) < terminated).astype(np.float32))


def weights(agent, tmp_path):
    """The agent's arrays, as its file holds them."""
    agent.save(tmp_path / "weights.npz")
    return read_npz(tmp_path / "weights.npz")


@AGENTS
def test_what_an_agent_returns_has_the_contracts_shapes(kind):
    for critics, actors in [(1, 1), (2, 1), (2, 2), (3, 2)]:
        agent = tiny_agent(kind, critics=critics, actors=actors)
        batch = random_batch(7)
        assert agent.act(batch.obs[0]).shape == (2,)
        assert agent.act(batch.obs).shape == (7, 2)
        assert agent.actions(batch.obs).shape == (actors, 7, 2)
        assert agent.q_values(batch.obs, batch.action).shape == (critics, 7)
        assert agent.q_next(batch.next_obs).shape == (critics, actors, 7)
        losses = agent.update(batch)
        assert losses["critic"].shape == (critics,)
        assert losses["actor"].shape == (actors,)


@AGENTS
def test_one_observation_gets_the_action_that_it_gets_in_a_batch(kind):
    agent = tiny_agent(kind)
    obs = random_batch(20).obs
    one_by_one = np.array([agent.act(one) for one in obs])
    np.testing.assert_allclose(one_by_one, agent.act(obs), atol=1e-6)


@AGENTS
def test_no_state_has_no_action_and_no_q(kind):
    agent = kind(Config("Pendulum-v1"), 3, 1)  # 2 critics, 2 actors
    none = np.zeros((0, 3))
    assert agent.act(none).shape == (0, 1)
    assert agent.q_values(none, np.zeros((0, 1))).shape == (2, 0)
    assert agent.q_next(none).shape == (2, 2, 0)


@AGENTS
def test_actions_stay_within_minus_one_and_one(kind):
    agent = tiny_agent(kind)
    assert abs(agent.actions(1e4 * random_batch(50).obs)).max() <= 1


@AGENTS
@pytest.mark.parametrize("rule", ["paired", "max_min", "first"])
def test_act_obeys_the_act_rule(kind, rule):
    """The choice is made again here, from what the agent says of each actor alone."""
    agent = tiny_agent(kind, critics=3, actors=2, act_rule=rule)
    obs = 5 * random_batch(200).obs
    actions = agent.actions(obs)
    q = np.stack([agent.q_values(obs, action) for action in actions], axis=1)
    own = np.array([q[0, 0], q[1, 1]])  # critic k at actor k's action
    lowest = q.min(axis=0)
    second = dict(paired=own[1] > own[0], max_min=lowest[1] > lowest[0],
                  first=np.zeros(200, bool))[rule]
    expected = np.where(second[:, None], actions[1], actions[0])
    np.testing.assert_allclose(agent.act(obs), expected, atol=1e-6)
    if rule != "first":
        assert 5 < second.sum() < 195  # both were chosen


@AGENTS
def test_q_next_holds_every_slow_critic_at_every_slow_actors_action(kind):
    agent = tiny_agent(kind, critics=3, actors=2)
    for seed in range(30):
        agent.update(random_batch(seed=seed))  # now slow and online differ
    obs = random_batch(9).obs
    q_next, actions = agent.q_next(obs), agent.actions(obs, slow=True)
    for k in range(2):
        np.testing.assert_allclose(
            q_next[:, k], agent.q_values(obs, actions[k], slow=True), atol=1e-6)
    online = agent.actions(obs)
    assert abs(online - actions).max() > 1e-3
    assert abs(agent.q_values(obs, online[0]) - q_next[:, 0]).max() > 1e-3


@AGENTS
@pytest.mark.parametrize("call", [
    lambda agent: agent.act(np.zeros(4)),
    lambda agent: agent.act(np.zeros((5, 2))),
    lambda agent: agent.actions(np.zeros((5, 4))),
    lambda agent: agent.q_values(np.zeros((5, 3)), np.zeros((5, 3))),
    lambda agent: agent.q_next(np.zeros((2, 5, 3))),
])
def test_an_array_of_the_wrong_width_is_refused(kind, call):
    with pytest.raises(ValueError, match="expected"):
        call(tiny_agent(kind))


def test_make_agent_reads_the_backend():
    assert type(make_agent(Config(), 3, 1)) is NumpyAgent
    assert type(make_agent(Config(backend="torch"), 3, 1)) is TorchAgent


def test_the_first_weights_are_uniform_in_one_over_root_inputs(tmp_path):
    """How wide: 1 / sqrt(inputs), as PyTorch's Linear does it, biases included."""
    agent = NumpyAgent(Config(algorithm="DDPG", hidden=(40, 30)), 8, 1)
    theta = weights(agent, tmp_path)["theta"]
    critic_first = theta[: (9 + 1) * 40]
    assert 0.98 / 3 < abs(critic_first).max() <= 1 / 3
    assert abs(critic_first.std() - 1 / 3 / math.sqrt(3)) < 0.01
    assert len(theta) == (10 * 40 + 41 * 30 + 31 * 1) + (9 * 40 + 41 * 30 + 31 * 1)


# --- one update -----------------------------------------------------------------------


@AGENTS
@pytest.mark.parametrize("choices", [
    dict(gamma=0.99), dict(gamma=0.5), dict(target_rule="single"),
    dict(target_rule="soft", nu=0.8), dict(y_min=0.3)], ids=str)
def test_the_critics_loss_is_the_mean_squared_td_error(kind, choices):
    """Eq. (3), for each critic against the one shared y of the config's choices."""
    agent = tiny_agent(kind, **choices)
    config, batch = agent.config, random_batch(terminated=0.4)
    y = td_target(batch.reward, batch.terminated, agent.q_next(batch.next_obs),
                  config.gamma, config.target_rule, config.nu, config.y_min)
    error = agent.q_values(batch.obs, batch.action) - y
    losses = agent.update(batch)
    np.testing.assert_allclose(losses["critic"], (error**2).mean(axis=1), rtol=1e-5)


@AGENTS
def test_the_actors_climb_the_updated_critics(kind):
    """The order inside an update: the actors' loss is minus Q *after* Eq. (3)."""
    agent = tiny_agent(kind, critic_lr=0.5)  # a huge step, so that the order shows
    batch = random_batch()
    actions = agent.actions(batch.obs)
    before = -np.array([agent.q_values(batch.obs, actions[k])[k].mean()
                        for k in range(2)])
    loss = agent.update(batch)["actor"]
    after = -np.array([agent.q_values(batch.obs, actions[k])[k].mean()
                       for k in range(2)])
    np.testing.assert_allclose(loss, after, rtol=1e-5)
    assert (abs(before - after) > 0.1).all()


@AGENTS
def test_climbs_first_sends_all_actors_up_the_first_critic(kind):
    agent = tiny_agent(kind, climbs="first")
    batch = random_batch()
    actions = agent.actions(batch.obs)
    loss = agent.update(batch)["actor"]
    first = [-agent.q_values(batch.obs, actions[k])[0].mean() for k in range(2)]
    np.testing.assert_allclose(loss, first, rtol=1e-5)


@AGENTS
def test_an_update_makes_q_truer_and_the_actions_better(kind):
    agent = tiny_agent(kind, critic_lr=1e-4, actor_lr=1e-4, tau=1e-9)
    batch = random_batch(64)
    y = td_target(batch.reward, batch.terminated, agent.q_next(batch.next_obs), 0.99)
    before = ((agent.q_values(batch.obs, batch.action) - y) ** 2).mean(axis=1)
    old = agent.actions(batch.obs)
    agent.update(batch)
    after = ((agent.q_values(batch.obs, batch.action) - y) ** 2).mean(axis=1)
    assert (after < before).all()
    new = agent.actions(batch.obs)
    for k in range(2):
        gain = (agent.q_values(batch.obs, new[k]) - agent.q_values(batch.obs, old[k]))
        assert gain[k].mean() > 0


@AGENTS
def test_the_slow_copies_go_the_part_tau_of_the_way(kind, tmp_path):
    """Eq. (1): slow <- slow + tau (online - slow)."""
    agent = tiny_agent(kind, tau=0.25)
    before = weights(agent, tmp_path)
    agent.update(random_batch())
    after = weights(agent, tmp_path)
    expected = before["theta_target"] + 0.25 * (after["theta"] - before["theta_target"])
    np.testing.assert_allclose(after["theta_target"], expected, atol=1e-7)
    assert not np.array_equal(after["theta_target"], before["theta_target"])


@AGENTS
def test_the_slow_copies_move_every_target_every_updates(kind, tmp_path):
    agent = tiny_agent(kind, tau=1.0, target_every=3)
    moved, old = [], weights(agent, tmp_path)["theta_target"]
    for seed in range(6):
        agent.update(random_batch(seed=seed))
        now = weights(agent, tmp_path)
        moved.append(not np.array_equal(now["theta_target"], old))
        old = now["theta_target"]
        if moved[-1]:  # tau = 1 copies outright
            np.testing.assert_allclose(old, now["theta"], atol=1e-7)
    assert moved == [False, False, True, False, False, True]


@AGENTS
def test_an_update_without_climbing_leaves_the_actors_alone(kind):
    agent = tiny_agent(kind)
    batch = random_batch()
    actions = agent.actions(batch.obs)
    q = agent.q_values(batch.obs, batch.action)
    losses = agent.update(batch, climb=False)
    assert np.isnan(losses["actor"]).all()
    np.testing.assert_array_equal(agent.actions(batch.obs), actions)
    assert (agent.q_values(batch.obs, batch.action) != q).all()


@AGENTS
@pytest.mark.parametrize("part", Batch._fields)
def test_a_batch_with_nan_is_refused_before_anything_has_changed(kind, part):
    agent, batch = tiny_agent(kind), random_batch()
    before = agent.arrays()
    bad = np.array(getattr(batch, part), float)
    bad.flat[0] = math.nan
    with pytest.raises(ValueError, match="nan"):
        agent.update(batch._replace(**{part: bad}))
    np.testing.assert_equal(agent.arrays(), before)
    with pytest.raises(ValueError, match="obs holds .*nan"):
        agent.act(np.full(agent.obs_dim, math.nan))


def test_a_gpu_that_is_not_there_is_named():
    torch = pytest.importorskip("torch")
    device = f"cuda:{torch.cuda.device_count()}"
    with pytest.raises(ValueError, match=f"'{device}': PyTorch finds no such GPU"):
        make_agent(Config(backend="torch", device=device), 3, 1)


def test_options_of_a_task_are_kept_as_a_file_holds_them():
    config = Config("Hopper-v5", task_options={"healthy_z_range": (0.7, 2.0)})
    assert Config.from_json(config.to_json()) == config
    for lost in ({"g": np.float32(9.8)}, {"path": dataclasses}, [1], "g=9"):
        with pytest.raises(ValueError, match="task_options=.*is not allowed"):
            Config(task_options=lost)


@AGENTS
def test_diverging_critics_are_noticed_at_once(kind):
    agent = tiny_agent(kind)
    batch = random_batch()
    with pytest.raises(ValueError, match="not finite.*critic_lr"):
        agent.update(batch._replace(reward=np.full(4, np.inf, np.float32)))


# --- Adam -----------------------------------------------------------------------------


def descend(gradients, lr=0.1, theta=0.0):
    """Steps of Adam on one number, in float64, one for each gradient."""
    theta, m, v = np.array([theta]), np.zeros(1), np.zeros(1)
    for t, gradient in enumerate(gradients, start=1):
        adam(theta, np.array([float(gradient)]), m, v, t, lr)
    return theta[0]


def test_adams_first_step_is_the_learning_rate_whatever_the_gradient():
    """Both moments are bias-corrected: g / (sqrt(g^2) + eps) is the sign of g."""
    for gradient in (1e-3, 1.0, 1e3):
        np.testing.assert_allclose(descend([gradient]), -0.1, rtol=1e-4)
        np.testing.assert_allclose(descend([-gradient]), 0.1, rtol=1e-4)


def test_adams_second_step_by_hand():
    """g = 1, then g = 2.

    m = 0.1, then 0.09 + 0.2 = 0.29; corrected by 1 - 0.9^2 = 0.19: 1.526316
    v = 0.001, then 0.000999 + 0.004 = 0.004999; by 1 - 0.999^2 = 0.001999: 2.500750
    """
    step = 0.29 / 0.19 / math.sqrt(0.004999 / 0.001999)
    np.testing.assert_allclose(descend([1, 2]), -0.1 - 0.1 * step, rtol=1e-7)


def test_adam_drops_only_what_has_faded_to_nothing():
    """Every 256 steps, and far below what any gradient still means."""
    m = np.array([1e-20, 1e-30])
    for t, left in ((255, [0.9e-20, 0.9e-30]), (256, [0.81e-20, 0])):
        adam(np.zeros(2), np.zeros(2), m, np.ones(2), t, 0.1)
        np.testing.assert_allclose(m, left, rtol=1e-12)


def test_adams_eps_stands_outside_the_square_root():
    """A gradient as small as eps goes half a step; inside the root it would go 1e-4."""
    np.testing.assert_allclose(descend([1e-8]), -0.05, rtol=1e-9)


def test_adam_equals_pytorchs_over_600_steps():
    import torch

    rng = np.random.default_rng(0)
    theta = rng.normal(size=40)
    theirs = torch.tensor(theta, requires_grad=True)
    optimizer = torch.optim.Adam([theirs], lr=1e-2)
    m, v = np.zeros(40), np.zeros(40)
    for t in range(1, 601):
        gradient = rng.normal(size=40) * 10.0 ** rng.integers(-9, 3, size=40)
        theirs.grad = torch.tensor(gradient)
        optimizer.step()
        adam(theta, gradient, m, v, t, 1e-2)
    np.testing.assert_allclose(theta, theirs.detach().numpy(), rtol=0, atol=1e-12)


# --- an agent's file ------------------------------------------------------------------


@AGENTS
def test_an_agents_file_holds_all_that_the_next_update_needs(kind, tmp_path):
    agent = tiny_agent(kind, target_every=2)
    for seed in range(3):
        agent.update(random_batch(seed=seed))
    agent.save(tmp_path / "agent.npz")
    again = kind.load(tmp_path / "agent.npz")
    assert again.config == agent.config and again.updates == 3
    for seed in range(3, 6):
        agent.update(random_batch(seed=seed))
        again.update(random_batch(seed=seed))
    obs = random_batch(30).obs
    np.testing.assert_array_equal(again.actions(obs), agent.actions(obs))
    np.testing.assert_array_equal(again.q_next(obs), agent.q_next(obs))


@AGENTS
def test_a_copied_agent_learns_as_the_original_does(kind):
    agent = tiny_agent(kind, algorithm="DN-DDPG")
    agent.update(random_batch())
    copies = [deepcopy(agent), pickle.loads(pickle.dumps(agent))]
    for one in (agent, *copies):
        for seed in range(1, 4):
            one.update(random_batch(seed=seed))
    obs = random_batch(30).obs
    for one in copies:
        assert one.updates == 4
        np.testing.assert_array_equal(one.actions(obs), agent.actions(obs))
        np.testing.assert_array_equal(one.q_next(obs), agent.q_next(obs))


@AGENTS
def test_a_batch_whose_parts_differ_in_length_is_refused(kind):
    agent, batch = tiny_agent(kind), random_batch()
    for part in Batch._fields:
        odd = batch._replace(**{part: getattr(batch, part)[:1]})
        with pytest.raises(ValueError, match="parts of one length"):
            agent.update(odd)
    assert agent.updates == 0


def test_the_wrong_kind_of_file_is_told_what_it_lacks(tmp_path):
    tiny_agent().save(tmp_path / "agent.npz")
    with pytest.raises(ValueError, match="no training .* it lacks 'small'"):
        Training.load(tmp_path / "agent.npz")
    write_npz(tmp_path / "other.npz", x=np.eye(2))
    with pytest.raises(ValueError, match="no agent .* it lacks 'config'"):
        NumpyAgent.load(tmp_path / "other.npz")


def test_a_trainings_file_opens_as_its_agent(tmp_path):
    training = Training(Config(toys.TASK, steps=30, **TINY | dict(warmup=10)))
    list(training)
    training.save(tmp_path / "run.npz")
    obs = np.random.default_rng(0).normal(size=(5, 2))
    for kind in (NumpyAgent, TorchAgent):
        agent = kind.load(tmp_path / "run.npz")
        np.testing.assert_allclose(agent.act(obs), training.agent.act(obs), atol=1e-6)


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file.npz"
    write_npz(path, a=np.arange(3))

    def breaks(file, **arrays):
        file.write(b"half of it")
        raise OSError("no space left on device")

    with pytest.raises(OSError, match="no space"):
        write_npz(path, save=breaks, a=np.arange(4))
    np.testing.assert_array_equal(read_npz(path)["a"], [0, 1, 2])
    assert [found.name for found in tmp_path.iterdir()] == ["file.npz"]


def test_npz_brings_arrays_and_texts_back(tmp_path):
    write_npz(tmp_path / "a.npz", n=3, text="γ", x=np.eye(2, dtype=np.float32))
    content = read_npz(tmp_path / "a.npz")
    assert set(content) == {"n", "text", "x"}
    assert int(content["n"]) == 3 and str(content["text"]) == "γ"
    assert content["x"].dtype == np.float32
    assert content["x"].tolist() == [[1, 0], [0, 1]]


class Trap:
    """Unpickling it writes a file: what a malicious checkpoint would do."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def damaged_files(tmp_path):
    """Files that are none of ours, by what is wrong with them."""
    agent = tiny_agent()
    good = tmp_path / "good.npz"
    agent.save(good)
    content, whole = read_npz(good), good.read_bytes()
    middle = len(whole) // 2
    for name, text in dict(empty=b"", text=b"not a file of numbers",
                           half=whole[:middle], tail=whole[middle:]).items():
        (tmp_path / f"{name}.npz").write_bytes(text)
    trap = np.array([Trap(tmp_path / "sprung")], dtype=object)
    np.savez(tmp_path / "pickled.npz", **content | {"theta": trap})
    np.save(tmp_path / "pickled.npy", trap, allow_pickle=True)
    np.save(tmp_path / "one_array.npy", np.arange(3))
    for name, change in {
        "other_arrays": {"weights": np.arange(3)},
        "other_config": content | {"config": "{}"[:1]},
        "unknown_field": content | {"config": '{"colour": "red"}'},
        "wrong_field": content | {"config": '{"gamma": 7}'},
        "short": content | {"theta": content["theta"][:-1]},
        "long": content | {"theta": np.append(content["theta"], 0)},
        "short_moments": content | {"adam_m": content["adam_m"][:-1]},
        "letters": content | {"theta": np.array(["a"] * len(content["theta"]))},
    }.items():
        np.savez(tmp_path / f"{name}.npz", **change)
    np.savez(tmp_path / "no_moments.npz",
             **{name: content[name] for name in content if name != "adam_v"})
    return sorted(path for path in tmp_path.iterdir() if path != good)


def test_damaged_and_foreign_files_are_refused_and_never_unpickled(tmp_path):
    files = damaged_files(tmp_path)
    assert len(files) == 16
    for kind in (NumpyAgent, TorchAgent):
        for path in files:
            with pytest.raises(ValueError, match=path.name):
                kind.load(path)
                pytest.fail(f"{kind.__name__} opened {path.name}")
    assert not (tmp_path / "sprung").exists()


def test_a_single_damaged_byte_is_noticed_or_does_not_matter(tmp_path):
    """Every 23rd byte in turn is turned over. A name or a number is never wrong."""
    path = tmp_path / "agent.npz"
    tiny_agent(hidden=(2,)).save(path)
    content, whole, noticed = read_npz(path), path.read_bytes(), 0
    for at in range(0, len(whole), 23):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1:])
        try:
            damaged = read_npz(path)
        except ValueError:
            noticed += 1
        else:
            assert damaged.keys() == content.keys(), at
            for name, array in content.items():
                np.testing.assert_array_equal(damaged[name], array, err_msg=f"{at}")
    assert noticed > 50


def test_a_file_that_is_not_there_is_not_called_damaged(tmp_path):
    with pytest.raises(FileNotFoundError):
        NumpyAgent.load(tmp_path / "nothing.npz")
