"""The Arm: its arithmetic by hand, its rules as an environment, its reference."""

import importlib
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import check_env

import dnddpg_minimal  # noqa: F401  (registers the tasks)
from dnddpg_minimal import arm

HALF_TURN = np.pi
QUARTER = np.pi / 2
EASY = (100.0, 100.0)


def make_arm(**options):
    """An Arm after reset(seed=0), without wrappers."""
    env = arm.Arm(**options)
    env.reset(seed=0)
    return env


def one_state(joints, goal=EASY, counter=0):
    return np.array([[*joints, *goal, counter]], float)


def random_states(n, seed=0):
    """States from everywhere, every second one near its goal or on it; n is even."""
    rng = np.random.default_rng(seed)
    states = arm.start_states(rng, n, goal="hard", goal_area="window")
    near = 200 + arm.locate(states[::2, :2])[:, 1] + rng.uniform(-30, 30, (n // 2, 2))
    states[::2, 2:4] = np.clip(near, 0, 400)
    states[:, 4] = rng.integers(0, 60, n)
    return states, rng.uniform(-1, 1, (n, 2))


# ------------------------------------------------------------------------ geometry


@pytest.mark.parametrize(
    ("joints", "elbow", "finger"),
    [
        ((0.0, 0.0), (100, 0), (200, 0)),  # stretched to the right
        ((QUARTER, 0.0), (0, 100), (0, 200)),  # stretched upwards
        ((0.0, QUARTER), (100, 0), (100, 100)),  # the elbow turns to the left
        ((0.0, HALF_TURN), (100, 0), (0, 0)),  # folded: the finger at the base
        ((QUARTER, -QUARTER), (0, 100), (100, 100)),
    ],
)
def test_elbow_and_finger_are_where_a_ruler_puts_them(joints, elbow, finger):
    points = arm.locate(np.array([joints]))
    np.testing.assert_allclose(points[0], [elbow, finger], atol=1e-12)


def test_an_observation_computed_by_hand():
    # Stretched to the right; the goal (100, 100) is at (-100, -100) from the base
    obs = arm.observe(one_state((0.0, 0.0)))
    by_hand = [0.5, 0, 1, 0, -200 / 400, -100 / 400, -300 / 400, -100 / 400, 0]
    np.testing.assert_allclose(obs[0], by_hand, atol=1e-7)
    assert obs.dtype == np.float32


def test_the_observation_flags_the_finger_on_the_goal_and_hides_the_counter():
    joints = (HALF_TURN, QUARTER)  # finger at (-100, -100) from the base: the easy goal
    obs = arm.observe(one_state(joints, counter=7))
    np.testing.assert_allclose(obs[0, 6:], [0, 0, 1], atol=1e-7)
    np.testing.assert_array_equal(obs, arm.observe(one_state(joints, counter=40)))


def test_a_step_turns_each_joint_by_a_tenth_of_its_action():
    after, _, _ = arm.step(one_state((1.0, 2.0)), np.array([[1.0, -0.5]]))
    np.testing.assert_allclose(after[0], [1.1, 1.95, 100, 100, 0])


def test_actions_beyond_one_are_clipped():
    after, _, _ = arm.step(one_state((1.0, 2.0)), np.array([[7.0, -7.0]]))
    np.testing.assert_allclose(after[0, :2], [1.1, 1.9])


def test_angles_stay_on_the_circle():
    after, _, _ = arm.step(one_state((0.05, 6.25)), np.array([[-1.0, 1.0]]))
    np.testing.assert_allclose(after[0, :2], [2 * np.pi - 0.05, 6.35 - 2 * np.pi])


def test_a_step_leaves_its_arguments_alone():
    states, actions = random_states(20)
    before = states.copy(), actions.copy()
    arm.step(states, actions)
    np.testing.assert_array_equal(states, before[0])
    np.testing.assert_array_equal(actions, before[1])


# ---------------------------------------------------------------- reward and success


def test_the_reward_is_the_distance_after_the_step():
    # After the step the arm is stretched to (200, 0), the goal 200 px below: -200 / 400
    states = one_state((-0.1, 0.0), goal=(400.0, 0.0))
    _, rewards, _ = arm.step(states, np.array([[1.0, 0.0]]))
    np.testing.assert_allclose(rewards, [-0.5])


def test_the_bonus_is_one_on_the_goal_and_nothing_beside_it():
    states = np.concatenate(
        [one_state((HALF_TURN, QUARTER)), one_state((0.0, QUARTER))]
    )
    stay = np.zeros((2, 2))
    _, plain, _ = arm.step(states, stay)
    _, bonus, _ = arm.step(states, stay, reward="distance_and_bonus")
    np.testing.assert_allclose(bonus - plain, [1.0, 0.0])


@pytest.mark.parametrize(
    ("dx", "dy", "expected"),
    [(19.9, 19.9, 1), (-19.9, 19.9, 1), (20.1, 0, 0), (0, -20.1, 0)],
)
def test_the_goal_is_a_square_of_forty_pixels(dx, dy, expected):
    # The finger at (300, 300) in the window. A disk would leave the corners out
    states = one_state((0.0, QUARTER), goal=(300 + dx, 300 + dy))
    after, _, _ = arm.step(states, np.zeros((1, 2)))
    assert after[0, 4] == expected


def test_leaving_the_goal_sets_the_counter_back():
    after, _, _ = arm.step(one_state((0.0, 0.0), counter=50), np.zeros((1, 2)))
    assert after[0, 4] == 0


@pytest.mark.parametrize("success_terminates", [False, True])
def test_success_comes_with_the_fifty_first_step_in_a_row(success_terminates):
    env = make_arm(success_terminates=success_terminates)
    env.state = one_state((HALF_TURN, QUARTER))[0]
    for _ in range(50):
        _, _, terminated, truncated, info = env.step(np.zeros(2))
        assert not (terminated or truncated or info["success"])
        assert info["on_goal"]
    _, _, terminated, truncated, info = env.step(np.zeros(2))
    assert info["success"] is True
    assert terminated is success_terminates
    assert truncated is (not success_terminates)


def test_the_clock_stops_an_episode_after_three_hundred_steps():
    env = gym.make("ArmEasy-v0", disable_env_checker=True)
    env.reset(seed=0)
    env.unwrapped.state = one_state((0.0, 0.0))[0]
    for step in range(1, 301):
        _, _, terminated, truncated, info = env.step(np.zeros(2, np.float32))
        assert not terminated and not info["success"]
        assert truncated == (step == 300)


# -------------------------------------------------- one source of the dynamics, N = 1


@pytest.mark.parametrize("reward", arm.REWARDS)
def test_ten_thousand_steps_at_once_equal_ten_thousand_single_steps(reward):
    states, actions = random_states(10_000 if reward == "distance" else 500)
    after, rewards, success = arm.step(states, actions, reward)
    obs = arm.observe(after)
    env = make_arm(reward=reward)
    singles = []
    for state, action in zip(states, actions):
        env.state = state
        one_obs, one_reward, _, truncated, info = env.step(action)
        flags = (truncated, info["success"], info["on_goal"])
        singles.append((env.state, one_obs, one_reward, flags))
    one_after, one_obs, one_reward, flags = map(np.array, zip(*singles))
    # Elementwise arithmetic: equal to the bit as a rule; 1e-12 for every processor
    np.testing.assert_allclose(one_after, after, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one_obs, obs, rtol=0, atol=1e-6)
    np.testing.assert_allclose(one_reward, rewards, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(flags, np.stack([success, success, obs[:, 8] > 0], 1))
    assert 0 < success.sum() < len(states)  # both cases were met


# ------------------------------------------------------------------------- the starts


def test_start_angles_are_uniform_on_the_circle():
    states = arm.start_states(np.random.default_rng(0), 20_000)
    for joint in (0, 1):
        counts, _ = np.histogram(states[:, joint], bins=8, range=(0, 2 * np.pi))
        assert abs(counts / 2500 - 1).max() < 0.08  # 4 standard errors are 0.075
    assert np.all(states[:, 2:4] == 100.0) and np.all(states[:, 4] == 0.0)


def test_reachable_goals_fill_the_disk_evenly():
    states = arm.start_states(np.random.default_rng(0), 20_000, goal="hard")
    radius = np.hypot(*(states[:, 2:4] - 200.0).T)
    assert radius.max() <= 200.0
    # A quarter of the area lies within half the radius: standard error 0.003
    assert abs((radius < 100.0).mean() - 0.25) < 0.013
    assert np.isfinite(arm.reference_steps(states[:300])).all()


def test_about_a_twelfth_of_the_goals_in_the_window_is_out_of_reach():
    rng = np.random.default_rng(0)
    goals = arm.start_states(rng, 100_000, goal="hard", goal_area="window")[:, 2:4]
    # The point of the square that is nearest to the base is beyond 200 px
    nearest = np.maximum(np.abs(goals - 200.0) - 20.0, 0.0)
    out_of_reach = np.hypot(nearest[:, 0], nearest[:, 1]) > 200.0
    assert abs(out_of_reach.mean() - 0.0833) < 0.0035  # 4 standard errors


def test_each_environment_has_a_goal_and_a_random_stream_of_its_own():
    one, other = arm.Arm(goal="hard"), arm.Arm(goal="hard")
    one.reset(seed=1)
    other.reset(seed=2)
    kept = one.state
    assert not np.array_equal(kept[2:4], other.state[2:4])
    other.reset()
    np.testing.assert_array_equal(one.state, kept)
    other.reset(seed=1)
    np.testing.assert_array_equal(other.state, kept)


# ----------------------------------------------------------------------- the reference


def test_inverse_kinematics_brings_the_finger_to_the_point_by_both_branches():
    rng = np.random.default_rng(0)
    states = arm.start_states(rng, 500, goal="hard")
    points = states[:, 2:4] - 200.0
    joints = arm.inverse_kinematics(points)
    for branch in (0, 1):
        finger = arm.locate(joints[:, branch])[:, 1]
        np.testing.assert_allclose(finger, points, atol=1e-6)


def test_inverse_kinematics_stretches_towards_a_point_out_of_reach():
    finger = arm.locate(arm.inverse_kinematics(np.array([[300.0, 400.0]]))[:, 0])[0, 1]
    np.testing.assert_allclose(finger, [120.0, 160.0])


def test_the_reference_counts_its_steps_right_on_a_case_by_hand():
    # Stretched arm, goal straight ahead by half a turn. Both joints may help: with
    # joint 2 alone at rest, joint 1 would need 32 steps to turn by pi
    states = one_state((0.0, 0.0), goal=(0.0, 200.0))
    assert arm.reference_steps(states) <= 31
    assert arm.reference_steps(one_state((HALF_TURN, QUARTER))) == 0  # there already
    # The elbow's branch is right, joint 1 is 0.35 rad off: ceil(0.35 / 0.1) = 4 steps
    # to the centre; the near edge is 20 px away of 35 and comes a step or two earlier
    near = arm.reference_steps(one_state((HALF_TURN - 0.35, QUARTER)))
    assert near in (2, 3)


def test_the_reference_is_on_goal_after_the_steps_it_says_and_then_stays():
    rng = np.random.default_rng(3)
    states = arm.start_states(rng, 60, goal="hard", goal_area="window")
    steps = arm.reference_steps(states)
    first_on_goal = np.where(arm.observe(states)[:, 8] > 0, 0.0, np.inf)
    was_on_goal = first_on_goal == 0
    for n in range(1, 85):
        states, _, success = arm.step(states, arm.reference_action(states))
        on_goal = states[:, 4] > 0
        first_on_goal[on_goal & np.isinf(first_on_goal)] = n
        assert on_goal[was_on_goal].all()  # it never leaves
        was_on_goal = on_goal
    np.testing.assert_array_equal(first_on_goal, steps)
    assert success[np.isfinite(steps)].all()  # 32 steps there, 51 on the goal


def test_the_reference_drives_the_environment_to_success():
    env = gym.make("ArmHard-v0", disable_env_checker=True)
    for seed in range(3):
        env.reset(seed=seed)
        start = env.unwrapped.state
        taken, success = 0, False
        while not success:
            action = arm.reference_action(env.unwrapped.state).astype(np.float32)
            _, _, _, truncated, info = env.step(action)
            taken, success = taken + 1, info["success"]
            assert success or not truncated
        # The first step on goal is the first of the 51
        assert taken == max(arm.reference_steps(start)[0], 1) + 50


def test_no_other_point_of_the_goal_is_much_faster_than_the_reference():
    states = arm.start_states(np.random.default_rng(1), 150, goal="hard")
    steps = arm.reference_steps(states)
    side = np.linspace(-20, 20, 33)
    grid = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    points = states[:, None, 2:4] - 200.0 + grid  # (N, P, xy)
    turns = arm.inverse_kinematics(points) - states[:, None, None, :2]
    turns = np.abs(np.remainder(turns + np.pi, 2 * np.pi) - np.pi).max(axis=3)
    turns[np.hypot(points[..., 0], points[..., 1]) > 200.0] = np.inf
    bound = np.ceil(turns.min(axis=(1, 2)) / 0.1)
    late = (steps - bound)[steps > 0]
    assert late.max() <= 1 and late.mean() < 0.05


def test_the_reference_stretches_towards_a_goal_out_of_reach():
    states = one_state((0.0, 1.0), goal=(400.0, 400.0))
    assert np.isinf(arm.reference_steps(states))
    for _ in range(40):
        states, _, _ = arm.step(states, arm.reference_action(states))
    finger = arm.locate(states[:, :2])[0, 1]
    np.testing.assert_allclose(finger, 200 / np.sqrt(2) * np.ones(2), atol=1e-6)


def test_the_reference_takes_one_state_or_many():
    states, _ = random_states(6)
    many = arm.reference_action(states)
    assert many.shape == (6, 2) and np.abs(many).max() <= 1.0
    np.testing.assert_array_equal(arm.reference_action(states[2]), many[2])


# ---------------------------------------------------------------- as Gymnasium wants it


@pytest.mark.filterwarnings("ignore:.*:UserWarning")  # "human" is not tried headless
@pytest.mark.parametrize("task", ["ArmEasy-v0", "ArmHard-v0"])
def test_gymnasiums_checker_is_content(task):
    env = gym.make(task, disable_env_checker=True, render_mode="rgb_array")
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_observations_stay_within_their_space():
    states, _ = random_states(5_000)
    space = arm.Arm().observation_space
    obs = arm.observe(states)
    assert np.all(obs >= space.low) and np.all(obs <= space.high)


def test_the_vector_api_runs_several_arms():
    envs = gym.make_vec("ArmHard-v0", num_envs=3, vectorization_mode="sync")
    obs, _ = envs.reset(seed=0)
    assert obs.shape == (3, 9) and not np.array_equal(obs[0], obs[1])
    obs, rewards, terminated, _, info = envs.step(envs.action_space.sample())
    assert obs.shape == (3, 9) and rewards.shape == (3,) and not terminated.any()
    assert info["success"].shape == (3,)
    envs.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"goal": "hrad"}, ["goal", "'hrad'", "'easy', 'hard'", "did you mean 'hard'"]),
        ({"goal_area": "reach"}, ["goal_area", "'window'", "mean 'reachable'"]),
        ({"reward": "sparse"}, ["reward", "'sparse'", "'distance_and_bonus'"]),
        ({"success_terminates": 1}, ["success_terminates=1", "False, True"]),
        ({"render_mode": "rgb"}, ["render_mode", "mean 'rgb_array'"]),
    ],
)
def test_a_wrong_option_is_refused_in_a_sentence(options, words):
    with pytest.raises(ValueError) as refused:
        arm.Arm(**options)
    for word in words:
        assert word in str(refused.value)


