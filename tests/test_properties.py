"""What must hold for every input, tried on many that nobody chose (hypothesis)."""

import numpy as np
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dnddpg_minimal import ReplayBuffer, choose_actor, stream, td_target, to_env

many = settings(deadline=None, derandomize=True, max_examples=30)
RULES = "max_min", "single", "paired_min", "selected", "soft"
numbers = st.floats(-1e3, 1e3).map(lambda x: round(x, 3))


@st.composite
def questions(draw, square=False):
    """The arguments of a target: reward, terminated (B,), q_next (C, K, B), gamma."""
    actors = draw(st.integers(1, 3))
    critics = actors if square else draw(st.integers(actors, 4))
    size = draw(st.integers(1, 5))
    return (draw(arrays(float, size, elements=numbers)),
            draw(arrays(float, size, elements=st.sampled_from([0.0, 1.0]))),
            draw(arrays(float, (critics, actors, size), elements=numbers)),
            draw(st.floats(0, 1).map(lambda x: round(x, 3))))


# --- targets --------------------------------------------------------------------------


@many
@given(questions(square=True), st.sampled_from(RULES))
def test_a_target_lies_between_the_lowest_and_the_highest_q(question, rule):
    reward, terminated, q_next, gamma = question
    y = td_target(*question, rule)
    discount = gamma * (1 - terminated)
    flat = q_next.reshape(-1, len(reward))
    assert (y >= reward + discount * flat.min(axis=0) - 1e-9).all()
    assert (y <= reward + discount * flat.max(axis=0) + 1e-9).all()


@many
@given(questions(square=True))
def test_max_min_is_the_most_hopeful_of_the_rules_that_ask_every_critic(question):
    highest = td_target(*question, "max_min")
    for rule in ("single", "selected", "soft"):
        assert (td_target(*question, rule) <= highest + 1e-9).all()


@many
@given(questions(square=True))
def test_paired_min_is_never_below_the_min_over_everything(question):
    lowest = td_target(*question, "soft", nu=1.0)  # min over actors of the min
    assert (td_target(*question, "paired_min") >= lowest - 1e-9).all()


@many
@given(questions(), st.integers(1, 3))
def test_one_more_critic_never_raises_a_target_and_one_more_actor_never_lowers_it(
        question, more):
    reward, terminated, q_next, gamma = question
    y = td_target(*question)
    critics = np.concatenate([q_next, q_next[:1] - more])
    assert (td_target(reward, terminated, critics, gamma) <= y).all()
    actors = np.concatenate([q_next, q_next[:, :1] - more], axis=1)
    assert (td_target(reward, terminated, actors, gamma) >= y).all()


@many
@given(questions(), st.permutations(range(4)), st.permutations(range(3)))
def test_max_min_does_not_care_who_is_called_first(question, critics, actors):
    reward, terminated, q_next, gamma = question
    critics = [c for c in critics if c < q_next.shape[0]]
    actors = [k for k in actors if k < q_next.shape[1]]
    shuffled = q_next[critics][:, actors]
    np.testing.assert_array_equal(td_target(reward, terminated, shuffled, gamma),
                                  td_target(*question))


@many
@given(questions(square=True), st.sampled_from(RULES), numbers)
def test_what_all_critics_add_comes_through_discounted(question, rule, more):
    """So a constant error in Q lives on in the next Q: the reason for the lag."""
    reward, terminated, q_next, gamma = question
    raised = td_target(reward, terminated, q_next + more, gamma, rule)
    np.testing.assert_allclose(
        raised, td_target(*question, rule) + gamma * (1 - terminated) * more, atol=1e-6)


@many
@given(questions(square=True), st.sampled_from(RULES))
def test_each_transition_is_answered_on_its_own(question, rule):
    reward, terminated, q_next, gamma = question
    y = td_target(*question, rule)
    for b in range(len(reward)):
        one = slice(b, b + 1)
        alone = td_target(reward[one], terminated[one], q_next[..., one], gamma, rule)
        np.testing.assert_array_equal(alone, y[one])


@many
@given(questions(), numbers)
def test_y_min_only_lifts_what_lies_below_it(question, y_min):
    y, limited = td_target(*question), td_target(*question, y_min=y_min)
    np.testing.assert_array_equal(limited, np.where(y < y_min, y_min, y))


@many
@given(questions(), st.sampled_from(["paired", "max_min", "first"]))
def test_the_chosen_actor_is_one_of_them_and_the_best_by_its_rule(question, rule):
    q = question[2]
    chosen = choose_actor(q, rule)
    assert chosen.shape == q.shape[2:]
    for b, k in enumerate(chosen):
        own = [q[actor, actor, b] for actor in range(q.shape[1])]
        score = dict(paired=own, max_min=q[..., b].min(axis=0),
                     first=[1] + [0] * (len(own) - 1))[rule]
        assert score[k] == max(score)


# --- replay ---------------------------------------------------------------------------


@many
@given(st.integers(1, 7), st.integers(1, 30), st.integers(0, 9))
def test_replay_holds_exactly_the_last_transitions_each_in_one_piece(capacity, added,
                                                                     seed):
    """Every entry is the transition's number, so a mixed-up row would show."""
    replay = ReplayBuffer(capacity, 2, 1, stream(seed, "replay"))
    for n in range(added):
        replay.add([n, n], [n], n, [n, n], n)
        assert replay.size == min(n + 1, capacity)
    obs, action, reward, next_obs, terminated = replay.sample(300)
    for column in (*obs.T, *action.T, *next_obs.T, terminated):
        np.testing.assert_array_equal(column, reward)
    assert set(reward) == set(range(max(0, added - capacity), added))


@many
@given(st.integers(1, 7), st.integers(1, 30), st.integers(1, 20))
def test_a_batch_has_the_size_asked_for_however_little_is_stored(capacity, added, size):
    replay = ReplayBuffer(capacity, 3, 2, stream(0, "replay"))
    for _ in range(added):
        replay.add(np.ones(3), np.ones(2), 1, np.ones(3), False)
    shapes = [part.shape for part in replay.sample(size)]
    assert shapes == [(size, 3), (size, 2), (size,), (size, 3), (size,)]


# --- units of the task ----------------------------------------------------------------


@many
@given(st.integers(0, 10**6), st.floats(-100, 100), st.floats(1e-3, 100))
def test_no_rounding_carries_an_action_out_of_its_bounds(seed, shift, width):
    """Two thousand dimensions at once, each with bounds of its own."""
    rng = np.random.default_rng(seed)
    low = (shift + rng.normal(size=2_000)).astype(np.float32)
    high = (low + width * rng.uniform(0.1, 1, 2_000)).astype(np.float32)
    space = Box(low, high)
    for end, bound in ((-1, low), (1, high)):
        executed = to_env(np.full((1, 2_000), end, np.float32), space)[0]
        assert (executed >= low).all() and (executed <= high).all()
        np.testing.assert_allclose(executed, bound, rtol=1e-4, atol=1e-4)
    between = to_env(rng.uniform(-1, 1, (1, 2_000)), space)[0]
    assert (between >= low).all() and (between <= high).all()
