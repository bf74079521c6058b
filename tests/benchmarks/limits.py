"""How fast and how large it may be. Only developers run this, on a free machine:

    python -m pytest -s tests/benchmarks/limits.py

The name does not begin with test_, so no other command runs it. A quarter of an hour;
it prints what it measured. Whoever is compared takes turns in one process (see
`benchmark.alternate`), so that a machine that slows down slows everybody down.
"""

import importlib.util
import os
from itertools import count

import pytest
from threadpoolctl import threadpool_limits

from dnddpg_minimal import Config, benchmark, study

ROUNDS = 7
TIMES_THE_PEER = dict(zip(benchmark.SIZES, (5, 2.5, 1.4), strict=True))
MOST_MEMORY = 900  # MB
STORED, STEPS = 100_000, 300  # transitions in replay, steps after that
LEAST_EFFICIENCY = 0.9
RUNS = [study.Run(Config("Pendulum-v1", "DDPG", seed, steps=10_000), "short")
        for seed in range(4)]


def speed_beside_the_peer(size, rounds, warmup=benchmark.WARMUP):
    """Steps a second of our DDPG, in those of the peer's."""
    import torch

    torch.set_num_threads(1)
    starts = benchmark.contestants(*size, warmup)
    with threadpool_limits(1):
        runs = {who: starts["DDPG", who]() for who in ("NumpyAgent", benchmark.PEER)}
        seconds = benchmark.alternate(runs, rounds)
    ours, peers = map(benchmark.median, seconds.values())
    return peers / ours


def parallel_efficiency(runs, folder, rounds):
    """Time with one worker, in that with two, for each of the two: 1 at best."""
    number = count()

    def with_workers(workers):
        place = folder / str(next(number))
        assert study.study(runs, place / "out", place / "in", workers, nice=0) == {}

    seconds = benchmark.alternate({1: lambda: with_workers(1),
                                   2: lambda: with_workers(2)}, rounds)
    one, two = map(benchmark.median, seconds.values())
    return one / (2 * two)


@pytest.mark.skipif(not importlib.util.find_spec("stable_baselines3"),
                    reason="the extra `dev`, which brings the peer, is not installed")
@pytest.mark.parametrize("size", TIMES_THE_PEER,
                         ids=lambda size: f"{size[0]}-{benchmark.shape(size[1])}")
def test_ddpg_is_so_many_times_as_fast_as_the_peers(size):
    times = speed_beside_the_peer(size, ROUNDS)
    print(f"{times:.2f} times the peer")
    assert times >= TIMES_THE_PEER[size]


def test_a_humanoid_run_with_a_full_replay_fits_in_900_mb():
    for *_, megabytes, _, moment in benchmark.peak_memory(STORED, STEPS):
        if megabytes == "-":
            pytest.skip(moment)
        print(f"{megabytes} MB, {moment}")
        assert float(megabytes) < MOST_MEMORY


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two cores")
def test_two_workers_do_nearly_twice_the_work_of_one(tmp_path):
    efficiency = parallel_efficiency(RUNS, tmp_path, rounds=3)
    print(f"efficiency {efficiency:.2f}")
    assert efficiency >= LEAST_EFFICIENCY
