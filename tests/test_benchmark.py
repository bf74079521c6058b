"""The benchmark: that it compares like with like. How fast, a free machine must say."""

import numpy as np
import pytest

from dnddpg_minimal import ALGORITHMS, Config, NumpyAgent, benchmark

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rows():
    """The table of a quick benchmark, row by row, as lists of cells."""
    with pytest.MonkeyPatch.context() as patch:
        text = []
        patch.setattr("builtins.print", lambda *words: text.extend(words))
        assert benchmark.main(["--quick"]) == 0
    lines = [line for line in "\n".join(text).splitlines() if line.startswith("| ")]
    assert len({len(line) for line in lines}) == 1  # columns stand below each other
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]


def test_the_table_names_everybody(rows):
    assert tuple(rows[0]) == benchmark.HEADER
    steps = [row for row in rows if row[0] == "steps a second"]
    for program in ("NumpyAgent", "TorchAgent"):
        assert [row[2] for row in steps if row[3] == program] == [*ALGORITHMS] * 2
    assert sum(row[3] == benchmark.PEER for row in steps) == 2
    assert [row[2] for row in rows if row[0] == "one update, ms"] == [*ALGORITHMS]


def test_every_median_is_a_number_or_says_why_not(rows):
    for row in rows[1:]:
        if row[4] == "-":
            assert row[6].startswith("not ")  # installed, measured on this system
        else:
            assert float(row[4]) > 0


def test_a_turn_is_so_many_steps_with_one_update_each():
    config = Config("Pendulum-v1", hidden=(4,), batch_size=4, warmup=20, steps=10**9,
                    buffer_size=100, yield_every=10, evaluate_every=10**9)
    seen = []

    class Spy(benchmark.Training):
        def __init__(self, config):
            super().__init__(config)
            seen.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark, "Training", Spy)
        go_on = benchmark.our_run(config, 10)
    assert (seen[0].step, seen[0].updates) == (20, 0)
    go_on()
    go_on()
    assert (seen[0].step, seen[0].updates) == (40, 20)


def test_the_peer_gets_the_same_work():
    pytest.importorskip("stable_baselines3", reason="the extra `dev` is not installed")
    from stable_baselines3 import DDPG

    config = Config("Pendulum-v1", hidden=(4, 3), batch_size=5, warmup=20, steps=10**9,
                    buffer_size=100, evaluate_every=10**9)
    models = []
    with pytest.MonkeyPatch.context() as patch:
        learn = DDPG.learn
        patch.setattr(DDPG, "learn", lambda self, *a, **k: (models.append(self),
                                                            learn(self, *a, **k)))
        go_on = benchmark.peer_run(config, 10)
        assert (models[0].num_timesteps, models[0]._n_updates) == (20, 0)
        go_on()
        go_on()
    model = models[-1]
    assert (model.num_timesteps, model._n_updates) == (40, 20)
    assert (model.batch_size, model.buffer_size) == (5, 100)
    assert [layer.out_features for layer in model.actor.mu if hasattr(
        layer, "out_features")] == [4, 3, 1]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_all_products_of_an_update_are_found(algorithm):
    """Counted as multiplications, from the layers' sizes (a bias is one more input).

    Of backward's products the one from a single output is none (it is an outer
    product), and neither actor nor critic needs a gradient by the observation.
    """
    config = Config("Pendulum-v1", algorithm, hidden=(7, 5), batch_size=4)
    agent = NumpyAgent(config, 3, 2)
    products = benchmark.products_of(agent, benchmark.random_batch(4, 3, 2))
    found = sum(first.shape[-1] * np.broadcast(first[..., 0, 0], second[..., 0, 0]).size
                * first.shape[-2] * second.shape[-1] for first, second, _ in products)
    critic = (3 + 2 + 1) * 7 + (7 + 1) * 5 + (5 + 1) * 1
    actor = (3 + 1) * 7 + (7 + 1) * 5 + (5 + 1) * 2
    hidden = (7 + 1) * 5
    C, K = config.critics, config.actors
    a_row = (K * actor + C * K * critic  # the slow copies' actions and Q
             + C * (critic + critic + hidden)  # critics: forward, gradients, back
             + K * (actor + critic)  # the actors' actions and their Q
             + K * (hidden + 7 * 2)  # back to the action
             + K * (actor + hidden + (5 + 1) * 2))  # gradients of the actors, back
    assert found == 4 * a_row


def test_watching_an_update_does_not_change_it():
    config = Config("Pendulum-v1", hidden=(7, 5), batch_size=4)
    watched, plain = NumpyAgent(config, 3, 2), NumpyAgent(config, 3, 2)
    batch = benchmark.random_batch(4, 3, 2)
    benchmark.products_of(watched, batch)  # two updates
    plain.update(batch)
    plain.update(batch)
    watched.update(batch)
    plain.update(batch)
    assert type(watched.update(batch)["critic"]) is np.ndarray
    plain.update(batch)
    np.testing.assert_array_equal(watched.q_next(batch.obs), plain.q_next(batch.obs))


def test_everybody_has_one_turn_in_each_round():
    turns = []
    seconds = benchmark.alternate({name: lambda name=name: turns.append(name)
                                   for name in "ABC"}, rounds=2)
    assert turns == ["A", "B", "C", "A", "B", "C"]
    assert {name: len(took) for name, took in seconds.items()} == dict(A=2, B=2, C=2)


def test_no_rounds_is_a_mistake_in_words():
    with pytest.raises(ValueError, match="rounds=0"):
        benchmark.main(["--rounds", "0"])