def test_a_wrong_reward_is_refused_by_the_pure_step_too():
    with pytest.raises(ValueError, match="did you mean 'distance'"):
        arm.step(one_state((0.0, 0.0)), np.zeros((1, 2)), reward="distanc")


@pytest.mark.parametrize(
    "state",
    [np.zeros(4), [0, np.nan, 100, 100, 0], [0, 0, 500, 100, 0], [0, 0, 9, 9, -1]],
)
def test_a_wrong_state_is_refused(state):
    env = make_arm()
    with pytest.raises(ValueError, match="state"):
        env.state = state


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(ResetNeeded):
        arm.Arm().step(np.zeros(2))


# ----------------------------------------------------------------------------- drawing


def test_a_picture_shows_goal_and_finger_where_they_are():
    env = make_arm(render_mode="rgb_array")
    env.state = one_state((0.0, QUARTER))[0]  # finger at (300, 300), goal (100, 100)
    picture = env.render()
    assert picture.shape == (400, 400, 3) and picture.dtype == np.uint8
    # Rows run downwards, y upwards
    assert np.abs(picture[400 - 110, 110].astype(int) - arm.GOAL_BLUE).max() < 10
    assert np.abs(picture[400 - 300, 300].astype(int) - arm.FINGER_ORANGE).max() < 10
    env.close()


def test_a_window_opens_and_closes(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")  # a screen that nobody sees
    env = make_arm(render_mode="human")
    env.step(np.zeros(2))
    assert env.render() is None
    env.close()
    env.close()  # twice does no harm


def test_rendering_without_a_mode_warns():
    with pytest.warns(UserWarning, match="render mode"):
        assert make_arm().render() is None


def test_without_pygame_the_arm_works_and_only_drawing_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)  # as if it were not installed
    env = make_arm(render_mode="rgb_array")
    env.step(np.zeros(2))
    with pytest.raises(DependencyNotInstalled, match="classic-control"):
        env.render()


def test_the_module_itself_does_not_import_pygame(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.delitem(sys.modules, "dnddpg_minimal.arm")
    assert importlib.import_module("dnddpg_minimal.arm").LINK == 100.0
